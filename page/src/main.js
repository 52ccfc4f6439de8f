// The page: asks for the head first, draws it, then connects everything else to the run.

import { Connection, VERSION } from './connection.js';
import { find, make } from './dom.js';
import { Human, forerunner } from './human.js';
import { buildPanels } from './panels.js';
import { Replay } from './replay.js';
import { Stage } from './stage.js';
import { Timeline, toldEvent } from './timeline.js';
import { Visitor } from './visitor.js';

const HUMAN = 'human/head.bin';
const EARLY_MS = 1000;
const EDITED = 'input, select, textarea, button, summary, a';

const token = new URLSearchParams(location.search).get('token') ?? sessionStorage.getItem('token') ?? '';
const address = new URL('ws', location.href);
address.protocol = address.protocol.replace('http', 'ws');
address.search = '';

class Page {
  constructor() {
    this.hello = null;
    this.panels = null;
    this.replay = null;
    this.faults = '';
    this.unconfirmed = {}; // torque that the end of the run could not confirm off: a fault of each joint
    this.status = {};
    this.newest = null;
    this.shownEvent = null;
    this.still = false; // while a picture of the page is taken, nothing is drawn
    this.ended = false; // the run has ended: a connection that closes is no news
    this.timeline = new Timeline(find('timeline'));
    this.stage = this.#stage();
    this.human = fetch(HUMAN, { credentials: 'same-origin' });
    this.stage?.prepare(forerunner());
    this.#drawHuman();
    this.connection = new Connection(address.href, token);
    this.visitor = new Visitor(this.connection);
    this.#listen();
    this.#keys();
  }

