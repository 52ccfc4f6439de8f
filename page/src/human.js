// The virtual human: one mesh, one shader. Skin tone, lips, brows, irises and hair are painted by the shader from where
// a point of the face lies at rest, so they stay sharp at any size and no picture is loaded.

import { BufferAttribute, BufferGeometry, Group, Mesh, ShaderMaterial, DoubleSide } from 'three';
import { PosedHead, readHead } from './mesh.js';
import { FRAGMENT, VERTEX } from './skin.js';

const material = new ShaderMaterial({ vertexShader: VERTEX, fragmentShader: FRAGMENT, side: DoubleSide });

/** Something that is drawn as the human is, to have the shader compiled. */
export const forerunner = () => new Mesh(new BufferGeometry(), material);

export class Human {
  constructor(buffer) {
    const head = readHead(buffer);
    this.posed = new PosedHead(head);
    this.channels = ['roll', 'pitch', 'yaw', 'x', 'y', 'z', ...head.morphs.keys()];
    const geometry = new BufferGeometry();
    this.position = new BufferAttribute(this.posed.positions, 3);
    this.normal = new BufferAttribute(this.posed.normals, 3);
    geometry.setAttribute('position', this.position);
    geometry.setAttribute('normal', this.normal);
    geometry.setAttribute('rest', new BufferAttribute(head.rest, 3));
    geometry.setAttribute('part', new BufferAttribute(head.part, 1));
    geometry.setAttribute('sky', new BufferAttribute(head.openSky, 1, true));
    geometry.setAttribute('scalp', new BufferAttribute(head.scalp, 1, true));
    geometry.setIndex(new BufferAttribute(head.triangles, 1));
    this.mesh = new Mesh(geometry, material);
    this.mesh.frustumCulled = false; // its box moves with every frame
    this.group = new Group();
    this.group.add(this.mesh);
  }

  /** `motion` (58,) in the order of `channels`. */
  show(motion) {
    this.posed.pose(motion);
    this.position.needsUpdate = true;
    this.normal.needsUpdate = true;
  }
}
