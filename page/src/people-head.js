// The virtual human on a canvas of its own: the mesh and the shader of the page, without its library (a tenth of the size).

import { PosedHead, readHead } from './mesh.js';
import { FRAGMENT, VERTEX } from './skin.js';

const UNIFORMS = 'uniform mat4 modelViewMatrix, projectionMatrix, viewMatrix;\nuniform mat3 normalMatrix;\n';
const TARGET_M = [0, -0.012, 0.02];
const DISTANCE_M = 1.05;
const FIELD_RAD = 0.37;
// the robot's axes (x forward, y left, z up) -> the viewer's (z to the viewer, x right, y up), column by column
const AXES = [0, 0, 1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 1];

export class Head {
  constructor(canvas, file) {
    this.canvas = canvas;
    const gl = (this.gl = canvas.getContext('webgl2', { antialias: true }));
    if (!gl) throw new Error('this browser has no WebGL 2, which drawing the faces needs');
    this.head = readHead(file);
    this.posed = new PosedHead(this.head);
    this.program = linked(gl, `precision highp float;\n${UNIFORMS}attribute vec3 position;\nattribute vec3 normal;\n${VERTEX}`,
      `precision highp float;\nuniform mat4 viewMatrix;\n${FRAGMENT}`);
    gl.useProgram(this.program);
    this.#attribute('rest', this.head.rest, 3, gl.FLOAT);
    this.#attribute('part', this.head.part, 1, gl.UNSIGNED_BYTE);
    this.#attribute('sky', this.head.openSky, 1, gl.UNSIGNED_BYTE, true);
    this.#attribute('scalp', this.head.scalp, 1, gl.UNSIGNED_BYTE, true);
    this.position = this.#attribute('position', this.posed.positions, 3, gl.FLOAT);
    this.normal = this.#attribute('normal', this.posed.normals, 3, gl.FLOAT);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, this.head.triangles, gl.STATIC_DRAW);
    gl.enable(gl.DEPTH_TEST);
  }

  /** `motion`: (58,). */
  show(motion) {
    const { gl, canvas, posed } = this;
    const scale = window.devicePixelRatio || 1;
    const [width, height] = [Math.round(canvas.clientWidth * scale), Math.round(canvas.clientHeight * scale)];
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    posed.pose(motion);
    for (const [buffer, values] of [[this.position, posed.positions], [this.normal, posed.normals]]) {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW);
    }
    gl.viewport(0, 0, width, height);
    gl.clearColor(0.905, 0.915, 0.925, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const view = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, -TARGET_M[0], -TARGET_M[1], -TARGET_M[2] - DISTANCE_M, 1];
    const modelView = AXES.slice();
    for (let i = 0; i < 3; i++) modelView[12 + i] = view[12 + i];
    const normal = [0, 1, 2, 4, 5, 6, 8, 9, 10].map((i) => modelView[i]);
    gl.uniformMatrix4fv(this.#at('viewMatrix'), false, view);
    gl.uniformMatrix4fv(this.#at('modelViewMatrix'), false, modelView);
    gl.uniformMatrix4fv(this.#at('projectionMatrix'), false, projection(width / height));
    gl.uniformMatrix3fv(this.#at('normalMatrix'), false, normal);
    const index = this.head.triangles instanceof Uint32Array ? gl.UNSIGNED_INT : gl.UNSIGNED_SHORT;
    gl.drawElements(gl.TRIANGLES, this.head.triangles.length, index, 0);
  }

  #at(name) { return this.gl.getUniformLocation(this.program, name); }

  #attribute(name, values, size, type, normalized = false) {
    const { gl } = this;
    const buffer = gl.createBuffer();
    const place = gl.getAttribLocation(this.program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    if (place >= 0) {
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, type, normalized, 0, 0);
    }
    return buffer;
  }
}

function projection(aspect) {
  const near = 0.1, far = 10;
  const narrow = Math.min(1, aspect / 0.9); // a narrow picture steps back, so that ears stay in it
  const f = narrow / Math.tan(FIELD_RAD / 2);
  return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0];
}

function linked(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [type, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  return program;
}
