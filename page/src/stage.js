// One canvas, two views: the virtual human, and the robot beside it. Draws only when something has moved.

import { Group, PerspectiveCamera, Scene, WebGLRenderer } from 'three';

const EASE_MS = 40; // a frame of the run: motion arrives at 25 Hz and is drawn at the screen's rate
const TURN_PER_PX = 0.008;
const WIDEST = 0.9;

class View {
  constructor(cell, fieldDeg) {
    this.cell = cell;
    this.scene = new Scene();
    this.root = new Group(); // the robot's axes (x forward, y left, z up) -> three's (z to the viewer, x right, y up)
    this.root.matrixAutoUpdate = false;
    this.root.matrix.set(0, 1, 0, 0, 0, 0, 1, 0, 1, 0, 0, 0, 0, 0, 0, 1);
    this.scene.add(this.root);
    this.camera = new PerspectiveCamera(fieldDeg, 1, 0.02, 20);
    this.aim([0, 0, 0], 1, 0, 0, 0.2);
  }

  /** Look at `target` (three's axes) from `distance` metres, so that `half` metres to each side are always seen. */
  aim(target, distance, azimuth, elevation, half) {
    Object.assign(this, { target, home: { distance, azimuth, elevation }, distance, azimuth, elevation, half });
  }

  turn(azimuth, elevation, closer = 1) {
    this.azimuth += azimuth;
    this.elevation = Math.max(-WIDEST, Math.min(WIDEST, this.elevation + elevation));
    this.distance = Math.max(0.4, Math.min(2, this.distance / this.home.distance / closer)) * this.home.distance;
  }

  reset() { Object.assign(this, this.home); }

  place(width, height) {
    const { camera, target, azimuth, elevation } = this;
    camera.aspect = width / height;
    const fits = this.half / Math.tan((camera.fov * Math.PI) / 360) / camera.aspect; // narrow cells: step back
    const distance = Math.max(this.distance, fits * (this.distance / this.home.distance));
    camera.position.set(
      target[0] + distance * Math.sin(azimuth) * Math.cos(elevation),
      target[1] + distance * Math.sin(elevation),
      target[2] + distance * Math.cos(azimuth) * Math.cos(elevation),
    );
    camera.lookAt(...target);
    camera.updateProjectionMatrix();
  }
}

/** Numbers on their way to the newest target. */
class Eased {
  #from = null; #to = null; #began = 0; #done = true;

  aim(target, now) {
    this.#from = this.#to === null || this.#to.length !== target.length ? target.slice() : this.at(now).slice();
    this.#to = target.slice();
    this.#began = now;
    this.#done = false;
  }

