// One simulated body: its faces, their edges, and the simulated markers.

import * as THREE from "/static/three/three.module.min.js";
import { COLOURINGS, rgb, writeColour } from "/static/results/colours.js";
import { frameOf } from "/static/results/source.js";

const CORNERS = [0, 1, 2, 0, 2, 3]; // of two triangles of a face
const PLAIN_OPACITY = 0.55,
  OVERLAID_OPACITY = 0.25;
const NO_VALUE = [0.6, 0.6, 0.6];

export class Body {
  constructor(motion, method, colour) {
    Object.assign(this, { motion, own: motion.methods.get(method), colour: rgb(colour) });
    const faces = motion.faces;
    this.corners = Uint32Array.from(faces.flatMap((face) => CORNERS.map((corner) => face[corner])));
    const edges = new Map();
    for (const face of faces) {
      face.forEach((from, k) => {
        const to = face[(k + 1) % 4];
        edges.set(`${Math.min(from, to)} ${Math.max(from, to)}`, [from, to]);
      });
    }
    this.ends = Uint32Array.from([...edges.values()].flat());
    this.faceGeometry = geometry(this.corners.length, true);
    this.edgeGeometry = geometry(this.ends.length, false);
    const offset = { polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 };
    this.plain = new THREE.MeshLambertMaterial({ color: colour, flatShading: true, transparent: true, ...offset });
    this.painted = new THREE.MeshBasicMaterial({ vertexColors: true, transparent: true, ...offset });
    this.mesh = new THREE.Mesh(this.faceGeometry, this.plain);
    this.edges = new THREE.LineSegments(this.edgeGeometry, new THREE.LineBasicMaterial({ color: colour, transparent: true }));
    this.lineGeometry = geometry(2 * motion.markers.length, false);
    this.lines = new THREE.LineSegments(this.lineGeometry, new THREE.LineBasicMaterial({ color: colour }));
    this.group = new THREE.Group();
    for (const part of [this.mesh, this.edges, this.lines]) {
      part.frustumCulled = false;
      this.group.add(part);
    }
  }

  // How it looks: `colouring` is none or a key of COLOURINGS with the largest value, `lines` the factor of the errors.
  style(colouring, most, overlaid, lines) {
    this.shows = COLOURINGS[colouring] ? { ...COLOURINGS[colouring], most } : null;
    this.mesh.material = this.shows ? this.painted : this.plain;
    this.mesh.material.opacity = overlaid ? OVERLAID_OPACITY : this.shows ? 1 : PLAIN_OPACITY;
    this.mesh.material.depthWrite = !overlaid && Boolean(this.shows);
    this.edges.material.opacity = this.shows && !overlaid ? 0.35 : 0.9;
    if (this.shows && !overlaid) this.edges.material.color.setRGB(0, 0, 0);
    else this.edges.material.color.setRGB(...this.colour);
    this.factor = this.own.markers ? lines : 0;
    this.lines.visible = this.factor > 0;
  }

  show(frame) {
    const vertices = frameOf(this.own.vertices, frame);
    place(this.faceGeometry, this.corners, vertices);
    place(this.edgeGeometry, this.ends, vertices);
    if (this.shows) this.paint(frame);
    if (this.factor) this.drawLines(frame);
  }

  paint(frame) {
    const colours = this.faceGeometry.getAttribute("color");
    const array = this.own[this.shows.key];
    const values = array ? frameOf(array, frame) : null;
    for (let k = 0; k < this.corners.length; k++) {
      const place = this.shows.key === "strain" ? this.motion.cells[Math.floor(k / CORNERS.length)] : this.corners[k];
      const value = values ? values[place] : NaN;
      if (Number.isNaN(value)) colours.array.set(NO_VALUE, 3 * k);
      else writeColour(value / this.shows.most, colours.array, 3 * k);
    }
    colours.needsUpdate = true;
  }

  // Lines from the simulated to the recorded markers; a missing marker has none.
  drawLines(frame) {
    const simulated = frameOf(this.own.markers, frame),
      recorded = frameOf(this.motion.recorded, frame);
    const ends = this.lineGeometry.getAttribute("position");
    for (let k = 0; k < simulated.length; k++) {
      const at = 6 * Math.floor(k / 3) + (k % 3),
        error = recorded[k] - simulated[k];
      ends.array[at] = simulated[k];
      ends.array[at + 3] = simulated[k] + (Number.isNaN(error) ? 0 : this.factor * error);
    }
    ends.needsUpdate = true;
  }

  free() {
    for (const part of [this.faceGeometry, this.edgeGeometry, this.lineGeometry]) part.dispose();
    for (const part of [this.plain, this.painted, this.edges.material, this.lines.material]) part.dispose();
  }
}

function geometry(points, coloured) {
  const made = new THREE.BufferGeometry();
  made.setAttribute("position", new THREE.BufferAttribute(new Float32Array(3 * points), 3));
  if (coloured) made.setAttribute("color", new THREE.BufferAttribute(new Float32Array(3 * points), 3));
  return made;
}

function place(made, indices, vertices) {
  const points = made.getAttribute("position");
  for (let k = 0; k < indices.length; k++) {
    for (let axis = 0; axis < 3; axis++) points.array[3 * k + axis] = vertices[3 * indices[k] + axis];
  }
  points.needsUpdate = true;
}
