// Plots over time with a line at the frame shown. A click goes to that time.

import uPlot from "/static/uplot/uPlot.esm.js";
import { SELECTED, methodColour, methodDash, pageColour } from "/static/results/colours.js";

const AXES = ["x", "y", "z"];
const FROM_ZERO = { range: (plot, least, most) => [0, 1.05 * most || 1] };
const LEGEND_PX = 30;
const TITLE_PX = 30;

function axis(label) {
  return {
    label,
    labelSize: 16,
    labelGap: 0,
    labelFont: "12px system-ui, sans-serif",
    font: "11px system-ui, sans-serif",
    stroke: pageColour("dim"),
    grid: { stroke: pageColour("grid"), width: 1 },
    ticks: { stroke: pageColour("edge"), width: 1, size: 5 },
    gap: 3,
    values: (_, ticks) => ticks.map((tick) => Number(tick.toPrecision(4))),
  };
}

// A plot in a box with a heading. `series` are uPlot's, `table` the times and the values of each.
class Plot {
  constructor(parent, name, jump) {
    Object.assign(this, { jump, time: 0 });
    this.box = document.createElement("div");
    this.box.className = "plot";
    this.box.dataset.plot = name;
    this.heading = document.createElement("p");
    this.heading.className = "heading";
    this.area = document.createElement("div");
    this.area.className = "area";
    this.box.append(this.heading, this.area);
    parent.append(this.box);
    new ResizeObserver(() => this.plot?.setSize(this.size())).observe(this.box);
  }

  size() {
    const { clientWidth, clientHeight } = this.box;
    const legend = this.legend ? LEGEND_PX : 0;
    return { width: Math.max(clientWidth, 160), height: Math.max(clientHeight - legend - TITLE_PX, 80) };
  }

  draw(label, series, table, { legend = false, fromZero = true } = {}) {
    this.legend = legend;
    this.plot?.destroy();
    this.area.replaceChildren();
    const options = {
      ...this.size(),
      scales: { x: { time: false }, y: fromZero ? FROM_ZERO : {} },
      legend: { show: legend, live: false },
      cursor: { drag: { x: false, y: false }, sync: { key: "time" }, points: { size: 5 } },
      axes: [{ ...axis("time [s]"), size: 26 }, { ...axis(label), size: 46 }],
      series: [{}, ...series.map((one) => ({ spanGaps: false, points: { show: false }, width: 1.5, ...one }))],
      hooks: { draw: [(plot) => this.drawLine(plot)] },
    };
    this.plot = new uPlot(options, table, this.area);
    this.plot.over.addEventListener("click", () => this.jump(this.plot.posToVal(this.plot.cursor.left, "x")));
  }

  show(time) {
    this.time = time;
    this.plot?.redraw(false, false);
  }

  drawLine(plot) {
    const { top, height, left, width } = plot.bbox,
      x = plot.valToPos(this.time, "x", true);
    if (x < left || x > left + width) return;
    plot.ctx.fillStyle = pageColour("text");
    plot.ctx.fillRect(x - 0.75, top, 1.5, height);
  }

  clear(text) {
    this.plot?.destroy();
    this.plot = null;
    this.area.replaceChildren();
    this.area.textContent = text;
  }
}

// The plots of one recording: error by method, error of each marker by one method, and the path of one marker.
export class Plots {
  constructor(parent, jump, chooseMethod, chooseAxis) {
    this.mean = new Plot(parent, "mean", jump);
    this.each = new Plot(parent, "each", jump);
    this.path = new Plot(parent, "path", jump);
    this.mean.heading.textContent = "Mean error of the markers";
    this.methodChoice = choice(this.each.heading, "Error of each marker by ", chooseMethod);
    this.pathText = document.createElement("span");
    this.path.heading.append(this.pathText);
    this.axisChoice = choice(this.path.heading, ", coordinate ", chooseAxis);
    setOptions(this.axisChoice, AXES);
  }

