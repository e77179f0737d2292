// Which view is shown: `#/` the list, `#/recording/<name>` one recording.

import { showList } from "/static/tracks/list.js";
import { Recording } from "/static/tracks/recording.js";

let open = null;

async function route() {
  open?.close();
  open = null;
  const match = location.hash.match(/^#\/recording\/(.+)$/);
  document.querySelector("#list").hidden = Boolean(match);
  document.querySelector("#recording").hidden = !match;
  delete document.body.dataset.ready;
  try {
    if (!match) await showList();
    else {
      open = window.review = new Recording(decodeURIComponent(match[1]));
      await open.start();
    }
  } catch (error) {
    const warning = document.querySelector("#warning");
    document.querySelector("#recording").hidden = false;
    warning.hidden = false;
    warning.textContent = error.message;
  }
}

window.addEventListener("hashchange", route);
window.addEventListener("pagehide", () => open?.close());
route();
