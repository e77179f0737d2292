// The lists beside the frames: stretches to look at, corrections, notes.

const $ = (selector) => document.querySelector(selector);

function item(text, className = "") {
  const entry = document.createElement("li");
  entry.textContent = text;
  entry.className = className;
  return entry;
}

const SIZES = {
  jump: "px jump",
  residual: "px residual",
  sigma: "px sigma",
  missing: "frames missing",
  filled: "frames filled",
};

export function showStretches(stretches, names, current, choose) {
  $("#count").textContent = stretches.length;
  $("#stretches").replaceChildren(
    ...stretches.map((stretch, index) => {
      const size =
        stretch.kind === "missing" || stretch.kind === "filled"
          ? stretch.size
          : stretch.size.toFixed(stretch.size < 10 ? 2 : 0);
      const where = stretch.first === stretch.last ? `${stretch.first}` : `${stretch.first} to ${stretch.last}`;
      const who =
        stretch.other < 0 ? names[stretch.marker] : `${names[stretch.marker]} and ${names[stretch.other]} exchanged?`;
      const text = `${who}: ${size} ${SIZES[stretch.kind]}, ${where}${stretch.camera ? `, ${stretch.camera}` : ""}`;
      const entry = item(text, `${index === current ? "current" : ""} ${stretch.reviewed ? "reviewed" : ""}`);
      entry.addEventListener("click", () => choose(index));
      return entry;
    }),
  );
  $("#stretches .current")?.scrollIntoView({ block: "nearest" });
}

function described(entry) {
  const texts = {
    place: () =>
      `${entry.marker} ${{ fit: "fitted", hand: "set by hand", followed: "followed" }[entry.how]}, ${entry.frames} frame${entry.frames === 1 ? "" : "s"}`,
    delete: () => `${entry.marker} deleted, ${entry.first} to ${entry.last}`,
    accept: () => `${entry.marker} accepted, ${entry.first} to ${entry.last}`,
    swap: () => `${entry.markers.join(" and ")} swapped from ${entry.first} on`,
    rename: () => `${entry.marker} is now ${entry.to}`,
  };
  return `${texts[entry.kind]()}, ${entry.camera} - ${entry.by}, ${entry.at.slice(0, 16).replace("T", " ")}`;
}

// A correction that was made on other tracks is kept or taken out: call("keep" or "drop", its index).
export function showCorrections({ corrections, corrections_file: file }, call) {
  $("#file").textContent = corrections.length ? `in ${file}, the last first:` : `none yet; they go to ${file}`;
  const entries = corrections.map((entry, index) => {
    const found = item(described(entry), entry.doubtful ? "doubtful" : "");
    if (entry.doubtful) {
      found.append(" - made on other tracks: ");
      for (const [kind, text] of [
        ["keep", "It holds"],
        ["drop", "Take it out"],
      ]) {
        const button = Object.assign(document.createElement("button"), { textContent: text });
        button.addEventListener("click", () => call(kind, index));
        found.append(button, " ");
      }
    }
    return found;
  });
  $("#corrections").replaceChildren(...entries.reverse());
}

export function showNotes(notes) {
  $("#notes").replaceChildren(...notes.map((note) => item(note)));
}
