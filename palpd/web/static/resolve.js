// The conversation of palpd resolve: the gap so far, the proposed motion with its rehearsal, agree or decline, the log, the result.

import { chart, instead, scaled } from "./chart.js";
import { request } from "./controls.js";
import { on } from "./link.js";
import { say } from "./message.js";
import { ask } from "./requests.js";
import { byId, decimal, duration, framed, make, refuse, resultOf, tile, work } from "./work.js";

const PAUSE_MS = 1000;
let status = {};
let shown = new URLSearchParams(location.search).get("job"), drawn = "", answered = "", finished = "";

async function update() {
  const answer = await ask("/do/jobs");
  if (!answer.ok) { refuse(byId("refusal"), answer.error); return; }
  if (byId("refusal").dataset.of !== "begin") refuse(byId("refusal"), "");
  const jobs = answer.jobs.filter((job) => job.program === "resolve"), running = jobs.find((job) => job.ended === null);
  shown ??= running?.id ?? jobs[0]?.id ?? null;
  byId("begin").querySelector("button").disabled = Boolean(running);
  const others = jobs.filter((job) => job.id !== shown);
  byId("earlier").hidden = others.length === 0;
  byId("jobs").replaceChildren(...others.map((job) => make("li", {}, make("a", { href: `/resolve?job=${encodeURIComponent(job.id)}`, text: job.id }), ` of ${job.by}: ${job.state}, ${job.runs} ${job.runs === 1 ? "run" : "runs"}. ${job.reason}`)));
  if (shown) await showJob();
}

async function showJob() {
  const job = await ask("/do/job", { id: shown });
  if (!job.ok) { refuse(byId("refusal"), job.error); shown = null; return; }
  const over = job.ended !== null;
  byId("conversation").hidden = false;
  const doing = over ? "" : job.activity || status.activity || "";
  byId("standing-job").replaceChildren(make("span", { className: `chip ${job.verdict ?? job.state}`, text: job.state === "waiting" ? "waits for your answer" : job.state }),
    ` ${job.runs} of at most ${job.most_runs} ${job.most_runs === 1 ? "run" : "runs"}${doing ? `, ${doing}` : ""}`);
  byId("cancel").hidden = over;
  const log = byId("log"), lines = job.log.filter(Boolean);
  if (log.childElementCount !== lines.length) {
    log.replaceChildren(...lines.map((line) => make("li", { text: line, className: line.startsWith("Recording ") ? "gap" : "" })));
    log.scrollTop = log.scrollHeight;
  }
  showProposal(job);
  showResult(job, over);
}

function showProposal(job) {
  const proposal = job.proposal, name = proposal ? `${job.id} ${proposal.number}` : "";
  byId("proposal").hidden = !proposal || answered === name;
  if (!proposal) return;
  byId("gap").textContent = proposal.gap;
  byId("decides").textContent = proposal.decides;
  byId("proposal-title").textContent = `Proposed motion ${proposal.number}`;
  byId("agree").disabled = byId("decline").disabled = job.state !== "waiting";
  byId("agree").onclick = () => decide(job.id, proposal.number, true);
  byId("decline").onclick = () => decide(job.id, proposal.number, false);
  byId("figures").replaceChildren(
    tile("Duration", duration(proposal.duration_s), "rehearsed without wires"),
    tile("Expected largest force", `${proposal.expected_peak_N.toFixed(1)} N`, `the guard ends it at ${proposal.limit_N} N`, proposal.expected_peak_N > 0.9 * proposal.limit_N ? "warn" : ""),
    tile("Presses to", (proposal.plan.depths_m ?? []).map((depth) => `${Number((depth * 1e3).toPrecision(4))} mm`).join(", ") || "none", `at ${Number((proposal.plan.press_speed_m_per_s * 1e3).toPrecision(3))} mm/s, holds of ${proposal.plan.hold_s} s`));
  if (drawn !== name) { drawn = name; draw(job.id); }
}

