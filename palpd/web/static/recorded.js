// One run: what it was, its force and depth over time, its diagnosis, its report, and that of two runs side by side.

import { broken, chart, extent, instead, scaled, spansOf } from "./chart.js";
import { say } from "./message.js";
import { ask, read } from "./requests.js";
import { byId, duration, framed, kilopascals, make, refuse, resultOf, tile, work } from "./work.js";

const asked = new URLSearchParams(location.search);
const run = asked.get("run") ?? "";
const address = encodeURIComponent(run);
const begin = byId("begin"), length = byId("length");
const SHORTEST_S = 0.2;
let facts, source, overview, whole = 0, fetching = 0;

/** The name of a run, as far as a text can show it. */
function nameOf(key) {
  try {
    return decodeURIComponent(key);
  } catch {
    return key;
  }
}

async function open() {
  byId("name").textContent = nameOf(run);
  const reading = await work("/runs/read", { run }, byId("reading"));
  if (reading.state !== "done") { refuse(byId("refusal"), reading.sentence); return; }
  const answer = await resultOf(reading);
  if (!answer.ok) { refuse(byId("refusal"), answer.error); return; }
  [facts, source] = [answer.result, reading.number];
  byId("recording").href = `/runs/recording?run=${address}`;
  byId("recording").hidden = false;
  showFacts();
  byId("facts").hidden = false;
  await showCourse();
}

function showFacts() {
  byId("verdict").textContent = facts.verdict;
  byId("verdict").className = `chip ${facts.verdict} ${facts.mood}`;
  byId("headline").textContent = facts.headline;
  const loop = facts.loop;
  byId("tiles").replaceChildren(
    tile("Began", facts.started.slice(0, 16).replace("T", " "), `${facts.kind.replace("_", " ")}${facts.dry ? ", dry" : ""}`),
    tile("Duration", duration(facts.duration_s), `${loop.ticks} ticks, ${loop.missed} missed`),
    tile("Largest force", facts.peak_force_N === null ? "–" : `${facts.peak_force_N.toFixed(2)} N`, `${facts.faults.length} ${facts.faults.length === 1 ? "fault" : "faults"}, ${facts.cut_short.length} cut short`),
    ...facts.sites.filter((site) => site.static_youngs_modulus_Pa !== null).slice(0, 6).map((site) => {
      const interval = site.static_ci95_Pa, misfit = site.hertz_misfit;
      const more = misfit ? `Hertz does not fit: ${kilopascals(misfit.low_Pa)} to ${kilopascals(misfit.high_Pa)} over depth`
        : interval ? `static, ± ${((interval[1] - interval[0]) / 2e3).toFixed(1)} (95 %)` : "static";
      return tile(`Site ${site.name}`, `${kilopascals(site.static_youngs_modulus_Pa)} kPa`, more);
    }));
  showRemarks(facts.remarks);
  ask("/runs/remark", { run }).then((answer) => { if (answer.ok) showRemarks(answer.remarks); }); // the facts may have been read before a remark
  const names = facts.sites.map((site) => site.name);
  byId("diagnose").elements.site.replaceChildren(...names.map((name) => make("option", { value: name, text: name })));
  byId("diagnose").hidden = names.length === 0;
}

function showRemarks(remarks) {
  const tags = remarks.tags.map((tag) => make("span", { className: "tag", text: tag },
    make("button", { type: "button", text: "×", ariaLabel: `take the tag ${tag} away`, on: { click: () => remark({ untag: tag }) } })));
  const notes = remarks.notes.map((note) => make("p", { className: "note" }, make("span", { className: "faint", text: `${note.date.slice(0, 10)} ` }), make("span", { text: note.text })));
  byId("remarks").replaceChildren(...tags, ...notes);
}

async function remark(change) {
  const answer = await ask("/runs/remark", { run, ...change });
  say(answer.ok ? "Kept beside the recording." : answer.error, answer.ok ? "done" : "refused");
  if (answer.ok) showRemarks(answer.remarks);
  return answer.ok;
}

byId("remark").addEventListener("submit", async (event) => {
  event.preventDefault();
  const form = event.target;
  if (await remark({ tag: form.elements.tag.value.trim(), note: form.elements.note.value })) form.reset();
});

// --- the course ---

