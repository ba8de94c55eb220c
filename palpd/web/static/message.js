// The one line in the abort bar that says how the last request ended.

const SHOWN_MS = 12000;
const line = document.getElementById("message");
let over = 0;

/** Show a sentence; kind is "done" (gone after a while), "aborted" or "refused". Text only: what comes from outside is never HTML. */
export function say(sentence, kind = "done") {
  line.textContent = sentence;
  line.dataset.kind = kind;
  clearTimeout(over);
  if (kind === "done") over = setTimeout(() => { line.textContent = ""; }, SHOWN_MS);
}
