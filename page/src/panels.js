// What a visitor can do. Every change is one command; what the program says against it comes back as an error.

import { find, make, panel, slider, throttled } from './dom.js';
import { lookPanel } from './look.js';
import { ServoTable } from './servos.js';
import { recordingPanel } from './recording.js';
import { visitorPanel } from './visitor-panel.js';

const SHOW_S = 1.0, AGAIN_MS = 400, EXPRESSION_S = 2.5;
const RATES = { nod: 'nods', smile: 'smiles', gaze_shift: 'looks away', blink: 'blinks', mm_hm: '“mm-hm”', laugh: 'laughs', brow_raise: 'raises brows', shake: 'shakes', tilt: 'tilts' };
const MOST_PER_MINUTE = { blink: 40, gaze_shift: 30 };
const OF_A_RECORDING = ['servos']; // a recording takes no commands
const TABLES = ['servos', 'channels', 'knobs']; // long lists, which stand under the curves
const GROUPS = [['Head', 0, 6], ['Brows and cheeks', 6, 14], ['Eyes', 14, 28], ['Jaw', 28, 32], ['Mouth', 32, 55], ['Nose and tongue', 55, 58]];

/** Fill #controls and #tables for the run of `hello`. Return {held(controls), release(), servos}. */
export function buildPanels(hello, connection, visitor, replays, chooseJoint) {
  const open = new Set([...document.querySelectorAll('main > section > details[open]')].map((each) => each.dataset.name));
  const first = !find('controls').children.length;
  const servos = new ServoTable(chooseJoint);
  servos.begin(hello);
  const held = heldPanel(hello, connection);
  const faces = facesPanel(hello, connection), look = lookPanel(connection);
  const parts = {
    person: ['The person', visitorPanel(hello, connection, visitor), true],
    listener: ['The listener', listenerPanel(hello, connection), false],
    face: ['Show a face', [faces.expressions, faces.actions], true],
    look: ['Where it looks', look.elements, false],
    recording: ['Record and replay', recordingPanel(hello, connection, replays), false],
    servos: ['Servos', [servos.element], true],
    knobs: ['How much it shows', knobsPanel(hello, connection), false],
    channels: ['Channels of the face', faces.groups, false],
  };
  const there = Object.entries(parts).filter(([name]) => !hello.replay || OF_A_RECORDING.includes(name));
  const panels = there.map(([name, [title, children, shown]]) => {
    const element = panel(title, first ? shown && innerWidth > 860 : open.has(name), ...children);
    element.dataset.name = name;
    return element;
  });
  const [tables, controls] = [true, false].map((long) => panels.filter(({ dataset }) => TABLES.includes(dataset.name) === long));
  find('controls').replaceChildren(held.element, ...controls);
  find('tables').replaceChildren(...tables);
  return { servos, held: held.show, release: () => { faces.letGo(); look.letGo(); } };
}

function heldPanel(hello, connection) {
  const text = make('p', { className: 'quiet' });
  const give = make('button', { type: 'button', onclick: () => connection.send('give') }, 'Give the controls back');
  const token = make('input', { type: 'password', placeholder: 'token', 'aria-label': 'Token that was printed when the robot started', autocomplete: 'off' });
  const enter = make('form', { className: 'row', onsubmit: (event) => {
    event.preventDefault();
    connection.token = token.value.trim();
    sessionStorage.setItem('token', connection.token);
    connection.send('hello', { version: hello.version, token: connection.token });
  } }, make('span', { className: 'quiet' }, 'To do more than look:'), token, make('button', {}, 'Enter'));
  const element = make('div', { className: 'row' }, text, give, enter);
  const show = ({ held, needs_token: needsToken }) => {
    give.hidden = held !== 'you';
    enter.hidden = !needsToken;
    text.textContent = { you: 'You have the controls.', other: 'Another visitor has the controls; every visitor may halt.' }[held] ?? '';
    element.hidden = !text.textContent && enter.hidden;
  };
  show({ held: hello.controls, needs_token: hello.needs_token && !connection.allowed });
  return { element, show };
}

function chosen(label, options, now, change) {
  const select = make('select', { 'aria-label': label, onchange: () => change(select.value) });
  for (const { name, line } of options) select.append(make('option', { value: name, title: line ?? '' }, name));
  if (!options.some(({ name }) => name === now)) select.prepend(make('option', { value: now ?? '', disabled: true }, now ?? '—'));
  select.value = now ?? '';
  const line = make('p', { className: 'quiet' }, options.find(({ name }) => name === now)?.line ?? '');
  return [make('label', { className: 'row' }, make('span', {}, label), select), line];
}

