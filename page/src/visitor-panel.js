// Who is listened to: a recorded person, or the visitor.

import { make } from './dom.js';

export function visitorPanel(hello, connection, visitor) {
  const speakers = hello.speakers.length ? speakerChoice(hello, connection) : [];
  const may = hello.source ?? {};
  if (!may.voice && !may.face) return [...speakers, ...(hello.speakers.length ? [] : [make('p', {}, hello.speaker ?? 'live')])];
  const problem = make('p', { className: 'sent', role: 'alert' });
  const video = make('video', { muted: true, playsInline: true, hidden: true, 'aria-label': 'What the camera sees; it stays in this browser' });
  const level = make('i');
  const meter = make('div', { className: 'meter', hidden: true, 'aria-hidden': 'true' }, level);
  const sent = make('p', { className: 'sent', role: 'status', 'aria-live': 'polite' });
  const guarded = (start, stop, on) => async () => {
    problem.textContent = '';
    try {
      if (on()) stop(); else await start();
    } catch (error) {
      problem.textContent = error.message;
    }
  };
  const voice = make('button', { type: 'button', onclick: guarded(() => visitor.startVoice(), () => visitor.stopVoice(), () => visitor.talking) });
  const face = make('button', { type: 'button', onclick: guarded(() => visitor.startFace(video, hello.channels), () => visitor.stopFace(), () => visitor.seen) });
  const show = () => {
    voice.textContent = visitor.talking ? 'Stop the microphone' : 'Use my microphone';
    face.textContent = visitor.seen ? 'Stop the camera' : 'Use my camera';
    voice.setAttribute('aria-pressed', visitor.talking);
    face.setAttribute('aria-pressed', visitor.seen);
    meter.hidden = !visitor.talking;
    video.hidden = !visitor.seen;
    sent.classList.toggle('on', visitor.talking || visitor.seen);
    sent.textContent = told(visitor);
  };
  voice.hidden = !may.voice;
  face.hidden = !may.face;
  visitor.addEventListener('changed', show);
  visitor.addEventListener('level', ({ detail }) => { level.style.width = `${Math.min(100, 140 * detail)}%`; });
  visitor.addEventListener('face', ({ detail }) => video.classList.toggle('lost', detail === null));
  show();
  return [...speakers, make('div', { className: 'row' }, voice, face), meter, video, sent, problem];
}

function told(visitor) {
  const to = location.hostname === 'localhost' || location.hostname === '127.0.0.1' ? 'the program on this machine' : `the robot at ${location.host}`;
  if (!visitor.talking && !visitor.seen) return `It would be sent to ${to}, and nowhere else: your voice as sound; of the camera 58 numbers about your face, never the picture.`;
  const what = [visitor.talking && 'your voice', visitor.seen && '58 numbers about your face, no picture'].filter(Boolean).join(' and ');
  return `Sent now to ${to}: ${what}.`;
}

function speakerChoice(hello, connection) {
  const select = make('select', { 'aria-label': 'Speaker', onchange: () => connection.send('speaker', { name: select.value }) },
    ...hello.speakers.map(({ name, line }) => make('option', { value: name, title: line ?? '' }, name)));
  if (!hello.speakers.some(({ name }) => name === hello.speaker)) select.prepend(make('option', { value: '', disabled: true }, hello.speaker ?? 'live'));
  select.value = hello.speakers.some(({ name }) => name === hello.speaker) ? hello.speaker : '';
  return [make('label', { className: 'row' }, make('span', {}, 'It listens to'), select)];
}
