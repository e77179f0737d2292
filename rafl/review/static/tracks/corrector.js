// Corrections of a recording: who may make them, and what is done to the selected markers.

import { page, post } from "/static/api.js";

const $ = (selector) => document.querySelector(selector);

export class Corrector {
  constructor(recording) {
    Object.assign(this, { recording, writable: false, lost: false, adding: false, busy: Promise.resolve() });
  }

  get query() {
    return { name: this.recording.name, page };
  }

  async claim() {
    try {
      const { writable, revision } = await post("claim", this.query);
      this.lost ||= this.writable && !writable;
      this.writable = writable;
      if (writable) this.lost = false;
      if (revision !== this.recording.state.revision && !this.acting) await this.recording.reload();
    } catch (error) {
      this.writable = false;
      return this.recording.showWarning(`the server does not answer: ${error.message}`);
    }
    this.recording.showWarning("");
  }

  // Another page may have been left open somewhere, or its browser have crashed.
  async takeOver() {
    await post("claim", { ...this.query, take: true });
    await this.claim();
  }

  // Do what the server calls an action, one after the other, and show what it changed.
  act(action) {
    const meant = { row: this.recording.row, ...action }; // what is shown now, not when its turn comes
    this.busy = this.busy.then(() => this.perform(meant));
    return this.busy;
  }

  async perform(action) {
    const { recording } = this;
    if (!this.writable) return recording.say("Another page has this recording; it cannot be corrected here.", true);
    document.body.dataset.acting = "yes";
    this.acting = true;
    try {
      const answer = await post("correct", this.query, action);
      recording.say(answer.message);
      await recording.take(answer);
      return answer;
    } catch (error) {
      recording.say(error.message, true);
    } finally {
      this.acting = false;
      delete document.body.dataset.acting;
    }
  }

  async do(what) {
    const { recording } = this;
    try {
      await recording.going; // what is done is done to what is shown
      const { camera, selected, state } = recording;
      if (what === "swap") {
        if (selected.length !== 2) throw new Error("Click on a marker, and with Shift on a second one, to swap them.");
        const [marker, other] = selected.map((index) => state.names[index]);
        await this.act({ kind: "swap", camera, marker, other });
      } else if (what === "delete")
        await this.act({
          kind: "delete",
          camera,
          marker: recording.marker(),
          ...recording.stretch(),
          all_cameras: $("#everywhere").checked,
        });
      else if (what === "accept") {
        await this.act({ kind: "accept", camera, marker: recording.marker(), ...recording.stretch() });
      } else if (what === "rename") {
        const other = $("#new-name").value;
        if (!other) throw new Error("Type the new name first.");
        if (await this.act({ kind: "rename", camera, marker: recording.marker(), other })) $("#new-name").value = "";
      } else if (what === "follow") await this.follow(camera, recording.marker());
      else if (what === "add") {
        const name = $("#name").value || recording.marker();
        this.adding = name;
        recording.say(`Click on the dot of ${name}.`);
      } else await this.act({ kind: what });
    } catch (error) {
      recording.say(error.message, true);
    }
  }

  // A marker that was lost is followed on from where it is put back.
  async move(camera, marker, x, y, hand) {
    const { state, row, data } = this.recording,
      name = state.names[marker],
      { block, at } = data.at(row);
    const lost = block.cameras[camera].kind[at * state.names.length + marker] !== 1;
    this.recording.select(marker, false);
    const answer = await this.act({
      kind: "place",
      camera,
      marker: name,
      x,
      y,
      hand,
      sigma: Number($("#sigma").value) || 1,
    });
    if (answer && lost && !hand) await this.follow(camera, name, row);
  }

  async add(camera, x, y) {
    const marker = this.adding,
      { recording } = this;
    this.adding = false;
    const isNew = !recording.state.names.includes(marker),
      { row } = recording;
    const answer = await this.act({ kind: "place", camera, marker, x, y, new: isNew });
    if (!answer) return;
    $("#name").value = "";
    recording.select(recording.state.names.indexOf(marker), false);
    await this.follow(camera, marker, row);
  }

  async follow(camera, marker, first = this.recording.row) {
    this.following = true;
    for (let row = first; this.following;) {
      const answer = await this.act({ kind: "follow", camera, marker, row });
      if (!answer?.more) break;
      row = answer.row;
    }
    this.following = false;
  }
}
