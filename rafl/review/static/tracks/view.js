// One camera's frame with the markers drawn over it: zoom, pan, select, drag.

const COLOURS = { 1: "#5aff7a", 2: "#ffaa28", 3: "#ff5a4a" };
const CHANGED = "#4cc9ff",
  SELECTED = "#ffffff",
  TRAIL = "#3c96ff";
const TRAIL_ROWS = 15,
  REACH_PX = 14;
const ELLIPSES = [60, 200, 0]; // sigmas at which they are drawn

export class CameraView {
  // calls: select(marker, more), move(camera, marker, x, y, hand), click(camera, x, y) -> whether it was used, activate(camera)
  constructor(parent, camera, size, calls) {
    Object.assign(this, {
      camera,
      calls,
      size: size ?? [640, 480],
      scale: 0,
      x: 0,
      y: 0,
      ellipse: 0,
      drag: null,
      image: null,
    });
    this.box = document.createElement("div");
    this.box.className = "camera";
    this.box.dataset.camera = camera;
    this.canvas = document.createElement("canvas");
    this.label = document.createElement("span");
    this.label.className = "label";
    this.box.append(this.canvas, this.label);
    parent.append(this.box);
    this.pen = this.canvas.getContext("2d");
    new ResizeObserver(() => {
      this.scale = 0;
      this.draw();
    }).observe(this.box);
    this.canvas.addEventListener("wheel", (event) => this.onWheel(event), { passive: false });
    this.canvas.addEventListener("pointerdown", (event) => this.onDown(event));
    this.canvas.addEventListener("pointermove", (event) => this.onMove(event));
    this.canvas.addEventListener("pointerup", (event) => this.onUp(event));
  }

  show(image, rows, row, names, selected) {
    Object.assign(this, { image, rows, row, names, selected });
    if (image && image.width && (image.width !== this.size[0] || image.height !== this.size[1])) {
      this.size = [image.width, image.height];
      this.scale = 0;
    }
    this.draw();
  }

  whole() {
    this.scale = 0;
    this.draw();
  }

  fit() {
    const { width, height } = this.canvas;
    this.scale = Math.min(width / this.size[0], height / this.size[1]);
    this.x = (width - this.scale * this.size[0]) / 2;
    this.y = (height - this.scale * this.size[1]) / 2;
  }

  // Pixel (0, 0) of the frame is the centre of its first pixel.
  toCanvas(x, y) {
    return [this.x + this.scale * (x + 0.5), this.y + this.scale * (y + 0.5)];
  }
  toFrame(event) {
    const ratio = this.canvas.width / this.canvas.clientWidth;
    return [(event.offsetX * ratio - this.x) / this.scale - 0.5, (event.offsetY * ratio - this.y) / this.scale - 0.5];
  }

  draw() {
    const ratio = window.devicePixelRatio || 1;
    const width = Math.round(this.box.clientWidth * ratio),
      height = Math.round(this.box.clientHeight * ratio);
    if (!width || !height) return;
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    if (!this.scale) this.fit();
    const pen = this.pen;
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.fillStyle = "#000";
    pen.fillRect(0, 0, width, height);
    const found = this.rows?.at(this.row);
    let text = this.camera;
    if (found) {
      const number = found.block.cameras[this.camera].frame[found.at];
      text += number < 0 ? ": no frame at this time" : `: frame ${number}`;
    }
    if (this.image?.missing) text += ` - ${this.image.missing}`;
    else if (this.image) {
      pen.imageSmoothingEnabled = this.scale < 2;
      pen.drawImage(this.image, this.x, this.y, this.scale * this.image.width, this.scale * this.image.height);
    }
    this.label.textContent = text;
    if (found) this.drawMarkers(found, ratio);
  }

