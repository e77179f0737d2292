// One recording: frames with markers, plots, stretches to look at, and corrections.

import { Images, Rows, get, leave } from "/static/api.js";
import { Corrector } from "/static/tracks/corrector.js";
import { onKey } from "/static/tracks/keyboard.js";
import { Plots } from "/static/tracks/plots.js";
import { showCorrections, showNotes, showStretches } from "/static/tracks/panels.js";
import { CameraView, ELLIPSES } from "/static/tracks/view.js";

const CLAIM_MS = 1500;
const PREFETCHED = 4; // frames ahead of the one shown
const $ = (selector) => document.querySelector(selector);

export class Recording {
  constructor(name) {
    Object.assign(this, {
      name,
      row: 0,
      asked: 0, // the row that will be shown
      selected: [],
      camera: "",
      stretches: [],
      current: -1,
      going: Promise.resolve(),
      stopped: false,
      wanted: 0,
    });
    this.corrector = new Corrector(this);
    this.listening = new AbortController();
  }

  async start() {
    $("#title").textContent = this.name;
    $("#describe").href = `#/specimen/${encodeURIComponent(this.name)}`;
    $("#warning").hidden = true;
    $("#take-over").hidden = true;
    $("#ellipse").textContent = `${ELLIPSES[0]} sigma`;
    $("#message").textContent = "";
    document.title = `${this.name} - rafl-review`;
    // Nothing of another recording stays, also if this one cannot be read.
    $("#cameras").replaceChildren();
    $("#plots").replaceChildren();
    this.clearStretch();
    for (const button of document.querySelectorAll("[data-do], #undo, #redo")) button.disabled = true;
    this.state = await get("recording", { name: this.name });
    const cameras = this.state.cameras.map(({ name }) => name);
    this.camera = cameras[0] ?? "";
    this.data = new Rows(this.name, cameras, this.state.rows);
    this.data.reset(this.state.names.length);
    this.images = new Images(this.name);
    for (const button of document.querySelectorAll("[data-do]")) button.disabled = false;
    const calls = {
      select: (marker, more) => this.select(marker, more),
      move: (camera, marker, x, y, hand) => this.corrector.move(camera, marker, x, y, hand),
      click: (camera, x, y) => this.corrector.adding && (this.corrector.add(camera, x, y), true),
      activate: (camera) => this.activate(camera),
    };
    this.views = this.state.cameras.map(({ name, size }) => new CameraView($("#cameras"), name, size, calls));
    this.activate(this.camera);
    this.plots = new Plots($("#plots"), this.state.rows, (row) => this.show(row));
    this.listen();
    this.showState();
    await this.corrector.claim();
    this.claiming = setInterval(() => this.corrector.claim(), CLAIM_MS);
    await Promise.all([this.show(0), this.loadStretches(), cameras.length ? this.plotMarker() : undefined]);
    document.body.dataset.ready = "recording";
  }

  close() {
    this.stopped = true;
    this.playing = false;
    clearInterval(this.claiming);
    this.listening.abort();
    leave(this.name);
  }

  showWarning(problem = this.problem ?? "") {
    this.problem = problem;
    const { writable, lost } = this.corrector,
      { locked, has_calibration: calibrated, unfit, doubtful } = this.state;
    const elsewhere = !writable && !problem;
    const reasons = [problem];
    if (elsewhere && lost) reasons.push("Another page has taken over this recording; it can be looked at here.");
    else if (elsewhere)
      reasons.push("Another page has this recording open: it can be looked at here, and corrected once that page is closed.");
    if (locked) reasons.push(`Nothing can be corrected: ${locked}`);
    if (!calibrated) reasons.push("The tracks hold no cameras, so nothing can be corrected; track again.");
    reasons.push(...unfit);
    if (doubtful.length)
      reasons.push("Some corrections were made on other tracks. They are applied; say in the list of corrections which still hold.");
    const text = reasons.filter(Boolean).join(" ");
    $("#warning-text").textContent = text;
    $("#warning").hidden = !text;
    $("#take-over").hidden = !elsewhere;
    document.body.dataset.writable = String(writable);
    const able = writable && !locked;
    for (const button of document.querySelectorAll("[data-do], #undo, #redo, #corrections button")) button.disabled = !able;
    if (able) {
      $("#undo").disabled = !this.state.corrections.length;
      $("#redo").disabled = !this.state.redo;
    }
  }

  // Show a row: all cameras at once, when their frames are there. The last row asked for wins.
  async show(row) {
    row = Math.min(Math.max(Math.round(row), 0), this.state.rows - 1);
    this.asked = row;
    const ticket = ++this.wanted;
    await this.data.load(row);
    const found = this.data.at(row);
    if (!found || ticket !== this.wanted) return;
    const numbers = this.views.map((view) => found.block.cameras[view.camera].frame[found.at]);
    const images = await Promise.all(
      this.views.map((view, k) => (numbers[k] < 0 ? null : this.images.get(view.camera, numbers[k]))),
    );
    if (ticket !== this.wanted || this.stopped) return;
    const [from, to] = ["#from", "#to"].map((field) => $(field).value);
    if (from !== "" && to !== "" && (row < Number(from) || row > Number(to))) this.clearStretch();
    this.row = row;
    this.views.forEach((view, k) => view.show(images[k], this.data, row, this.state.names, this.selected));
    this.plots.show(row);
    $("#row").value = row;
    $("#time").textContent = `${found.block.time[found.at].toFixed(3)} s`;
    document.body.dataset.row = row;
    this.views.forEach((view, k) => {
      for (let ahead = 1; ahead <= PREFETCHED && numbers[k] >= 0 && row + ahead < this.state.rows; ahead++)
        this.images.get(view.camera, numbers[k] + ahead);
    });
  }

