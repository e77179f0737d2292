// A board image with what was found and computed drawn over it.

import { FrameView, label, line, ring } from "/static/frame.js";

const CORNER = "#5aff7a",
  ARROW = "#ffaa28",
  FAR = "#ff5a4a",
  GRID = "#4cc9ff",
  ORIGIN = "#ffe36b",
  BARE = "#ff5a4a30";
const AXES = { x: "#ff6b6b", y: "#5aff7a", z: "#6b9cff" };
const FAR_SIGMAS = 4; // of a residual, relative to that of the camera: a point this far off is drawn in red
const LEGEND_PX = 80; // longest arrow of the legend

export class BoardView extends FrameView {
  constructor(parent) {
    super(parent, "");
    this.shown = null;
  }

  // shown: camera, name, boards, coverage, magnification, options
  take(shown) {
    const [width, height] = shown.camera.size;
    if (width !== this.size[0] || height !== this.size[1]) {
      this.size = [width, height];
      this.scale = 0;
    }
    if (shown.name !== this.shown?.name || shown.camera !== this.shown?.camera) this.image = null;
    this.shown = shown;
    this.draw();
  }

  show(image) {
    this.image = image;
    this.draw();
  }

  drawOver(pen, ratio) {
    if (!this.shown) return;
    const { camera, name, boards, coverage, magnification, options } = this.shown;
    pen.font = `${12 * ratio}px system-ui, sans-serif`;
    pen.lineWidth = 1.3 * ratio;
    const whole = name === "";
    if (whole) {
      const [left, top] = this.toCanvas(-0.5, -0.5);
      pen.fillStyle = "#22262b";
      pen.fillRect(left, top, this.scale * this.size[0], this.scale * this.size[1]);
    }
    if (coverage) this.drawBare(pen, coverage.cells);
    if (options.plane) this.drawPlane(pen, ratio, camera.grid);
    for (const board of boards) this.drawBoard(pen, ratio, board, magnification, options, camera.residual);
    const [board] = boards;
    let text = whole ? `${camera.name}: all ${camera.images.length} images` : name;
    if (!whole && !board) text += ": looking for the board ...";
    else if (!whole && board.reason) text += `: not used: ${board.reason}`;
    if (this.image?.missing) text += ` - ${this.image.missing}`;
    this.label.textContent = text;
    this.drawLegend(pen, ratio, magnification);
  }

  // Cells of the image where no board was.
  drawBare(pen, cells) {
    pen.fillStyle = BARE;
    const height = this.size[1] / cells.length,
      width = this.size[0] / cells[0].length;
    cells.forEach((row, r) =>
      row.forEach((covered, c) => {
        if (covered) return;
        const [x, y] = this.toCanvas(c * width - 0.5, r * height - 0.5);
        pen.fillRect(x, y, this.scale * width, this.scale * height);
      }),
    );
  }

  trace(pen, path) {
    pen.beginPath();
    path.forEach(([u, v], k) => {
      const [x, y] = this.toCanvas(u, v);
      k ? pen.lineTo(x, y) : pen.moveTo(x, y);
    });
    pen.stroke();
  }

  drawPlane(pen, ratio, grid) {
    pen.strokeStyle = pen.fillStyle = GRID;
    for (const { axis, value, path } of grid.lines) {
      pen.globalAlpha = value === 0 ? 0.9 : 0.4;
      pen.lineWidth = (value === 0 ? 1.6 : 1) * ratio;
      this.trace(pen, path);
      pen.globalAlpha = 1;
      const seen = path.map(([u, v]) => this.toCanvas(u, v)).filter((point) => this.isInside(point, ratio));
      if (!seen.length) continue;
      const upright = Math.abs(path.at(-1)[1] - path[0][1]) > Math.abs(path.at(-1)[0] - path[0][0]);
      // Upright lines are named at the top of the image, the others at its left.
      const [x, y] = seen.reduce((one, other) => ((upright ? other[1] < one[1] : other[0] < one[0]) ? other : one));
      label(pen, `${axis} ${value}`, x + 3 * ratio, upright ? y + 11 * ratio : y - 3 * ratio, ratio);
    }
    for (const [axis, path] of Object.entries(grid.axes)) {
      pen.strokeStyle = pen.fillStyle = AXES[axis];
      pen.lineWidth = 3 * ratio;
      this.trace(pen, path);
      const [x, y] = this.toCanvas(...path.at(-1)),
        [startX, startY] = this.toCanvas(...path[0]);
      // An axis along the line of sight is a point.
      if (Math.hypot(x - startX, y - startY) > 8 * ratio) label(pen, `${axis} ${grid.length} mm`, x + 5 * ratio, y - 5 * ratio, ratio);
    }
  }