  /** The values now, or null where nothing has changed since the last call that reached the target. */
  step(now) {
    if (this.#done) return null;
    if (now - this.#began >= EASE_MS) this.#done = true;
    return this.at(now);
  }

  at(now) {
    const part = Math.min(1, (now - this.#began) / EASE_MS);
    return this.#to.map((to, i) => this.#from[i] + part * (to - this.#from[i]));
  }
}

export class Stage {
  #motion = new Eased();
  #joints = new Eased();
  #dirty = true;
  #told = false; // that the face has been drawn
  #fence = null;
  #drawing = null; // motion of the picture that is being drawn

  /** Throws where there is no WebGL. */
  constructor(canvas, humanCell, robotCell) {
    this.canvas = canvas;
    this.renderer = new WebGLRenderer({ canvas, alpha: true, antialias: true, powerPreference: 'low-power' });
    this.renderer.setClearColor(0, 0);
    this.renderer.autoClear = false;
    this.renderer.debug.checkShaderErrors = false; // asking waits for the compiler
    this.human = null;
    this.robot = null;
    this.pictures = 0; // that were drawn
    this.seen = null; // motion that the last of them shows
    this.views = [new View(humanCell, 22), new View(robotCell, 26)];
    this.views[0].aim([0, 0.010, 0.02], 0.92, 0, 0.04, 0.125);
    new ResizeObserver(() => this.redraw()).observe(canvas);
    canvas.addEventListener('webglcontextlost', (event) => event.preventDefault());
    canvas.addEventListener('webglcontextrestored', () => this.redraw());
    this.#listenToPointer();
    requestAnimationFrame((now) => this.#loop(now));
  }

  /** Compile the human's shader while its mesh is on its way. */
  prepare(mesh) { this.renderer.compile(mesh, this.views[0].camera); }

  setHuman(human) {
    this.human = human;
    this.views[0].root.add(human.group);
    this.redraw();
  }

  /** The robot, and whatever lights it; null takes it away. */
  setRobot(robot) {
    const view = this.views[1];
    view.scene.clear();
    view.scene.add(view.root);
    view.root.clear();
    this.robot = robot;
    if (robot) {
      view.root.add(robot.group);
      view.scene.add(...robot.lights);
      view.root.updateMatrixWorld(true);
      view.aim(...robot.framing());
    }
    this.redraw();
  }

  show(motion, joints) {
    const now = performance.now();
    this.#motion.aim(motion, now);
    this.#joints.aim(joints, now);
  }

  redraw() { this.#dirty = true; }

  #loop(now) {
    requestAnimationFrame((next) => this.#loop(next));
    if (document.hidden || this.#behind()) return;
    const motion = this.#motion.step(now), joints = this.#joints.step(now);
    if (motion && this.human) { this.human.show(motion); this.#drawing = motion; this.#dirty = true; }
    if (joints && this.robot) { this.robot.show(joints); this.#dirty = true; }
    if (this.#dirty) this.#draw();
  }

  /** Whether the last picture is still being drawn: without a graphics card that takes longer than a frame. */
  #behind() {
    const gl = this.renderer.getContext();
    if (this.#fence && gl.getSyncParameter(this.#fence, gl.SYNC_STATUS) !== gl.SIGNALED && !gl.isContextLost()) return true;
    if (this.#fence) { this.pictures += 1; this.seen = this.#drawing; }
    gl.deleteSync(this.#fence);
    this.#fence = null;
    return false;
  }

  #draw() {
    const { canvas, renderer } = this;
    const box = canvas.getBoundingClientRect();
    const ratio = Math.min(devicePixelRatio, 2);
    if (!box.width) return;
    if (canvas.width !== Math.floor(box.width * ratio) || canvas.height !== Math.floor(box.height * ratio)) {
      renderer.setPixelRatio(ratio);
      renderer.setSize(box.width, box.height, false);
    }
    this.#dirty = false;
    renderer.setScissorTest(false);
    renderer.clear();
    renderer.setScissorTest(true);
    for (const view of this.views) {
      const cell = view.cell.getBoundingClientRect();
      if (!cell.width || !view.root.children.length) continue;
      view.place(cell.width, cell.height);
      const box4 = [cell.left - box.left, box.bottom - cell.bottom, cell.width, cell.height];
      renderer.setViewport(...box4);
      renderer.setScissor(...box4);
      renderer.render(view.scene, view.camera);
    }
    const gl = renderer.getContext();
    this.#fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    if (this.human && !this.#told) this.#tell(gl);
  }

  /** The face is seen for the first time: that is waited for, nothing else is there yet to be held up. */
  #tell(gl) {
    gl.finish();
    this.#told = true;
    performance.mark('first picture');
    dispatchEvent(new Event('first-picture'));
  }

  #viewAt(x) {
    const robot = this.views[1].cell.getBoundingClientRect();
    return this.robot && robot.width && x >= robot.left ? this.views[1] : this.views[0];
  }

  #listenToPointer() {
    const { canvas } = this;
    let view = null, x = 0, y = 0;
    canvas.addEventListener('pointerdown', (event) => {
      view = this.#viewAt(event.clientX);
      [x, y] = [event.clientX, event.clientY];
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener('pointermove', (event) => {
      if (!view) return;
      view.turn(-(event.clientX - x) * TURN_PER_PX, (event.clientY - y) * TURN_PER_PX);
      [x, y] = [event.clientX, event.clientY];
      this.redraw();
    });
    for (const end of ['pointerup', 'pointercancel']) canvas.addEventListener(end, () => { view = null; });
    canvas.addEventListener('dblclick', () => { this.views.forEach((each) => each.reset()); this.redraw(); });
    canvas.addEventListener('wheel', (event) => {
      if (!event.ctrlKey && document.activeElement !== canvas) return; // the page scrolls unless the picture is meant
      event.preventDefault();
      this.#viewAt(event.clientX).turn(0, 0, Math.exp(-event.deltaY / 800));
      this.redraw();
    }, { passive: false });
    canvas.addEventListener('keydown', (event) => {
      const turns = { ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1], '+': [0, 0, 1.1], '-': [0, 0, 1 / 1.1] };
      if (event.key === 'Home') this.views.forEach((each) => each.reset());
      else if (event.key in turns) this.views.forEach((each) => each.turn(...turns[event.key]));
      else return;
      event.preventDefault();
      this.redraw();
    });
  }
}
