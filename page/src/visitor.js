// The visitor as the person who is listened to: microphone and camera, what is sent, and nothing else.

const VOICE = 1, FACE = 2, VERSION = 1, HEADER = 24;
const MOST_WAITING = 64_000; // bytes: a line that is slower than this gets no more until it has caught up
const CAMERA_MS = 40;

/** The 24 bytes before a piece of voice or a face (docs/reference/protocol.md), and the piece. */
export function framed(kind, rate_hz, at_s, body) {
  const message = new Uint8Array(HEADER + body.byteLength);
  const view = new DataView(message.buffer);
  view.setUint8(0, kind);
  view.setUint8(1, VERSION);
  view.setUint32(4, rate_hz, true);
  view.setFloat64(8, performance.now() / 1000, true);
  view.setFloat64(16, at_s, true);
  message.set(new Uint8Array(body.buffer, body.byteOffset, body.byteLength), HEADER);
  return message;
}

export class Visitor extends EventTarget {
  #connection; #context = null; #voice = null; #camera = null; #timer = null; #tracker = null;

  constructor(connection) {
    super();
    this.#connection = connection;
    this.sent = { voice: 0, face: 0 }; // bytes
    connection.addEventListener('closed', () => this.stop());
  }

  get talking() { return this.#voice !== null; }
  get seen() { return this.#camera !== null; }
  get feeds() { return [this.talking && 'voice', this.seen && 'face'].filter(Boolean); }

  /** Asks the browser for the microphone. Throws what the browser says. */
  async startVoice() {
    const wanted = { echoCancellation: true, noiseSuppression: false, autoGainControl: true, channelCount: 1 };
    const stream = await media({ audio: wanted });
    this.#context = new AudioContext();
    await this.#context.resume();
    await this.#context.audioWorklet.addModule('static/voice-worklet.js');
    const source = this.#context.createMediaStreamSource(stream);
    const pieces = new AudioWorkletNode(this.#context, 'voice-pieces', { numberOfOutputs: 0 });
    const behind_s = performance.now() / 1000 - this.#context.currentTime; // of the sound's clock to ours
    pieces.port.onmessage = ({ data: { piece, at } }) => this.#heard(piece, at + behind_s);
    source.connect(pieces);
    this.#voice = stream;
    stream.getTracks()[0].onended = () => this.stopVoice();
    this.#announce();
  }

  stopVoice() {
    this.#voice?.getTracks().forEach((track) => track.stop());
    this.#context?.close();
    this.#voice = this.#context = null;
    this.#announce();
  }

  /** Asks for the camera; `video` shows the visitor what it sees. The picture itself never leaves the browser. */
  async startFace(video, channels) {
    const stream = await media({ video: { width: 640, height: 480, frameRate: 30, facingMode: 'user' } });
    video.srcObject = stream;
    this.#camera = stream;
    try {
      await video.play();
      const { FaceTracker } = await import('./face.js');
      this.#tracker = await FaceTracker.opened(channels);
    } catch (error) {
      this.stopFace();
      throw error;
    }
    stream.getTracks()[0].onended = () => this.stopFace();
    let last = -1;
    this.#timer = setInterval(() => {
      if (video.currentTime === last || this.#connection.waiting > MOST_WAITING) return;
      last = video.currentTime;
      const at_s = performance.now() / 1000;
      const face = this.#tracker.track(video, performance.now());
      this.#send(FACE, 0, at_s, face ?? new Float32Array(0));
      this.dispatchEvent(new CustomEvent('face', { detail: face }));
    }, CAMERA_MS);
    this.#announce();
  }

  stopFace() {
    clearInterval(this.#timer);
    this.#camera?.getTracks().forEach((track) => track.stop());
    this.#tracker?.close();
    this.#camera = this.#tracker = null;
    this.#announce();
  }

  stop() {
    if (this.talking) this.stopVoice();
    if (this.seen) this.stopFace();
  }

  #heard(piece, at_s) {
    let most = 0;
    for (const sample of piece) most = Math.max(most, Math.abs(sample));
    this.dispatchEvent(new CustomEvent('level', { detail: most / 32767 }));
    if (this.#connection.waiting < MOST_WAITING) this.#send(VOICE, this.#context.sampleRate, at_s, piece);
  }

  #send(kind, rate_hz, at_s, body) {
    this.#connection.sendBytes(framed(kind, rate_hz, at_s, body));
    this.sent[kind === VOICE ? 'voice' : 'face'] += HEADER + body.byteLength;
  }

  #announce() {
    this.#connection.send('source', { feeds: this.feeds });
    this.dispatchEvent(new Event('changed'));
  }
}

async function media(wanted) {
  if (!navigator.mediaDevices) throw new Error('the browser lends microphone and camera to https and localhost alone');
  try {
    return await navigator.mediaDevices.getUserMedia(wanted);
  } catch (error) {
    const said = { NotAllowedError: 'the browser was not allowed to', NotFoundError: 'there is none', NotReadableError: 'it is in use elsewhere' };
    throw new Error(said[error.name] ?? error.message);
  }
}
