// The last morning check, the control chart of each figure over the checks since the baseline, and what injections say of this cell.

import { chart } from "./chart.js";
import { begin } from "./controls.js";
import { inButtons, say } from "./message.js";
import { read } from "./requests.js";
import { byId, decimal, make, refuse } from "./work.js";

const MOODS = { ok: "done", warn: "remarkable", stop: "stopped" };
const WORDS = { ok: "ok", warn: "warning", stop: "do not palpate" };

function about(checks) {
  const last = checks[checks.length - 1], first = checks[0];
  const parts = [`${checks.length} check${checks.length > 1 ? "s" : ""} since ${first.date.slice(0, 10)}`];
  if (first.baseline) parts.push(`the baseline: ${first.baseline}`);
  if (last.named.length) parts.push(`the diagnosis of the puck names ${last.named.join(", ")}`);
  if (last.temperature_C !== null) parts.push(`${last.temperature_C.toFixed(1)} °C`);
  return parts.join("; ");
}

function draw(figure, checks) {
  const plain = figure.words.replace(/^the /, ""), title = plain[0].toUpperCase() + plain.slice(1);
  const holder = make("div", {}), x = checks.map((_, k) => k + 1);
  const names = checks.map((check, k) => `${check.date.slice(0, 16)}: ${figure.values[k]?.toPrecision(4)} ${figure.unit}`);
  const of = (changed) => figure.values.map((value, k) => (figure.changed[k] === changed ? value : null));
  requestAnimationFrame(() => chart(holder, { label: `${figure.words} over the checks`, xLabel: "check", yLabel: figure.unit, height: 190,
    x: [0.5, Math.max(checks.length, 8) + 0.5], series: [
      { x, low: figure.low, high: figure.high },
      { x, y: of(false), points: true, bare: true, names },
      { x, y: of(true), points: true, bare: true, names, colour: 1 },
    ] }));
  return make("section", {}, make("h2", { text: title }), holder);
}

function limitRow(limit) {
  return make("tr", {}, make("td", {}, make("b", { text: limit.effect }), make("p", { className: "faint", text: limit.words })),
    make("td", { text: limit.text }), make("td", { className: "number", text: `${limit.named} of ${limit.injections}` }));
}

function showInjections(of) {
  byId("injections").hidden = !of.refusal && !of.injections;
  refuse(byId("injections-refusal"), of.refusal || "");
  byId("injected").textContent = (of.sentences || []).join(" ");
  byId("injected-last").textContent = of.last ? `The newest: ${of.last}` : "";
  byId("limits-table").hidden = !(of.limits || []).length;
  byId("limits").replaceChildren(...(of.limits || []).map(limitRow));
}

async function showChecks() {
  const answer = await read("/checks/list", { patience_ms: 130000 });
  refuse(byId("refusal"), answer.ok ? "" : answer.error);
  if (answer.ok) showInjections(answer.injections);
  if (answer.ok && answer.checks.length) {
    const last = answer.checks[answer.checks.length - 1];
    byId("last").replaceChildren(make("span", { className: `chip ${MOODS[last.level]}`, text: WORDS[last.level] }), ` ${last.date.slice(0, 16).replace("T", " ")}: ${inButtons(last.sentence)}`);
    byId("about").textContent = about(answer.checks);
    byId("renewal").hidden = last.level === "ok";
    byId("charts").replaceChildren(...answer.figures.map((figure) => draw(figure, answer.checks)));
  } else if (answer.ok) byId("last").textContent = "There is no check yet. The first one is the commissioning: make it when you know that the cell is well.";
}

byId("check").addEventListener("click", () => {
  const temperature_C = decimal(byId("temperature").value), here = byId("here").checked;
  if (Number.isNaN(temperature_C)) return say(`The temperature is ${byId("temperature").value}, expected a number of °C, or nothing.`, "refused");
  begin("check", { ...(temperature_C === null ? {} : { temperature_C }), ...(here ? { here } : {}) });
  byId("here").checked = false; // the word counts for one check
});
byId("renew").addEventListener("click", () => {
  const note = byId("note").value.trim();
  if (!note) return say("The note is empty, expected what was changed; write it beside the button.", "refused");
  begin("baseline", { note });
  byId("note").value = "";
});
document.addEventListener("palpd-job", showChecks);
showChecks();
