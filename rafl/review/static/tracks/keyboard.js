// The keys of the page of a recording.

import { ELLIPSES } from "/static/tracks/view.js";

const $ = (selector) => document.querySelector(selector);

export function onKey(recording, event) {
  const { corrector } = recording;
  if (event.target.matches("input, dialog *") || event.altKey || event.metaKey) return;
  const step = event.shiftKey ? 10 : 1;
  const keys = {
    ArrowLeft: () => recording.show(recording.asked - step),
    ArrowRight: () => recording.show(recording.asked + step),
    Home: () => recording.show(0),
    End: () => recording.show(recording.state.rows - 1),
    " ": () => recording.play(),
    n: () => recording.later(),
    p: () => recording.earlier(),
    s: () => corrector.do("swap"),
    d: () => corrector.do("delete"),
    f: () => corrector.do("follow"),
    a: () => corrector.do("add"),
    Enter: () => corrector.do("accept"),
    "[": () => {
      $("#from").value = recording.row;
    },
    "]": () => {
      $("#to").value = recording.row;
    },
    0: () => recording.views.forEach((view) => view.whole()),
    e: () => {
      for (const view of recording.views) view.ellipse = (view.ellipse + 1) % ELLIPSES.length;
      const factor = ELLIPSES[recording.views[0]?.ellipse ?? 0];
      $("#ellipse").textContent = factor ? `${factor} sigma` : "none";
      recording.redraw();
    },
    "?": () => $("#keys").showModal(),
    Escape: () => {
      corrector.adding = corrector.following = false;
      recording.say("");
    },
  };
  const withControl = { z: () => corrector.do("undo"), y: () => corrector.do("redo") };
  const call = event.ctrlKey ? withControl[event.key] : keys[event.key];
  if (!call) return;
  event.preventDefault();
  call();
}
