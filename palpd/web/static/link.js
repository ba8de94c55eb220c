// The stream from the server. Every page hears it; `on("frame", f)` adds a listener. What has not been heard for 0.24 s is old.

const SILENT_MS = 240;
const CHECK_MS = 40;
const AGAIN_MS = 500;

const listeners = new Map();
let socket = null;
let heard_ms = 0;
let state = "connecting";

/** Call `listener` with each event of that kind: frame, status, job, log, sites, lost (the service), link (the stream itself). */
export function on(kind, listener) {
  if (!listeners.has(kind)) listeners.set(kind, []);
  listeners.get(kind).push(listener);
}

function tell(kind, content) {
  for (const listener of listeners.get(kind) ?? []) listener(content);
}

function become(next) {
  if (next === state) return;
  state = next;
  document.body.dataset.link = state;
  tell("link", state);
}

/** Open the stream, once all listeners are there, and again whenever it closes. */
export function begin() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  const mine = new WebSocket(`${scheme}://${location.host}/live`);
  socket = mine;
  mine.onmessage = ({ data }) => {
    if (socket !== mine) return;
    heard_ms = performance.now();
    become("open");
    const event = JSON.parse(data);
    tell(event.event, event);
  };
  mine.onclose = () => {
    if (socket !== mine) return;
    become("lost");
    tell("closed", null);
    setTimeout(begin, AGAIN_MS);
  };
}

setInterval(() => {
  if (state !== "open") return;
  const silent_ms = performance.now() - heard_ms;
  if (silent_ms > SILENT_MS) become("lost");
}, CHECK_MS);