async function draw(id) {
  const end = await work("/resolve/rehearse", { id }, byId("drawing-state"));
  const answer = ["done", "stopped"].includes(end.state) ? await resultOf(end) : { ok: false, error: end.sentence };
  for (const each of ["force", "depth"]) instead(byId(each));
  if (!answer.ok) { byId("drawing-state").replaceChildren(make("p", { className: "faint", text: answer.error })); return; }
  const columns = answer.result.course;
  chart(byId("force"), { label: "contact force of the rehearsal", yLabel: "force (N)", xLabel: "time (s)", height: 210, series: [{ x: columns.t_s, low: columns.force_low_N, high: columns.force_high_N, y: columns.force_high_N }] });
  chart(byId("depth"), { label: "depth of the rehearsal", yLabel: "depth (mm)", xLabel: "time (s)", height: 210, series: [{ x: columns.t_s, low: scaled(columns.depth_low_m, 1e3), high: scaled(columns.depth_high_m, 1e3), y: scaled(columns.depth_high_m, 1e3), colour: 1 }] });
}

async function decide(id, number, agree) {
  byId("agree").disabled = byId("decline").disabled = true;
  const answer = await request("decide", { id, number, agree });
  if (answer.ok) {
    answered = `${id} ${number}`;
    say(agree ? "Agreed: the motion begins." : "Declined: nothing moves.");
  }
  update();
}

function showResult(job, over) {
  byId("result").hidden = !over;
  if (!over || finished === job.id) return;
  finished = job.id;
  byId("sentence").textContent = job.reason || job.verdict;
  const rounds = job.result?.rounds ?? [], share = (value) => `${(100 * value).toFixed(0)} %`;
  byId("rounds").replaceChildren(...(rounds.length ? [make("table", {}, make("thead", {}, make("tr", {}, ...["recording", "what it says", "still open", "gained"].map((each) => make("th", { text: each })))),
    make("tbody", {}, ...rounds.map((round) => make("tr", {}, make("td", { text: round.recording }), make("td", { text: round.sentence }), make("td", { text: Object.entries(round.open).map(([name, value]) => `${name} ${share(value)}`).join(", ") }),
      make("td", { text: round.gained === null ? "–" : `${round.settled ? "at least " : ""}${round.gained.toFixed(1)} nats` })))))] : []));
  byId("page").replaceChildren(...(job.result?.diagnosis ? [framed(`/resolve/report?id=${encodeURIComponent(job.id)}`, "diagnosis of all recordings")] : []));
}

byId("begin").addEventListener("submit", async (event) => {
  event.preventDefault();
  const fields = event.target.elements, depth = decimal(fields.depth.value);
  if (Number.isNaN(depth)) return refuse(byId("refusal"), `The deepest press is ${fields.depth.value}, expected a number of mm, or nothing.`);
  const wishes = { rounds: Number(fields.rounds.value), take_reference: fields.take_reference.checked, ...(depth === null ? {} : { max_depth_m: depth / 1e3 }) };
  const answer = await request("begin", { program: "resolve", arguments: wishes });
  byId("refusal").dataset.of = answer.ok ? "" : "begin";
  refuse(byId("refusal"), answer.ok ? "" : answer.error ?? "");
  if (answer.ok) { say(`Job ${answer.id} makes at most ${answer.most_runs} ${answer.most_runs === 1 ? "run" : "runs"}.`); shown = answer.id; history.replaceState(null, "", `/resolve?job=${encodeURIComponent(shown)}`); await update(); }
});
byId("cancel").addEventListener("click", async () => {
  const answer = await ask("/do/cancel", { id: shown });
  say(answer.ok ? "The job is cancelled." : answer.error, answer.ok ? "done" : "refused");
});

on("status", (event) => { status = event; });

for (;;) {
  await update();
  await new Promise((resolve) => setTimeout(resolve, PAUSE_MS));
}
