// A calibration: a camera's images with corners, residuals, coverage, plane and axes, and what their numbers say.

import { get } from "/static/api.js";
import { BoardView } from "/static/calibration/board_view.js";
import { listFacts, listImages, drawHistogram } from "/static/calibration/panels.js";

const MAGNIFICATIONS = [10, 20, 50, 100, 200, 500, 1000, 2000];
const AUTO = "auto";
const ARROW_PX = 60; // of the largest usual arrow
const IMAGES = 24; // kept
const ALL = ""; // the name under which all images of a camera are shown together
const $ = (selector) => document.querySelector(selector);

class Calibration {
  async start() {
    Object.assign(this, { boards: {}, coverage: {}, kept: new Map(), camera: "", name: ALL, wanted: 0 });
    this.about = await get("calibration");
    $("#title").textContent = this.about.file;
    $("#folder").textContent = `board images in ${this.about.folder}`;
    document.title = `${this.about.file} - rafl-review`;
    this.view = new BoardView($("#cameras"));
    $("#tabs").replaceChildren(
      ...this.about.cameras.map(({ name }) => {
        const tab = Object.assign(document.createElement("button"), { textContent: name });
        tab.addEventListener("click", () => this.showCamera(name));
        return tab;
      }),
    );
    $("#magnification").replaceChildren(
      ...[AUTO, ...MAGNIFICATIONS].map((factor) =>
        Object.assign(document.createElement("option"), {
          value: factor,
          textContent: factor === AUTO ? "as they fit" : `× ${factor}`,
        }),
      ),
    );
    this.listen();
    await this.showCamera(this.about.cameras[0].name);
    document.body.dataset.ready = "calibration";
    await this.examine();
    document.body.dataset.examined = "yes";
  }

  // Every image is examined when its turn comes: first those of the camera that is shown.
  async examine() {
    for (;;) {
      const missing = (camera) => camera.images.find((name) => !this.boards[name]);
      const camera = [this.shown(), ...this.about.cameras].find((one) => missing(one) || !this.coverage[one.name]);
      if (!camera) return;
      const name = missing(camera);
      if (name) this.boards[name] = await get("board", { name });
      else this.coverage[camera.name] = await get("coverage", { camera: camera.name });
      if (camera.name === this.camera) this.redraw();
    }
  }

  shown() {
    return this.about.cameras.find(({ name }) => name === this.camera);
  }

  async showCamera(camera) {
    this.camera = camera;
    $("#camera").textContent = camera;
    for (const tab of $("#tabs").children) tab.classList.toggle("current", tab.textContent === camera);
    // The board whose pose is known lies on the plane, so that a wrong plane is seen there first.
    const { images } = this.shown();
    await this.show(images.find((name) => this.boards[name]?.known) ?? images[0] ?? ALL);
  }

  async show(name) {
    this.name = name;
    document.body.dataset.image = name || "all";
    const ticket = ++this.wanted;
    this.redraw();
    const image = name ? await this.image(name) : null;
    if (ticket !== this.wanted) return;
    this.view.show(image);
    document.body.dataset.drawn = name || "all";
  }

  image(name) {
    let found = this.kept.get(name);
    if (!found) {
      found = fetch(`/api/image?${new URLSearchParams({ name })}`)
        .then((answer) => (answer.ok ? answer.blob() : Promise.reject(new Error("it cannot be shown"))))
        .then(createImageBitmap)
        .catch((error) => ({ missing: error.message }));
    }
    this.kept.delete(name);
    this.kept.set(name, found);
    if (this.kept.size > IMAGES) this.kept.delete(this.kept.keys().next().value);
    return found;
  }

  // The magnification that somebody has chosen, or else that at which usual residuals of the boards shown can be seen.
  magnification(boards) {
    const chosen = $("#magnification").value;
    if (chosen !== AUTO) return Number(chosen);
    const sizes = boards.map((board) => board.rms).filter(Boolean);
    sizes.sort((a, b) => a - b);
    const wanted = ARROW_PX / (3 * (sizes[Math.floor(sizes.length / 2)] ?? 0.1));
    return MAGNIFICATIONS.findLast((factor) => factor <= wanted) ?? MAGNIFICATIONS[0];
  }

  redraw() {
    const camera = this.shown();
    const boards = this.name === ALL ? camera.images.map((name) => this.boards[name]) : [this.boards[this.name]];
    const found = boards.filter(Boolean);
    const magnification = this.magnification(found);
    this.magnified = magnification;
    const options = { corners: $("#show-corners").checked, plane: $("#show-plane").checked };
    const coverage = this.name === ALL ? this.coverage[camera.name] : null;
    this.view.take({ camera, name: this.name, boards: found, coverage, magnification, options });
    listFacts(camera, this.boards, this.coverage[camera.name]);
    listImages(camera, this.boards, this.name, (name) => this.show(name));
    drawHistogram($("#histogram"), found);
  }

  step(by) {
    const names = [ALL, ...this.shown().images];
    const at = names.indexOf(this.name) + by;
    this.show(names[Math.min(Math.max(at, 0), names.length - 1)]);
  }

  listen() {
    for (const box of document.querySelectorAll("header input, header select"))
      box.addEventListener("change", () => this.redraw());
    $("#help").addEventListener("click", () => $("#keys").showModal());
    window.addEventListener("keydown", (event) => this.onKey(event));
  }

  onKey(event) {
    if (event.target.matches("select, dialog *") || event.altKey || event.metaKey || event.ctrlKey) return;
    const { cameras } = this.about,
      number = cameras.indexOf(this.shown());
    const longer = (by) => {
      const at = MAGNIFICATIONS.indexOf(this.magnified) + by;
      $("#magnification").value = MAGNIFICATIONS[Math.min(Math.max(at, 0), MAGNIFICATIONS.length - 1)];
      this.redraw();
    };
    const turn = event.shiftKey ? cameras.length - 1 : 1;
    const keys = {
      ArrowUp: () => this.step(-1),
      ArrowDown: () => this.step(1),
      p: () => this.step(-1),
      n: () => this.step(1),
      w: () => {
        const rated = this.shown().images.filter((name) => this.boards[name]?.rms);
        if (rated.length)
          this.show(rated.reduce((one, other) => (this.boards[other].rms > this.boards[one].rms ? other : one)));
      },
      "+": () => longer(1),
      "-": () => longer(-1),
      Tab: () => this.showCamera(cameras[(number + turn) % cameras.length].name),
      0: () => this.view.whole(),
      "?": () => $("#keys").showModal(),
    };
    const call = keys[event.key];
    if (!call) return;
    event.preventDefault();
    call();
  }
}

const calibration = (window.review = new Calibration());
calibration.start().catch((error) => {
  $("#warning").hidden = false;
  $("#warning").textContent = error.message;
});
