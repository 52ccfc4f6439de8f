// Record the run, take the file along, look at the run again.

import { make } from './dom.js';

export function recordingPanel(hello, connection, replays) {
  const record = make('button', { type: 'button', onclick: () => connection.send('record', { on: record.getAttribute('aria-pressed') !== 'true' }) });
  const download = make('a', { href: 'recording', download: '' }, 'Download');
  download.addEventListener('click', () => { // with the token of that moment
    download.href = connection.token ? `recording?token=${encodeURIComponent(connection.token)}` : 'recording';
  });
  const said = make('p', { className: 'sent', role: 'status' });
  const replay = make('button', { type: 'button', onclick: async () => {
    try { await replays(); said.textContent = ''; } catch (error) { said.textContent = error instanceof TypeError ? 'The program has ended: there is nothing to replay from.' : error.message; }
  } }, 'Replay the run so far');
  const show = (now) => {
    record.setAttribute('aria-pressed', String(now.on));
    record.textContent = now.on ? 'Stop recording' : 'Record';
    download.hidden = now.on || now.seconds === null; // there is none yet
  };
  show(hello.record ?? { on: false, seconds: null });
  connection.addEventListener('record', ({ detail }) => show(detail));
  return [make('div', { className: 'row' }, record, download, replay), said];
}
