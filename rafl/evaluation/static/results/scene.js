// Recorded markers and simulated bodies in 3-D: one panel for each method, or all in one.

import * as THREE from "/static/three/three.module.min.js";
import { Body } from "/static/results/body.js";
import { COLOURINGS, SELECTED, methodColour, pageColour } from "/static/results/colours.js";
import { drawLabels } from "/static/results/labels.js";
import { Orbit } from "/static/results/orbit.js";
import { frameOf } from "/static/results/source.js";

const FIELD_DEGREES = 24;
const MARKER_SIZE = 0.014; // radius, in the radius of all that is shown
const PICK_PX = 14;

export class Scene {
  // `select` is called with the number of a marker that was clicked.
  // Throws where the browser has no WebGL.
  constructor(canvas, labels, select) {
    Object.assign(this, { canvas, labels, select, frame: 0, bodies: new Map(), shown: [], overlaid: false });
    THREE.ColorManagement.enabled = false; // colours are shown as the legend has them
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
    this.renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    this.renderer.autoClear = false;
    this.camera = new THREE.PerspectiveCamera(FIELD_DEGREES, 1, 0.1, 10);
    this.lamp = new THREE.DirectionalLight(0xffffff, 1.7);
    this.world = new THREE.Scene();
    this.world.add(new THREE.AmbientLight(0xffffff, 1.9), this.lamp, this.lamp.target);
    this.orbit = new Orbit(canvas, () => this.request(), (x, y) => this.pick(x, y));
    this.state = { colouring: "none", lines: 0, marker: -1, text: {} };
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.request());
    this.resize();
  }

  // Takes a motion, or null for none. `methods` are the names of all methods, in the order of their colours.
  load(motion, methods) {
    for (const body of this.bodies.values()) {
      this.world.remove(body.group);
      body.free();
    }
    if (this.markers) {
      this.world.remove(this.markers);
      this.markers.geometry.dispose();
      this.markers.material.dispose();
      this.markers.dispose();
    }
    this.bodies = new Map();
    this.markers = null;
    this.motion = motion;
    if (!motion) return this.request();
    for (const [index, method] of methods.entries()) {
      if (!motion.methods.get(method)?.vertices) continue;
      const body = new Body(motion, method, methodColour(index));
      this.bodies.set(method, body);
      this.world.add(body.group);
    }
    const { centre, radius } = extent(motion);
    this.size = MARKER_SIZE * radius;
    this.radius = radius;
    const material = new THREE.MeshLambertMaterial({ color: 0xffffff });
    this.markers = new THREE.InstancedMesh(new THREE.SphereGeometry(1, 14, 10), material, motion.markers.length);
    this.markers.frustumCulled = false;
    this.world.add(this.markers);
    this.orbit.fit(centre, radius);
    return this.restyle();
  }

  // Which methods are shown, and how.
  set(shown, overlaid, state) {
    Object.assign(this, { shown, overlaid });
    Object.assign(this.state, state);
    this.restyle();
  }

  restyle() {
    for (const body of this.bodies.values()) {
      body.style(this.state.colouring, this.most(), this.overlaid && this.shown.length > 1, this.state.lines);
    }
    this.show(this.frame);
  }

  // The largest value that colours show, over all methods and frames.
  most() {
    const about = COLOURINGS[this.state.colouring];
    let most = 0;
    if (about && this.motion) {
      for (const own of this.motion.methods.values()) {
        for (const value of own[about.key]?.values ?? []) if (value > most) most = value;
      }
    }
    return most;
  }

  show(frame) {
    this.frame = frame;
    if (this.motion) {
      for (const body of this.bodies.values()) body.show(frame);
      this.placeMarkers();
    }
    this.request();
  }

  placeMarkers() {
    const points = frameOf(this.motion.recorded, this.frame),
      matrix = new THREE.Matrix4(),
      plain = new THREE.Color(pageColour("recorded")),
      chosen = new THREE.Color(SELECTED);
    for (let k = 0; k < this.motion.markers.length; k++) {
      const [x, y, z] = points.subarray(3 * k, 3 * k + 3);
      const size = Number.isNaN(x) ? 0 : this.size * (k === this.state.marker ? 1.7 : 1);
      matrix.makeScale(size, size, size).setPosition(size ? x : 0, size ? y : 0, size ? z : 0);
      this.markers.setMatrixAt(k, matrix);
      this.markers.setColorAt(k, k === this.state.marker ? chosen : plain);
    }
    this.markers.instanceMatrix.needsUpdate = true;
    this.markers.instanceColor.needsUpdate = true;
  }

  resize() {
    const { clientWidth, clientHeight } = this.canvas.parentElement;
    this.ratio = Math.min(window.devicePixelRatio || 1, 2);
    this.renderer.setPixelRatio(this.ratio);
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.labels.width = this.canvas.width;
    this.labels.height = this.canvas.height;
    this.draw();
  }

  // Draws once before the browser shows the next picture.
  request() {
    if (this.requested) return;
    this.requested = true;
    requestAnimationFrame(() => this.draw());
  }

  // Panels: label, methods, and place in CSS pixels from the top left.
  panels() {
    const { clientWidth, clientHeight } = this.canvas.parentElement;
    const groups = this.overlaid || this.shown.length < 2 ? [this.shown] : this.shown.map((method) => [method]);
    // As many columns as make the shorter side of a panel longest.
    const side = (columns) => Math.min(clientWidth / columns, clientHeight / Math.ceil(groups.length / columns));
    const columns = groups.map((_, k) => k + 1).reduce((best, own) => (side(own) > side(best) ? own : best), 1),
      rows = Math.ceil(groups.length / columns);
    const [width, height] = [Math.floor(clientWidth / columns), Math.floor(clientHeight / rows)];
    return groups.map((methods, k) => ({
      methods,
      left: (k % columns) * width,
      top: Math.floor(k / columns) * height,
      width,
      height,
    }));
  }

  draw() {
    this.requested = false;
    const panels = this.panels(),
      { clientHeight } = this.canvas.parentElement;
    this.renderer.setScissorTest(false);
    this.renderer.setClearColor(new THREE.Color(pageColour("scene")), 1);
    this.renderer.clear();
    this.renderer.setScissorTest(true);
    for (const panel of panels) {
      const place = [panel.left, clientHeight - panel.top - panel.height, panel.width, panel.height];
      this.renderer.setViewport(...place);
      this.renderer.setScissor(...place);
      for (const [method, body] of this.bodies) body.group.visible = panel.methods.includes(method);
      this.orbit.apply(this.camera, panel.width / panel.height);
      this.lamp.position.copy(this.camera.position);
      this.lamp.target.position.set(...this.orbit.target);
      this.lamp.target.updateMatrixWorld();
      this.renderer.render(this.world, this.camera);
    }
    drawLabels(this, panels);
  }

  // Where a point [m] is in a panel, in CSS pixels of the view.
  project(point, panel) {
    this.orbit.apply(this.camera, panel.width / panel.height);
    const { x, y } = new THREE.Vector3(...point).project(this.camera);
    return [panel.left + (0.5 + 0.5 * x) * panel.width, panel.top + (0.5 - 0.5 * y) * panel.height];
  }

  pick(x, y) {
    if (!this.motion) return;
    const inside = ({ left, top, width, height }) => x >= left && x < left + width && y >= top && y < top + height;
    const panel = this.panels().find(inside);
    if (!panel) return;
    const points = frameOf(this.motion.recorded, this.frame);
    let [nearest, least] = [-1, PICK_PX];
    for (let k = 0; k < this.motion.markers.length; k++) {
      const [u, v] = this.project(points.subarray(3 * k, 3 * k + 3), panel),
        distance = Math.hypot(u - x, v - y);
      if (distance < least) [nearest, least] = [k, distance];
    }
    if (nearest >= 0) this.select(nearest);
  }
}

// Centre and radius of a ball around all bodies and markers.
function extent(motion) {
  const low = [Infinity, Infinity, Infinity],
    high = [-Infinity, -Infinity, -Infinity];
  const arrays = [motion.recorded, ...[...motion.methods.values()].map((own) => own.vertices ?? own.markers)];
  for (const { values } of arrays) {
    values.forEach((value, k) => {
      if (value < low[k % 3]) low[k % 3] = value;
      if (value > high[k % 3]) high[k % 3] = value;
    });
  }
  const centre = low.map((value, k) => 0.5 * (value + high[k]));
  return { centre, radius: 0.5 * Math.hypot(...low.map((value, k) => high[k] - value)) };
}
