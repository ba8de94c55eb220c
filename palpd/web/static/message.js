// The one line in the abort bar that says how the last request ended.

const line = document.getElementById("message");

/** Show a sentence; kind is "done" or "refused". Text only: what comes from outside is never HTML. */
export function say(sentence, kind = "done") {
  line.textContent = sentence;
  line.dataset.kind = kind;
}
