"use strict";
// Vectors, packed arrays, and the camera through which the scene is seen. Metres, z up.

const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scaled = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const unit = (a) => scaled(a, 1 / Math.hypot(a[0], a[1], a[2]));

function unpacked(text, Kind) {
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return new Kind(bytes.buffer);
}

/** The recording: people's rows by frame, their joints and bodies. */
class Recording {
  constructor(data) {
    Object.assign(this, data);
    this.frames = unpacked(data.frames, Int32Array);
    this.times = unpacked(data.times, Float32Array);
    this.starts = unpacked(data.starts, Int32Array);
    this.who = unpacked(data.who, Uint16Array);
    this.joints = unpacked(data.joints, Int16Array);
    this.known = unpacked(data.known, Uint8Array);
    this.J = data.joint_names.length;
    this.skins = data.mesh ? new Skins(data, this) : null;
  }
  get length() { return this.frames.length; }
  place(packed, at) {
    if (packed[at] === -32768) return null;
    return [0, 1, 2].map((axis) => this.origin[axis] + this.unit * packed[at + axis]);
  }
  joint(row, j) { return this.place(this.joints, 3 * (row * this.J + j)); }
  seen(row, j) { return (this.known[row * this.J + j] & 3) === 1; }
  /** Standard deviation in metres; 0 where it is not known. */
  sigma(row, j) {
    const level = this.known[row * this.J + j] >> 2;
    return level === 0 ? 0 : 1e-3 * 2 ** ((level - 1) / 8);
  }
  rowOf(frame, person) {
    for (let row = this.starts[frame]; row < this.starts[frame + 1]; row++) if (this.who[row] === person) return row;
    return -1;
  }
  /** Share of a row's joints that a camera saw, of those placed. */
  seenShare(row) {
    let placed = 0, seen = 0;
    for (let j = 0; j < this.J; j++) {
      if (this.joints[3 * (row * this.J + j)] === -32768) continue;
      placed++;
      if (this.seen(row, j)) seen++;
    }
    return placed ? seen / placed : 0;
  }
  /** Middle of a row's placed joints. */
  middle(row) {
    let sum = [0, 0, 0], count = 0;
    for (let j = 0; j < this.J; j++) {
      const at = this.joint(row, j);
      if (at) { sum = add(sum, at); count++; }
    }
    return count ? scaled(sum, 1 / count) : null;
  }
}

/** From where and how the scene is seen: around a target, or through one of the cameras. */
class Eye {
  constructor(view, cameras) {
    this.view = view;
    this.cameras = cameras;
    this.through = null;
    this.width = this.height = 1;
    this.reset();
  }
  reset() {
    this.azimuth = Eye.AZIMUTH;
    this.elevation = Eye.ELEVATION;
    this.target = [...this.view.middle];
    this.through = null;
    this.zoom = 1;
    this.fit = null;
  }
  resize(width, height) {
    this.width = width;
    this.height = height;
    this.fit = null;
  }
  turn(dx, dy) {
    this.leave();
    this.azimuth -= dx;
    this.elevation = Math.min(1.55, Math.max(-0.35, this.elevation + dy));
  }
  move(dx, dy) {
    this.leave();
    const metres = this.distance / this.focal;
    this.target = add(add(this.target, this.right, -dx * metres), this.up, dy * metres);
  }
  scale(factor) {
    this.leave();
    this.zoom = Math.min(12, Math.max(0.12, this.zoom * factor));
  }
  /** Away from a camera, to the free view. */
  leave() { this.through = null; }
  /** How far the eye is from its target, metres. */
  get distance() {
    this.fit ??= this.fitting();
    return this.fit / this.zoom;
  }
  /** The distance at which the box around all people just fits on the screen, in the first view. */
  fitting() {
    const { low, high, middle } = this.view, [forward, right, up] = Eye.axes(Eye.AZIMUTH, Eye.ELEVATION);
    let distance = 1;
    for (let corner = 0; corner < 8; corner++) {
      const at = sub([0, 1, 2].map((axis) => (corner >> axis & 1 ? high : low)[axis]), middle);
      const wide = Math.abs(dot(at, right)) * this.focal / (0.46 * this.width);
      const tall = Math.abs(dot(at, up)) * this.focal / (0.42 * this.height);
      distance = Math.max(distance, Math.max(wide, tall) - dot(at, forward));
    }
    return distance;
  }
  /** Bring position and axes up to date before drawing. */
  settle() {
    this.frameBox = null;
    if (this.through !== null) {
      const camera = this.cameras[this.through], [w, h] = camera.size;
      const s = Math.min(this.width / w, this.height / h) * 0.98;
      const x = (this.width - s * w) / 2, y = (this.height - s * h) / 2;
      this.position = camera.centre;
      this.right = camera.turn[0];
      this.up = scaled(camera.turn[1], -1);
      this.forward = camera.turn[2];
      this.fx = s * camera.K[0];
      this.fy = s * camera.K[1];
      this.cx = x + s * camera.K[2];
      this.cy = y + s * camera.K[3];
      this.focal = this.fx;
      this.frameBox = [x, y, s * w, s * h];
      return;
    }
    this.focal = this.fx = this.fy = 1.9 * Math.max(this.height, 0.6 * this.width);
    this.cx = this.width / 2;
    this.cy = this.height / 2;
    [this.forward, this.right, this.up] = Eye.axes(this.azimuth, this.elevation);
    this.position = add(this.target, this.forward, -this.distance);
  }
  depth(p) { return dot(sub(p, this.position), this.forward); }
  /** [x, y, depth] on the screen; null behind the eye. */
  project(p) {
    const d = sub(p, this.position), z = dot(d, this.forward);
    if (!(z > Eye.NEAR)) return null;
    return [this.cx + this.fx * dot(d, this.right) / z, this.cy - this.fy * dot(d, this.up) / z, z];
  }
  /** A line's two ends on the screen, cut where it passes the eye; null where all of it is behind. */
  line(a, b) {
    const za = this.depth(a), zb = this.depth(b), near = 1.01 * Eye.NEAR;
    if (za < near && zb < near) return null;
    if (za < near) a = add(a, sub(b, a), (near - za) / (zb - za));
    if (zb < near) b = add(b, sub(a, b), (near - zb) / (za - zb));
    return [this.project(a), this.project(b)];
  }
}
Eye.NEAR = 0.08;
Eye.AZIMUTH = -1.1;
Eye.ELEVATION = 0.36;
/** Forward, right and up of an eye that looks from a direction, radians. */
Eye.axes = (azimuth, elevation) => {
  const c = Math.cos(elevation), forward = [-c * Math.cos(azimuth), -c * Math.sin(azimuth), -Math.sin(elevation)];
  const right = unit(cross(forward, [0, 0, 1]));
  return [forward, right, cross(right, forward)];
};
