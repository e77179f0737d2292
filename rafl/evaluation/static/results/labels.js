// What is written over the 3-D view: names of the panels, axes, the selected marker, the colour scale and the time.

import { COLOURINGS, SELECTED, niceBelow, pageColour, viridisGradient } from "/static/results/colours.js";
import { frameOf } from "/static/results/source.js";

const AXES = 0.35; // length, at most, in the radius of what is shown
const BAR = { width: 180, height: 10 }; // of the colour scale [px]
const FONT = "px system-ui, sans-serif";

export function drawLabels(scene, panels) {
  const pen = scene.labels.getContext("2d"),
    { clientWidth, clientHeight } = scene.labels.parentElement;
  pen.setTransform(scene.ratio, 0, 0, scene.ratio, 0, 0);
  pen.clearRect(0, 0, clientWidth, clientHeight);
  const text = pageColour("text"),
    dim = pageColour("dim");
  const { text: words, colouring, marker } = scene.state;
  const write = (line, x, y, colour = text, size = 13, align = "left") => {
    pen.font = size + FONT;
    pen.textAlign = align;
    pen.lineWidth = 3;
    pen.strokeStyle = pageColour("scene");
    pen.strokeText(line, x, y);
    pen.fillStyle = colour;
    pen.fillText(line, x, y);
  };
  pen.lineJoin = "round";
  pen.strokeStyle = pageColour("edge");
  for (const { left, top, width, height } of panels) pen.strokeRect(left + 0.5, top + 0.5, width, height);
  if (!scene.motion) return write(words.missing ?? "", 12, 40, dim);
  const length = niceBelow(1e3 * AXES * scene.radius) / 1e3;
  for (const panel of panels) {
    let y = panel.top + 20;
    for (const method of panel.methods) {
      write(words.panels?.[method] ?? method, panel.left + 12, y, words.colours?.[method] ?? text);
      y += 18;
    }
    if (!panel.methods.length) write("recorded markers", panel.left + 12, y, text);
    drawAxes(scene, pen, panel, length, write, dim);
    if (marker >= 0) {
      const point = frameOf(scene.motion.recorded, scene.frame).subarray(3 * marker, 3 * marker + 3);
      if (!Number.isNaN(point[0])) {
        const [u, v] = scene.project(point, panel);
        write(scene.motion.markers[marker], u + 10, v - 8, SELECTED);
      }
    }
  }
  write(`${words.recording ?? ""}, ${words.time ?? ""}`, clientWidth - 12, clientHeight - 12, text, 13, "right");
  if (COLOURINGS[colouring]) drawScale(scene, pen, COLOURINGS[colouring], clientHeight, write, text);
}

// Axes at the origin of the specimen's frame, all of one length.
function drawAxes(scene, pen, panel, length, write, colour) {
  const [u, v] = scene.project([0, 0, 0], panel);
  ["x", "y", "z"].forEach((name, k) => {
    const end = [0, 0, 0];
    end[k] = length;
    const [x, y] = scene.project(end, panel);
    pen.strokeStyle = colour;
    pen.lineWidth = 1.5;
    pen.beginPath();
    pen.moveTo(u, v);
    pen.lineTo(x, y);
    pen.stroke();
    if (Math.hypot(x - u, y - v) > 8) write(name, x + 3, y - 3, colour, 12);
  });
  const right = panel.left + panel.width - 12;
  write(`axes ${Number((1e3 * length).toPrecision(2))} mm long`, right, panel.top + panel.height - 30, colour, 12, "right");
}

function drawScale(scene, pen, { label, unit, factor }, height, write, colour) {
  const [left, top, most] = [14, height - 32, factor * scene.most()];
  if (!most) return write(`${label}: none of the methods has one`, left, top, colour, 12);
  pen.fillStyle = viridisGradient(pen, left, left + BAR.width);
  pen.fillRect(left, top, BAR.width, BAR.height);
  write(`${label} [${unit}]`, left, top - 6, colour, 12);
  for (const share of [0, 0.5, 1]) {
    const align = share === 0 ? "left" : share === 1 ? "right" : "center";
    const value = Number((share * most).toPrecision(3));
    write(String(value), left + share * BAR.width, top + BAR.height + 14, colour, 12, align);
  }
}
