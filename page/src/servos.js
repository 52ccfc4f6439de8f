// The table of servos: the goal of each, where it is, and how it is.

import { make } from './dom.js';

const HOT_C = 60;
const COLUMNS = [ // a column of which no servo of this head tells anything is left out
  ['goal °', (joint) => degrees(joint.goal_rad)],
  ['is at °', (joint) => degrees(joint.present_rad)],
  ['ms ago', (joint) => number(joint.age_s, 1000, 0)],
  ['°C', (joint) => number(joint.temperature_C, 1, 0)],
  ['mA', (joint) => number(joint.current_mA, 1, 0)],
  ['load %', (joint) => number(joint.load_percent, 1, 0)],
  ['V', (joint) => number(joint.voltage_V, 1, 1)],
];
const NOTHING = '–';

const number = (value, by, digits) => (Number.isFinite(value) ? (value * by).toFixed(digits) : NOTHING);
const degrees = (rad) => number(rad, 180 / Math.PI, 1);

export class ServoTable {
  constructor(choose) {
    this.body = make('tbody');
    this.summary = make('p', { className: 'quiet' });
    this.choose = choose;
    this.head = make('tr');
    this.table = make('table', {}, make('thead', {}, this.head), this.body);
    this.element = make('div', {}, this.summary, make('div', { className: 'scroll', tabIndex: 0, role: 'region', 'aria-label': 'Servos' }, this.table));
    this.facts = {};
    this.titles = '';
  }

  begin({ joints, replay }) {
    this.facts = Object.fromEntries(joints.map((joint) => [joint.name, joint]));
    this.body.replaceChildren();
    this.summary.textContent = replay ? 'A recording: none is connected.' : '';
  }

  /** The status document's `joints` and `faults`, once a second. */
  show(status) {
    const faults = status.faults ?? {}, joints = Object.entries(status.joints ?? {});
    const columns = COLUMNS.filter(([, of]) => joints.some(([, joint]) => of(joint) !== NOTHING));
    const titles = ['joint', ...columns.map(([title]) => title)];
    if (titles.join() !== this.titles) this.head.replaceChildren(...titles.map((title) => make('th', { scope: 'col' }, title)));
    this.titles = titles.join();
    const rows = joints.map(([name, joint]) => {
      const { bus, id, model } = this.facts[name] ?? {};
      const title = `${model ?? ''} id ${id ?? '?'} on ${bus ?? '?'}; click: its curve`;
      const row = make('tr', { title, onclick: () => this.choose(name) }, make('td', {}, name, ...(faults[name] ? [make('small', {}, faults[name])] : [])), ...columns.map(([, of]) => make('td', {}, of(joint))));
      row.className = faults[name] ? 'bad' : joint.temperature_C >= HOT_C ? 'hot' : '';
      return row;
    });
    this.body.replaceChildren(...rows);
    const hottest = status.hottest;
    const tick = status.tick?.achieved_hz ?? status.tick?.hz;
    this.summary.textContent = [
      tick ? `${tick.toFixed(0)} goals a second` : '',
      hottest ? `warmest: ${hottest.joint}, ${hottest.temperature_C.toFixed(0)} °C` : '',
      `${Object.keys(faults).length || 'no'} fault${Object.keys(faults).length === 1 ? '' : 's'}`,
      ...(status.outputs ?? []).map(({ kind, peer, state, frames_per_s: rate }) => `${kind} ${peer}: ${state === 'sending' ? `${rate.toFixed(0)} frames a second` : state}`),
    ].filter(Boolean).join(' · ');
  }
}
