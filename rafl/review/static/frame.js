// A frame or image on a canvas with what is drawn over it: zoom, pan, and the way from pixels to the screen.

const LEAST_SCALE = 0.02,
  LARGEST_SCALE = 80,
  CLICK_PX = 3; // a pointer that moves farther drags

// What a subclass draws is `drawOver(pen, ratio)`. What it can hold and drag is `grab(x, y)`, -1 where there is nothing;
// a press that it uses itself is `pressed(x, y, event)`; a press and release without a drag `clicked(held, event, x, y)`;
// the end of a drag of what it holds `dropped(held, event, to)`.
export class FrameView {
  constructor(parent, camera, size) {
    Object.assign(this, { camera, size: size ?? [640, 480], scale: 0, x: 0, y: 0, drag: null, image: null });
    this.box = document.createElement("div");
    this.box.className = "camera";
    this.box.dataset.camera = camera;
    this.canvas = document.createElement("canvas");
    this.label = document.createElement("span");
    this.label.className = "label";
    this.box.append(this.canvas, this.label);
    parent.append(this.box);
    this.pen = this.canvas.getContext("2d");
    new ResizeObserver(() => this.whole()).observe(this.box);
    this.canvas.addEventListener("wheel", (event) => this.onWheel(event), { passive: false });
    this.canvas.addEventListener("pointerdown", (event) => this.onDown(event));
    this.canvas.addEventListener("pointermove", (event) => this.onMove(event));
    this.canvas.addEventListener("pointerup", (event) => this.onUp(event));
  }

  drawOver() {}
  grab() {
    return -1;
  }
  pressed() {
    return false;
  }
  clicked() {}
  dropped() {}

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
    if (this.image?.width) {
      pen.imageSmoothingEnabled = this.scale < 2;
      pen.drawImage(this.image, this.x, this.y, this.scale * this.size[0], this.scale * this.size[1]);
    }
    this.drawOver(pen, ratio);
  }

  onWheel(event) {
    event.preventDefault();
    const [x, y] = this.toFrame(event),
      factor = Math.exp(-0.0015 * event.deltaY);
    const before = this.toCanvas(x, y);
    this.scale = Math.min(Math.max(this.scale * factor, LEAST_SCALE), LARGEST_SCALE);
    const after = this.toCanvas(x, y);
    this.x += before[0] - after[0];
    this.y += before[1] - after[1];
    this.draw();
  }

  onDown(event) {
    if (event.button !== 0) return;
    const [x, y] = this.toFrame(event);
    if (this.pressed(x, y, event)) return;
    this.canvas.setPointerCapture(event.pointerId);
    const from = [event.clientX, event.clientY];
    this.drag = { held: this.grab(x, y), from, origin: [this.x, this.y], to: null, moved: false };
  }

  onMove(event) {
    if (!this.drag) return;
    const ratio = this.canvas.width / this.canvas.clientWidth;
    const dx = event.clientX - this.drag.from[0],
      dy = event.clientY - this.drag.from[1];
    this.drag.moved ||= Math.hypot(dx, dy) > CLICK_PX;
    if (!this.drag.moved) return;
    if (this.drag.held >= 0) this.drag.to = this.toFrame(event);
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
    if (!drag.moved) this.clicked(drag.held, event, ...this.toFrame(event));
    else if (drag.held >= 0) this.dropped(drag.held, event, drag.to);
    this.draw();
  }
}

export function line(pen, x1, y1, x2, y2) {
  pen.beginPath();
  pen.moveTo(x1, y1);
  pen.lineTo(x2, y2);
  pen.stroke();
}

export function ring(pen, x, y, a, b) {
  if (!(a > 0 && b > 0)) return;
  pen.beginPath();
  pen.ellipse(x, y, a, b, 0, 0, 2 * Math.PI);
  pen.stroke();
}

// A text with a dark edge, so that it can be read over any image.
export function label(pen, text, x, y, ratio) {
  const { strokeStyle, lineWidth } = pen;
  pen.strokeStyle = "#000c";
  pen.lineWidth = 3 * ratio;
  pen.strokeText(text, x, y);
  pen.fillText(text, x, y);
  Object.assign(pen, { strokeStyle, lineWidth });
}
