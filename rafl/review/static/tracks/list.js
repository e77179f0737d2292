// The list of recordings. What their files hold is asked for when a row comes into view.

import { get, post } from "/static/api.js";

const AT_ONCE = 40;
const percent = (share) => `${(100 * share).toFixed(1)} %`;

export async function showList() {
  const { folder, recordings } = await get("recordings");
  document.title = `${folder} - rafl-review`;
  document.querySelector("#folder").textContent = folder;
  const body = document.querySelector("#rows"),
    filter = document.querySelector("#filter");
  const waiting = new Map();
  let asking = false;

  async function ask() {
    if (asking) return;
    asking = true;
    try {
      while (waiting.size) {
        const part = [...waiting].slice(0, AT_ONCE);
        part.forEach(([name]) => waiting.delete(name));
        const found = await post(
          "summaries",
          {},
          part.map(([name]) => name),
        );
        for (const [name, row] of part) fill(row, found[name]);
      }
    } finally {
      asking = false;
    }
  }

  const observer = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (!entry.isIntersecting) continue;
      observer.unobserve(entry.target);
      waiting.set(entry.target.dataset.name, entry.target);
    }
    ask();
  });
  body.replaceChildren(
    ...recordings.map(({ name, corrected }) => {
      const row = document.createElement("tr");
      row.dataset.name = name;
      for (let k = 0; k < 8; k++) row.append(document.createElement("td"));
      const link = document.createElement("a");
      link.href = `#/recording/${encodeURIComponent(name)}`;
      link.textContent = name;
      row.cells[0].append(link);
      row.cells[7].textContent = corrected ? "yes" : "";
      return row;
    }),
  );
  for (const row of body.rows) observer.observe(row);
  const apply = () => {
    const text = filter.value.toLowerCase();
    for (const row of body.rows) row.hidden = !row.dataset.name.toLowerCase().includes(text);
  };
  filter.oninput = apply;
  apply();
  filter.focus();
  document.body.dataset.ready = "list";
}

function fill(row, found) {
  if (found.error) {
    row.cells[1].textContent = "cannot be read";
    row.cells[1].className = "bad";
    row.title = found.error;
    return;
  }
  const texts = [
    found.frames,
    found.markers,
    found.cameras,
    percent(found.measured),
    percent(found.filled),
    percent(found.missing),
  ];
  texts.forEach((text, k) => {
    row.cells[k + 1].textContent = text;
  });
}
