// The numbers beside a board image: of the camera, of all images, and a histogram of the residuals.

const LARGE_RATIO = 2.5, // of an image's residual to the usual one of its camera, from which it is called large
  LARGE_PX = 0.1; // and the least that is
const BINS = 41;
const $ = (selector) => document.querySelector(selector);

function row(...texts) {
  const found = document.createElement("tr");
  found.append(...texts.map((text) => Object.assign(document.createElement("td"), { textContent: text })));
  return found;
}

function median(values) {
  const sorted = [...values].sort((one, other) => one - other);
  return sorted[Math.floor(sorted.length / 2)] ?? 0;
}

export function listFacts(camera, boards, coverage) {
  const examined = camera.images.map((name) => boards[name]).filter(Boolean);
  const found = examined.filter((board) => !board.reason);
  const residuals = found.flatMap((board) => board.residual);
  const squares = residuals.reduce((sum, [u, v]) => sum + u * u + v * v, 0);
  const rms = Math.sqrt(squares / (2 * residuals.length || 1));
  const largest = residuals.reduce((most, residual) => Math.max(most, Math.hypot(...residual)), 0);
  const waiting = camera.images.length - examined.length;
  const rows = [
    ["model", `${camera.model}, ${camera.size[0]} × ${camera.size[1]} px`],
    ["boards", `found in ${found.length} of ${examined.length} images${waiting ? `, ${waiting} to examine` : ""}`],
    ["points", `${residuals.length}`],
    ["residual", residuals.length ? `${rms.toFixed(3)} px RMS, largest ${largest.toFixed(3)} px` : "none"],
    ["in calib.yaml", `${camera.residual.toFixed(3)} px`],
    ["covered", coverage ? `${(100 * coverage.share).toFixed(0)} % of the image` : "..."],
    ["plane", camera.plane ?? "none in calib.yaml"],
    ["grid", camera.grid.reason || `lines on the plane every ${camera.grid.spacing} mm`],
  ];
  $("#facts").replaceChildren(...rows.map((texts) => row(...texts)));
  $("#legend").textContent =
    "Circles: corners found. Arrows: from where the calibration expects a corner to where it was found, red if more than four times the usual. Red area of `all images`: no board was there. Blue lines: the plane of the markers that only this camera sees.";
}

// Why an image deserves a look; empty if it does not.
function remark(board, usual) {
  if (!board) return "";
  if (board.reason) return `not used: ${board.reason}`;
  const remarks = [];
  if (board.rms > Math.max(LARGE_RATIO * usual, LARGE_PX)) {
    if (board.known && board.rms > LARGE_RATIO * board.best)
      remarks.push(
        `the pose in board.yaml does not fit: ${board.rms.toFixed(2)} px there, ${board.best.toFixed(2)} px where it fits best`,
      );
    else remarks.push("large residual");
  }
  if (board.known) remarks.push(`pose in board.yaml${board.off_plane === undefined ? "" : `, ${board.off_plane.toFixed(1)} mm off the plane`}`);
  return remarks.join("; ");
}

export function listImages(camera, boards, current, choose) {
  const usual = median(camera.images.map((name) => boards[name]?.best).filter(Boolean));
  const all = row("all images", "", "", "", "");
  all.addEventListener("click", () => choose(""));
  all.classList.toggle("current", current === "");
  const rows = [all];
  for (const name of camera.images) {
    const board = boards[name],
      served = board && !board.reason;
    const entry = row(
      name.slice(name.indexOf("/") + 1),
      board ? board.pixels.length : "...",
      served ? board.rms.toFixed(3) : "",
      served ? board.largest.toFixed(2) : "",
      served ? `${board.tilt.toFixed(0)}°` : "",
    );
    entry.dataset.name = name;
    const text = remark(board, usual);
    const large = served && board.rms > Math.max(LARGE_RATIO * usual, LARGE_PX);
    entry.classList.toggle("current", name === current);
    entry.classList.toggle("large", Boolean(large || board?.reason));
    entry.addEventListener("click", () => choose(name));
    rows.push(entry);
    if (text) {
      const below = row(text);
      below.className = `remark${entry.classList.contains("large") ? " large" : ""}`;
      below.cells[0].colSpan = 5;
      below.addEventListener("click", () => choose(name));
      rows.push(below);
    }
  }
  const before = $("#images .current")?.dataset.name;
  $("#images").replaceChildren(...rows);
  if (before !== current) $("#images .current")?.scrollIntoView({ block: "nearest" });
}

// How many coordinates have which residual, of the boards that are shown.
export function drawHistogram(canvas, boards) {
  const pen = canvas.getContext("2d"),
    { width, height } = canvas;
  pen.clearRect(0, 0, width, height);
  const values = boards.flatMap((board) => (board.residual ?? []).flat());
  if (!values.length) return;
  const sizes = values.map(Math.abs).sort((one, other) => one - other);
  const limit = 1.1 * sizes[Math.floor(0.99 * (sizes.length - 1))] || 1;
  const counts = new Array(BINS).fill(0);
  for (const value of values) {
    const bin = Math.floor(((value + limit) / (2 * limit)) * BINS);
    counts[Math.min(Math.max(bin, 0), BINS - 1)] += 1; // the ends hold what lies beyond
  }
  const most = Math.max(...counts),
    base = height - 18;
  pen.fillStyle = "#ffaa28";
  counts.forEach((count, k) => {
    const bar = (count / most) * (base - 4);
    pen.fillRect((k * width) / BINS, base - bar, width / BINS - 1, bar);
  });
  pen.fillStyle = "#9aa4af";
  pen.font = "11px system-ui, sans-serif";
  pen.textAlign = "left";
  pen.fillText(`-${limit.toPrecision(2)} px`, 0, height - 4);
  pen.textAlign = "center";
  pen.fillText("residual of a coordinate", width / 2, height - 4);
  pen.textAlign = "right";
  pen.fillText(`${limit.toPrecision(2)} px`, width, height - 4);
}
