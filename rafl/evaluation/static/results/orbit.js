// The place from which the bodies are seen: turned about a point by mouse and keys.

const FROM = { start: [-62, 18], front: [-90, 0], end: [0, 0], top: [-90, 89.9] }; // azimuth, elevation [degrees]
const TURN = 0.4; // degrees for a pixel
const MARGIN = 0.95;

export class Orbit {
  // `changed` is called after every change, `click` with the place of a click that turns nothing.
  constructor(element, changed, click) {
    Object.assign(this, { changed, click, target: [0, 0, 0], radius: 1, zoom: 1 });
    [this.azimuth, this.elevation] = FROM.start;
    this.shift = [0, 0]; // of the target on the screen, in radii
    element.addEventListener("pointerdown", (event) => this.press(element, event));
    element.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoomBy(Math.exp(-0.0015 * event.deltaY));
    });
  }

  press(element, event) {
    element.setPointerCapture(event.pointerId);
    let [x, y] = [event.clientX, event.clientY],
      moved = 0;
    const move = (next) => {
      const [dx, dy] = [next.clientX - x, next.clientY - y];
      [x, y] = [next.clientX, next.clientY];
      moved += Math.abs(dx) + Math.abs(dy);
      if (next.shiftKey) this.shiftBy(dx / element.clientHeight, dy / element.clientHeight);
      else this.turn(-TURN * dx, TURN * dy);
    };
    const end = (last) => {
      element.removeEventListener("pointermove", move);
      element.removeEventListener("pointerup", end);
      element.removeEventListener("pointercancel", end);
      if (moved < 4 && last.type === "pointerup") this.click(last.offsetX, last.offsetY);
    };
    element.addEventListener("pointermove", move);
    element.addEventListener("pointerup", end);
    element.addEventListener("pointercancel", end);
  }

  // Looks at a ball around a point.
  fit(target, radius) {
    Object.assign(this, { target, radius });
    this.changed();
  }

  look(from) {
    [this.azimuth, this.elevation] = FROM[from];
    this.zoom = 1;
    this.shift = [0, 0];
    this.changed();
  }

  turn(azimuth, elevation) {
    this.azimuth += azimuth;
    this.elevation = Math.min(Math.max(this.elevation + elevation, -89.9), 89.9);
    this.changed();
  }

  zoomBy(factor) {
    this.zoom = Math.min(Math.max(this.zoom * factor, 0.2), 30);
    this.changed();
  }

  shiftBy(dx, dy) {
    this.shift[0] -= (2 * dx) / this.zoom;
    this.shift[1] += (2 * dy) / this.zoom;
    this.changed();
  }

  // Places a camera for a panel of an aspect ratio.
  apply(camera, aspect) {
    const [a, e] = [this.azimuth, this.elevation].map((angle) => (angle * Math.PI) / 180);
    const back = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
    const right = [-Math.sin(a), Math.cos(a), 0];
    const up = [-Math.sin(e) * Math.cos(a), -Math.sin(e) * Math.sin(a), Math.cos(e)];
    const half = (camera.fov * Math.PI) / 360;
    const distance = (MARGIN * this.radius) / Math.sin(half) / Math.min(aspect, 1) / this.zoom;
    const centre = this.target.map(
      (value, k) => value + this.radius * (this.shift[0] * right[k] + this.shift[1] * up[k]),
    );
    camera.up.set(0, 0, 1);
    camera.position.set(...centre.map((value, k) => value + distance * back[k]));
    camera.lookAt(...centre);
    camera.aspect = aspect;
    camera.near = distance / 100;
    camera.far = distance + 20 * this.radius;
    camera.updateProjectionMatrix();
    camera.updateMatrixWorld();
  }
}
