// The last twenty seconds: the voice with its phrases, what the listener decided, the pose asked for, one joint.

import { color } from './dom.js';

export const SPAN_S = 20;
const QUIET_DB = -62, LOUD_DB = -12;
const MARKS = { nod: '↓', shake: '↔', tilt: '⟋', smile: '☺', laugh: '☺', blink: '–', gaze_shift: '→', brow_raise: '^', mm_hm: '♪' };
const NAMES = { gaze_shift: 'looks away', brow_raise: 'raises brows', mm_hm: '“mm-hm”' };
const REASONS = { log_rate: 'its usual rate', looked_at: 'is looked at', floor_mine: 'its own turn' };
const reason = (name) => REASONS[name] ?? name.replace(/_s$/, '').replaceAll('_', ' ');
const named = (kind) => NAMES[kind] ?? kind.replaceAll('_', ' ');
const ROWS = [['voice', 0.23], ['events', 0.19], ['pose', 0.28], ['joint', 0.30]];
const AT_MOST_MS = 80; // a curve that scrolls needs no more
const LEFT_PX = 64, RIGHT_PX = 8, FOOT_PX = 16, LINE_PX = 12;
const MOST_LINES = 3; // of a joint's name, left of its curve

export class Timeline {
  #changed = false;

  constructor(canvas) {
    this.canvas = canvas;
    this.joint = -1; // the one that moves most
    this.jointNames = [];
    this.clear();
    this.pen = canvas.getContext('2d', { willReadFrequently: true }); // lines on the processor: the card has a face to draw
    new ResizeObserver(() => this.draw()).observe(canvas);
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => this.draw());
    setInterval(() => this.#changed && !document.hidden && requestAnimationFrame(() => this.#paint()), AT_MOST_MS);
  }

  clear() {
    this.frames = [];
    this.events = [];
    this.draw();
  }

  frame(frame) {
    const last = this.frames.at(-1);
    if (last && frame.t < last.t - 0.5) this.clear(); // another run
    this.frames.push(frame);
    while (this.frames[0].t < frame.t - SPAN_S - 1) this.frames.shift();
    while (this.events.length && this.events[0].at_s < frame.t - SPAN_S - 2) this.events.shift();
    this.draw();
  }

  event(event) { this.events.push(event); }

  /** Everything between two instants, of a recording. */
  show(frames, events) {
    this.frames = frames;
    this.events = events;
    this.draw();
  }

