// SPDX-License-Identifier: Apache-2.0
// The bytes of a scan (`Shown` of host/ohmskin/view/boards.py), and the websocket that brings them.

// A connection that was lost is tried again after this time [ms].
const AGAIN_MS = 1000;
// How often the host is asked for its clock [ms], and how many answers are kept: clocks drift.
const CLOCK_EVERY_MS = 1000;
const CLOCKS = 16;
// The websocket's code for a board that was closed and does not come back (view/panel.py).
const CLOSED = 4001;

export const token = new URLSearchParams(location.search).get("token");

export function address(path) {
  return `${path}?token=${encodeURIComponent(token ?? "")}`;
}

export function decode(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const scan = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const cells = scan.rows * scan.columns;
  scan.planes.forEach((name, index) => {
    scan[name] = new Float32Array(buffer, 4 + length + 4 * cells * index, cells);
  });
  return scan;
}

// What the host's clock says when performance.now() says 0 [ms]: by the shortest of the last
// round trips, whose middle is when the host answered.
class Clock {
  constructor() {
    this.answers = [];
  }

  take(sentMs, hostS) {
    const nowMs = performance.now();
    this.answers.push({ tripMs: nowMs - sentMs, offsetMs: 1000 * hostS - (sentMs + nowMs) / 2 });
    if (this.answers.length > CLOCKS) this.answers.shift();
    this.offsetMs = this.answers.reduce((a, b) => (b.tripMs < a.tripMs ? b : a)).offsetMs;
  }
}

// Calls on: state(content), notice(content), scan(scan), link(whether there is one), closed().
export class Connection {
  constructor(number, on) {
    this.number = number;
    this.on = on;
    this.clock = new Clock();
    this.open();
    this.timer = setInterval(() => this.askClock(), CLOCK_EVERY_MS);
  }

  open() {
    const url = new URL(address(`boards/${this.number}`), location.href);
    url.protocol = url.protocol.replace("http", "ws");
    this.socket = new WebSocket(url);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => {
      this.on.link(true);
      this.askClock();
    };
    this.socket.onmessage = ({ data }) => this.take(data);
    this.socket.onclose = ({ code }) => {
      if (this.ended) return;
      this.on.link(false);
      if (code === CLOSED) this.end(this.on.closed());
      else setTimeout(() => this.ended || this.open(), AGAIN_MS);
    };
  }

  take(data) {
    if (data instanceof ArrayBuffer) {
      const scan = decode(data);
      this.say({ do: "ack", scan: scan.scan });
      this.on.scan(scan);
      return;
    }
    const message = JSON.parse(data);
    if (message.kind === "clock") this.clock.take(message.page_ms, message.host_s);
    else this.on[message.kind](message);
  }

  askClock() {
    this.say({ do: "clock", page_ms: performance.now() });
  }

  say(message) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  end() {
    this.ended = true;
    clearInterval(this.timer);
    this.socket.close();
  }
}