const piece = (from, to) => read(`/calculations/${source}/course?begin_s=${from}&end_s=${to}`, { patience_ms: 60000 });

async function showCourse() {
  const answer = await piece(0, 1e9);
  if (!answer.ok) { refuse(byId("overview"), answer.error); return; }
  whole = answer.duration_s;
  const columns = broken(answer.columns), spans = spansOf(columns, facts.sites.map((site) => site.name));
  overview = chart(byId("overview"), {
    label: `contact force over the whole run of ${duration(whole)}; a window of it is shown below`, height: 110, x: [0, whole], xLabel: "", yLabel: "N", spans, window: shown,
    series: [{ x: columns.t_s, low: columns.force_low_N, high: columns.force_high_N, y: columns.force_high_N }],
  });
  byId("sites").replaceChildren(make("button", { type: "button", text: "whole run", on: { click: () => choose(0, whole) } }),
    ...spans.slice(0, 12).map((span) => make("button", { type: "button", text: `site ${span.label}`, on: { click: () => choose(span.from, span.to) } })));
  draw(columns, spans);
  dragging();
}

const long = () => SHORTEST_S + (Math.max(whole, SHORTEST_S) - SHORTEST_S) * (Number(length.value) / 1000) ** 2;
const first = () => (Math.max(whole, SHORTEST_S) - long()) * (Number(begin.value) / 1000);
const shown = () => [first(), first() + long()];

function choose(from, to) {
  const span = Math.min(Math.max(to - from, SHORTEST_S), whole);
  length.value = Math.round(1000 * Math.sqrt((span - SHORTEST_S) / Math.max(whole - SHORTEST_S, 1e-9)));
  begin.value = Math.round(1000 * Math.max(0, from) / Math.max(whole - long(), 1e-9));
  moved();
}

function moved() {
  const [from, to] = shown();
  byId("window").textContent = `${from.toFixed(2)} s to ${to.toFixed(2)} s`;
  overview?.redraw();
  const number = ++fetching;
  setTimeout(async () => {
    if (number !== fetching) return;
    const answer = await piece(from, to);
    if (number !== fetching) return;
    const columns = answer.ok ? broken(answer.columns) : null;
    if (answer.ok) draw(columns, spansOf(columns, facts.sites.map((site) => site.name)));
    else refuse(byId("curve"), answer.error);
  }, 120);
}
for (const slider of [begin, length]) slider.addEventListener("input", moved);

function dragging() {
  const holder = byId("overview");
  let offset = null;
  const at = (event) => overview.place(event.clientX - holder.getBoundingClientRect().left);
  holder.addEventListener("pointerdown", (event) => {
    const [from, to] = shown(), here = at(event);
    offset = here >= from && here <= to && long() < whole * 0.98 ? here - from : Math.min(long(), whole / 8) / 2;
    if (long() >= whole * 0.98) choose(here - whole / 16, here + whole / 16);
    holder.setPointerCapture(event.pointerId);
    choose(at(event) - offset, at(event) - offset + long());
  });
  holder.addEventListener("pointermove", (event) => { if (offset !== null) choose(at(event) - offset, at(event) - offset + long()); });
  for (const end of ["pointerup", "pointercancel"]) holder.addEventListener(end, () => { offset = null; });
}