  isInside([x, y], ratio) {
    const edge = 12 * ratio,
      [left, top] = this.toCanvas(-0.5, -0.5),
      right = left + this.scale * this.size[0],
      bottom = top + this.scale * this.size[1];
    return (
      x >= Math.max(left, 0) &&
      y >= Math.max(top, 0) + edge &&
      x <= Math.min(right, this.canvas.width) - edge &&
      y <= Math.min(bottom, this.canvas.height)
    );
  }

  drawBoard(pen, ratio, board, magnification, options, usual) {
    pen.lineWidth = 1.5 * ratio;
    board.pixels.forEach(([u, v], k) => {
      const [x, y] = this.toCanvas(u, v),
        residual = board.residual?.[k];
      pen.strokeStyle = board.residual ? CORNER : FAR;
      if (options.corners) ring(pen, x, y, 3.5 * ratio, 3.5 * ratio);
      if (!residual) return;
      pen.strokeStyle = Math.hypot(...residual) > FAR_SIGMAS * Math.SQRT2 * usual ? FAR : ARROW;
      const [dx, dy] = residual.map((value) => value * magnification * this.scale);
      arrow(pen, x, y, x + dx, y + dy, 5 * ratio);
    });
    if (board.origin && options.plane) {
      const [x, y] = this.toCanvas(...board.origin),
        arm = 8 * ratio;
      pen.strokeStyle = pen.fillStyle = ORIGIN;
      pen.lineWidth = 2 * ratio;
      line(pen, x - arm, y - arm, x + arm, y + arm);
      line(pen, x - arm, y + arm, x + arm, y - arm);
      label(pen, "board's origin", x + 11 * ratio, y + 15 * ratio, ratio);
    }
  }

  // An arrow of a round length, as residuals are drawn.
  drawLegend(pen, ratio, magnification) {
    const longest = (LEGEND_PX * ratio) / (magnification * this.scale);
    const power = 10 ** Math.floor(Math.log10(longest));
    const length = [5, 2, 1].find((step) => step * power <= longest) * power;
    const y = this.canvas.height - 14 * ratio,
      x = 12 * ratio;
    const text = `residual of ${Number(length.toPrecision(1))} px, × ${magnification}`;
    pen.fillStyle = "#000a";
    const end = x + length * magnification * this.scale;
    pen.fillRect(x - 6 * ratio, y - 13 * ratio, end - x + pen.measureText(text).width + 22 * ratio, 24 * ratio);
    pen.strokeStyle = pen.fillStyle = ARROW;
    pen.lineWidth = 1.5 * ratio;
    arrow(pen, x, y, end, y, 5 * ratio);
    pen.fillStyle = "#e6e9ec";
    pen.fillText(text, end + 8 * ratio, y + 4 * ratio);
  }
}

function arrow(pen, x1, y1, x2, y2, head) {
  line(pen, x1, y1, x2, y2);
  const angle = Math.atan2(y2 - y1, x2 - x1),
    size = Math.min(head, Math.hypot(x2 - x1, y2 - y1) / 2);
  for (const turn of [2.6, -2.6]) line(pen, x2, y2, x2 + size * Math.cos(angle + turn), y2 + size * Math.sin(angle + turn));
}
