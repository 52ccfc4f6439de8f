// Elements in few words: make('button', { onclick }, 'Halt').

export const find = (id) => document.getElementById(id);

export function make(tag, values = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(values)) {
    if (name.startsWith('on')) element.addEventListener(name.slice(2), value);
    else if (name in element && name !== 'list') element[name] = value;
    else element.setAttribute(name, value);
  }
  element.append(...children);
  return element;
}

/** A section that folds. */
export function panel(title, open, ...children) {
  return make('details', { className: 'panel', open }, make('summary', {}, title), make('div', {}, ...children));
}

/** A range with its name and value; `changed(value)` while it is drawn. */
export function slider(name, { min = 0, max = 1, step = 0.01, value = 0, text = (v) => v.toFixed(2), changed }) {
  const output = make('output', {}, text(value));
  const input = make('input', { type: 'range', 'aria-label': name });
  Object.assign(input, { min, max, step, value });
  input.addEventListener('input', () => { output.textContent = text(+input.value); changed(+input.value); });
  const label = make('label', { className: 'slider', title: name }, make('span', {}, name), input, output);
  label.setValue = (next) => { input.value = next; output.textContent = text(+input.value); };
  return label;
}

/** Calls `work` with the newest arguments, no more often than every `ms`. */
export function throttled(work, ms) {
  let timer = null, newest = null;
  return (...args) => {
    newest = args;
    timer ??= setTimeout(() => { timer = null; work(...newest); }, ms);
  };
}

let colors = new Map(); // asking for a style makes the browser lay the page out

/** A colour of the style sheet. */
export function color(name) {
  if (!colors.has(name)) colors.set(name, getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
  return colors.get(name);
}
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => { colors = new Map(); });
