// One camera's frame with the markers drawn over it: select, drag.

import { FrameView, label, line, ring } from "/static/frame.js";

const COLOURS = { 1: "#5aff7a", 2: "#ffaa28", 3: "#ff5a4a" };
const CHANGED = "#4cc9ff",
  SELECTED = "#ffffff",
  TRAIL = "#3c96ff";
const TRAIL_ROWS = 15,
  REACH_PX = 14;
export const ELLIPSES = [60, 200, 0]; // sigmas at which they are drawn

export class CameraView extends FrameView {
  // calls: select(marker, more), move(camera, marker, x, y, hand), click(camera, x, y) -> whether it was used, activate(camera)
  constructor(parent, camera, size, calls) {
    super(parent, camera, size);
    Object.assign(this, { calls, ellipse: 0 });
  }

  show(image, rows, row, names, selected) {
    Object.assign(this, { image, rows, row, names, selected });
    if (image && image.width && (image.width !== this.size[0] || image.height !== this.size[1])) {
      this.size = [image.width, image.height];
      this.scale = 0;
    }
    this.draw();
  }

  drawOver(pen, ratio) {
    const found = this.rows?.at(this.row);
    let text = this.camera;
    if (found) {
      const number = found.block.cameras[this.camera].frame[found.at];
      text += number < 0 ? ": no frame at this time" : `: frame ${number}`;
    }
    if (this.image?.missing) text += ` - ${this.image.missing}`;
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
      const dragged = this.drag?.held === marker && this.drag.to;
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
      label(pen, this.names[marker], x + 9 * ratio, y - 7 * ratio, ratio);
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
  grab(x, y) {
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

  pressed(x, y) {
    this.calls.activate(this.camera);
    return this.calls.click(this.camera, x, y);
  }

  clicked(marker, event) {
    this.calls.select(marker, event.shiftKey);
  }

  dropped(marker, event, to) {
    this.calls.move(this.camera, marker, ...to, event.shiftKey);
  }
}
