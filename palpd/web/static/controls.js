// Arm, start, pause, retract, clear, and who holds the controls. What is impossible, and why, is the service's own answer (`status.now`).

import { on } from "./link.js";
import { NAMES, capital, inButtons, say } from "./message.js";
import { ask, read } from "./requests.js";

const RENEW_MS = 3000;
const SURE_MS = 5000;
const PATIENCE_MS = { arm: 65000, check: 65000 };
const LEASE = "palpd.lease";
const PLAN = "palpd.plan";
const NAME = "palpd.operator";
const DONE = { check: "Robot and sensor were checked", arm: "Armed", start: "Started", pause: "The run pauses", resume: "The run goes on", retract: "The arm leaves the tissue", "level-test": "The arm goes 5 mm up", clear: "The latch is cleared", begin: "The job has begun", decide: "Answered", "keep-plan": "The plan is kept", "forget-plan": "The plan is forgotten" };

const take = document.getElementById("take");
const operator = document.getElementById("operator");
const holder = document.getElementById("holder");
const pause = document.getElementById("pause");
const decide = document.getElementById("decide");
const place = document.getElementById("place-choice");
const cause = document.getElementById("cause");
const buttons = [...document.querySelectorAll("[data-do]")];
let status = null;
let lost = false;
let job = null;
let lease = sessionStorage.getItem(LEASE);
let sure_until_ms = 0;

/** What proves that this page holds the controls; null where it does not. */
export const currentLease = () => lease;

/** The plan to start: {name, text} as YAML; null where none is chosen. The plan editor sets it too. */
export const chosenPlan = () => JSON.parse(sessionStorage.getItem(PLAN) ?? "null");

/** Choose the plan to start; `follows` the file that the page's server was given, which may change. */
export function choosePlan(name, text, follows = false) {
  sessionStorage.setItem(PLAN, JSON.stringify({ name, text, follows }));
  document.dispatchEvent(new CustomEvent("palpd-plan"));
}

function keep(token) {
  lease = token;
  if (token === null) sessionStorage.removeItem(LEASE);
  else sessionStorage.setItem(LEASE, token);
  show();
}

async function takeControls(force) {
  const answer = await ask("/do/take", { name: operator.value.trim() || "operator", force });
  if (answer.ok) keep(answer.lease);
  else say(answer.error, "refused");
  return answer.ok;
}

/**
 * Send a request that needs the controls, and take them first where nobody holds them. Says how it ended, and returns the answer.
 * Controls that have run out, while the link was lost, are taken once more: it is the same press of the same button.
 */
export async function request(what, content = {}) {
  const held = lease !== null;
  if (!held && !(await takeControls(false))) return { ok: false };
  const send = () => ask(`/do/${what}`, { ...content, lease }, { patience_ms: PATIENCE_MS[what] ?? 8000 });
  let answer = await send();
  if (held && !answer.ok && !answer.unreached && !(await renewed())) {
    if (!(await takeControls(false))) return { ok: false }; // it has said who holds them now
    answer = await send();
  }
  say(answer.ok ? `${DONE[what] ?? what}.` : answer.error, answer.ok ? "done" : "refused");
  return answer;
}

/** Why a button is impossible now: {reason, way}; null where it is possible. `others` says that somebody else holds the controls. */
function obstacleOf(what) {
  if (lost) return { reason: "the service does not answer", way: null };
  if (lease === null && status?.controls) return { reason: `${status.controls} holds the controls`, way: null, others: true };
  const obstacle = status?.now?.obstacles?.[what] ?? null;
  return obstacle === null && what === "start" && chosenPlan() === null ? { reason: "no plan is chosen", way: "plan" } : obstacle;
}

const WAYS = { abort: "Wait for its end, or Abort", plan: "Choose a plan first", clear: "Look at the cell, then Clear" };

function sentenceOf({ reason, way }) {
  return `${capital(inButtons(reason))}.${way ? ` ${WAYS[way] ?? `${NAMES[way]} first`}.` : ""}`;
}

async function press(what) {
  const obstacle = obstacleOf(what);
  if (obstacle !== null && !obstacle.others) return say(`${NAMES[what]} is not possible: ${sentenceOf(obstacle)}`, "refused");
  if (what === "arm" || what === "check") say("Checking robot and sensor …");
  if (what === "calibrate") return begin("calibrate", {});
  if (what === "clear") return request("clear", { cause: cause.value.trim() || null });
  if (what !== "start") return request(what);
  const plan = chosenPlan();
  const fault = plan?.follows ? await readAnew() : "";
  if (fault || chosenPlan()?.text !== plan?.text) return say(fault || `${plan.name} has changed since this page read it. It is read anew: look at it, then Start.`, "refused");
  return request("start", { text: plan?.text, file: plan?.name, place: place.value || null });
}

