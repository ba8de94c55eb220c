// The abort: a button and the space bar, on every page. It needs no lease and no fresh page, and waits for nothing else on the page.

import { say } from "./message.js";

const TRIES = 20;
const AGAIN_MS = 1000; // without an answer it is sent once more, beside the ones before: no answer does not mean that it has not arrived
const PATIENCE_MS = 15000;
const TEXT_FIELDS = "input:not([type=button]):not([type=submit]):not([type=checkbox]):not([type=radio]):not([type=range]):not([type=file]), textarea, [contenteditable=true]";
const button = document.getElementById("abort");

async function send() {
  const answer = await fetch("/abort", { method: "POST", cache: "no-store", keepalive: true, signal: AbortSignal.timeout(PATIENCE_MS) });
  return answer.json();
}

/** Abort, and say how it went. */
export async function abort() {
  button.dataset.sent = "";
  setTimeout(() => delete button.dataset.sent, 600);
  let answered = false;
  const warn = (words, attempt) => { if (!answered) say(`${words} (attempt ${attempt} of ${TRIES}); use the emergency stop.`, "refused"); };
  for (let attempt = 1; attempt <= TRIES && !answered; attempt++) {
    send().then((content) => {
      answered = true;
      say(content.ok ? `Abort carried out: ${content.state}.` : content.error, content.ok ? "aborted" : "refused");
    }, () => warn("The abort has not reached palpd", attempt));
    await new Promise((later) => setTimeout(later, AGAIN_MS));
    warn("No answer to the abort yet", attempt);
  }
}

button.addEventListener("click", abort);

// While a button or a link has the focus, the space bar would press it: the abort takes it first, on the way down and on the way up.
for (const kind of ["keydown", "keyup"]) {
  document.addEventListener(kind, (event) => {
    if (event.code !== "Space" || event.ctrlKey || event.altKey || event.metaKey || event.target.closest?.(TEXT_FIELDS)) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    if (kind === "keydown" && !event.repeat) abort();
  }, { capture: true });
}

// The space bar aborts, so the enter key switches a check box.
document.addEventListener("keydown", (event) => {
  if (event.code === "Enter" && event.target.matches?.("input[type=checkbox]")) event.target.click();
});
