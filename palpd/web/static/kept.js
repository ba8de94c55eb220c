// The plans that the service keeps under a name, with what their rehearsals gave: choose one, keep another, forget one.

import { currentLease, request } from "./controls.js";
import { on } from "./link.js";
import { ask } from "./requests.js";
import { byId, duration, make, refuse } from "./work.js";

const CHOSEN = "palpd.kept";
const SURE_MS = 5000;

/**
 * Show the kept plans. `now()` gives the plan of the editor, {yaml, rehearsal}; `open(name, yaml)` shows one there.
 * Returns {edited, configured: config_sha256 -> nothing, rehearsed: (yaml, figures) -> nothing}.
 */
export function keptPlans(now, open) {
  const list = byId("kept"), field = byId("kept-name"), refusal = byId("kept-refusal");
  let plans = [], config = "", problem = "", drawn = "", sure = "", chosen = JSON.parse(sessionStorage.getItem(CHOSEN) ?? "null"); // chosen: {name, sha256, yaml} as it was seen

  function choose(plan, yaml) {
    chosen = plan && { name: plan.name, sha256: plan.sha256, yaml };
    sessionStorage.setItem(CHOSEN, JSON.stringify(chosen));
    if (plan) field.value = plan.name;
    refuse(refusal, "");
  }

  async function refresh() {
    const answer = await ask("/do/plans");
    if (answer.ok) plans = answer.plans ?? [];
    problem = answer.ok ? "" : answer.error;
    draw();
  }

  function rehearsal(figures) {
    if (!figures) return [make("span", { className: "faint", text: "not rehearsed; choose it, and the page rehearses it" })];
    const old = config && figures.config_sha256 !== config, cut = figures.cut_short, stopped = figures.verdict !== "done";
    const words = stopped ? "stopped by the guard" : cut ? `${cut} of ${figures.presses} presses cut short` : "no press cut short";
    return [make("span", { className: `chip ${old ? "" : stopped || cut ? "remarkable" : "done"}`, text: words }),
      make("span", { className: old ? "faint" : "", text: `${duration(figures.duration_s)}, at most ${figures.peak_force_N.toFixed(1)} N` }),
      make("span", { className: "faint", text: old ? "config.yaml has changed since the rehearsal; choose the plan to rehearse it again" : `rehearsed ${when(figures.date)}` })];
  }

  const when = (date) => new Date(date).toLocaleString(undefined, { day: "numeric", month: "short", hour: "2-digit", minute: "2-digit" });

  function edited() {
    byId("kept-state").textContent = chosen && field.value === chosen.name && chosen.yaml !== now().yaml ? "changed since it was kept" : "";
  }

  /** Draw the list where it is another one than before: a button that is pressed right now must not go. */
  function draw() {
    const mine = (plan) => chosen?.name === plan.name, next = JSON.stringify([plans, config, chosen, problem, sure]);
    edited();
    if (next === drawn) return;
    drawn = next;
    const focused = [...list.querySelectorAll("button")].indexOf(document.activeElement);
    list.replaceChildren(...plans.map((plan) => make("li", mine(plan) ? { "aria-current": "true" } : {},
      make("b", { text: plan.name }), ...rehearsal(plan.rehearsal),
      make("span", { className: "faint", text: `kept by ${plan.by || "hand"}${plan.kept ? ` ${when(plan.kept)}` : ""}` }),
      mine(plan) && plan.sha256 !== chosen.sha256 ? make("span", { className: "changed", text: "It was changed since you chose it." }) : "",
      make("span", { className: "actions" },
        make("button", { type: "button", text: mine(plan) ? "Chosen" : "Choose", ariaLabel: `${mine(plan) ? "Chosen" : "Choose"}: ${plan.name}`, on: { click: () => show(plan) } }),
        make("button", { type: "button", text: sure === plan.name ? "Press again to forget" : "Forget", ariaLabel: `${sure === plan.name ? "Press again to forget" : "Forget"} ${plan.name}`, on: { click: () => forget(plan) } })))));
    if (problem || !plans.length) list.replaceChildren(make("li", { className: "faint", text: problem || "No plan is kept yet. Give the plan below a name, and keep it for another day." }));
    list.querySelectorAll("button")[focused]?.focus();
  }

  async function show(plan) {
    const answer = await ask("/do/plans", { name: plan.name });
    if (!answer.ok) { refuse(refusal, answer.error); return; }
    choose(answer.plans[0], answer.yaml);
    open(plan.name, answer.yaml);
    await refresh();
  }

  async function keep(replaced) {
    const name = field.value.trim(), { yaml, rehearsal: figures } = now(), was = replaced ?? (chosen?.name === name ? chosen.sha256 : null);
    const answer = await request("keep-plan", { name, text: yaml, file: "the plan", was, rehearsal: figures });
    if (answer.ok) { choose(answer.plans[0], yaml); open(name, yaml); }
    else refuse(refusal, answer.error);
    await refresh();
    const other = plans.find((plan) => plan.name === name);
    if (answer.error && other && other.sha256 !== was) refusal.firstChild.append(" ", make("button", { type: "button", text: `Replace ${name}`, on: { click: () => keep(other.sha256) } }));
  }

  async function forget(plan) {
    if (sure !== plan.name) { // no dialog: it would hold the space bar back
      sure = plan.name;
      setTimeout(() => { sure = ""; draw(); }, SURE_MS);
      return draw();
    }
    const answer = await request("forget-plan", { name: plan.name, was: plan.sha256 });
    refuse(refusal, answer.error ?? "");
    if (answer.ok && chosen?.name === plan.name) choose(null);
    await refresh();
  }

  byId("keep").addEventListener("submit", (event) => { event.preventDefault(); keep(); });
  field.addEventListener("input", edited);
  addEventListener("focus", refresh);
  on("status", () => { if (problem) refresh(); }); // the service is there again
  if (chosen) field.value = chosen.name;
  refresh();

  return {
    edited,
    configured(sha256) { config = sha256; draw(); },
    /** Keep a rehearsal beside the plan that it belongs to, where that has none of this configuration. A refusal changes nothing here. */
    async rehearsed(yaml, figures) {
      const plan = plans.find((each) => each.name === chosen?.name && each.sha256 === chosen.sha256 && chosen.yaml === yaml);
      if (!plan || plan.rehearsal?.config_sha256 === figures.config_sha256) return;
      await ask("/do/keep-plan", { name: plan.name, text: yaml, was: plan.sha256, rehearsal: figures, lease: currentLease() });
      await refresh();
    },
  };
}