  draw() { this.#changed = true; }

  #paint() {
    this.#changed = false;
    const { canvas, pen } = this;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width || !height) return;
    const ratio = Math.min(devicePixelRatio, 2);
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.font = '11px system-ui, "DejaVu Sans", sans-serif';
    pen.textBaseline = 'middle';
    const end = Math.max(this.frames.at(-1)?.t ?? 0, 0.001);
    const x = (t) => LEFT_PX + ((t - end + SPAN_S) / SPAN_S) * (width - LEFT_PX - RIGHT_PX);
    this.#ground(pen, x, end, width, height);
    let top = 0;
    for (const [name, share] of ROWS) {
      const tall = share * (height - FOOT_PX);
      this[`_${name}`](pen, x, top + 4, tall - 8, end);
      pen.fillStyle = color('line');
      pen.fillRect(0, top + tall - 0.5, width, 1);
      top += tall;
    }
  }

  #ground(pen, x, end, width, height) {
    pen.save();
    pen.beginPath();
    pen.rect(LEFT_PX, 0, width - LEFT_PX, height - FOOT_PX);
    pen.clip();
    pen.fillStyle = color('phrase');
    let from = null;
    for (const frame of this.frames) {
      if (frame.talk && from === null) from = frame.t;
      if (!frame.talk && from !== null) { pen.fillRect(x(from), 0, x(frame.t) - x(from), height - FOOT_PX); from = null; }
    }
    if (from !== null) pen.fillRect(x(from), 0, x(end) - x(from), height - FOOT_PX);
    pen.restore();
    pen.fillStyle = color('quiet');
    pen.textAlign = 'center';
    for (let t = Math.ceil((end - SPAN_S) / 5) * 5; t <= end; t += 5) {
      if (t >= 0 && x(t) > LEFT_PX - 1) pen.fillText(`${t} s`, Math.min(x(t), width - 16), height - FOOT_PX / 2);
    }
  }

  #label(pen, text, y, hue = 'quiet') {
    pen.textAlign = 'left';
    pen.fillStyle = color(hue);
    pen.fillText(text, 2, y);
  }

  _voice(pen, x, top, tall) {
    const middle = top + tall / 2;
    this.#label(pen, 'voice', middle);
    for (const [key, hue] of [['db', 'voice'], ['own', 'own']]) {
      pen.fillStyle = color(hue);
      for (const frame of this.frames) {
        if (frame[key] === null || frame[key] === undefined || x(frame.t) < LEFT_PX) continue;
        const loud = Math.max(0, Math.min(1, (frame[key] - QUIET_DB) / (LOUD_DB - QUIET_DB)));
        const half = Math.max(0.5, (loud * tall) / 2);
        pen.fillRect(x(frame.t) - 1, middle - half, 1.7, 2 * half);
      }
    }
  }

  _events(pen, x, top, tall) {
    this.#label(pen, 'events', top + tall * 0.3);
    const hazards = this.frames.filter((frame) => frame.h);
    if (hazards.length) {
      const most = Math.max(0.2, ...hazards.map((frame) => frame.h.nod ?? 0));
      this.#label(pen, 'nod soon?', top + tall * 0.82, 'pitch');
      this.#line(pen, x, hazards, (frame) => frame.h.nod ?? 0, (v) => top + tall - (v / most) * tall * 0.75, 'pitch', 1, 0.7);
    }
    pen.textAlign = 'left';
    const ends = [-1e9, -1e9]; // of what is written in the two lines
    for (const event of this.events) {
      const at = x(event.at_s), until = x(event.at_s + Math.min(event.lasts_s ?? 0, 3));
      if (at < LEFT_PX) continue;
      const small = event.event === 'blink';
      pen.fillStyle = color(small ? 'quiet' : 'read');
      pen.globalAlpha = 0.9;
      pen.fillRect(at, top, small ? 2 : Math.max(3, until - at), small ? 5 : 6);
      pen.globalAlpha = 1;
      if (small) continue;
      const text = `${MARKS[event.event] ?? '·'} ${named(event.event)}`, wide = pen.measureText(text).width;
      const begin = Math.min(at, pen.canvas.clientWidth - wide - 2); // whole at the right end too
      const line = ends[0] < begin ? 0 : ends[1] < begin ? 1 : -1;
      if (line < 0) continue;
      pen.fillStyle = color('ink');
      pen.fillText(text, begin, top + 14 + 12 * line);
      ends[line] = begin + wide + 6;
    }
  }

  _pose(pen, x, top, tall) {
    const axes = [[1, 'pitch'], [2, 'yaw'], [0, 'roll']];
    const most = Math.max(0.12, ...this.frames.map((frame) => Math.max(...axes.map(([i]) => Math.abs(frame.m[i])))));
    const y = (v) => top + tall / 2 + (v / most) * (tall / 2); // nose down is down
    axes.forEach(([i, hue], row) => {
      this.#label(pen, hue, top + tall * (0.17 + 0.33 * row), hue);
      this.#line(pen, x, this.frames, (frame) => frame.m[i], y, hue, 1.6);
    });
    this.#scale(pen, x, most, top, tall);
  }

  _joint(pen, x, top, tall) {
    const chosen = this.joint < 0 ? this.#liveliest() : this.joint;
    const asked = (frame) => frame.j[chosen], read = (frame) => frame.r?.[chosen] ?? null;
    const values = this.frames.flatMap((frame) => [asked(frame), read(frame)]).filter((v) => v !== null && v !== undefined);
    const low = Math.min(...values), high = Math.max(...values);
    const middle = values.length ? (low + high) / 2 : 0, most = Math.max(0.03, (high - low) / 2 || 0);
    const y = (v) => top + tall / 2 - ((v - middle) / most) * (tall / 2 - 3);
    this.#label(pen, 'goal', top + tall * 0.70, 'asked');
    this.#label(pen, 'is at', top + tall * 0.90, 'read');
    this.#line(pen, x, this.frames, read, y, 'read', 2.2);
    this.#line(pen, x, this.frames, asked, y, 'asked', 1.2);
    const lines = wrapped(this.jointNames[chosen] ?? 'joint', (text) => pen.measureText(text).width, LEFT_PX - 6, MOST_LINES);
    lines.forEach((line, i) => this.#label(pen, line, top + tall * 0.06 + LINE_PX * i));
    this.#scale(pen, x, most, top, tall);
  }

  #liveliest() {
    const count = this.frames[0]?.j.length ?? 0;
    let best = 0, most = -1;
    for (let joint = 0; joint < count; joint++) {
      let low = Infinity, high = -Infinity;
      for (const { j } of this.frames) { low = Math.min(low, j[joint]); high = Math.max(high, j[joint]); }
      if (high - low > 1.3 * most) [best, most] = [joint, high - low]; // the first of those that move about as much
    }
    return best;
  }

  #scale(pen, x, most, top, tall) {
    const text = `± ${((most * 180) / Math.PI).toFixed(most < 0.2 ? 1 : 0)}°`, wide = pen.measureText(text).width;
    pen.fillStyle = color('panel'); // under it: a curve may run there
    pen.globalAlpha = 0.85;
    pen.fillRect(pen.canvas.clientWidth - RIGHT_PX - wide - 3, top + tall - 11, wide + 6, 14);
    pen.globalAlpha = 1;
    pen.textAlign = 'right';
    pen.fillStyle = color('quiet');
    pen.fillText(text, pen.canvas.clientWidth - RIGHT_PX, top + tall - 4);
  }

  #line(pen, x, frames, value, y, hue, wide, alpha = 1) {
    pen.beginPath();
    let down = false;
    for (const frame of frames) {
      const v = value(frame);
      if (v === null || v === undefined || x(frame.t) < LEFT_PX) { down = false; continue; }
      if (down) pen.lineTo(x(frame.t), y(v)); else pen.moveTo(x(frame.t), y(v));
      down = true;
    }
    pen.strokeStyle = color(hue);
    pen.lineWidth = wide;
    pen.globalAlpha = alpha;
    pen.lineJoin = 'round';
    pen.stroke();
    pen.globalAlpha = 1;
  }
}