  #stage() {
    try {
      return new Stage(find('view'), find('human-cell'), find('robot-cell'));
    } catch {
      find('no-webgl').hidden = false;
      find('view').hidden = true;
      return null;
    }
  }

  async #drawHuman() {
    if (!this.stage) return;
    try {
      const reply = await this.human;
      if (!reply.ok) throw new Error(`${HUMAN}: ${reply.status}`);
      this.stage.setHuman(new Human(await reply.arrayBuffer()));
    } catch (error) {
      this.notice(`The virtual human cannot be shown: ${error.message}`);
    }
  }

  async #drawRobot(hello) {
    find('stage').classList.remove('no-robot');
    find('robot-caption').textContent = hello.urdf_generic ? 'what its servos show, drawn from its joints (your own picture: `urdf:` in head.yaml)' : 'what its servos show';
    if (!this.stage) return;
    const complain = (problem) => this.notice(`The robot is not shown whole: ${problem}`);
    try {
      const { loadRobot } = await import('./robot.js');
      const robot = await loadRobot(hello.urdf, hello.urdf_joints, complain);
      if (hello !== this.hello) return; // another run has begun
      if (this.newest) robot.show(this.newest.u);
      this.stage.setRobot(robot);
      this.faults = '';
      robot.loaded.then(() => { if (this.stage.robot === robot) this.stage.setRobot(robot); });
    } catch (error) {
      this.stage.setRobot(null);
      find('stage').classList.add('no-robot');
      this.notice(`The robot cannot be shown: ${error.message}`);
    }
  }

  #listen() {
    const { connection } = this;
    const on = (type, heard) => connection.addEventListener(type, ({ detail }) => heard(detail));
    on('hello', (hello) => this.#begin(hello));
    on('frame', (frame) => { this.newest = frame; if (!this.replay && !this.still) this.#show(frame); });
    on('event', (event) => { this.timeline.event(event); if (!this.replay) this.shownEvent = event; });
    on('status', ({ status }) => this.#status(status));
    on('controls', (controls) => { this.panels?.held(controls); if (controls.held === 'other') this.panels?.release(); });
    on('over', ({ report }) => this.#over(report.torque_unconfirmed ?? []));
    on('error', ({ error }) => this.notice(error, 6000));
    connection.addEventListener('closed', () => {
      if (this.ended) document.body.classList.add('gone'); // nothing is there to be worked
      else this.#state('no connection', 'trying again');
    });
  }

  #begin(hello) {
    if (hello.version !== VERSION) { this.#wrongVersion(hello.version); return; }
    const same = this.hello?.urdf === hello.urdf && this.hello?.head === hello.head;
    this.hello = hello;
    this.ended = false;
    document.body.classList.remove('gone');
    this.unconfirmed = {};
    this.notice('');
    this.panels?.release();
    find('halt').hidden = hello.replay;
    find('what').textContent = `${hello.head} · ${hello.listener}${hello.port === 'sim' ? ' · emulated servos' : ` · ${hello.port}`}`;
    document.title = `${hello.head} · sfms-robot`;
    this.timeline.jointNames = hello.joints.map(({ name }) => name);
    this.timeline.joint = -1;
    find('joint').replaceChildren(make('option', { value: -1 }, 'that moves most'), ...hello.joints.map(({ name }, i) => make('option', { value: i }, name)));
    this.panels = buildPanels(hello, this.connection, this.visitor, () => this.#startReplay(), (name) => {
      find('joint').value = this.timeline.joint = hello.joints.findIndex((joint) => joint.name === name);
    });
    if (!same || !this.stage?.robot) this.#drawRobot(hello);
    if (hello.over) this.#over(hello.torque_unconfirmed);
  }

  #wrongVersion(version) {
    this.notice(`This page speaks version ${VERSION}, the program version ${version}: reload the page.`);
    const asked = `reloaded for ${version}`;
    if (sessionStorage.getItem(asked)) return; // once: then it is the program that is older
    sessionStorage.setItem(asked, '1');
    location.reload();
  }

  #show(frame) {
    this.timeline.frame(frame);
    this.#picture(frame);
    const event = this.shownEvent;
    if (event) find('last-event').textContent = toldEvent(event, frame.t);
  }

  #picture(frame) {
    this.stage?.show(frame.m, frame.u);
    if (frame.s && (!this.ended || this.hello.replay)) this.#state(frame.s, (frame.w ?? []).join(', '));
    const faults = { ...frame.f, ...this.unconfirmed };
    const told = JSON.stringify(faults);
    if (told !== this.faults && this.stage) this.#showFaults(faults, told);
  }

  async #showFaults(faults, told) {
    this.faults = told;
    this.stage.robot?.showFaults(faults);
    this.stage.redraw();
    const { kindOfFault } = await import('./robot.js');
    const alike = {}; // one line for what several joints share
    for (const [name, text] of Object.entries(faults)) (alike[text] ??= []).push(name);
    const line = (names) => (names.length > 2 ? `${names.slice(0, 2).join(', ')} and ${names.length - 2} more` : names.join(', '));
    find('faults').replaceChildren(...Object.entries(alike).map(([text, names]) => make('li', { className: kindOfFault(text), title: names.join(', ') }, `${line(names)}: ${text}`)));
  }

  #state(name, why) {
    const state = find('state');
    if (find('state-name').textContent !== name) find('state-name').textContent = name;
    if (find('state-why').textContent !== why) find('state-why').textContent = why;
    state.dataset.state = name;
    state.title = why;
    find('resume').hidden = name !== 'halted';
    find('halt').setAttribute('aria-pressed', String(name === 'halted'));
  }

  #status(status) {
    this.status = status;
    this.panels?.servos.show(status);
    const wire = status.latency_ms?.frame_to_wire?.p50 ?? status.latency_ms?.p50;
    const trip = this.connection.roundTripMs;
    find('latency').textContent = [wire ? `moves after ${wire < 1000 ? `${wire.toFixed(0)} ms` : `${(wire / 1000).toFixed(1)} s`}` : '', trip ? `this page is ${trip.toFixed(0)} ms away` : ''].filter(Boolean).join(' · ');
  }

  #over(unconfirmed) {
    const names = unconfirmed.join(', ');
    this.unconfirmed = Object.fromEntries(unconfirmed.map((name) => [name, 'not confirmed off']));
    if (names) this.notice(`Torque is NOT confirmed off: ${names}. Switch off the supply before you touch the head.`);
    this.ended = true;
    find('latency').textContent = '';
    find('halt').hidden = true;
    if (names) this.#state('fault', `torque is not confirmed off: ${names}`);
    else this.#state('ended', this.hello.replay ? 'this is a recording' : 'the run has ended');
    this.#startReplay().then(
      () => { if (!names && !this.hello.replay) this.notice('The run has ended. This is its replay.', 0, true); },
      () => { if (!names) this.notice('The run has ended.', 0, true); },
    );
  }

  async #startReplay() {
    const moved = (at_s, playing) => {
      find('scrub').value = at_s;
      find('scrubbed').textContent = `${at_s.toFixed(1)} s`;
      find('play').textContent = playing ? 'Pause' : 'Play';
    };
    const replay = await Replay.fetched('runs/last', (frame, at_s) => {
      const [frames, events] = replay.window(at_s);
      this.timeline.show(frames, events);
      this.#picture(frame);
      this.shownEvent = events.filter(({ event }) => event !== 'blink').at(-1) ?? null;
      find('last-event').textContent = this.shownEvent ? toldEvent(this.shownEvent, at_s) : '\u00a0';
    }, moved);
    this.replay?.stop();
    this.replay = replay;
    Object.assign(find('scrub'), { min: replay.startS, max: replay.endS });
    find('scrub').oninput = () => { replay.pause(+find('scrub').value); };
    find('play').onclick = () => (replay.playing ? replay.pause() : replay.play());
    find('live').onclick = () => {
      replay.stop();
      this.replay = null;
      this.timeline.clear();
      find('replay').hidden = true;
    };
    find('live').hidden = this.hello.replay || this.ended; // there is no run to go back to
    find('replay').hidden = false;
    replay.seek(replay.startS);
    replay.play();
  }

  #keys() {
    find('halt').onclick = () => this.#halt();
    find('resume').onclick = () => this.connection.send('resume');
    find('joint').onchange = () => { this.timeline.joint = +find('joint').value; this.timeline.draw(); };
    addEventListener('keydown', (event) => {
      const space = event.key === ' ' && !event.target.closest?.(EDITED); // there it means something else
      if (event.key !== 'Escape' && !space) return;
      event.preventDefault();
      this.#halt();
    });
  }

  #halt() {
    if (this.hello?.replay) return; // nothing moves
    if (!this.connection.send('halt')) this.notice('NOT HALTED: there is no connection. Use the switch of the robot.', 10000);
  }

  /** Show one line at the top for `ms`, or until the next one; `calm`: information, no warning. */
  notice(text, ms = 0, calm = false) {
    find('notice').classList.toggle('calm', calm);
    clearTimeout(this.noticeTimer);
    find('notice').textContent = text;
    find('notice').hidden = !text;
    if (ms) this.noticeTimer = setTimeout(() => this.notice(''), ms);
  }
}

/** The face is there, or is late: now the rest of the page, and the run, whose messages take the processor's time too. */
function begin() {
  if (begun) return;
  begun = true;
  document.documentElement.classList.remove('early');
  globalThis.page.connection.begin();
}
let begun = false;
addEventListener('first-picture', () => requestAnimationFrame(begin));
setTimeout(begin, EARLY_MS);
globalThis.page = new Page();
if (!globalThis.page.stage) begin();
