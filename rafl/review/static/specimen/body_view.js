// One camera's frame of a specimen at rest: its dots, the corners that were clicked on, and the outline of the body.

import { FrameView, label, line, ring } from "/static/frame.js";

const DOT = "#5aff7a",
  LEFT_OUT = "#9aa4af",
  CORNER = "#ffe36b",
  OUTLINE = "#4cc9ff";
const REACH_PX = 12;
export const CORNERS = 4;

export class BodyView extends FrameView {
  // changed(): corners were added or moved
  constructor(parent, camera, size, changed) {
    super(parent, camera, size);
    Object.assign(this, { changed, corners: [], dots: [], outline: [] });
  }

  // dots: name, which may be empty, x, y [px], whether it is left out
  show(image, dots) {
    Object.assign(this, { image, dots });
    if (image?.width && (image.width !== this.size[0] || image.height !== this.size[1])) {
      this.size = [image.width, image.height];
      this.scale = 0;
    }
    this.draw();
  }

  clear() {
    this.corners = [];
    this.outline = [];
    this.draw();
  }

  grab(x, y) {
    const reach = (REACH_PX * (window.devicePixelRatio || 1)) / this.scale;
    return this.corners.findIndex(([u, v]) => Math.hypot(u - x, v - y) < reach);
  }

  clicked(held, event, x, y) {
    if (held >= 0 || this.corners.length === CORNERS) return;
    this.corners.push([x, y]);
    this.changed();
  }

  dropped(held, event, to) {
    this.corners[held] = to;
    this.changed();
  }

  drawOver(pen, ratio) {
    pen.font = `${12 * ratio}px system-ui, sans-serif`;
    pen.lineWidth = 1.3 * ratio;
    this.label.textContent = this.camera + (this.image?.missing ? ` - ${this.image.missing}` : "");
    for (const { name, x: u, y: v, out } of this.dots) {
      const [x, y] = this.toCanvas(u, v);
      pen.strokeStyle = pen.fillStyle = out ? LEFT_OUT : DOT;
      ring(pen, x, y, 5 * ratio, 5 * ratio);
      if (name) label(pen, name, x + 7 * ratio, y - 6 * ratio, ratio);
    }
    pen.strokeStyle = OUTLINE;
    for (const edge of this.outline) {
      pen.beginPath();
      edge.forEach(([u, v], k) => {
        const [x, y] = this.toCanvas(u, v);
        k ? pen.lineTo(x, y) : pen.moveTo(x, y);
      });
      pen.stroke();
    }
    pen.strokeStyle = CORNER;
    pen.lineWidth = 2 * ratio;
    this.corners.forEach((corner, number) => {
      const [x, y] = this.toCanvas(...((this.drag?.held === number && this.drag.to) || corner)),
        arm = 9 * ratio;
      line(pen, x - arm, y, x + arm, y);
      line(pen, x, y - arm, x, y + arm);
    });
  }
}
