// What palpd setup has done on this cell, and which step is next. It reads only.

import { read } from "./requests.js";
import { byId, make, refuse } from "./work.js";

const MOODS = { ok: "done", warn: "remarkable", fail: "failed" };
const cell = (...children) => make("td", {}, ...children);
const faint = (text) => (text ? make("p", { className: "faint", text }) : null);
const chip = (verdict) => make("span", { className: `chip ${MOODS[verdict] || ""}`, text: verdict });

function lines(name, result) {
  const findings = result && result.findings.length ? result.findings : [{}];
  return findings.map((finding, index) => make("tr", {},
    make("td", { className: "when" }, ...(index ? [] : [make("b", { text: name }), faint(result && result.date.slice(0, 16).replace("T", " "))])),
    cell(chip(finding.verdict || (result ? result.verdict : "open"))),
    cell(finding.name ? `${finding.name}: ${finding.measured}` : "", faint(finding.expected && `expected ${finding.expected}`)),
    cell(finding.advice || "")));
}

const answer = await read("/setup/rows", { patience_ms: 65000 });
refuse(byId("refusal"), answer.ok ? "" : answer.error);
if (answer.ok) {
  const next = answer.order.find((name) => !answer.steps[name] || answer.steps[name].verdict === "fail");
  byId("next").textContent = next ? `Next is ${next}: palpd setup goes on there, at a terminal.` : "All steps are done or skipped.";
  byId("steps").replaceChildren(...answer.order.flatMap((name) => lines(name, answer.steps[name])));
  byId("rows").replaceChildren(...Object.entries(answer.assumptions).map(([rests_on, state]) => make("tr", {}, cell(rests_on.replaceAll("`", "")), cell(state))));
}