  drawMarkers({ block, at }, ratio) {
    const pen = this.pen,
      values = block.cameras[this.camera],
      count = this.names.length;
    pen.lineWidth = 1.3 * ratio;
    pen.font = `${12 * ratio}px system-ui, sans-serif`;
    for (let marker = 0; marker < count; marker++) {
      const cell = at * count + marker,
        kind = values.kind[cell];
      if (!kind) continue;
      const dragged = this.drag?.marker === marker && this.drag.to;
      const [x, y] = this.toCanvas(...(dragged || [values.pixel[2 * cell], values.pixel[2 * cell + 1]]));
      const isSelected = this.selected.includes(marker);
      this.drawTrail(marker, count);
      pen.strokeStyle = pen.fillStyle = COLOURS[kind];
      if (kind === 3) {
        line(pen, x - 4 * ratio, y - 4 * ratio, x + 4 * ratio, y + 4 * ratio);
        line(pen, x - 4 * ratio, y + 4 * ratio, x + 4 * ratio, y - 4 * ratio);
      } else {
        ring(pen, x, y, 3.5 * ratio, 3.5 * ratio);
        const factor = ELLIPSES[this.ellipse] * this.scale;
        if (factor) ring(pen, x, y, factor * values.sigma[2 * cell], factor * values.sigma[2 * cell + 1]);
      }
      if (block.changed[cell]) {
        pen.strokeStyle = CHANGED;
        pen.strokeRect(x - 7 * ratio, y - 7 * ratio, 14 * ratio, 14 * ratio);
      }
      if (isSelected) {
        pen.strokeStyle = SELECTED;
        ring(pen, x, y, 11 * ratio, 11 * ratio);
        pen.fillStyle = SELECTED;
      }
      pen.strokeStyle = "#000c";
      pen.lineWidth = 3 * ratio;
      pen.strokeText(this.names[marker], x + 9 * ratio, y - 7 * ratio);
      pen.fillText(this.names[marker], x + 9 * ratio, y - 7 * ratio);
      pen.lineWidth = 1.3 * ratio;
    }
  }

  drawTrail(marker, count) {
    const pen = this.pen;
    pen.strokeStyle = TRAIL;
    pen.beginPath();
    let open = false;
    for (let row = Math.max(this.row - TRAIL_ROWS, 0); row <= this.row; row++) {
      const found = this.rows.at(row);
      const values = found?.block.cameras[this.camera],
        cell = found && found.at * count + marker;
      if (!found || (values.kind[cell] !== 1 && values.kind[cell] !== 2)) {
        open = false;
        continue;
      }
      const [x, y] = this.toCanvas(values.pixel[2 * cell], values.pixel[2 * cell + 1]);
      open ? pen.lineTo(x, y) : pen.moveTo(x, y);
      open = true;
    }
    pen.stroke();
  }

  // The marker nearest to a position of the frame; -1 if none is near.
  markerAt(x, y) {
    const found = this.rows?.at(this.row);
    if (!found) return -1;
    const values = found.block.cameras[this.camera],
      count = this.names.length;
    let best = -1,
      least = (REACH_PX * (window.devicePixelRatio || 1)) / this.scale;
    for (let marker = 0; marker < count; marker++) {
      const cell = found.at * count + marker;
      const distance = Math.hypot(values.pixel[2 * cell] - x, values.pixel[2 * cell + 1] - y);
      if (values.kind[cell] && distance < least) [best, least] = [marker, distance];
    }
    return best;
  }

  onWheel(event) {
    event.preventDefault();
    const [x, y] = this.toFrame(event),
      factor = Math.exp(-0.0015 * event.deltaY);
    const before = this.toCanvas(x, y);
    this.scale = Math.min(Math.max(this.scale * factor, 0.02), 80);
    const after = this.toCanvas(x, y);
    this.x += before[0] - after[0];
    this.y += before[1] - after[1];
    this.draw();
  }

  onDown(event) {
    if (event.button !== 0) return;
    const [x, y] = this.toFrame(event);
    this.calls.activate(this.camera);
    if (this.calls.click(this.camera, x, y)) return;
    this.canvas.setPointerCapture(event.pointerId);
    this.drag = {
      marker: this.markerAt(x, y),
      from: [event.clientX, event.clientY],
      origin: [this.x, this.y],
      to: null,
      moved: false,
    };
  }

  onMove(event) {
    if (!this.drag) return;
    const ratio = this.canvas.width / this.canvas.clientWidth;
    const dx = event.clientX - this.drag.from[0],
      dy = event.clientY - this.drag.from[1];
    this.drag.moved ||= Math.hypot(dx, dy) > 3;
    if (!this.drag.moved) return;
    if (this.drag.marker >= 0) this.drag.to = this.toFrame(event);
    else {
      this.x = this.drag.origin[0] + dx * ratio;
      this.y = this.drag.origin[1] + dy * ratio;
    }
    this.draw();
  }

  onUp(event) {
    const drag = this.drag;
    this.drag = null;
    if (!drag) return;
    if (!drag.moved) this.calls.select(drag.marker, event.shiftKey);
    else if (drag.marker >= 0) this.calls.move(this.camera, drag.marker, ...drag.to, event.shiftKey);
    this.draw();
  }
}

function line(pen, x1, y1, x2, y2) {
  pen.beginPath();
  pen.moveTo(x1, y1);
  pen.lineTo(x2, y2);
  pen.stroke();
}

function ring(pen, x, y, a, b) {
  if (!(a > 0 && b > 0)) return;
  pen.beginPath();
  pen.ellipse(x, y, a, b, 0, 0, 2 * Math.PI);
  pen.stroke();
}
