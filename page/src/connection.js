// The WebSocket: JSON messages out as events, commands in, and a connection that comes back by itself.

export const VERSION = 1;
const FIRST_WAIT_MS = 400;
const LONGEST_WAIT_MS = 5000;
const PING_MS = 2000;

/** Events: `open`, `closed`, and one per message, named by its type, with the message as `detail`. */
export class Connection extends EventTarget {
  #socket = null;
  #wait = FIRST_WAIT_MS;
  #pinged = new Map();
  #number = 0;

  constructor(address, token) {
    super();
    this.address = address;
    this.token = token;
    this.held = 'nobody';
    this.allowed = false; // more than to look
    this.roundTripMs = null;
  }

  /** Connect, and stay so. */
  begin() {
    this.#open();
    setInterval(() => this.#ping(), PING_MS);
    document.addEventListener('visibilitychange', () => document.hidden || this.#ping());
  }

  get open() { return this.#socket?.readyState === WebSocket.OPEN; }
  get waiting() { return this.#socket?.bufferedAmount ?? 0; } // bytes that have not left

  /** One command; false where there is no connection. */
  send(type, values = {}) {
    if (!this.open) return false;
    this.#socket.send(JSON.stringify({ type, ...values }));
    return true;
  }

  /** Begin anew. */
  close() { this.#socket.close(); }

  sendBytes(bytes) { if (this.open) this.#socket.send(bytes); }

  #open() {
    const socket = new WebSocket(this.address);
    this.#socket = socket;
    socket.binaryType = 'arraybuffer';
    socket.onopen = () => {
      this.#wait = FIRST_WAIT_MS;
      this.send('hello', { version: VERSION, token: this.token });
      this.dispatchEvent(new Event('open'));
    };
    socket.onmessage = ({ data }) => this.#heard(JSON.parse(data));
    socket.onclose = () => {
      this.held = 'nobody';
      this.allowed = false;
      this.dispatchEvent(new Event('closed'));
      setTimeout(() => this.#open(), this.#wait);
      this.#wait = Math.min(2 * this.#wait, LONGEST_WAIT_MS);
    };
  }

  #heard(message) {
    if (message.type === 'pong') {
      const sent = this.#pinged.get(message.id);
      this.#pinged.clear();
      if (sent !== undefined) this.roundTripMs = performance.now() - sent;
    } else if (message.type === 'hello') this.held = message.controls;
    else if (message.type === 'controls') [this.held, this.allowed] = [message.held, !message.needs_token];
    this.dispatchEvent(new CustomEvent(message.type, { detail: message }));
  }

  #ping() {
    if (this.#pinged.size > 3) { this.#pinged.clear(); this.#socket?.close(); return; } // nobody is there any more
    if (this.send('ping', { id: this.#number })) this.#pinged.set(this.#number++, performance.now());
  }
}
