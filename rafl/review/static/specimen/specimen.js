// The specimen of a recording at rest: corners give its size, the tracks its dots; what is confirmed becomes specimen.yaml.

import { Images, Rows, get, post } from "/static/api.js";
import { BodyView, CORNERS } from "/static/specimen/body_view.js";

const SIDES = ["x", "y", "z"];
const $ = (selector) => document.querySelector(selector);

function items(list, texts) {
  list.replaceChildren(...texts.map((text) => Object.assign(document.createElement("li"), { textContent: text })));
}

export class Specimen {
  constructor(name) {
    Object.assign(this, { name, row: 0, described: null, leftOut: new Set(), listening: new AbortController() });
  }

  async start() {
    $("#specimen-title").textContent = this.name;
    document.title = `${this.name} - specimen - rafl-review`;
    $("#specimen-back").href = `#/recording/${encodeURIComponent(this.name)}`;
    $("#specimen-warning").hidden = $("#found").hidden = true;
    $("#specimen-cameras").replaceChildren();
    for (const field of document.querySelectorAll("#specimen aside input[type=number]")) field.value = "";
    for (const list of ["#size-remarks", "#written", "#dots"]) $(list).replaceChildren();
    $("#lying").checked = false;
    this.say("");
    this.state = await get("recording", { name: this.name });
    const cameras = this.state.cameras.map(({ name }) => name);
    this.data = new Rows(this.name, cameras, this.state.rows);
    this.data.reset(this.state.names.length);
    this.images = new Images(this.name);
    this.views = this.state.cameras.map(
      ({ name, size }) => new BodyView($("#specimen-cameras"), name, size, () => this.measure()),
    );
    this.listen();
    this.countCorners();
    await this.show(0);
    document.body.dataset.ready = "specimen";
  }

  close() {
    this.listening.abort();
  }

  say(text, bad = false) {
    $("#specimen-message").textContent = text;
    $("#specimen-message").classList.toggle("bad", bad);
  }

  async show(row) {
    this.row = Math.min(Math.max(Math.round(row), 0), this.state.rows - 1);
    $("#specimen-row").value = this.row;
    await this.data.load(this.row);
    const found = this.data.at(this.row);
    if (!found) return;
    await Promise.all(
      this.views.map(async (view) => {
        const number = found.block.cameras[view.camera].frame[found.at];
        view.show(number < 0 ? null : await this.images.get(view.camera, number), this.dots(view.camera, found));
      }),
    );
  }

  // The dots of a camera in the row shown, by the names that were found.
  dots(camera, { block, at }) {
    const { names } = this.state,
      values = block.cameras[camera];
    const renamed = new Map(this.described?.dots.map((dot) => [dot.track, dot.name]) ?? []);
    return names.flatMap((name, marker) => {
      const cell = at * names.length + marker;
      if (values.kind[cell] !== 1) return [];
      const out = this.leftOut.has(name) || (this.described !== null && !renamed.has(name));
      return [{ name: renamed.get(name) ?? "", x: values.pixel[2 * cell], y: values.pixel[2 * cell + 1], out }];
    });
  }

  countCorners() {
    $("#corners-count").textContent = this.views
      .map(({ camera, corners }) => `${camera}: ${corners.length} of ${CORNERS}`)
      .join(", ");
  }

  // The size, from all cameras with four corners.
  async measure() {
    this.countCorners();
    const complete = this.views.filter(({ corners }) => corners.length === CORNERS);
    if (!complete.length) return;
    const pixels = Object.fromEntries(complete.map(({ camera, corners }) => [camera, corners]));
    try {
      const found = await post("specimen/corners", { name: this.name }, pixels);
      found.size_mm.forEach((side, k) => {
        if (side !== null) $(`#size-${SIDES[k]}`).value = side;
      });
      items($("#size-remarks"), found.remarks);
      this.outline(found.outline);
      this.say("The size is filled in. Compare it with a ruler, then find the places.");
    } catch (error) {
      this.say(error.message, true);
    }
  }