/** Begin a job; its end is said in the line of messages. */
export async function begin(program, content) {
  const answer = await request("begin", { program, arguments: content });
  if (answer.ok) job = answer.id;
  return answer;
}

on("job", (event) => {
  if (event.id !== job || event.ended === null) return;
  job = null;
  say(`${capital(event.program)}: ${event.verdict}${event.reason ? `. ${event.reason}` : ""}`, event.verdict === "done" ? "done" : "refused");
  document.dispatchEvent(new CustomEvent("palpd-job", { detail: event }));
});

for (const button of buttons) button.addEventListener("click", () => press(button.dataset.do));

take.addEventListener("click", async () => {
  if (lease !== null) {
    const answer = await ask("/do/release", { lease });
    keep(null);
    say(answer.ok ? "The controls are free." : answer.error, answer.ok ? "done" : "refused");
  } else if (status?.controls && performance.now() > sure_until_ms) {
    sure_until_ms = performance.now() + SURE_MS; // no dialog: it would hold the space bar back
    show();
    setTimeout(show, SURE_MS + 50);
  } else if (await takeControls(performance.now() <= sure_until_ms)) {
    sure_until_ms = 0;
    say("You hold the controls.");
  }
});

/** Renew the controls. Resolves to whether this page still holds them, as far as it can know. */
async function renewed() {
  if (lease === null) return false;
  const mine = lease;
  const answer = await ask("/do/renew", { lease: mine });
  if (answer.ok || lease !== mine || answer.unreached || answer.expired) return true;
  keep(null);
  say(answer.error); // gone after a while: the button says who holds them
  return false;
}
setInterval(renewed, RENEW_MS);
renewed(); // what another page of this tab held may have ended since

operator.value = localStorage.getItem(NAME) ?? "";
operator.addEventListener("change", () => localStorage.setItem(NAME, operator.value.trim()));

function show() {
  const other = lease === null && status?.controls;
  take.textContent = lease !== null ? "Release controls" : other ? (performance.now() <= sure_until_ms ? "Press again to take them" : "Take by force") : "Take controls";
  holder.classList.toggle("hidden", lease !== null); // the button says so
  holder.textContent = lease !== null ? "You hold the controls" : other ? `${status.controls} holds the controls` : "";
  const obstacles = status?.now?.obstacles ?? {};
  pause.dataset.do = obstacles.pause && !obstacles.resume ? "resume" : "pause";
  pause.textContent = NAMES[pause.dataset.do];
  const next = other || lost ? null : status?.now?.next;
  for (const button of buttons) {
    const what = button.dataset.do, obstacle = obstacleOf(what);
    if (obstacle) button.setAttribute("aria-disabled", "true");
    else button.removeAttribute("aria-disabled");
    button.title = obstacle ? sentenceOf(obstacle) : button.dataset.about ?? "";
    button.toggleAttribute("data-next", what === next && !obstacle);
    if (what === "clear") button.hidden = !status?.latched && !status?.now?.cause;
  }
  decide.hidden = status?.now?.next !== "decide";
  decide.toggleAttribute("data-next", !decide.hidden);
  document.body.toggleAttribute("data-no-plan", next === "start" && chosenPlan() === null);
  const asked = status?.now?.cause ?? null;
  document.getElementById("cause-line").hidden = asked === null;
  if (asked === null) cause.value = "";
  const question = status?.now?.question ?? null;
  document.getElementById("place-line").hidden = question === null;
  document.getElementById("place-question").textContent = question === null ? "" : `${capital(question)}.`;
  if (question === null) place.value = "";
}

on("status", (event) => { [status, lost] = [event, false]; show(); });
on("lost", () => { [status, lost] = [null, true]; show(); });
document.addEventListener("palpd-plan", show);
show();

/** Choose the plan of the page's server as its file is now, where no other one is chosen. Returns why it cannot be read. */
async function readAnew() {
  const plan = await read("/first-plan"), before = chosenPlan();
  if (plan.ok && plan.name && (before === null || before.follows) && before?.text !== plan.text) choosePlan(plan.name, plan.text, true);
  return plan.ok ? "" : plan.error;
}
if ((chosenPlan()?.follows ?? true) && document.body.dataset.page !== "entrance") readAnew();
