// Arm, start, pause, retract, clear, and who holds the controls. All refusals are the service's own sentences.

import { on } from "./link.js";
import { say } from "./message.js";
import { ask, read } from "./requests.js";

const RENEW_MS = 3000;
const SURE_MS = 5000;
const PATIENCE_MS = { arm: 65000 };
const LEASE = "palpd.lease";
const PLAN = "palpd.plan";
const NAME = "palpd.operator";
const DONE = { arm: "Armed", start: "Started", pause: "Pause", resume: "Resume", retract: "The arm leaves the tissue", "level-test": "The arm goes 5 mm up", clear: "The latch is cleared", "keep-plan": "The plan is kept", "forget-plan": "The plan is forgotten" };

const take = document.getElementById("take");
const operator = document.getElementById("operator");
const holder = document.getElementById("holder");
const pause = document.getElementById("pause");
let status = null;
let lease = sessionStorage.getItem(LEASE);
let sure_until_ms = 0;

/** Whether this page holds the controls. */
export const holding = () => lease !== null;

/** What proves that; null where this page does not hold them. */
export const currentLease = () => lease;

/** The plan to start: {name, text} as YAML; null where none is chosen. The plan editor sets it too. */
export const chosenPlan = () => JSON.parse(sessionStorage.getItem(PLAN) ?? "null");

/** Choose the plan to start. */
export function choosePlan(name, text) {
  sessionStorage.setItem(PLAN, JSON.stringify({ name, text }));
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

/** Send a request that needs the controls, and take them first where nobody holds them. Says how it ended, and returns the answer. */
export async function request(what, content = {}) {
  if (lease === null && !(await takeControls(false))) return { ok: false };
  const answer = await ask(`/do/${what}`, { ...content, lease }, { patience_ms: PATIENCE_MS[what] ?? 8000 });
  say(answer.ok ? `${[DONE[what] ?? what, answer.state].filter(Boolean).join(": ")}.` : answer.error, answer.ok ? "done" : "refused");
  return answer;
}

async function press(what) {
  if (what !== "start") {
    if (what === "arm") say("Checking robot and sensor …");
    return request(what);
  }
  const plan = chosenPlan();
  if (plan === null) return say("No plan is chosen; choose one on the Run page.", "refused");
  const place = document.getElementById("place-choice")?.value || null;
  return request("start", { text: plan.text, file: plan.name, place });
}

for (const button of document.querySelectorAll("[data-do]")) {
  button.addEventListener("click", () => press(button.dataset.do));
}

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

setInterval(async () => {
  if (lease === null) return;
  const mine = lease;
  const answer = await ask("/do/renew", { lease: mine });
  if (!answer.ok && lease === mine && answer.error && !answer.unreached) {
    keep(null);
    say(answer.error, "refused");
  }
}, RENEW_MS);

operator.value = localStorage.getItem(NAME) ?? "";
operator.addEventListener("change", () => localStorage.setItem(NAME, operator.value.trim()));

function show() {
  const other = lease === null && status?.controls;
  take.textContent = lease !== null ? "Release controls" : other ? (performance.now() <= sure_until_ms ? "Press again to take them" : "Take by force") : "Take controls";
  holder.textContent = lease !== null ? "You hold the controls" : other ? `${status.controls} holds the controls` : "";
  const paused = ["paused", "pause_retract"].includes(status?.phase);
  pause.dataset.do = paused ? "resume" : "pause";
  pause.textContent = paused ? "Resume" : "Pause";
}

on("status", (event) => { status = event; show(); });
on("lost", () => { status = null; show(); });
show();

if (chosenPlan() === null && document.body.dataset.page !== "entrance") {
  read("/first-plan").then((plan) => { if (plan.ok && plan.name && chosenPlan() === null) choosePlan(plan.name, plan.text); });
}