  redraw() {
    for (const view of this.views) {
      view.selected = this.selected;
      view.draw();
    }
  }

  activate(camera) {
    if (camera !== this.camera && this.plots) {
      this.camera = camera;
      this.plotMarker();
    }
    this.camera = camera;
    for (const view of this.views) view.box.classList.toggle("active", view.camera === camera);
  }

  select(marker, more) {
    this.clearStretch();
    if (marker < 0) this.selected = more ? this.selected : [];
    else if (more) this.selected = [...this.selected.filter((other) => other !== marker), marker].slice(-2);
    else this.selected = [marker];
    $("#selected").textContent = this.selected.map((index) => this.state.names[index]).join(" and ");
    document.body.dataset.selected = this.selected.map((index) => this.state.names[index]).join(",");
    this.redraw();
    this.plotMarker();
  }

  plotMarker() {
    const marker = this.selected.at(-1) ?? 0;
    const title = `${this.state.names[marker] ?? ""} in camera ${this.camera}, over the rows of the tracks`;
    return this.plots
      .load(this.name, marker, this.camera, title)
      .catch((error) => this.say(error.message, true));
  }

  say(text, bad = false) {
    $("#message").textContent = text;
    $("#message").classList.toggle("bad", bad);
  }

  async reload() {
    await this.take(await get("recording", { name: this.name }));
  }

  async take(state) {
    Object.assign(this.state, state);
    this.data.reset(this.state.names.length);
    this.selected = this.selected.filter((marker) => marker < this.state.names.length);
    this.showState();
    await this.show(this.row);
    document.body.dataset.revision = this.state.revision;
    this.plotMarker();
    this.loadStretches();
  }

  showState() {
    showCorrections(this.state, (kind, entry) => this.corrector.act({ kind, entry }));
    showNotes(this.state.notes);
    this.showWarning();
    $("#names").replaceChildren(
      ...this.state.names.map((name) => Object.assign(document.createElement("option"), { value: name })),
    );
  }

  async loadStretches() {
    const revision = this.state.revision;
    const found = await get("stretches", { name: this.name });
    if (revision !== this.state.revision) return;
    this.stretches = found.filter((item) => !item.reviewed || $("#all").checked);
    const before = this.chosen;
    this.current = before
      ? this.stretches.findIndex(
          (item) =>
            item.kind === before.kind &&
            item.marker === before.marker &&
            item.camera === before.camera &&
            item.first === before.first,
        )
      : -1;
    if (this.current < 0 && before) this.current = Math.min(this.position, this.stretches.length) - 0.5; // between two: it is gone
    this.listStretches();
  }

  listStretches() {
    showStretches(this.stretches, this.state.names, this.current, (index) => this.goTo(index));
  }

  goTo(index) {
    if (!this.stretches.length) return this.say("Nothing is left to look at.");
    index = Math.min(Math.max(index, 0), this.stretches.length - 1);
    const item = this.stretches[index];
    this.current = this.position = index;
    this.chosen = item;
    this.listStretches();
    if (item.camera) this.activate(item.camera);
    const row = item.kind === "jump" ? item.last : item.first; // of a jump, the first frame with the wrong dot
    this.going = this.show(row).then(() => {
      this.select(item.marker, false);
      if (item.other >= 0) this.select(item.other, true);
      $("#from").value = item.first;
      $("#to").value = item.last;
    });
  }

  later() {
    this.goTo(Math.floor(this.current) + 1);
  }
  earlier() {
    this.goTo(Math.ceil(this.current) - 1);
  }

  // A stretch belongs to the marker and the place for which it was chosen.
  clearStretch() {
    $("#from").value = $("#to").value = "";
  }

  stretch() {
    const first = $("#from").value === "" ? this.row : Number($("#from").value);
    const last = $("#to").value === "" ? first : Number($("#to").value);
    return { row: Math.min(first, last), last_row: Math.max(first, last) };
  }

  marker() {
    if (!this.selected.length) throw new Error("Click on a marker first.");
    return this.state.names[this.selected.at(-1)];
  }

  async play() {
    this.playing = !this.playing;
    $("#play").textContent = this.playing ? "Stop" : "Play";
    while (this.playing && this.row < this.state.rows - 1) {
      const due = performance.now() + 1000 / Math.min(this.state.fps, 50);
      await this.show(this.row + 1);
      await new Promise((done) => setTimeout(done, Math.max(due - performance.now(), 0)));
    }
    this.playing = false;
    $("#play").textContent = "Play";
  }

  listen() {
    const on = (target, kind, call) => target.addEventListener(kind, call, { signal: this.listening.signal });
    for (const button of document.querySelectorAll("[data-do]"))
      on(button, "click", () => {
        button.blur();
        this.corrector.do(button.dataset.do);
      });
    on($("#later"), "click", () => this.later());
    on($("#earlier"), "click", () => this.earlier());
    on($("#take-over"), "click", () => {
      $("#taking").returnValue = "no";
      $("#taking").showModal();
    });
    on($("#taking"), "close", () => $("#taking").returnValue === "yes" && this.corrector.takeOver());
    on($("#previous"), "click", () => this.show(this.row - 1));
    on($("#next"), "click", () => this.show(this.row + 1));
    on($("#play"), "click", () => {
      $("#play").blur();
      this.play();
    });
    on($("#undo"), "click", () => this.corrector.do("undo"));
    on($("#redo"), "click", () => this.corrector.do("redo"));
    on($("#help"), "click", () => $("#keys").showModal());
    on($("#row"), "change", () => this.show(Number($("#row").value)));
    on($("#all"), "change", () => this.loadStretches());
    on(window, "keydown", (event) => onKey(this, event));
  }


}
