// Plots of the selected marker over time, with a line at the frame shown. A click jumps there.

import uPlot from "/static/uplot/uPlot.esm.js";
import { getArray } from "/static/api.js";

const AXIS = {
  stroke: "#9aa4af",
  grid: { stroke: "#2c3137" },
  ticks: { stroke: "#3a3f46" },
  font: "11px system-ui",
  values: (_, ticks) => ticks.map((tick) => Number(tick.toPrecision(4))),
};
const LABEL = { labelSize: 16, labelGap: 0, labelFont: "11px system-ui" };
const PLOTS = [
  {
    key: "path",
    share: 1.0,
    left: "x, y, z [mm]",
    right: "u, v [px]",
    series: [
      ["x [mm]", "#ff8f6b"],
      ["y [mm]", "#5aff7a"],
      ["z [mm]", "#6bb8ff"],
      ["u [px]", "#d5a6ff"],
      ["v [px]", "#ffe36b"],
    ],
  },
  { key: "residual", share: 0.5, left: "residual [px]", series: [["residual [px]", "#ff8f6b"]] },
  {
    key: "sigma",
    share: 0.5,
    left: "sigma [px]",
    right: "sigma [mm]",
    series: [
      ["sigma [px]", "#6bb8ff"],
      ["sigma [mm]", "#5aff7a"],
    ],
  },
];
const FROM_ZERO = { range: (plot, least, most) => [0, 1.1 * most || 1] };
const LEGEND_PX = 28; // below each plot
const BANDS = { 0: "#ff5a4a33", 2: "#ffaa2833" }; // missing, filled

export class Plots {
  constructor(parent, rows, jump) {
    Object.assign(this, { parent, rows, jump, row: 0, state: null, plots: [] });
    this.x = Float64Array.from({ length: rows }, (_, row) => row);
    for (const { key, series, left, right } of PLOTS) {
      const options = {
        ...this.size(key),
        scales: {
          x: { time: false, range: [0, Math.max(rows - 1, 1)] },
          ...(key === "path" ? {} : { y: FROM_ZERO, second: FROM_ZERO }),
        },
        legend: { live: false },
        cursor: { drag: { x: false, y: false }, sync: { key: "row" }, points: { size: 4 } },
        axes: [
          { ...AXIS, size: 20, gap: 2, label: "row", ...LABEL },
          { ...AXIS, size: 48, space: 24, label: left, ...LABEL },
          ...(right
            ? [{ ...AXIS, size: 48, side: 1, space: 24, scale: "second", grid: { show: false }, label: right, ...LABEL }]
            : []),
        ],
        series: [
          {},
          ...series.map(([label, stroke]) => ({
            label,
            stroke,
            width: 1.2,
            spanGaps: false,
            points: { show: false },
            scale: this.scaleOf(key, label),
          })),
        ],
        hooks: { drawClear: [(plot) => this.drawBands(plot)], draw: [(plot) => this.drawLine(plot)] },
      };
      const box = document.createElement("div");
      box.className = `plot ${key}`;
      parent.append(box);
      const plot = new uPlot(options, [this.x, ...series.map(() => new Array(rows).fill(null))], box);
      plot.root.dataset.plot = key;
      plot.over.addEventListener("click", () => this.jump(Math.round(plot.posToVal(plot.cursor.left, "x"))));
      this.plots.push(plot);
    }
    new ResizeObserver(() => this.plots.forEach((plot, k) => plot.setSize(this.size(PLOTS[k].key)))).observe(parent);
  }

  scaleOf(key, label) {
    return (key === "path" && label.endsWith("[px]")) || (key === "sigma" && label.endsWith("[mm]")) ? "second" : "y";
  }

  size(key) {
    const { share } = PLOTS.find((plot) => plot.key === key);
    return {
      width: Math.max(Math.floor(this.parent.clientWidth / 2) - 6, 200),
      height: Math.max(Math.round(share * this.parent.clientHeight) - LEGEND_PX, 50),
    };
  }

  async load(name, marker, camera, title) {
    const values = await getArray("series", { name, marker, camera });
    const column = (k) =>
      Array.from(values.subarray(k * this.rows, (k + 1) * this.rows), (v) => (Number.isFinite(v) ? v : null));
    const [x, y, z, sigmaMm, u, v, sigmaPx, residual, state] = Array.from({ length: 9 }, (_, k) => column(k));
    this.state = state;
    document.querySelector("#plotted").textContent = title;
    [[x, y, z, u, v], [residual], [sigmaPx, sigmaMm]].forEach((data, k) => this.plots[k].setData([this.x, ...data]));
  }

  show(row) {
    this.row = row;
    for (const plot of this.plots) plot.redraw(false, false);
  }

  drawBands(plot) {
    if (!this.state) return;
    const { left, top, width, height } = plot.bbox;
    for (let row = 0; row < this.rows;) {
      let end = row + 1;
      while (end < this.rows && this.state[end] === this.state[row]) end++;
      if (BANDS[this.state[row]]) {
        const from = Math.max(plot.valToPos(row - 0.5, "x", true), left),
          to = Math.min(plot.valToPos(end - 0.5, "x", true), left + width);
        plot.ctx.fillStyle = BANDS[this.state[row]];
        if (to > from) plot.ctx.fillRect(from, top, Math.max(to - from, 1), height);
      }
      row = end;
    }
  }

  drawLine(plot) {
    if (plot.root.dataset.plot === "residual" && this.state && plot.data[1].every((value) => value === null)) {
      plot.ctx.fillStyle = AXIS.stroke;
      plot.ctx.save();
      plot.ctx.textAlign = "left";
      plot.ctx.fillText("no other camera sees this marker", plot.bbox.left + 10, plot.bbox.top + plot.bbox.height / 2);
      plot.ctx.restore();
    }
    const { top, height, left, width } = plot.bbox,
      x = plot.valToPos(this.row, "x", true);
    if (x < left || x > left + width) return;
    plot.ctx.fillStyle = "#fffc";
    plot.ctx.fillRect(x - 0.5, top, 1.5, height);
  }
}