function listenerPanel(hello, connection) {
  const seed = make('input', { type: 'number', min: 0, value: hello.seed, 'aria-label': 'Seed', style: 'width: 7em' });
  const again = (value) => connection.send('seed', { seed: Math.max(0, Math.floor(value)) });
  const choices = hello.listeners.length
    ? [
        ...chosen('Listener', hello.listeners, hello.listener, (name) => connection.send('listener', { name })),
        make('div', { className: 'row' }, make('label', { className: 'row' }, 'Seed', seed),
          make('button', { type: 'button', onclick: () => again(+seed.value) }, 'Listen again'),
          make('button', { type: 'button', onclick: () => again(Math.random() * 1e6) }, 'Another')),
        make('p', { className: 'quiet' }, 'Each of these starts the run again; this page stays.'),
      ]
    : [make('p', {}, `${hello.listener}, seed ${hello.seed}`)];
  const rates = Object.keys(RATES).filter((kind) => kind in (hello.people_per_minute ?? {})).map((kind) => rateSlider(kind, hello, connection));
  return [...choices, ...(rates.length ? [make('h3', { style: 'margin:0;font-size:.95rem' }, 'How often a minute'), ...rates] : [])];
}

function rateSlider(kind, hello, connection) {
  const asked = hello.calmness[kind];
  const set = throttled((value) => connection.send('calm', { rates: { [kind]: value } }), 150);
  const row = slider(RATES[kind], {
    max: MOST_PER_MINUTE[kind] ?? 10, step: 0.1, value: asked ?? hello.people_per_minute[kind], changed: set,
    text: (value) => value.toFixed(1),
  });
  row.classList.add('rate');
  if (asked === null) row.querySelector('output').textContent = 'as people';
  return row;
}

function facesPanel(hello, connection) {
  const held = {}; // channel -> value of what the visitor holds
  const rows = new Map();
  let timer = null;
  const send = () => connection.send('show', { channels: held, seconds: SHOW_S });
  const soon = throttled(send, 60);
  const hold = (name, value) => {
    held[name] = value;
    soon();
    timer ??= setInterval(send, AGAIN_MS); // so long as it is held
  };
  const letGo = () => {
    clearInterval(timer);
    timer = null;
    Object.keys(held).forEach((name) => delete held[name]);
    rows.forEach((row) => row.setValue(0));
  };
  addEventListener('controls-lost', letGo);
  const groups = GROUPS.map(([title, from, to]) => make('details', {}, make('summary', {}, `${title} (${to - from})`),
    ...hello.channels.slice(from, to).map((name, i) => {
      const most = from + i < 3 ? 0.5 : 0.03;
      const bounds = from + i < 6 ? { min: -most, max: most, step: most / 100 } : {};
      const text = from + i < 3 ? (v) => `${((v * 180) / Math.PI).toFixed(0)}°` : from + i < 6 ? (v) => `${(v * 1000).toFixed(0)} mm` : undefined;
      const row = slider(name, { ...bounds, ...(text && { text }), changed: (value) => hold(name, value) });
      row.dataset.channel = name;
      rows.set(name, row);
      return row;
    })));
  const expressions = make('div', { className: 'row', role: 'group', 'aria-label': 'Expressions' },
    ...Object.keys(hello.expressions).map((name) => make('button', { type: 'button', onclick: () => connection.send('expression', { name, seconds: EXPRESSION_S }) }, name.replaceAll('_', ' '))));
  const release = () => confirm('Switch all torque off and end the run? A neck may fall.') && connection.send('release');
  const actions = make('div', { className: 'row' },
    make('button', { type: 'button', onclick: () => { letGo(); connection.send('neutral'); } }, 'Neutral'),
    make('button', { type: 'button', onclick: letGo }, 'Let go of the sliders'),
    make('button', { type: 'button', onclick: release, title: 'Torque off at once; the run ends' }, 'Release torque'));
  return { expressions, actions, groups, letGo };
}

function knobsPanel(hello, connection) {
  const rows = (kind, title, explained) => [
    make('p', { className: 'quiet' }, `${title}: ${explained}`),
    ...hello.regions.map((region) => slider(region, {
      max: 2, step: 0.05, value: hello[kind][region] ?? 1,
      changed: throttled((value) => connection.send('knobs', { [kind]: { [region]: value } }), 100),
    })),
  ];
  return [...rows('intensity', 'Intensity', 'how large the motion is: 0 none, 1 as designed, 2 twice as large'), ...rows('style', 'Style', 'how much of the small motion shows')];
}
