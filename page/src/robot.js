// The robot head, from its URDF. Loaded after the first picture of the human.

import { Box3, Color, DirectionalLight, Group, HemisphereLight, LoadingManager, Sphere, Vector3 } from 'three';
import URDFLoader from 'urdf-loader';

const FAULT_COLORS = { silent: 0x6b4fa0, limp: 0xc29a00, hot: 0xe0561b, faulty: 0xd02020 };

/** What a fault is shown as. */
export function kindOfFault(text) {
  if (/silent|no (answer|reply|status)|unplugged|gone|lost/i.test(text)) return 'silent';
  if (/limp|torque/i.test(text)) return 'limp';
  if (/hot|heat|temperature/i.test(text)) return 'hot';
  return 'faulty';
}

/** Fetches and reads a URDF. Throws an Error that names the file, or the joint that is not in it. */
export async function loadRobot(address, names, complain) {
  const reply = await fetch(address);
  if (!reply.ok) throw new Error(`${address}: ${reply.status} ${(await reply.text()).trim()}`);
  const text = await reply.text();
  const document_ = new DOMParser().parseFromString(text, 'text/xml');
  const problem = document_.querySelector('parsererror');
  if (problem) throw new Error(`${address}: not XML: ${problem.textContent.trim().split('\n')[0]}`);
  if (!document_.querySelector('robot')) throw new Error(`${address}: no <robot> in it`);
  const folder = new URL(address, location.href);
  const manager = new LoadingManager();
  manager.onError = (url) => complain(`${address}: mesh ${decodeURIComponent(url.split('/').pop())} cannot be loaded`);
  const loader = new URDFLoader(manager);
  loader.workingPath = new URL('.', folder).href;
  loader.packages = (name) => new URL(name, folder).href;
  const model = loader.parse(document_);
  const missing = names.filter((name) => !(name in model.joints));
  if (missing.length) complain(`${address}: no joint "${missing[0]}" (there is ${Object.keys(model.joints).slice(0, 8).join(', ')})`);
  return new Robot(model, names, new Promise((resolve) => { manager.onLoad = resolve; }));
}

class Robot {
  #glow = new Map(); // mesh -> the fault that it shows

  constructor(model, names, loaded) {
    this.model = model;
    this.names = names;
    this.loaded = loaded; // its meshes are there; never where it has none
    this.group = new Group();
    this.group.add(model);
    const key = new DirectionalLight(0xfff1e0, 2.2), rim = new DirectionalLight(0xdfe9ff, 1.0);
    key.position.set(-1.2, 1.6, 2.0);
    rim.position.set(1.8, 0.6, -0.6);
    this.lights = [new HemisphereLight(0xe9f0f8, 0x6d6257, 1.5), key, rim];
  }

  /** Joint values (rad, m), in the order of `names`. */
  show(values) {
    this.names.forEach((name, i) => {
      const joint = this.model.joints[name];
      if (joint && Number.isFinite(values[i])) {
        joint.ignoreLimits = true; // the servos stand where they stand
        joint.setJointValue(values[i]);
      }
    });
  }

  /** Colour the parts that each joint moves; joints of the head that are none of the URDF are only named. */
  showFaults(faults) {
    const wanted = new Map();
    for (const [name, text] of Object.entries(faults)) {
      this.model.joints[name]?.traverse((part) => part.isMesh && wanted.set(part, new Color(FAULT_COLORS[kindOfFault(text)])));
    }
    for (const [part, fault] of wanted) {
      if (!this.#glow.has(part)) {
        this.#glow.set(part, part.material);
        part.material = part.material.clone();
      }
      part.material.color.copy(fault);
      part.material.emissive?.copy(fault).multiplyScalar(0.35);
    }
    for (const [part, material] of this.#glow) {
      if (wanted.has(part)) continue;
      part.material.dispose();
      part.material = material;
      this.#glow.delete(part);
    }
  }

  /** Where a camera sees all of it: arguments of `View.aim`. */
  framing() {
    const box = new Box3().setFromObject(this.group);
    if (box.isEmpty()) return [[0, 0, 0], 1, 0.3, 0.1, 0.2];
    const size = box.getSize(new Vector3()), sphere = box.getBoundingSphere(new Sphere());
    const half = Math.max(size.y * 0.56, 0.02);
    const wide = Math.max(size.x, size.z) * 0.56;
    return [sphere.center.toArray(), half / Math.tan((13 * Math.PI) / 180) + size.z / 2, 0.38, 0.10, wide];
  }
}
