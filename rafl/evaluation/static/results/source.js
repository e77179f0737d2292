// Where the data come from: the server of rafl-review, or this file if it holds them.

const summary = document.querySelector("#summary");

export const embedded = summary !== null;

export async function ask(call, parameters = {}) {
  const answer = await fetch(`/api/${call}?${new URLSearchParams(parameters)}`).catch(() => {
    throw new Error("rafl-review does not answer any more; start it again");
  });
  if (answer.ok) return answer;
  const text = await answer.text();
  let found = null;
  try {
    found = JSON.parse(text).error;
  } catch {
    /* no JSON */
  }
  throw new Error(found ?? `the server answered ${answer.status}: ${text}`);
}

export async function loadSummary() {
  return embedded ? JSON.parse(summary.textContent) : (await ask("summary")).json();
}

// The motion of a recording; null if this file does not hold it.
export async function loadMotion(number) {
  if (!embedded) return decode(await (await ask("motion", { number })).arrayBuffer());
  const text = document.getElementById(`motion-${number}`)?.textContent;
  return text ? decode(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer) : null;
}

async function decode(buffer) {
  if (!("DecompressionStream" in window)) throw new Error("this browser is too old to unpack motions; use a newer one");
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const motion = { ...header, frames: header.time.length, methods: new Map(), arrays: undefined };
  let at = 4 + length;
  for (const about of header.arrays) {
    const values = await decodeArray(about, new Uint8Array(buffer, at, about.bytes));
    at += about.bytes;
    if (about.method === "") motion[about.key] = values;
    else {
      if (!motion.methods.has(about.method)) motion.methods.set(about.method, {});
      Object.assign(motion.methods.get(about.method), { [about.key]: values });
    }
  }
  return motion;
}

// 16-bit codes, of which the changes along the first axis are stored: first the low bytes of all, then the high ones.
async function decodeArray({ shape, offset, scale }, bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer());
  const count = planes.length / 2,
    row = count / shape[0];
  const codes = new Int16Array(count),
    values = new Float32Array(count);
  for (let k = 0; k < count; k++) {
    codes[k] = (planes[k] | (planes[count + k] << 8)) + (k >= row ? codes[k - row] : 0);
    values[k] = codes[k] === -32768 ? NaN : offset + scale * codes[k];
  }
  return { values, frames: shape[0], row };
}

// The values of a frame; of the last one if the array has fewer frames.
export function frameOf(array, frame) {
  const first = Math.min(frame, array.frames - 1) * array.row;
  return array.values.subarray(first, first + array.row);
}
