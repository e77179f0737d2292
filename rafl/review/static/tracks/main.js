// Which view is shown: `#/` the list, `#/recording/<name>` one recording, `#/specimen/<name>` the specimen that it shows.

import { showList } from "/static/tracks/list.js";
import { Recording } from "/static/tracks/recording.js";
import { Specimen } from "/static/specimen/specimen.js";

const VIEWS = { recording: Recording, specimen: Specimen };

let open = null;

async function route() {
  open?.close();
  open = null;
  const [, kind, name] = location.hash.match(/^#\/(recording|specimen)\/(.+)$/) ?? [];
  for (const id of ["list", "recording", "specimen"]) document.querySelector(`#${id}`).hidden = id !== (kind ?? "list");
  delete document.body.dataset.ready;
  try {
    if (!kind) await showList();
    else {
      open = window.review = new VIEWS[kind](decodeURIComponent(name));
      await open.start();
    }
  } catch (error) {
    const place = kind === "specimen" ? "#specimen-warning" : "#warning";
    if (!kind) document.querySelector("#recording").hidden = false;
    document.querySelector(place).hidden = false;
    document.querySelector(kind === "specimen" ? place : "#warning-text").textContent = error.message;
  }
}

window.addEventListener("hashchange", route);
window.addEventListener("pagehide", () => open?.close());
route();
