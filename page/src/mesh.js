// The virtual head's file (sfms_robot/face/human_mesh.py describes it) and the motion of its vertices. No WebGL here.
//
// Morphs and the turn of the neck are done by the processor: 60,000 small moves, a millisecond a frame. The graphics
// card then needs one short shader, which every browser compiles quickly, and normals follow the skin exactly.

const TYPES = { uint8: Uint8Array, uint16: Uint16Array, int16: Int16Array };
const PIVOT_M = [-0.012, 0.0, -0.065];

/** The file -> {facts, rest, share, part, openSky, triangles, morphs: Map(name -> {moved, moves, step})}. */
export function readHead(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const facts = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  if (facts.version !== 1) throw new Error(`mesh of version ${facts.version}; this page reads version 1`);
  const arrays = {};
  let at = 4 + length;
  for (const [name, type, count] of facts.arrays) {
    at += (4 - (at % 4)) % 4;
    arrays[name] = new TYPES[type](buffer, at, count);
    at += arrays[name].byteLength;
  }
  const morphs = new Map();
  let first = 0;
  for (const { name, count, step_m: step } of facts.morphs) {
    const moved = arrays.moved.subarray(first, first + count);
    morphs.set(name, { moved, moves: arrays.moves.subarray(3 * first, 3 * (first + count)), step });
    first += count;
  }
  const rest = Float32Array.from(arrays.rest, (steps) => steps * facts.step_m);
  return { ...arrays, facts, rest, morphs, openSky: arrays.open_sky };
}

/** A head's vertices at any motion. `positions` and `normals` are filled anew by `pose`, in the robot's axes. */
export class PosedHead {
  constructor(head) {
    this.head = head;
    this.positions = Float32Array.from(head.rest);
    this.normals = new Float32Array(head.rest.length);
    this.#computeNormals();
  }

  /** `motion`: (58,) roll, pitch, yaw [rad], x, y, z [m], then one weight per morph, in the order of the file. */
  pose(motion) {
    const { rest, morphs } = this.head;
    const out = this.positions;
    out.set(rest);
    let channel = 6;
    for (const { moved, moves, step } of morphs.values()) {
      const weight = motion[channel++] * step;
      if (Math.abs(weight) < 1e-12) continue;
      for (let i = 0, j = 0; i < moved.length; i++, j += 3) {
        const v = 3 * moved[i];
        out[v] += weight * moves[j];
        out[v + 1] += weight * moves[j + 1];
        out[v + 2] += weight * moves[j + 2];
      }
    }
    this.#turn(motion);
    this.#computeNormals();
  }

  /** R = Rz(yaw) Ry(pitch) Rx(roll) about the neck, each vertex by its own share of the angles. */
  #turn(motion) {
    const { share } = this.head;
    const out = this.positions;
    const turns = new Array(256); // shares come in 256 steps
    for (let i = 0; i < share.length; i++) {
      const part = share[i];
      if (part === 0) continue;
      const r = (turns[part] ??= rotation(motion, part / 255));
      const v = 3 * i;
      const x = out[v] - PIVOT_M[0], y = out[v + 1] - PIVOT_M[1], z = out[v + 2] - PIVOT_M[2];
      out[v] = r[0] * x + r[1] * y + r[2] * z + r[9];
      out[v + 1] = r[3] * x + r[4] * y + r[5] * z + r[10];
      out[v + 2] = r[6] * x + r[7] * y + r[8] * z + r[11];
    }
  }

  #computeNormals() {
    const { triangles } = this.head;
    const p = this.positions, n = this.normals;
    n.fill(0);
    for (let t = 0; t < triangles.length; t += 3) {
      const a = 3 * triangles[t], b = 3 * triangles[t + 1], c = 3 * triangles[t + 2];
      const ux = p[b] - p[a], uy = p[b + 1] - p[a + 1], uz = p[b + 2] - p[a + 2];
      const vx = p[c] - p[a], vy = p[c + 1] - p[a + 1], vz = p[c + 2] - p[a + 2];
      const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
      n[a] += x; n[a + 1] += y; n[a + 2] += z;
      n[b] += x; n[b + 1] += y; n[b + 2] += z;
      n[c] += x; n[c + 1] += y; n[c + 2] += z;
    }
    for (let i = 0; i < n.length; i += 3) {
      const length = Math.hypot(n[i], n[i + 1], n[i + 2]) || 1;
      n[i] /= length; n[i + 1] /= length; n[i + 2] /= length;
    }
  }
}

function rotation(motion, share) {
  const [roll, pitch, yaw] = [motion[0] * share, motion[1] * share, motion[2] * share];
  const cr = Math.cos(roll), sr = Math.sin(roll), cp = Math.cos(pitch), sp = Math.sin(pitch);
  const cy = Math.cos(yaw), sy = Math.sin(yaw);
  return [
    cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr,
    sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr,
    -sp, cp * sr, cp * cr,
    PIVOT_M[0] + motion[3] * share, PIVOT_M[1] + motion[4] * share, PIVOT_M[2] + motion[5] * share,
  ];
}
