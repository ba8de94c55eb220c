// What palpd setup has done on this cell and which step is next; where the page leads through it, what it says and asks.

import { on } from "./link.js";
import { capital, say } from "./message.js";
import { ask, read } from "./requests.js";
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

async function showSteps(talk) {
  const answer = await read("/setup/rows", { patience_ms: 65000 });
  byId("done").hidden = !answer.ok;
  const first = talk.offered && !talk.configured && !answer.ok;
  refuse(byId("refusal"), answer.ok || first ? "" : answer.error);
  byId("next").textContent = first ? capital(`${answer.error}.`) : "";
  byId("begin").textContent = answer.ok && Object.keys(answer.steps).length ? "Go on" : "Begin";
  byId("again").hidden = !answer.ok || talk.under_way;
  if (!answer.ok) return;
  const next = answer.order.find((name) => !answer.steps[name] || answer.steps[name].verdict === "fail");
  if (next) byId("next").textContent = `Next is ${next}: ${talk.offered ? "Go on leads there" : "palpd setup goes on there, at a terminal"}.`;
  else byId("next").replaceChildren("All steps are done or skipped. Next, start the service (", make("code", { text: `palpd serve --config ${talk.config}` }),
    "), press Arm, and make the first morning check in the tab ", make("a", { href: "/checks", text: "Checks" }),
    ". Installed by systemd it has a page of its own: end this one, then ", make("code", { text: "systemctl enable --now palpd palpd-web" }), ".");
  byId("redo").replaceChildren(...answer.order.filter((name) => answer.steps[name]).map((name) => make("option", { text: name })));
  byId("steps").replaceChildren(...answer.order.flatMap((name) => lines(name, answer.steps[name])));
  byId("rows").replaceChildren(...Object.entries(answer.assumptions).map(([rests_on, state]) => make("tr", {}, cell(rests_on.replaceAll("`", "")), cell(state))));
}

const KINDS = [[/^\d+\/\d+ {2}/, "faint"], [/^\d+\/\d+ /, "title"], [/^ {2}FAIL/, "bad"], [/^ {2}warn/, "warned-line"], [/^ {2}ok/, "good"]];

function spoken(line) {
  if ("say" in line) return make("li", { text: line.say, className: (KINDS.find(([words]) => words.test(line.say)) ?? [])[1] ?? "" });
  if ("ask" in line) return make("li", { text: line.ask, className: "asked" });
  if ("answered" in line) return make("li", { text: `▸ ${line.answered || "(nothing)"}`, className: "answered" });
  if ("ended" in line) return make("li", { text: line.ended ? `The set-up has ended with code ${line.ended}.` : "The set-up has ended.", className: "faint" });
  return make("li", { text: line.refused ?? line.begun, className: "refused" in line ? "bad" : "faint" });
}

async function send(path, content) {
  const answer = await ask(path, content);
  if (!answer.ok) say(answer.error, "refused");
  return answer.ok;
}

const DEAD_MS = 800;

function showQuestion(number, line) {
  const box = byId("question");
  box.hidden = !line;
  if (!line) { box.replaceChildren(); box.dataset.number = ""; return; }
  if (box.dataset.number === `${number}`) return; // what is typed stays
  box.dataset.number = number;
  const enable = (enabled) => { for (const button of box.querySelectorAll("button")) button.disabled = !enabled; };
  const answer = async (text) => {
    enable(false);
    if (!(await send("/setup/answer", { number, question: line.ask, answer: text }))) enable(true);
  };
  const button = (text) => {
    const moves = text === line.moves;
    const made = make("button", { type: "button", text: moves ? `${capital(text)}: the arm moves` : capital(text), className: moves ? "moves" : "", on: { click: () => answer(text) } });
    if (!moves) return made;
    made.addEventListener("keydown", (event) => { if (event.key === "Enter") event.preventDefault(); }); // no motion by a key
    made.disabled = true; // nor by the second click of a double click on the question before
    setTimeout(() => { made.disabled = false; }, DEAD_MS);
    return made;
  };
  const typed = make("input", { value: line.usual, id: "typed", autocomplete: "off", spellcheck: false, maxLength: 2000 });
  const form = make("form", { className: "line", on: { submit: (event) => { event.preventDefault(); answer(typed.value); } } }, typed, make("button", { type: "submit", text: "Answer" }));
  const title = line.answers.length ? make("p", { text: line.ask, id: "question-text" }) : make("p", { id: "question-text" }, make("label", { htmlFor: "typed", text: line.ask }));
  const step = [...byId("said").querySelectorAll(".title")].at(-1)?.textContent ?? "";
  box.replaceChildren(faint(step), title, line.answers.length ? make("p", { className: "line" }, ...line.answers.map(button)) : form);
}

let shown = 0, heard = null, reading = false, was = null;

async function showTalk() {
  if (reading) return;
  reading = true;
  for (let before = null; before !== heard;) { // lines may come while some are read
    before = heard;
    const answer = await read(`/setup/talk?after=${shown}`);
    if (!answer.ok) break;
    byId("talk").hidden = !answer.offered;
    const log = byId("said");
    if (answer.lines < shown) { log.replaceChildren(); shown = 0; before = null; continue; } // another server
    log.append(...answer.said.map(spoken));
    shown += answer.said.length;
    const open = answer.asked !== null && answer.asked === shown - 1;
    if (answer.said.length || !open) showQuestion(answer.asked, open ? answer.said.at(-1) : null);
    if (answer.said.length) log.scrollTop = log.scrollHeight;
    byId("begin").hidden = answer.under_way;
    if (was !== answer.under_way) { was = answer.under_way; showSteps(answer); }
  }
  reading = false;
}

on("setup", (event) => { heard = event; showTalk(); });
byId("begin").addEventListener("click", () => send("/setup/begin"));
byId("redo-begin").addEventListener("click", () => send("/setup/begin", { redo: byId("redo").value }));
