"use strict";
// People's bodies: a light mesh that bones bend (linear blend skinning), frame by frame.

class Skins {
  constructor(data, recording) {
    this.recording = recording;
    this.faces = unpacked(data.mesh.faces, Int16Array);
    this.bones = unpacked(data.mesh.bones, Int16Array);
    this.weights = unpacked(data.mesh.weights, Uint8Array);
    this.parents = unpacked(data.mesh.parents, Int16Array);
    this.rest = unpacked(data.rest, Int16Array);
    this.restJoints = unpacked(data.rest_joints, Int16Array);
    this.turns = unpacked(data.turns, Int16Array);
    this.pelvis = unpacked(data.pelvis, Int16Array);
    this.count = this.bones.length / 4;
    this.moves = new Float64Array(12 * this.parents.length);
  }
  /** Vertices of a row's body, three numbers each, metres; null where there is none. */
  vertices(row, person) {
    const pelvis = this.recording.place(this.pelvis, 3 * row);
    if (!pelvis) return null;
    this.pose(row, person, pelvis);
    const { rest, bones, weights, moves, count } = this, out = new Float64Array(3 * count);
    for (let v = 0; v < count; v++) {
      const at = 3 * (person * count + v), x = rest[at] / 1000, y = rest[at + 1] / 1000, z = rest[at + 2] / 1000;
      let sum = 0, a = 0, b = 0, c = 0;
      for (let k = 4 * v; k < 4 * v + 4; k++) {
        const w = weights[k], m = 12 * bones[k];
        if (!w) continue;
        sum += w;
        a += w * (moves[m] * x + moves[m + 1] * y + moves[m + 2] * z + moves[m + 3]);
        b += w * (moves[m + 4] * x + moves[m + 5] * y + moves[m + 6] * z + moves[m + 7]);
        c += w * (moves[m + 8] * x + moves[m + 9] * y + moves[m + 10] * z + moves[m + 11]);
      }
      out[3 * v] = a / sum;
      out[3 * v + 1] = b / sum;
      out[3 * v + 2] = c / sum;
    }
    return out;
  }
  /** How far the skin at each vertex turns to the light, from -1 to 1: the mean over the triangles around it. */
  slopes(at, light) {
    const { faces, count } = this, normal = new Float64Array(3 * count), out = new Float64Array(count);
    for (let t = 0; t < faces.length; t += 3) {
      const p = 3 * faces[t], q = 3 * faces[t + 1], s = 3 * faces[t + 2];
      const ax = at[q] - at[p], ay = at[q + 1] - at[p + 1], az = at[q + 2] - at[p + 2];
      const bx = at[s] - at[p], by = at[s + 1] - at[p + 1], bz = at[s + 2] - at[p + 2];
      const nx = ay * bz - az * by, ny = az * bx - ax * bz, nz = ax * by - ay * bx;
      for (const v of [p, q, s]) {
        normal[v] += nx;
        normal[v + 1] += ny;
        normal[v + 2] += nz;
      }
    }
    for (let v = 0; v < count; v++) {
      const x = normal[3 * v], y = normal[3 * v + 1], z = normal[3 * v + 2];
      out[v] = (x * light[0] + y * light[1] + z * light[2]) / (Math.hypot(x, y, z) || 1);
    }
    return out;
  }
  /** Each bone's motion from the T-pose into the world, three rows of four. */
  pose(row, person, pelvis) {
    const { parents, moves, turns, restJoints } = this, B = parents.length;
    const at = (b, axis) => restJoints[3 * (person * B + b) + axis] / 1000;
    for (let b = 0; b < B; b++) {
      const q = [0, 1, 2, 3].map((i) => turns[4 * (row * B + b) + i]);
      const n = Math.hypot(...q) || 1, [x, y, z, w] = q.map((value) => value / n);
      const own = [
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
      ];
      const parent = 12 * parents[b];
      for (let i = 0; i < 3; i++) {
        // A joint stays where its parent bone takes it; the pelvis is where it is.
        let place = pelvis[i];
        if (b > 0) place = moves[parent + 4 * i + 3] + [0, 1, 2].reduce((s, k) => s + moves[parent + 4 * i + k] * at(b, k), 0);
        for (let j = 0; j < 3; j++) {
          moves[12 * b + 4 * i + j] = b === 0 ? own[3 * i + j]
            : [0, 1, 2].reduce((s, k) => s + moves[parent + 4 * i + k] * own[3 * k + j], 0);
        }
        moves[12 * b + 4 * i + 3] = place;
      }
      for (let i = 0; i < 3; i++) {
        for (let j = 0; j < 3; j++) moves[12 * b + 4 * i + 3] -= moves[12 * b + 4 * i + j] * at(b, j);
      }
    }
  }
}
