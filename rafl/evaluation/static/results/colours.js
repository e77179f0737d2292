// Colours of methods, of values, and of the page.

const METHODS = ["#d9730d", "#2176c7", "#2a9055", "#9450c8", "#c9357a"];
// The colour map viridis at even steps.
const VIRIDIS = ["#440154", "#482878", "#3e4a89", "#31688e", "#26828e", "#1f9e89", "#35b779", "#6dcd59", "#b4de2c", "#fde725"];
const STOPS = VIRIDIS.map(rgb);

export const SELECTED = "#e0243a";

// What colours show: title, unit, factor from the data to the unit, and the array.
export const COLOURINGS = {
  strain: { label: "Green strain (magnitude)", unit: "%", factor: 100, key: "strain" },
  force: { label: "residual force on a vertex", unit: "mN", factor: 1000, key: "force" },
};

export function methodColour(index) {
  return METHODS[index % METHODS.length];
}

// Lines of methods beyond the number of colours are dashed.
export function methodDash(index) {
  return index < METHODS.length ? [] : [6, 3];
}

export function rgb(text) {
  return [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16) / 255);
}

// Writes the colour of a share from 0 to 1 into an array.
export function writeColour(share, out, at) {
  const place = Math.min(Math.max(share, 0), 1) * (STOPS.length - 1);
  const index = Math.min(Math.floor(place), STOPS.length - 2),
    part = place - index;
  for (let k = 0; k < 3; k++) out[at + k] = (1 - part) * STOPS[index][k] + part * STOPS[index + 1][k];
}

export function viridisGradient(pen, left, right) {
  const gradient = pen.createLinearGradient(left, 0, right, 0);
  VIRIDIS.forEach((colour, k) => gradient.addColorStop(k / (VIRIDIS.length - 1), colour));
  return gradient;
}

// A colour of the page's style, which differs between light and dark.
export function pageColour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

// A number that is 1, 2 or 5 times a power of ten, near to a value and not above it.
export function niceBelow(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * ([5, 2].find((step) => step * power <= value) ?? 1);
}
