// The page: one recording in 3-D over time, its plots, and the tables of all recordings.

import { methodColour } from "/static/results/colours.js";
import { listen } from "/static/results/keys.js";
import { Player } from "/static/results/player.js";
import { Overview, Plots } from "/static/results/plots.js";
import { download, fileName, savePicture, saveVideo } from "/static/results/save.js";
import { Scene } from "/static/results/scene.js";
import { ask, embedded, frameOf, loadMotion, loadSummary } from "/static/results/source.js";
import { showTables } from "/static/results/tables.js";

const MOST_LISTED = 3; // errors of methods in the list of recordings
const $ = (selector) => document.querySelector(selector);

class Page {
  constructor(summary) {
    Object.assign(this, { summary, number: -1, motion: null, marker: -1, axis: 0, method: "", loading: 0, lasting: "" });
    this.hidden = new Set(); // methods
    this.player = new Player(
      (frame) => this.show(frame),
      () => ($("#play").textContent = this.player.playing ? "Stop" : "Play"),
    );
    try {
      this.scene = new Scene($("#scene"), $("#labels"), (marker) => this.selectMarker(marker));
    } catch (error) {
      this.scene = null;
      this.lasting = `This browser draws nothing in 3-D (${error.message}): switch WebGL on. Plots and tables are complete.`;
    }
    this.plots = new Plots(
      $("#plots"),
      (time) => (this.player.stop(), this.player.goToTime(time)),
      (method) => ((this.method = method), this.loadPlots()),
      (axis) => ((this.axis = "xyz".indexOf(axis)), this.loadPlots()),
    );
  }

  get about() {
    return this.summary.recordings[this.number];
  }

  get shown() {
    return this.summary.methods.filter((method) => this.motion?.methods.has(method) && !this.hidden.has(method));
  }