  outline(lines) {
    for (const view of this.views) {
      view.outline = lines[view.camera] ?? [];
      view.draw();
    }
  }

  form() {
    const number = (field) => ($(field).value === "" ? null : Number($(field).value));
    const size = SIDES.map((side) => number(`#size-${side}`));
    if (size.includes(null)) throw new Error("Click on the corners, or type length, width and height first.");
    return {
      size_mm: size,
      element_mm: number("#element"),
      youngs_modulus: number("#modulus"),
      density: number("#density"),
      lying: $("#lying").checked,
      left_out: [...this.leftOut],
    };
  }

  async find() {
    const button = $("#find");
    if (button.disabled) return;
    button.disabled = true;
    document.body.dataset.finding = "yes";
    try {
      const form = this.form();
      this.say("The places are being found; this takes some seconds ...");
      this.described = await post("specimen/describe", { name: this.name }, form);
      this.outline(this.described.outline);
      this.list();
      this.say("Check the names, and that the blue outline lies on the body.");
    } catch (error) {
      this.described = null;
      $("#found").hidden = true;
      this.say(error.message, true);
    } finally {
      button.disabled = false;
      delete document.body.dataset.finding;
    }
    await this.show(this.row);
  }

  list() {
    const { dots, summary, warnings, folder } = this.described;
    $("#found").hidden = false;
    $("#summary").textContent = summary;
    $("#specimen-folder").textContent = folder;
    $("#written").textContent = "";
    items($("#found-warnings"), warnings);
    const gone = [...this.leftOut].map((track) => ({ name: track, track }));
    $("#dots").replaceChildren(...[...dots, ...gone].map((dot) => this.entry(dot)));
    $("#write").disabled = false;
  }

  entry({ name, track, at_mm: place, sigma_mm: sigma }) {
    const entry = document.createElement("tr");
    const label = document.createElement("label"),
      tick = Object.assign(document.createElement("input"), { type: "checkbox", checked: Boolean(place) });
    label.append(tick, ` ${name}`);
    for (let k = 0; k < 3; k++) entry.append(document.createElement("td"));
    entry.cells[0].append(label);
    entry.cells[1].textContent = place ? place.map((value) => value.toFixed(2)).join(", ") : "left out";
    entry.cells[2].textContent = place ? sigma.toFixed(2) : "";
    entry.title = `${track} in the tracks`;
    entry.classList.toggle("left-out", !place);
    tick.addEventListener("change", () => {
      tick.checked ? this.leftOut.delete(track) : this.leftOut.add(track);
      entry.classList.toggle("left-out", !tick.checked);
      $("#write").disabled = true; // what is written is what was found
      this.say("Find the places again, with the dots that are ticked.");
      this.show(this.row);
    });
    return entry;
  }

  async write(replace = false) {
    const file = $("#specimen-file").value.trim();
    try {
      const body = { key: this.described.key, file, replace_files: replace };
      const answer = await post("specimen/write", { name: this.name }, body);
      if (!answer.written) {
        $("#replace-text").textContent = `There is ${answer.there.join(" and ")} already. Replace it?`;
        $("#replace").returnValue = "no";
        return $("#replace").showModal();
      }
      $("#written").textContent = `Wrote ${answer.file} and its picture. Next: rafl-track videos/ --calib calib.yaml --specimen ${file}.yaml`;
      this.say("written");
    } catch (error) {
      this.say(error.message, true);
    }
  }

  listen() {
    const on = (target, kind, call) => target.addEventListener(kind, call, { signal: this.listening.signal });
    on($("#specimen-row"), "change", () => this.show(Number($("#specimen-row").value)));
    on($("#corners-clear"), "click", () => {
      for (const view of this.views) view.clear();
      this.countCorners();
    });
    on($("#find"), "click", () => this.find());
    on($("#write"), "click", () => this.write());
    on($("#replace"), "close", () => $("#replace").returnValue === "yes" && this.write(true));
    on(window, "keydown", (event) => {
      if (event.key === "0" && !event.target.matches("input")) for (const view of this.views) view.whole();
    });
  }
}
