// Calculations of the server: begin one, show how far it is, cancel it, and take its result.

import { ask, read } from "./requests.js";

const PAUSE_MS = 400;
const OVER = ["done", "refused", "stopped", "cancelled", "failed"];
const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

/** Make an element with a text and further children. */
export function make(name, options = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(options)) {
    if (key === "text") made.textContent = value;
    else if (key === "on") for (const [event, listener] of Object.entries(value)) made.addEventListener(event, listener);
    else if (key in made && key !== "list") made[key] = value;
    else made.setAttribute(key, value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

export const byId = (id) => document.getElementById(id);

/** A figure with its name, and what belongs to it. */
export const tile = (name, value, more, mood = "") => make("div", { className: `tile ${mood}` }, make("span", { text: name }), make("b", { text: value }), make("span", { text: more }));

/** A modulus in kPa with three digits, one of them a decimal at least, or with the decimals of the one beside it; a dash of none. */
export function kilopascals(value, beside = value) {
  if (value === null || value === undefined) return "–";
  const size = Math.abs(beside) / 1e3;
  return (value / 1e3).toFixed(size >= 10 ? 1 : size >= 1 ? 2 : 3);
}

/** A number with a decimal point or comma; null of an empty field, NaN of no number. A field of type number drops the comma: 1,5 becomes 15. */
export const decimal = (word) => (word.trim() === "" ? null : Number(word.trim().replace(",", ".")));

/** Seconds as people read them. */
export function duration(seconds) {
  if (seconds < 60) return `${seconds.toFixed(seconds < 10 ? 1 : 0)} s`;
  return `${Math.floor(seconds / 60)} min ${Math.round(seconds % 60)} s`;
}

/**
 * Begin a calculation and wait for its end, with a line of progress and a button that cancels it, as `signal` does.
 * Resolves to the calculation ({state, number, sentence, ...}) or to a refusal ({state: "refused", sentence}).
 */
export async function work(path, content, holder, signal = null) {
  const begun = await ask(path, content);
  if (!begun.ok) return { state: "refused", sentence: begun.error };
  if (begun.report) return { state: "done", report: begun.report };
  const step = make("span", { className: "step" });
  const bar = make("progress", { ariaLabel: begun.name });
  const cancelled = () => ask(`/calculations/${begun.number}/cancel`);
  const cancel = make("button", { type: "button", text: "Cancel", on: { click: cancelled } });
  if (signal?.aborted) cancelled();
  signal?.addEventListener("abort", cancelled);
  holder?.replaceChildren(make("div", { className: "progress", role: "status" }, bar, step, cancel));
  let now = begun, lost = 0;
  while (!OVER.includes(now.state)) {
    const part = /^(\d+) of (\d+)/.exec(now.step);
    if (part) [bar.value, bar.max] = [Number(part[1]) - 0.5, Number(part[2])];
    const what = now.state === "waiting" ? "waits for its turn" : now.step || now.name;
    step.textContent = `${what}, ${duration(now.elapsed_s)}`;
    await pause(PAUSE_MS);
    const answer = await read(`/calculations/${begun.number}`);
    if (answer.ok) [now, lost] = [answer, 0];
    else if (++lost > 10 || !answer.error.startsWith("the page does not reach")) return { state: "failed", sentence: answer.error };
  }
  signal?.removeEventListener("abort", cancelled);
  if (holder?.contains(bar)) holder.replaceChildren(); // what was begun since has put its own there
  return now;
}

/** The result of a calculation that is done. */
export async function resultOf(calculation) {
  return read(`/calculations/${calculation.number}/result`, { patience_ms: 30000 });
}

/** A sentence that says what is wrong; empty clears it. */
export function refuse(holder, sentence) {
  holder.replaceChildren(...(sentence ? [make("p", { className: "refusal", role: "alert", text: sentence })] : []));
}

/** A report in its frame, in its whole height. It holds no script and never gets the focus, so that the space bar aborts as everywhere. */
export function framed(address, title) {
  const frame = make("iframe", { title, src: address, className: "report", sandbox: "allow-same-origin", tabIndex: -1 });
  frame.addEventListener("load", () => {
    const inner = frame.contentDocument;
    if (!inner?.documentElement) return;
    const fit = () => { frame.height = `${Math.ceil(inner.documentElement.getBoundingClientRect().height)}`; };
    for (const folded of inner.querySelectorAll("details")) folded.open = true;
    fit();
    new ResizeObserver(fit).observe(inner.documentElement);
  });
  return frame;
}
