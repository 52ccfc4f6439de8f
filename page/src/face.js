// The visitor's face by MediaPipe's landmarker, in the browser: 52 blendshapes and the pose of the head, no picture sent.

import { FaceLandmarker } from '@mediapipe/tasks-vision';

const FILES = { wasmLoaderPath: 'static/vision/vision_wasm_internal.js', wasmBinaryPath: 'static/vision/vision_wasm_internal.wasm' };
const MODEL = 'face_landmarker.task';
const M_PER_CM = 0.01;

export class FaceTracker {
  #landmarker; #order;

  static async opened(channels) {
    const landmarker = await FaceLandmarker.createFromOptions(FILES, {
      baseOptions: { modelAssetPath: MODEL, delegate: 'CPU' },
      runningMode: 'VIDEO', numFaces: 1, outputFaceBlendshapes: true, outputFacialTransformationMatrixes: true,
    });
    return new FaceTracker(landmarker, channels);
  }

  constructor(landmarker, channels) {
    this.#landmarker = landmarker;
    this.#order = new Map(channels.map((name, i) => [name, i]));
  }

  /** (58,) of the protocol, or null where there is no face. */
  track(video, now_ms) {
    const found = this.#landmarker.detectForVideo(video, now_ms);
    if (!found.faceBlendshapes.length || !found.facialTransformationMatrixes.length) return null;
    const face = new Float32Array(58);
    for (const { categoryName, score } of found.faceBlendshapes[0].categories) {
      const i = this.#order.get(categoryName);
      if (i >= 6) face[i] = score;
    }
    face.set(poseOf(found.facialTransformationMatrixes[0].data));
    return face;
  }

  close() { this.#landmarker.close(); }
}

/**
 * MediaPipe's 4 x 4 (columns first; x to the picture's right, y up, z to the camera; centimetres) -> roll, pitch, yaw
 * [rad], x, y, z [m] of the person's head in its own axes: x forward (from the lens on, so negative), y to its left, z
 * up. The same as sfms_robot/sources/webcam_worker.py.
 */
export function poseOf(m) {
  const r = (row, column) => m[4 * column + row];
  const axes = [2, 0, 1]; // ours x, y, z are theirs z, x, y: the person's left is the picture's right
  const R = axes.map((row) => axes.map((column) => r(row, column)));
  const pitch = Math.asin(Math.max(-1, Math.min(1, -R[2][0])));
  return [Math.atan2(R[2][1], R[2][2]), pitch, Math.atan2(R[1][0], R[0][0]), ...axes.map((row) => r(row, 3) * M_PER_CM)];
}