function draw(columns, spans) {
  const [from, to] = shown(), x = [from, to];
  byId("window").textContent = `${from.toFixed(2)} s to ${to.toFixed(2)} s`;
  const limit = facts.conditions.find(([name]) => name === "limits");
  const depth = { low: scaled(columns.depth_low_m, 1e3), high: scaled(columns.depth_high_m, 1e3) };
  const known = depth.high.some((value) => value !== null);
  chart(byId("force"), {
    label: `contact force from ${from.toFixed(1)} to ${to.toFixed(1)} s${limit ? `; limits ${limit[1]}` : ""}`, x, xLabel: "", yLabel: "force (N)", spans, height: 200,
    series: [{ x: columns.t_s, low: columns.force_low_N, high: columns.force_high_N, y: columns.force_high_N }],
  });
  chart(byId("depth"), known
    ? { label: "depth of the tip below the surface over time", x, xLabel: "time (s)", yLabel: "depth (mm)", height: 200, series: [{ x: columns.t_s, ...depth, y: depth.high, colour: 1 }] }
    : { label: "height of the tip over time", x, xLabel: "time (s)", yLabel: "height (mm)", height: 200, series: [{ x: columns.t_s, y: scaled(columns.z_low_m, 1e3), colour: 1 }] });
  const pressed = depth.high.map((value, k) => (value !== null && value > -1 ? k : -1)).filter((k) => k >= 0);
  if (!pressed.length) { instead(byId("curve"), make("p", { className: "faint", text: "Nothing was pressed in this time, or the surface was not known yet." })); return; }
  const sites = [...new Set(pressed.map((k) => columns.site[k]))];
  chart(byId("curve"), {
    label: "contact force over depth", xLabel: "depth below the surface (mm)", yLabel: "force (N)", height: 400, legend: true,
    x: extent(pressed.map((k) => depth.high[k])),
    series: sites.slice(0, 4).map((site, colour) => ({
      x: depth.high.map((value, k) => (columns.site[k] === site && value !== null && value > -1 ? value : null)), y: columns.force_high_N, colour,
      label: `site ${facts.sites[site]?.name ?? site}`,
    })),
  });
}

// --- the diagnosis ---

byId("diagnose").addEventListener("submit", async (event) => {
  event.preventDefault();
  const site = event.target.elements.site.value, button = event.target.querySelector("button");
  button.disabled = true;
  const end = await work("/runs/diagnose", { run, site }, byId("diagnosing"));
  button.disabled = false;
  if (end.state !== "done") { refuse(byId("diagnosis"), end.sentence); return; }
  const answer = await resultOf(end);
  if (!answer.ok) { refuse(byId("diagnosis"), answer.error); return; }
  showDiagnosis(answer.result, end.number, site);
});

function showDiagnosis(diagnosis, number, site) {
  const share = (value) => make("span", { className: "share" }, make("progress", { max: 1, value, ariaLabel: "probability" }), make("span", { className: "number", text: `${(100 * value).toFixed(0)} %` }));
  const candidates = diagnosis.candidates.slice(0, 6);
  const keep = make("button", { type: "button", text: "Keep for the trend", on: { click: async () => {
    const answer = await ask("/runs/keep", { run, number });
    say(answer.ok ? `Kept as ${answer.kept}.` : answer.error, answer.ok ? "done" : "refused");
  } } });
  byId("diagnosis").replaceChildren(
    make("p", { className: "headline", text: diagnosis.sentence }),
    candidates.length ? make("table", { className: "candidates" }, make("thead", {}, make("tr", {}, make("th", { text: "Effect" }), make("th", { text: "Probability" }))),
      make("tbody", {}, ...candidates.map((each) => make("tr", {}, make("td", { text: each.id }), make("td", {}, share(each.probability)))))) : null,
    make("p", { className: "actions" }, keep, " ", make("a", { className: "button", href: `/calculations/${number}/report?download`, text: "Download its page" })),
    framed(`/calculations/${number}/report`, `diagnosis of site ${site}`));
}

// --- the report ---

async function showReport(beside) {
  byId("report").replaceChildren();
  const end = await work("/runs/make-report", { run, beside }, byId("writing"));
  if (end.state !== "done") { refuse(byId("report"), end.sentence); return; }
  const where = end.report ?? `/calculations/${end.number}/report`;
  byId("page").href = `${where}${where.includes("?") ? "&" : "?"}download`;
  byId("page").hidden = false;
  byId("report-title").textContent = beside ? `Report beside ${nameOf(beside)}` : "Report";
  byId("report").replaceChildren(framed(where, "report of the run"));
}

async function offerOthers() {
  const select = byId("beside").elements.beside, answer = await read("/runs/list?kind=palpation", { patience_ms: 130000 });
  if (answer.ok) select.append(...answer.runs.filter((each) => each.key !== run).map((each) => make("option", { value: each.key, text: `${each.name}, ${each.started.slice(0, 10)}` })));
  const beside = asked.get("beside") ?? "";
  if (beside && ![...select.options].some((option) => option.value === beside)) select.append(make("option", { value: beside, text: nameOf(beside) }));
  select.value = beside;
  select.addEventListener("change", () => showReport(select.value));
}

showReport(asked.get("beside") ?? "");
offerOthers();
open();
