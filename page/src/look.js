// Where the robot looks: a pad for the pointer, two sliders for the keyboard, one direction.

import { make, slider, throttled } from './dom.js';

const MOST_DEG = { aside: 45, up: 25 };
const HELD_S = 8, AGAIN_MS = 6000; // so long as it is held; who closes the page lets go of it
const BACK_S = 0.1;
const SEND_MS = 80;
const RAD = Math.PI / 180;

/** {elements, letGo}: `aside` counts to the viewer's right, which is the robot's left. */
export function lookPanel(connection) {
  const now = { aside: 0, up: 0 };
  let timer = null;
  const look = (seconds) => connection.send('look_at', { x_m: 1, y_m: Math.tan(now.aside * RAD), z_m: Math.tan(now.up * RAD), seconds });
  const soon = throttled(() => timer && look(HELD_S), SEND_MS);
  const hold = (direction) => {
    Object.assign(now, direction);
    draw();
    clearInterval(timer);
    timer = setInterval(() => look(HELD_S), AGAIN_MS);
    soon();
  };
  const letGo = () => {
    const held = timer !== null;
    clearInterval(timer);
    timer = null;
    Object.assign(now, { aside: 0, up: 0 });
    draw();
    return held;
  };
  const rows = {
    aside: slider('to the right', { min: -MOST_DEG.aside, max: MOST_DEG.aside, step: 1, text: degrees, changed: (aside) => hold({ aside }) }),
    up: slider('up', { min: -MOST_DEG.up, max: MOST_DEG.up, step: 1, text: degrees, changed: (up) => hold({ up }) }),
  };
  for (const [name, row] of Object.entries(rows)) row.dataset.look = name;
  const dot = make('i');
  const pad = make('div', { className: 'pad', 'aria-hidden': 'true' }, dot); // the sliders say the same in words
  const draw = () => {
    dot.style.left = `${50 + (50 * now.aside) / MOST_DEG.aside}%`;
    dot.style.top = `${50 - (50 * now.up) / MOST_DEG.up}%`;
    for (const [name, row] of Object.entries(rows)) row.setValue(now[name]);
  };
  const point = (event) => {
    const box = pad.getBoundingClientRect();
    const share = (at, from, size) => Math.max(-1, Math.min(1, (2 * (at - from)) / size - 1));
    hold({
      aside: Math.round(MOST_DEG.aside * share(event.clientX, box.left, box.width)),
      up: -Math.round(MOST_DEG.up * share(event.clientY, box.top, box.height)),
    });
  };
  pad.addEventListener('pointerdown', (event) => { pad.setPointerCapture(event.pointerId); point(event); });
  pad.addEventListener('pointermove', (event) => pad.hasPointerCapture(event.pointerId) && point(event));
  const ahead = make('button', { type: 'button', onclick: () => letGo() && look(BACK_S) }, 'Let it look where it likes');
  draw();
  return { elements: [pad, rows.aside, rows.up, make('div', { className: 'row' }, ahead)], letGo };
}

const degrees = (value) => `${value.toFixed(0)}°`;