  // `shown` are the methods in the view, `all` those of the run; `curve` is the error over time of the summary.
  load({ motion, curve, all, shown, method, marker, axis: coordinate }) {
    const series = (name) => {
      const index = all.indexOf(name);
      return { label: name, stroke: methodColour(index), dash: methodDash(index) };
    };
    const simulated = shown.filter((name) => curve.errors[name]);
    if (simulated.length) {
      const table = [curve.time, ...simulated.map((name) => curve.errors[name])];
      this.mean.draw("error [mm]", simulated.map(series), table);
    } else this.mean.clear("no method is shown");
    const own = motion?.methods.get(method)?.error;
    setOptions(this.methodChoice, Object.keys(curve.errors), method);
    if (own) {
      const lines = motion.markers.map((name, k) => ({
        label: name,
        stroke: k === marker ? SELECTED : `${series(method).stroke}70`,
        width: k === marker ? 2.5 : 1,
      }));
      // The selected marker comes last, over the others.
      const order = motion.markers.map((_, k) => k).sort((a, b) => (a === marker) - (b === marker));
      const table = [motion.time, ...order.map((k) => column(own, 1, k, 0))];
      this.each.draw("error [mm]", order.map((k) => lines[k]), table);
    } else this.each.clear("no error of markers");
    if (motion && marker >= 0) {
      this.pathText.textContent = `Marker ${motion.markers[marker]}`;
      this.axisChoice.value = AXES[coordinate];
      const paths = shown.filter((name) => motion.methods.get(name)?.markers);
      const columns = [column(motion.recorded, 3, marker, coordinate)];
      for (const name of paths) columns.push(column(motion.methods.get(name).markers, 3, marker, coordinate));
      const recorded = {
        label: "recorded",
        stroke: pageColour("recorded"),
        width: 0,
        points: { show: true, size: 4, fill: pageColour("recorded") },
      };
      const label = `${AXES[coordinate]} [mm]`;
      this.path.draw(label, [recorded, ...paths.map(series)], [motion.time, ...columns], { fromZero: false });
    } else {
      this.pathText.textContent = "Marker";
      this.path.clear("no motion");
    }
  }

  // Of a dataset, which has no simulations.
  hideErrors(hidden) {
    for (const plot of [this.mean, this.each]) plot.box.hidden = hidden;
  }

  show(time) {
    for (const plot of [this.mean, this.each, this.path]) plot.show(time);
  }
}

// The errors over time of all recordings of a dataset's split, in one plot. A click opens the nearest curve's recording.
export class Overview {
  constructor(parent, open) {
    this.plot = new Plot(parent, "curves", (time) => this.choose(time, open));
    this.plot.heading.remove();
  }

  load(recordings, all) {
    this.curves = [];
    for (const { number, curve } of recordings) {
      for (const method of all) if (curve.errors[method]) this.curves.push({ number, method, curve });
    }
    const labelled = new Set();
    const series = this.curves.map(({ method }) => {
      const first = !labelled.has(method);
      labelled.add(method);
      const index = all.indexOf(method);
      return { label: first ? method : "", stroke: methodColour(index), dash: methodDash(index), alpha: 0.75, width: 1 };
    });
    const table = uPlot.join(this.curves.map(({ method, curve }) => [curve.time, curve.errors[method]]));
    this.plot.time = -1;
    this.plot.draw("error [mm]", series, table, { legend: true });
    this.plot.plot.root.querySelectorAll(".u-series").forEach((row) => {
      const label = row.querySelector(".u-label");
      row.hidden = !label.textContent || label.textContent === "Value";
    });
  }

  choose(time, open) {
    const { plot } = this.plot,
      error = plot.posToVal(plot.cursor.top, "y"),
      row = plot.data[0].reduce((best, own, k) => (Math.abs(own - time) < Math.abs(plot.data[0][best] - time) ? k : best), 0);
    let [nearest, least] = [-1, Infinity];
    this.curves.forEach((_, k) => {
      const value = plot.data[k + 1][row];
      if (value != null && Math.abs(value - error) < least) [nearest, least] = [k, Math.abs(value - error)];
    });
    if (nearest >= 0) open(this.curves[nearest].number, time);
  }
}

function column(array, parts, marker, part) {
  const values = [];
  for (let frame = 0; frame < array.frames; frame++) {
    const value = array.values[frame * array.row + parts * marker + part];
    values.push(Number.isNaN(value) ? null : 1e3 * value);
  }
  return values;
}

function choice(parent, label, changed) {
  const around = document.createElement("label"),
    select = document.createElement("select");
  around.append(label, select);
  parent.append(around);
  select.addEventListener("change", () => changed(select.value));
  return select;
}

export function setOptions(select, names, value = names[0]) {
  select.replaceChildren(...names.map((name) => new Option(name, name)));
  select.value = value;
}
