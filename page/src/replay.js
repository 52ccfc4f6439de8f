// A recorded run, played in the page: the messages of /runs/last, at their own times.

import { SPAN_S } from './timeline.js';

export class Replay {
  #timer = null;
  #playing = false;
  #from = 0; #began = 0;

  /** `show(frame)` for the instant at hand, `moved(at_s, playing)` for the scrubber. */
  constructor(show, moved) {
    this.show = show;
    this.moved = moved;
    this.frames = [];
    this.events = [];
    this.hello = null;
  }

  static async fetched(address, show, moved) {
    const reply = await fetch(address);
    if (!reply.ok) throw new Error((await reply.text()).trim() || `no recording (${reply.status})`);
    const replay = new Replay(show, moved);
    for (const line of (await reply.text()).split('\n')) if (line) replay.#take(JSON.parse(line));
    if (!replay.frames.length) throw new Error('the recording is empty');
    return replay;
  }

  #take(message) {
    if (message.type === 'hello') this.hello = message;
    else if (message.type === 'frame') this.frames.push(message);
    else if (message.type === 'event') this.events.push(message);
  }

  get startS() { return this.frames[0].t; }
  get endS() { return this.frames.at(-1).t; }
  get playing() { return this.#playing; }

  /** What the timeline shows at `at_s`. */
  window(at_s) {
    return [
      this.frames.slice(this.#indexAt(at_s - SPAN_S), this.#indexAt(at_s) + 1),
      this.events.filter((event) => event.at_s <= at_s && event.at_s > at_s - SPAN_S),
    ];
  }

  seek(at_s) {
    this.#from = Math.max(this.startS, Math.min(this.endS, at_s));
    this.#began = performance.now();
    this.#tell(this.#from);
  }

  play() {
    if (this.#from >= this.endS) this.#from = this.startS;
    this.#playing = true;
    this.#began = performance.now();
    this.#timer = setInterval(() => {
      const at_s = this.#from + (performance.now() - this.#began) / 1000;
      if (at_s >= this.endS) this.pause(this.endS);
      else this.#tell(at_s);
    }, 40);
  }

  pause(at_s = this.#from + (this.#playing ? (performance.now() - this.#began) / 1000 : 0)) {
    clearInterval(this.#timer);
    this.#playing = false;
    this.seek(at_s);
  }

  stop() { clearInterval(this.#timer); this.#playing = false; }

  #tell(at_s) {
    this.show(this.frames[this.#indexAt(at_s)], at_s);
    this.moved(at_s, this.#playing);
  }

  /** The last frame not after `at_s`, or the first. */
  #indexAt(at_s) {
    let low = 0, high = this.frames.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.frames[middle].t <= at_s) low = middle + 1; else high = middle;
    }
    return Math.max(0, low - 1);
  }
}
