// What buttons, choices and keys do.

const $ = (selector) => document.querySelector(selector);
const FROM = { 0: "start", 1: "front", 2: "end", 3: "top" };
const FIRST_METHOD_KEY = 4;
const TURN = 5; // degrees
const ZOOM = 1.15;

function turned(select, step) {
  const count = select.options.length;
  if (!count) return;
  select.selectedIndex = (select.selectedIndex + step + count) % count;
  select.dispatchEvent(new Event("change"));
}

// Goes on in a choice without coming back to its begin.
function stepped(select, step) {
  const index = select.selectedIndex + step;
  if (index < 0 || index >= select.options.length) return;
  select.selectedIndex = index;
  select.dispatchEvent(new Event("change"));
}

function keysOf(page) {
  const { player } = page,
    orbit = page.scene?.orbit;
  const keys = {
    ArrowLeft: (event) => player.step(event.shiftKey ? -10 : -1),
    ArrowRight: (event) => player.step(event.shiftKey ? 10 : 1),
    " ": () => player.toggle(),
    Home: () => player.step(-player.time.length),
    End: () => player.step(player.time.length),
    ",": () => stepped($("#speed"), 1),
    ".": () => stepped($("#speed"), -1),
    n: () => turned($("#recording"), 1),
    p: () => turned($("#recording"), -1),
    m: () => turned($("#marker"), 1),
    M: () => turned($("#marker"), -1),
    c: () => turned($("#colouring"), 1),
    o: () => turned($("#layout"), 1),
    e: () => turned($("#lines"), 1),
    "?": () => $("#keys").showModal(),
  };
  if (page.scene) {
    Object.assign(keys, {
      h: () => orbit.turn(-TURN, 0),
      l: () => orbit.turn(TURN, 0),
      j: () => orbit.turn(0, -TURN),
      k: () => orbit.turn(0, TURN),
      "+": () => orbit.zoomBy(ZOOM),
      "-": () => orbit.zoomBy(1 / ZOOM),
      s: () => $("#picture").click(),
      v: () => $("#video").click(),
    });
    for (const [key, from] of Object.entries(FROM)) keys[key] = () => orbit.look(from);
  }
  for (let key = FIRST_METHOD_KEY; key <= 9; key++) {
    keys[key] = () => document.querySelectorAll("#methods input")[key - FIRST_METHOD_KEY]?.click();
  }
  return keys;
}

export function listen(page) {
  const { player } = page;
  const click = (selector, action) =>
    $(selector).addEventListener("click", () => Promise.resolve(action()).catch((error) => page.say(error.message)));
  click("#first", () => player.step(-player.time.length));
  click("#back", () => player.step(-1));
  click("#play", () => player.toggle());
  click("#on", () => player.step(1));
  click("#last", () => player.step(player.time.length));
  click("#help", () => $("#keys").showModal());
  click("#picture", async () => page.savePicture());
  click("#video", async () => page.saveVideo());
  click("#file", async () => page.saveFile());
  for (const button of document.querySelectorAll("[data-from]")) {
    button.addEventListener("click", () => page.scene?.orbit.look(button.dataset.from));
  }
  $("#frame").addEventListener("input", (event) => (player.stop(), player.go(Number(event.target.value))));
  $("#speed").addEventListener("change", (event) => (player.speed = Number(event.target.value)));
  $("#recording").addEventListener("change", (event) => page.open(Number(event.target.value)));
  $("#marker").addEventListener("change", (event) => page.selectMarker(Number(event.target.value)));
  for (const choice of ["#layout", "#colouring", "#lines"]) $(choice).addEventListener("change", () => page.restyle());
  const keys = keysOf(page);
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || $("#keys").open) return;
    // Keys that a control has a use for are left to it.
    const { tagName, type } = event.target;
    if (tagName === "SELECT" && ["ArrowUp", "ArrowDown", "Home", "End", " "].includes(event.key)) return;
    if (type === "range" && !event.shiftKey && (event.key.startsWith("Arrow") || ["Home", "End"].includes(event.key))) return;
    if (event.key === " " && (tagName === "BUTTON" || type === "checkbox")) return;
    const action = keys[event.key];
    if (!action) return;
    event.preventDefault();
    action(event);
  });
}
