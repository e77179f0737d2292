// Calls of the server, and the caches of what it sends.

export const page = crypto.randomUUID();

const query = (parameters) => new URLSearchParams(parameters).toString();

async function checked(answer) {
  if (answer.ok) return answer;
  let text = `the server answered ${answer.status}`;
  try {
    text = (await answer.json()).error ?? text;
  } catch {
    /* no JSON */
  }
  throw new Error(text);
}

export async function get(call, parameters = {}) {
  return (await checked(await fetch(`/api/${call}?${query(parameters)}`))).json();
}

export async function getArray(call, parameters) {
  return new Float32Array(await (await checked(await fetch(`/api/${call}?${query(parameters)}`))).arrayBuffer());
}

export async function post(call, parameters, body) {
  const options = { method: "POST", headers: { "Content-Type": "application/json" } };
  if (body !== undefined) options.body = JSON.stringify(body);
  return (await checked(await fetch(`/api/${call}?${query(parameters)}`, options))).json();
}

export function leave(name) {
  navigator.sendBeacon(`/api/release?${query({ name, page })}`);
}

const ROWS = 256; // of one block

// Rows of the tracks, fetched in blocks.
export class Rows {
  constructor(name, cameras, total) {
    Object.assign(this, { name, cameras, total, blocks: new Map(), markers: 0 });
  }

  reset(markers) {
    this.markers = markers;
    this.blocks.clear();
  }

  fetch(index) {
    if (index < 0 || index * ROWS >= this.total) return Promise.resolve();
    if (!this.blocks.has(index)) {
      const first = index * ROWS,
        count = Math.min(ROWS, this.total - first);
      const markers = this.markers;
      const loading = getArray("block", { name: this.name, first, count }).then((values) => {
        const block = parse(values, count, markers, this.cameras);
        if (this.blocks.get(index) === loading) this.blocks.set(index, block);
        return block;
      });
      loading.catch(() => this.blocks.delete(index));
      this.blocks.set(index, loading);
    }
    return Promise.resolve(this.blocks.get(index));
  }

  async load(row) {
    const index = Math.floor(row / ROWS);
    await Promise.all([this.fetch(index), row % ROWS < 20 ? this.fetch(index - 1) : undefined]);
    if (row % ROWS > ROWS - 64) this.fetch(index + 1);
  }

  // The values of a row; null if they are not loaded.
  at(row) {
    const block = this.blocks.get(Math.floor(row / ROWS));
    return !block || block instanceof Promise ? null : { block, at: row % ROWS };
  }
}

function parse(values, rows, markers, cameras) {
  let at = 0;
  const take = (count) => values.subarray(at, (at += count));
  const cells = rows * markers;
  const block = {
    time: take(rows),
    state: take(cells),
    changed: take(cells),
    position: take(3 * cells),
    sigma: take(3 * cells),
    cameras: {},
  };
  for (const camera of cameras) {
    block.cameras[camera] = {
      frame: take(rows),
      damaged: take(rows),
      kind: take(cells),
      pixel: take(2 * cells),
      sigma: take(2 * cells),
      residual: take(cells),
    };
  }
  return block;
}

const IMAGES = 96; // kept

// Frames of the cameras as bitmaps.
export class Images {
  constructor(name) {
    Object.assign(this, { name, kept: new Map() });
  }

  get(camera, number) {
    const key = `${number} ${camera}`;
    let found = this.kept.get(key);
    if (!found) {
      found = fetch(`/api/frame?${query({ name: this.name, camera, number })}`)
        .then(checked)
        .then((answer) => answer.blob())
        .then(createImageBitmap)
        .catch((error) => ({ missing: error.message }));
    }
    this.kept.delete(key);
    this.kept.set(key, found);
    if (this.kept.size > IMAGES) this.kept.delete(this.kept.keys().next().value);
    return found;
  }
}