  async start() {
    const { title, note, models, methods, recordings, tables } = this.summary;
    document.title = title;
    $("#title").textContent = title;
    $("#note").textContent = note;
    $("#note").hidden = !note;
    $("#models").textContent = models;
    this.method = methods[methods.length - 1] ?? "";
    this.fillRecordings();
    showTables($("#tables"), tables, (number) => this.open(number, true));
    this.fillOverview();
    for (const button of [$("#picture"), $("#video")]) button.hidden = !this.scene;
    $("#file").hidden = embedded;
    const simulated = tables.length > 0;
    $("#errors").hidden = !simulated;
    this.plots.hideErrors(!simulated);
    listen(this);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.restyle());
    const first = recordings.findIndex(({ split }) => split === "test");
    await this.open(Math.max(first, 0));
  }

  fillRecordings() {
    const groups = new Map();
    this.summary.recordings.forEach(({ dataset, recording, split, mean }, number) => {
      if (!groups.has(dataset)) {
        const group = document.createElement("optgroup");
        group.label = dataset;
        groups.set(dataset, group);
      }
      const errors = Object.values(mean).map((value) => value.toFixed(2));
      const text = errors.length && errors.length <= MOST_LISTED ? `, error ${errors.join(" / ")} mm` : "";
      groups.get(dataset).append(new Option(`${recording} (${split}${text})`, number));
    });
    $("#recording").append(...groups.values());
  }

  fillOverview() {
    const groups = new Map();
    this.summary.recordings.forEach((about, number) => {
      if (!Object.keys(about.curve.errors).length) return;
      const key = `${about.dataset}: ${about.split}`;
      if (!groups.has(key)) groups.set(key, []);
      groups.get(key).push({ ...about, number });
    });
    if (!groups.size) return;
    $("#overview").hidden = false;
    this.overview = new Overview($("#curves"), async (number, time) => {
      await this.open(number, true);
      this.player.goToTime(time);
    });
    const select = $("#group");
    select.append(...[...groups.keys()].map((key) => new Option(key)));
    select.value = [...groups.keys()].find((key) => key.endsWith(": test")) ?? select.value;
    this.drawOverview = () => this.overview.load(groups.get(select.value), this.summary.methods);
    select.addEventListener("change", this.drawOverview);
    this.drawOverview();
  }

  // Shows a recording; `scroll` brings the view into sight.
  async open(number, scroll = false) {
    const asked = ++this.loading;
    delete document.body.dataset.ready;
    const motion = await loadMotion(number).catch((error) => this.warn(error.message));
    if (asked !== this.loading) return; // another one was chosen meanwhile
    const name = this.motion?.markers[this.marker];
    Object.assign(this, { number, motion: motion ?? null });
    $("#recording").value = number;
    for (const row of document.querySelectorAll("tr[data-recording]")) {
      row.classList.toggle("current", Number(row.dataset.recording) === number);
    }
    this.marker = motion ? motion.markers.indexOf(name) : -1;
    if (motion && this.marker < 0) [this.marker, this.axis] = motion.most_active;
    this.fillMethods();
    this.fillMarkers();
    this.scene?.load(this.motion, this.summary.methods);
    this.player.stop();
    this.player.load(motion ? motion.time : this.about.curve.time.length ? this.about.curve.time : [0]);
    $("#frame").max = this.player.last;
    this.restyle();
    if (motion) this.warn("");
    if (motion === null) {
      const sentence = "The motion of this recording is not in this file, which would be too large. Its errors are.";
      this.warn(`${sentence} rafl-review with the run folder shows all recordings.`);
    }
    if (scroll) $("header").scrollIntoView({ block: "start" });
    Object.assign(document.body.dataset, { ready: "results", recording: number });
  }

  fillMethods() {
    const { mean, std } = this.about;
    const names = this.summary.methods.filter((name) => name in mean || this.motion?.methods.has(name));
    $("#methods").replaceChildren(
      ...names.map((name) => {
        const item = document.createElement("li"),
          label = document.createElement("label"),
          box = document.createElement("input"),
          swatch = document.createElement("span"),
          error = document.createElement("span");
        box.type = "checkbox";
        box.checked = !this.hidden.has(name);
        box.dataset.method = name;
        box.addEventListener("change", () => this.toggleMethod(name));
        swatch.className = "swatch";
        swatch.style.background = methodColour(this.summary.methods.indexOf(name));
        error.className = "error";
        error.textContent = name in mean ? `${mean[name].toFixed(3)} ± ${std[name].toFixed(3)} mm` : "";
        label.append(box, swatch, name);
        item.append(label, error);
        return item;
      }),
    );
  }

  fillMarkers() {
    const names = this.motion?.markers ?? [];
    $("#marker").replaceChildren(...names.map((name, k) => new Option(name, k)));
    $("#marker").disabled = !names.length;
  }

  toggleMethod(name) {
    if (!this.hidden.delete(name)) this.hidden.add(name);
    this.fillMethods();
    this.restyle();
  }

  selectMarker(marker) {
    this.marker = marker;
    this.restyle();
  }

  // Draws everything anew after a choice.
  restyle() {
    const { dataset, recording, split } = this.about ?? {};
    $("#marker").value = this.marker;
    const colours = {},
      panels = {};
    for (const [index, name] of this.summary.methods.entries()) {
      colours[name] = methodColour(index);
      panels[name] = name in this.about.mean ? `${name}: ${this.about.mean[name].toFixed(3)} mm` : name;
    }
    const text = { colours, panels, recording: `${dataset} / ${recording} (${split})`, missing: "no motion to show" };
    this.scene?.set(this.shown, $("#layout").value === "overlay", {
      colouring: $("#colouring").value,
      lines: Number($("#lines").value),
      marker: this.marker,
      text: { ...this.scene.state.text, ...text },
    });
    this.loadPlots();
    this.drawOverview?.();
    this.show(this.player.frame);
  }

  loadPlots() {
    const { motion, method, marker, axis } = this;
    const shown = motion ? this.shown : this.summary.methods.filter((name) => !this.hidden.has(name));
    this.plots.load({ motion, curve: this.about.curve, all: this.summary.methods, shown, method, marker, axis });
    this.plots.show(this.player.time[this.player.frame]);
  }

  show(frame) {
    const time = this.player.time[frame],
      kept = this.motion?.stride ?? 1;
    const count = this.about?.frames ?? this.player.time.length;
    const text = `${time.toFixed(3)} s, frame ${frame * kept} of ${count - 1}`;
    $("#frame").value = frame;
    $("#time").textContent = text;
    document.body.dataset.frame = frame;
    if (this.scene) {
      this.scene.state.text.time = text;
      this.scene.show(frame);
      $("#scene").setAttribute("aria-label", `3-D view of ${this.about?.recording ?? ""} at ${text}`);
    }
    this.plots?.show(time);
    this.showMissing(frame);
  }

  showMissing(frame) {
    if (!this.motion) return ($("#missing").textContent = "");
    const points = frameOf(this.motion.recorded, frame);
    const missing = this.motion.markers.filter((_, k) => Number.isNaN(points[3 * k]));
    const total = this.motion.markers.length;
    $("#missing").textContent = missing.length
      ? `${missing.length} of ${total} markers missing in this frame: ${missing.join(", ")}`
      : `all ${total} markers recorded in this frame`;
  }

  // A warning about what is shown now, beside one that lasts.
  warn(text) {
    const all = [this.lasting, text].filter(Boolean).join(" ");
    $("#warning").textContent = all;
    $("#warning").hidden = !all;
  }

  say(text) {
    $("#message").textContent = text;
  }

  get fileName() {
    return fileName(this.about.dataset, this.about.recording);
  }

  async savePicture() {
    await savePicture(this.scene, this.fileName);
    this.say("picture saved");
  }

  async saveVideo() {
    if (this.player.playing && this.filming) return this.player.stop();
    this.filming = true;
    this.say("filming: keep this page in sight; v or Stop ends it");
    const saved = await saveVideo(this.scene, this.player, this.fileName).finally(() => (this.filming = false));
    this.say(saved ? "video saved" : "stopped; no video saved");
  }

  async saveFile() {
    this.say("writing the file ...");
    const content = await (await ask("file")).blob();
    download(content, `${fileName(this.summary.title)}.html`);
    this.say("file saved");
  }
}

try {
  const page = (window.results = new Page(await loadSummary()));
  await page.start();
} catch (error) {
  const warning = $("#warning");
  warning.hidden = false;
  warning.textContent = error.message;
}
