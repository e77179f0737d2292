// The tables below the view.

// `open` is called with the number of a recording that was chosen in a table.
export function showTables(parent, tables, open) {
  for (const { title, note, columns, rows } of tables) {
    const heading = make("h2", title),
      text = make("p", note, "note");
    const table = document.createElement("table"),
      head = document.createElement("tr"),
      body = document.createElement("tbody");
    head.append(...columns.map((name) => make("th", name)));
    for (const { cells, recording } of rows) {
      const row = document.createElement("tr");
      row.append(...cells.map(({ text: content, style }) => make("td", content, style)));
      if (recording !== undefined) addLink(row, recording, open);
      body.append(row);
    }
    const top = document.createElement("thead");
    top.append(head);
    table.append(top, body);
    const frame = document.createElement("div");
    frame.className = "wide";
    frame.append(table);
    parent.append(heading, text, frame);
  }
}

function addLink(row, recording, open) {
  const cell = row.cells[1],
    button = make("button", cell.textContent, "link");
  button.title = "show this recording";
  button.addEventListener("click", () => open(recording));
  cell.replaceChildren(button);
  row.dataset.recording = recording;
}

function make(tag, text, style = "") {
  const element = document.createElement(tag);
  element.textContent = text;
  element.className = style;
  return element;
}