/** A joint's name in lines no wider than `most`, broken at its underscores; what does not fit ends in an ellipsis. */
export function wrapped(name, width, most, lines) {
  const out = [];
  for (const word of name.split(/(?<=_)/)) {
    if (out.length && width(out.at(-1) + word) <= most) out.push(out.pop() + word);
    else out.push(word);
  }
  const kept = out.slice(0, lines);
  if (out.length > lines) kept.push(`${kept.pop()}…`);
  return kept.map((line) => {
    let text = line;
    while (text.length > 2 && width(text) > most) text = `${text.replace(/…$/, '').slice(0, -1)}…`;
    return text;
  });
}

/** The largest terms for and against, in words. */
export function toldEvent(event, now_s) {
  const size = event.size < 0.7 && ['nod', 'shake', 'tilt', 'gaze_shift'].includes(event.event) ? `, ${((event.size * 180) / Math.PI).toFixed(0)}°` : '';
  const spoke = Object.entries(event.evidence ?? {}).sort((a, b) => Math.abs(b[1]) - Math.abs(a[1])).slice(0, 3);
  const why = spoke.map(([name, weight]) => `${reason(name)} ${weight > 0 ? '+' : ''}${weight.toFixed(1)}`).join(', ');
  const chance = event.probability ? ` · chance ${(100 * event.probability).toFixed(1)} %` : '';
  const ago = Math.max(0, now_s - event.at_s);
  return `${named(event.event)}${size}, ${ago < 0.5 ? 'now' : `${ago.toFixed(0)} s ago`}${chance}${why ? ` · why: ${why}` : ''}`;
}
