// The page of a blind comparison: both clips have to be seen once, then each question gets left, right or neither.

import { Head } from './people-head.js';

const FRAME_HZ = 25;
const CHANNELS = 58;
const KEY = 'sfms-robot-participant';
const SIDES = ['left', 'right'];
const CHOICES = { ArrowLeft: 'left', ArrowRight: 'right', ArrowDown: 'neither' };
const LABELS = { left: 'Left', right: 'Right', neither: 'Cannot tell' };
const token = new URLSearchParams(location.hash.slice(1)).get('token');
const $ = (id) => document.getElementById(id);

let participant, questions, trial, heads, chosen, seen, playing;

async function post(path, told = {}) {
  const headers = { 'content-type': 'application/json', ...(token ? { 'x-token': token } : {}) };
  const answer = await fetch(path, { method: 'POST', headers, body: JSON.stringify(told) });
  if (!answer.ok) throw new Error((await answer.text()).trim());
  return answer.json();
}

async function fetched(path) {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(`${path}: ${answer.status}`);
  return answer.arrayBuffer();
}

/** Begin, or go on where this browser was; a study of other clips does not know the name and simply begins. */
async function start() {
  const begun = await post('begin');
  questions = begun.questions;
  participant = localStorage.getItem(KEY) ?? begun.participant;
  localStorage.setItem(KEY, participant);
  const mesh = await fetched('human/head.bin');
  heads = Object.fromEntries(SIDES.map((side) => [side, new Head($(side), mesh)]));
  addEventListener('resize', () => playing || rest());
  await show(await post('next', { participant }));
}

async function show(told) {
  stop();
  $('count').textContent = `${told.answered} of ${told.trials} answered`;
  $('progress').max = told.trials;
  $('progress').value = told.answered;
  $('trial').hidden = told.trial === undefined;
  $('done').hidden = told.trial !== undefined;
  if (told.trial === undefined) return;
  const [left, right] = await Promise.all(SIDES.map((side) => fetched(`clips/${told[side]}`)));
  trial = { number: told.trial, left: new Float32Array(left), right: new Float32Array(right) };
  $('voice').src = `clips/${told.audio}`;
  chosen = {};
  seen = new Set();
  ask();
  rest();
  $('play-left').focus();
}

function rest() {
  for (const side of SIDES) heads[side].show(trial[side].subarray(0, CHANNELS));
}

/** Plays one clip with the voice; the other face stays as it is at its beginning. */
async function play(side) {
  stop();
  rest();
  const voice = $('voice'), motion = trial[side], frames = motion.length / CHANNELS;
  voice.currentTime = 0;
  playing = side;
  document.body.dataset.playing = side;
  try { await voice.play(); } catch (error) { stop(); return say(`no sound: ${error.message}`); }
  const mixed = new Float32Array(CHANNELS);
  const draw = () => {
    if (playing !== side) return;
    const at = Math.min(voice.currentTime * FRAME_HZ, frames - 1);
    const now = Math.floor(at), next = Math.min(now + 1, frames - 1), part = at - now;
    for (let i = 0; i < CHANNELS; i++) {
      mixed[i] = (1 - part) * motion[now * CHANNELS + i] + part * motion[next * CHANNELS + i];
    }
    heads[side].show(mixed);
    if (voice.ended) { seen.add(side); stop(); ask(); } else requestAnimationFrame(draw);
  };
  requestAnimationFrame(draw);
}

function stop() {
  playing = undefined;
  delete document.body.dataset.playing;
  $('voice').pause();
}

/** The questions, open once both clips were seen to their end. */
function ask() {
  const open = seen.size === 2;
  const keys = document.createElement('span');
  keys.className = 'keys'; // who has none is not told of them
  keys.textContent = open ? ' Keys: arrow left, arrow right, arrow down for neither.' : ' Keys: 1 and 2.';
  $('hint').replaceChildren(open ? 'Now your answer.' : 'Watch both to their end first.', keys);
  const rows = Object.entries(questions).map(([name, text]) => {
    const row = document.createElement('fieldset');
    row.disabled = !open;
    const legend = document.createElement('legend');
    legend.textContent = text;
    row.append(legend, ...Object.keys(LABELS).map((choice) => button(name, choice)));
    return row;
  });
  $('questions').replaceChildren(...rows);
  if (open) $('questions').querySelector('button:not([aria-pressed=true])')?.focus();
}

function button(name, choice) {
  const made = document.createElement('button');
  made.type = 'button';
  made.textContent = LABELS[choice];
  made.setAttribute('aria-pressed', chosen[name] === choice);
  made.addEventListener('click', () => choose(name, choice));
  return made;
}

async function choose(name, choice) {
  chosen[name] = choice;
  ask();
  if (Object.keys(chosen).length < Object.keys(questions).length) return;
  try {
    await show(await post('answer', { participant, trial: trial.number, answers: chosen }));
  } catch (error) { say(`${error.message}; not saved: choose again`); }
}

function say(text) { $('say').textContent = text; }

addEventListener('keydown', (event) => {
  if (!trial || $('trial').hidden || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === '1' || event.key === '2') play(SIDES[Number(event.key) - 1]);
  else if (CHOICES[event.key] && seen.size === 2) {
    const open = Object.keys(questions).find((name) => !chosen[name]);
    if (open) choose(open, CHOICES[event.key]);
  } else return;
  event.preventDefault();
});
for (const side of SIDES) $(`play-${side}`).addEventListener('click', () => play(side));
$('another').addEventListener('click', () => { localStorage.removeItem(KEY); location.reload(); });
start().catch((error) => say(error.message));
