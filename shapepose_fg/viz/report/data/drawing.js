"use strict";
// The scene on a canvas: floor, then everything else from far to near.

const SURE = 2.8;  // sigmas within which a joint lies with 95 % probability, in 3D
const TRAIL_S = 2;
const SHADES = 24;

function mixed(hex, other, share) {
  const part = (text, at) => parseInt(text.slice(at, at + 2), 16);
  const channel = (at) => Math.round(part(hex, at) * (1 - share) + part(other, at) * share);
  return `rgb(${channel(1)},${channel(3)},${channel(5)})`;
}

/** The colour of skin that faces the light (1) or turns away from it (0). */
function shaded(hex, lit) {
  return lit < 0.5 ? mixed(hex, "#1c2233", 0.42 * (1 - 2 * lit)) : mixed(hex, "#ffffff", 0.62 * (2 * lit - 1));
}

class Painter {
  constructor(canvas, recording, eye) {
    this.canvas = canvas;
    this.ctx = canvas.getContext("2d");
    this.recording = recording;
    this.eye = eye;
    this.shades = recording.people.map((person) => ({
      plain: person.colour,
      skin: Array.from({ length: SHADES }, (_, i) => shaded(person.colour, i / (SHADES - 1))),
      dark: mixed(person.colour, "#202838", 0.28),
      bone: mixed(person.colour, "#10141c", 0.55),
    }));
    this.readTheme();
  }
  readTheme() {
    const style = getComputedStyle(document.documentElement);
    const value = (name) => style.getPropertyValue(name).trim();
    this.theme = { line: value("--grid"), ground: value("--ground"), ink: value("--ink"), soft: value("--soft"),
      paper: value("--stage"), shadow: value("--shadow") };
    this.dark = value("--dark") === "1";
  }
  resize() {
    const box = this.canvas.getBoundingClientRect(), ratio = Math.min(window.devicePixelRatio || 1, 2);
    this.canvas.width = Math.max(1, Math.round(box.width * ratio));
    this.canvas.height = Math.max(1, Math.round(box.height * ratio));
    this.ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.eye.resize(box.width, box.height);
  }
  draw(frame, show) {
    const { ctx, eye } = this;
    eye.settle();
    ctx.clearRect(0, 0, eye.width, eye.height);
    ctx.lineCap = ctx.lineJoin = "round";
    this.floor();
    const items = [];
    for (let row = this.recording.starts[frame]; row < this.recording.starts[frame + 1]; row++) {
      const person = this.recording.who[row];
      this.shadow(row);
      if (show.trails) this.trail(frame, person);
      if (show.bodies && this.recording.skins) this.body(items, row, person);
      if (show.bones) this.bones(items, row, person, show.bodies && this.recording.skins);
      if (show.sigma) this.spheres(items, row, person);
      this.label(items, row, person);
    }
    if (show.cameras) this.recording.cameras.forEach((camera, index) => this.camera(items, camera, index));
    if (show.before) this.recording.before.forEach((camera) => this.camera(items, camera, null));
    items.sort((a, b) => b.depth - a.depth);
    for (const item of items) {
      if (item.paint) item.paint();
      else {
        ctx.lineWidth = 0.8;
        this.triangle(item);
      }
    }
    if (eye.frameBox) this.frameOf(eye.frameBox);
    this.compass();
  }
  /** A round floor with lines every half metre. */
  floor() {
    const { ctx, eye, recording } = this, view = recording.view, z = recording.floor;
    let radius = view.reach + 1.2;
    if (view.cameras > 0 && view.cameras < 3.5 * radius) radius = Math.max(radius, view.cameras + 0.6);
    const step = radius > 14 ? 2 : radius > 7 ? 1 : 0.5;
    const centre = [Math.round(view.middle[0]), Math.round(view.middle[1])];
    const rim = [];
    for (let i = 0; i < 96; i++) {
      const angle = i * Math.PI / 48;
      rim.push([centre[0] + radius * Math.cos(angle), centre[1] + radius * Math.sin(angle), z]);
    }
    const seen = rim.map((p) => eye.project(p));
    if (seen.every(Boolean)) {
      ctx.beginPath();
      seen.forEach((p, i) => (i ? ctx.lineTo(p[0], p[1]) : ctx.moveTo(p[0], p[1])));
      ctx.closePath();
      ctx.fillStyle = this.theme.ground;
      ctx.fill();
    }
    ctx.strokeStyle = this.theme.line;
    for (const whole of [false, true]) {
      ctx.beginPath();
      ctx.lineWidth = whole ? 1.1 : 0.6;
      const n = Math.floor(radius / step);
      for (let i = -n; i <= n; i++) {
        const at = i * step, half = Math.sqrt(radius * radius - at * at);
        if ((Math.abs(at / (2 * step)) % 1 < 1e-6) !== whole) continue;
        for (const [a, b] of [
          [[centre[0] + at, centre[1] - half, z], [centre[0] + at, centre[1] + half, z]],
          [[centre[0] - half, centre[1] + at, z], [centre[0] + half, centre[1] + at, z]],
        ]) {
          const ends = eye.line(a, b);
          if (!ends) continue;
          ctx.moveTo(ends[0][0], ends[0][1]);
          ctx.lineTo(ends[1][0], ends[1][1]);
        }
      }
      ctx.stroke();
    }
    this.step = step;
  }
  /** A soft shadow below the middle of a person. */
  shadow(row) {
    const { ctx, eye, recording } = this, middle = recording.middle(row);
    if (!middle) return;
    const at = [middle[0], middle[1], recording.floor], p = eye.project(at);
    if (!p) return;
    const wide = 0.42 * eye.fx / p[2], flat = Math.max(0.12, Math.abs(eye.forward[2]));
    ctx.save();
    ctx.translate(p[0], p[1]);
    ctx.scale(1, flat);
    const fade = ctx.createRadialGradient(0, 0, 0, 0, 0, wide);
    fade.addColorStop(0, this.theme.shadow);
    fade.addColorStop(1, "rgba(0,0,0,0)");
    ctx.fillStyle = fade;
    ctx.beginPath();
    ctx.arc(0, 0, wide, 0, 2 * Math.PI);
    ctx.fill();
    ctx.restore();
  }
  /** Where a person walked in the last seconds, on the floor. */
  trail(frame, person) {
    const { ctx, eye, recording } = this, now = recording.times[frame];
    let last = null;
    for (let f = frame; f >= 0 && now - recording.times[f] <= TRAIL_S; f--) {
      const row = recording.rowOf(f, person), middle = row < 0 ? null : recording.middle(row);
      const p = middle && eye.project([middle[0], middle[1], recording.floor]);
      if (p && last) {
        ctx.globalAlpha = 0.85 * (1 - (now - recording.times[f]) / TRAIL_S);
        ctx.strokeStyle = this.shades[person].plain;
        ctx.lineWidth = 2.5;
        ctx.beginPath();
        ctx.moveTo(last[0], last[1]);
        ctx.lineTo(p[0], p[1]);
        ctx.stroke();
      }
      last = p;
    }
    ctx.globalAlpha = 1;
  }
  /** The triangles of a body that face the eye, each in the shade of its slope. */
  body(items, row, person) {
    const { eye, recording } = this, skins = recording.skins, shades = this.shades[person].skin;
    const vertices = skins.vertices(row, person);
    if (!vertices) return;
    const n = skins.count, x = new Float64Array(n), y = new Float64Array(n), z = new Float64Array(n);
    const [r, u, f, o] = [eye.right, eye.up, eye.forward, eye.position];
    for (let v = 0; v < n; v++) {
      const a = vertices[3 * v] - o[0], b = vertices[3 * v + 1] - o[1], c = vertices[3 * v + 2] - o[2];
      z[v] = a * f[0] + b * f[1] + c * f[2];
      x[v] = eye.cx + eye.fx * (a * r[0] + b * r[1] + c * r[2]) / z[v];
      y[v] = eye.cy - eye.fy * (a * u[0] + b * u[1] + c * u[2]) / z[v];
    }
    const light = unit(add(add(scaled(r, -0.45), u, 0.75), f, -0.6)), faces = skins.faces;
    const slope = skins.slopes(vertices, light);
    for (let t = 0; t < faces.length; t += 3) {
      const i = faces[t], j = faces[t + 1], k = faces[t + 2];
      if (z[i] < Eye.NEAR || z[j] < Eye.NEAR || z[k] < Eye.NEAR) continue;
      // What turns clockwise on the screen, whose y points down, is seen from behind.
      if ((x[j] - x[i]) * (y[k] - y[i]) - (x[k] - x[i]) * (y[j] - y[i]) >= 0) continue;
      const lit = (slope[i] + slope[j] + slope[k]) / 3;
      const shade = shades[Math.round((SHADES - 1) * Math.min(1, Math.max(0, 0.5 + 0.5 * lit)))];
      items.push({ depth: (z[i] + z[j] + z[k]) / 3, shade, x: [x[i], x[j], x[k]], y: [y[i], y[j], y[k]] });
    }
  }
  triangle({ shade, x, y }) {
    const ctx = this.ctx;
    ctx.fillStyle = ctx.strokeStyle = shade;
    ctx.beginPath();
    ctx.moveTo(x[0], y[0]);
    ctx.lineTo(x[1], y[1]);
    ctx.lineTo(x[2], y[2]);
    ctx.closePath();
    ctx.fill();
    ctx.stroke();  // closes the hairline between neighbours
  }
  /** Joints and what joins them; rings where no camera saw a joint. */
  bones(items, row, person, overBody) {
    const { ctx, eye, recording } = this, shade = this.shades[person];
    const front = overBody ? 0.3 : 0, points = [];
    for (let j = 0; j < recording.J; j++) {
      const at = recording.joint(row, j);
      points.push(at && eye.project(at));
    }
    for (const [a, b] of recording.bones) {
      const p = points[a], q = points[b];
      if (!p || !q) continue;
      const depth = (p[2] + q[2]) / 2, sure = recording.seen(row, a) && recording.seen(row, b);
      items.push({ depth: depth - front, paint: () => {
        ctx.strokeStyle = overBody && !this.dark ? shade.bone : shade.plain;
        if (overBody && this.dark) ctx.strokeStyle = shade.bone;
        ctx.globalAlpha = sure ? 1 : 0.55;
        ctx.lineWidth = Math.max(1.2, 0.018 * eye.fx / depth);
        ctx.beginPath();
        ctx.moveTo(p[0], p[1]);
        ctx.lineTo(q[0], q[1]);
        ctx.stroke();
        ctx.globalAlpha = 1;
      } });
    }
    points.forEach((p, j) => {
      if (!p) return;
      const radius = Math.max(1.6, 0.019 * eye.fx / p[2]), seen = recording.seen(row, j);
      items.push({ depth: p[2] - front - 0.03, paint: () => {
        ctx.beginPath();
        ctx.arc(p[0], p[1], seen ? radius : 1.15 * radius, 0, 2 * Math.PI);
        ctx.fillStyle = seen ? (overBody ? shade.bone : shade.plain) : "#ffffff";
        ctx.fill();
        if (!seen) {
          ctx.strokeStyle = shade.bone;
          ctx.lineWidth = Math.max(1, 0.45 * radius);
          ctx.stroke();
        }
      } });
    });
  }
  /** Spheres that hold a joint's place with 95 % probability. */
  spheres(items, row, person) {
    const { ctx, eye, recording } = this;
    for (let j = 0; j < recording.J; j++) {
      const at = recording.joint(row, j), p = at && eye.project(at), sigma = recording.sigma(row, j);
      if (!p || !sigma) continue;
      items.push({ depth: p[2] - 0.32, paint: () => {
        ctx.beginPath();
        ctx.arc(p[0], p[1], SURE * sigma * eye.fx / p[2], 0, 2 * Math.PI);
        ctx.globalAlpha = 0.16;
        ctx.fillStyle = this.shades[person].plain;
        ctx.fill();
        ctx.globalAlpha = 0.8;
        ctx.lineWidth = 1;
        ctx.strokeStyle = this.shades[person].bone;
        ctx.stroke();
        ctx.globalAlpha = 1;
      } });
    }
  }
  /** A person's number above the head, and above a raised hand. */
  label(items, row, person) {
    const { ctx, eye, recording } = this, middle = recording.middle(row);
    if (!middle) return;
    let top = -Infinity;
    for (let j = 0; j < recording.J; j++) {
      const at = recording.joint(row, j);
      if (at) top = Math.max(top, at[2]);
    }
    const p = eye.project([middle[0], middle[1], top + 0.22]);
    if (!p) return;
    const text = String(recording.people[person].id);
    items.push({ depth: p[2] - 0.4, paint: () => {
      ctx.font = "600 12px system-ui, sans-serif";
      ctx.textAlign = "center";
      ctx.textBaseline = "middle";
      const wide = Math.max(18, ctx.measureText(text).width + 10);
      ctx.fillStyle = this.shades[person].dark;
      ctx.beginPath();
      ctx.roundRect(p[0] - wide / 2, p[1] - 18, wide, 18, 9);
      ctx.fill();
      ctx.fillStyle = "#ffffff";
      ctx.fillText(text, p[0], p[1] - 8.5);
    } });
  }
  /** A camera as the pyramid that it sees; without an index as it was before, dashed and without a name. */
  camera(items, camera, index) {
    const { ctx, eye } = this;
    if (index !== null && eye.through === index) return;
    const [fx, fy, cx, cy] = camera.K, [w, h] = camera.size;
    const deep = Math.min(0.5, 0.07 * this.recording.view.reach + 0.18);
    const corners = [[0, 0], [w, 0], [w, h], [0, h]].map(([x, y]) => {
      const ray = [(x - cx) / fx, (y - cy) / fy, 1];
      return add(add(add(camera.centre, camera.turn[0], deep * ray[0]), camera.turn[1], deep * ray[1]), camera.turn[2], deep);
    });
    const centre = eye.project(camera.centre), depth = eye.depth(camera.centre);
    if (!centre) return;
    items.push({ depth, paint: () => {
      ctx.strokeStyle = index === null ? "#c8513f" : this.theme.soft;
      ctx.lineWidth = 1.2;
      ctx.setLineDash(index === null ? [5, 4] : []);
      const points = corners.map((corner) => eye.project(corner));
      if (points.every(Boolean)) {
        ctx.beginPath();
        points.forEach((p, i) => (i ? ctx.lineTo(p[0], p[1]) : ctx.moveTo(p[0], p[1])));
        ctx.closePath();
        ctx.globalAlpha = 0.12;
        ctx.fillStyle = this.theme.soft;
        ctx.fill();
        ctx.globalAlpha = 1;
      }
      ctx.beginPath();
      const edges = corners.map((corner, i) => [corner, corners[(i + 1) % 4]]);
      for (const [a, b] of [...edges, ...corners.map((corner) => [camera.centre, corner])]) {
        const ends = eye.line(a, b);
        if (!ends) continue;
        ctx.moveTo(ends[0][0], ends[0][1]);
        ctx.lineTo(ends[1][0], ends[1][1]);
      }
      ctx.stroke();
      ctx.setLineDash([]);
      if (index === null) return;
      ctx.font = "11px system-ui, sans-serif";
      ctx.textAlign = "center";
      ctx.textBaseline = "bottom";
      ctx.lineWidth = 3;
      ctx.strokeStyle = this.theme.paper;
      const name = camera.name.length > 18 ? `…${camera.name.slice(-17)}` : camera.name;
      const drawn = [centre, ...points.filter(Boolean)];
      if (!drawn.some(([x, y]) => x > 0 && x < eye.width && y > 0 && y < eye.height)) return;
      const half = ctx.measureText(name).width / 2 + 4;
      const along = Math.max(half, Math.min(eye.width - half, centre[0]));
      const above = Math.max(16, Math.min(...drawn.map((p) => p[1])) - 4);
      ctx.strokeText(name, along, above);
      ctx.fillStyle = this.theme.ink;
      ctx.fillText(name, along, above);
    } });
  }
  /** The edge of a camera's picture, and shade outside it. */
  frameOf([x, y, w, h]) {
    const { ctx, eye } = this;
    ctx.fillStyle = this.theme.paper;
    ctx.globalAlpha = 0.72;
    ctx.beginPath();
    ctx.rect(0, 0, eye.width, eye.height);
    ctx.rect(x, y, w, h);
    ctx.fill("evenodd");
    ctx.globalAlpha = 1;
    ctx.strokeStyle = this.theme.soft;
    ctx.lineWidth = 1;
    ctx.strokeRect(x, y, w, h);
  }
  /** The world's axes, in the corner. */
  compass() {
    const { ctx, eye, recording } = this, size = 20, x = 34, y = eye.height - 34;
    ["x", "y", "z"].forEach((name, i) => {
      const axis = recording.axes[i];
      const dx = size * dot(axis, eye.right), dy = -size * dot(axis, eye.up);
      ctx.strokeStyle = ctx.fillStyle = ["#c8513f", "#4f9a4b", "#3f7fb8"][i];
      ctx.lineWidth = 2;
      ctx.beginPath();
      ctx.moveTo(x, y);
      ctx.lineTo(x + dx, y + dy);
      ctx.stroke();
      ctx.font = "600 10px system-ui, sans-serif";
      ctx.textAlign = "center";
      ctx.textBaseline = "middle";
      ctx.fillText(name, x + 1.4 * dx, y + 1.4 * dy);
    });
  }
}
