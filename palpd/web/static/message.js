// The one line in the abort bar that says how the last request ended, and the names of buttons in place of commands.

const SHOWN_MS = 12000;
const line = document.getElementById("message");
let over = 0;

/** The buttons of the arm, by what they ask for. */
export const NAMES = {
  check: "Check", arm: "Arm", start: "Start", pause: "Pause", resume: "Resume", retract: "Retract", "level-test": "Level test",
  calibrate: "Calibrate", clear: "Clear", decide: "Answer the job", recover: "Recover", abort: "Abort",
};

export const capital = (text) => text.slice(0, 1).toUpperCase() + text.slice(1);

/** A sentence of the service with buttons in place of commands of the terminal. What only the terminal can do stays a command. */
export function inButtons(sentence) {
  return sentence
    .replace(/\b(?:run )?palpd (arm|start|pause|resume|retract|level-test|calibrate|clear|abort)\b(?! --| ID)/g, (_, what) => NAMES[what])
    .replace(/\b(?:run )?palpd check --new-baseline\b/g, "begin a new baseline in Checks").replace(/\brun palpd check\b/g, "make a check in Checks")
    .replace(/\bpalpd controls --free\b/g, "Take by force")
    .replace(/\bpalpd doctor looks\b/g, "Check looks").replace(/\bthe daemon is\b/g, "the service is").replace(/--return\b/g, "Return").replace(/--here\b/g, "Here");
}

/** Show a sentence; kind is "done" (gone after a while), "aborted" or "refused". Text only: what comes from outside is never HTML. */
export function say(sentence, kind = "done") {
  line.textContent = inButtons(sentence);
  line.dataset.kind = kind;
  clearTimeout(over);
  if (kind === "done") over = setTimeout(() => { line.textContent = ""; }, SHOWN_MS);
}

/** Take a refusal away, once what it spoke of has changed. */
export function unsay() {
  if (line.dataset.kind === "refused") line.textContent = "";
}
