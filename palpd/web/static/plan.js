// The plan as a form and as text, judged by the same command as in the terminal, previewed and rehearsed.

import { chart, scaled, spansOf } from "./chart.js";
import { choosePlan, chosenPlan, request } from "./controls.js";
import { keptPlans } from "./kept.js";
import { ask, read } from "./requests.js";
import { byId, duration, kilopascals, make, refuse, resultOf, tile, work } from "./work.js";

const form = byId("form"), text = byId("yaml"), standing = byId("standing");
const FIRST = "sites:\n  - {name: A, x_m: 0.0, y_m: 0.0}\ndepths_m: [0.004]\n";
const BY_ITSELF_MS = 1500;
const BESIDE_M = 0.02;
let plan = null, judged = null, schema = null, number = 0, timer = 0, rehearsing = null, name = "plan.yaml";
let answer = {}; // of the last check that was sound
let faults = {}; // sentences by key, of the last check
let outcome = null; // of the last rehearsal, and the text that it is true for
let typed = true; // whether the text was edited last, and not the form

// --- from the form to text ---

const plain = (value) => (typeof value === "string" ? (/^[A-Za-z_][\w.-]*$/.test(value) && !/^(null|true|false|yes|no|on|off)$/i.test(value) ? value : JSON.stringify(value)) : String(value));
const inline = (value) => `{${Object.entries(value).map(([key, each]) => `${key}: ${plain(each)}`).join(", ")}}`;

function yamlOf(values) {
  const lines = [];
  for (const [key, value] of Object.entries(values)) {
    if (value === null || value === undefined || key === "version") continue;
    if (Array.isArray(value) && value.some((each) => typeof each === "object")) lines.push(`${key}:`, ...value.map((each) => `  - ${inline(each)}`));
    else if (Array.isArray(value)) lines.push(`${key}: [${value.map(plain).join(", ")}]`);
    else if (typeof value === "object") lines.push(`${key}: ${inline(value)}`);
    else lines.push(`${key}: ${plain(value)}`);
  }
  return `${lines.join("\n")}\n`;
}

// --- units: the form speaks mm, the plan holds m ---

const UNITS = [["_m_per_s", "mm/s", 3], ["_s", "s", 0], ["_m", "mm", 3]];
const unit = (key) => UNITS.find(([end]) => key.endsWith(end)) ?? ["", "", 0];
const named = (key) => key.slice(0, key.length - unit(key)[0].length).replaceAll("_", " ");
const labelled = (key) => named(key) + (unit(key)[1] ? ` (${unit(key)[1]})` : "");

/** A number with its decimal point moved, as its digits stand: nothing is rounded, and back it is the same number. */
function moved(value, places) {
  const [digits, exponent = "0"] = String(value).toLowerCase().split("e");
  return Number(`${digits}e${Number(exponent) + places}`);
}
const shown = (key, value) => (typeof value === "number" ? String(moved(value, unit(key)[2])) : value ?? "");
const mm = (value_m) => Number(moved(value_m, 3).toPrecision(4));
const entered = (key, word) => (word.trim() !== "" && Number.isFinite(Number(word)) ? moved(word.trim(), -unit(key)[2]) : word);

// --- from the schema to the form ---

const resolved = (node) => (node.$ref ? schema.$defs[node.$ref.split("/").at(-1)] : node.allOf ? resolved(node.allOf[0]) : node);
const inner = (node) => (node.anyOf ? resolved(node.anyOf.find((each) => each.type !== "null")) : resolved(node));
const optional = (node) => Boolean(node.anyOf?.some((each) => each.type === "null"));
const about = (path) => make("span", { id: `about-${path}`, className: "about" });

function control(node, key, value, path, changed) {
  const common = { id: `field-${path}`, "data-path": path, "aria-describedby": `about-${/^sites\.\d+/.exec(path)?.[0] ?? path}` };
  if (node.enum || node.const) {
    const select = make("select", { ...common, on: { change: () => changed(select.value) } }, ...(node.enum ?? [node.const]).map((each) => make("option", { value: each, text: each })));
    select.value = value;
    return select;
  }
  const numeric = node.type === "number" || node.type === "integer";
  let before = [].concat(value ?? []).map((each) => [shown(key, each), each]);
  const input = make("input", { ...common, type: "text", inputMode: numeric || node.items ? "decimal" : "text", value: before.map(([word]) => word).join(", "), on: { input: () => {
    if (!node.items) { changed(numeric ? entered(key, input.value) : input.value); return; }
    const words = input.value.split(/(?:,(?!\d)|[;\s])+/).filter(Boolean); // 4,5 is no list of two: it stays a word, which the check refuses
    before = words.map((word) => before.find(([same]) => same === word) ?? [word, entered(key, word)]); // the others keep their exact numbers
    changed(before.map(([, each]) => each));
  } } });
  return Object.assign(input, { bounds: node.items ?? node });
}

function field(node, key, values, path) {
  const kind = inner(node);
  return make("div", { className: "field" }, make("label", { htmlFor: `field-${path}`, text: labelled(key), title: node.description ?? kind.description ?? "" }),
    control(kind, key, values[key], path, (value) => { values[key] = value; fromForm(); }), about(path));
}

function block(node, key, values) {
  const kind = inner(node), fields = make("div", { className: "fields" });
  const what = node.description ?? kind.description ?? "";
  const fill = () => fields.replaceChildren(...(values[key] ? Object.keys(kind.properties).map((each) => field(kind.properties[each], each, values[key], `${key}.${each}`)) : [make("p", { className: "faint", text: what })]));
  fill();
  const legend = make("legend", { text: named(key), title: what });
  if (optional(node)) {
    const box = make("input", { type: "checkbox", checked: Boolean(values[key]), ariaLabel: `give ${named(key)}`, on: { change: () => {
      values[key] = box.checked ? Object.fromEntries(Object.entries(kind.properties).map(([each, of]) => [each, of.default ?? (of.type === "string" ? "" : Math.max(0, of.minimum ?? 0))])) : null;
      fill();
      fromForm();
    } } });
    legend.prepend(box);
  }
  return make("fieldset", {}, legend, fields, about(key));
}

/** A free place for another site: one step on from the last two, else 20 mm beside the last one. */
function freePlace(sites, most_m) {
  const apart_m = answer.apart_m ?? BESIDE_M / 2;
  const places = sites.map((site) => [Number(site.x_m) || 0, Number(site.y_m) || 0]), last = places.at(-1) ?? [0, 0], before = places.at(-2) ?? last;
  const free = (place) => place.every((value) => Math.abs(value) <= most_m) && places.every(([x, y]) => Math.hypot(place[0] - x, place[1] - y) >= apart_m - 1e-9);
  const on = [last[0] - before[0], last[1] - before[1]], beside = [[BESIDE_M, 0], [0, BESIDE_M], [-BESIDE_M, 0], [0, -BESIDE_M]];
  for (const [x, y] of Math.hypot(...on) < apart_m ? beside : [on, ...beside])
    for (let k = 1; k <= sites.length + 1; k++) {
      const place = [last[0] + k * x, last[1] + k * y].map((value) => Number(value.toFixed(6)));
      if (free(place)) return place;
    }
  return last; // the field is full; the check questions this one
}

function rows(node, key, values) {
  const kind = resolved(node.items), keys = Object.keys(kind.properties), body = make("tbody");
  const fill = () => body.replaceChildren(...values[key].flatMap((entry, place) => [make("tr", {},
    ...keys.map((each) => { const input = control(resolved(kind.properties[each]), each, entry[each], `${key}.${place}.${each}`, (value) => { entry[each] = value; fromForm(); }); input.setAttribute("aria-label", `${labelled(each)} of row ${place + 1}`); return make("td", {}, input); }),
    make("td", {}, make("button", { type: "button", text: "Remove", disabled: values[key].length === 1, on: { click: () => { values[key].splice(place, 1); fill(); fromForm(); } } }))),
  make("tr", {}, make("td", { colSpan: keys.length + 1 }, about(`${key}.${place}`)))]));
  fill();
  const add = make("button", { type: "button", text: "Add a site", on: { click: () => {
    const used = new Set(values[key].map((entry) => entry.name)), [x_m, y_m] = freePlace(values[key], kind.properties.x_m.maximum);
    values[key].push({ name: [..."ABCDEFGHIJKLMNOPQRSTUVWXYZ"].find((letter) => !used.has(letter)) ?? `S${values[key].length + 1}`, x_m, y_m });
    fill();
    fromForm();
  } } });
  return make("fieldset", { className: "rows" }, make("legend", { text: named(key), title: node.description ?? "" }),
    make("table", {}, make("thead", {}, make("tr", {}, ...keys.map((each) => make("th", { text: labelled(each) })), make("th", {}, make("span", { className: "hidden", text: "remove" })))), body), add, about(key), make("div", { id: "places" }));
}

function showForm() {
  const values = structuredClone(plan), parts = [], single = make("div", { className: "fields" });
  form.values = values;
  for (const [key, node] of Object.entries(schema.properties)) {
    if (key === "version") continue;
    const kind = inner(node);
    if (kind.type === "array" && resolved(kind.items ?? {}).properties) parts.push(rows(kind, key, values));
    else if (kind.properties) parts.push(block(node, key, values));
    else single.append(field(node, key, values, key));
  }
  form.replaceChildren(parts.shift(), single, ...parts);
  showPlaces();
}

/** The sites from above, in the order in which the arm goes there. */
function showPlaces() {
  const sites = form.values.sites.filter((site) => Number.isFinite(site.x_m) && Number.isFinite(site.y_m));
  chart(byId("places"), { label: `the sites from above: ${sites.map((site) => `${site.name} at x ${mm(site.x_m)}, y ${mm(site.y_m)} mm`).join("; ")}`, height: 200, equal: true, xLabel: "x (mm)", yLabel: "y (mm)",
    series: [{ x: sites.map((site) => mm(site.x_m)), y: sites.map((site) => mm(site.y_m)), points: true, labels: sites.map((site) => site.name) }] });
}

function fromForm() {
  text.value = yamlOf(form.values);
  typed = false;
  showPlaces();
  later();
}

// --- what stands beside a field ---

/** Put a sentence beside the field of a key, or of the block that it stands in. Returns the field that it belongs to; null where there is none. */
function note(path, sentence, kind) {
  for (const parts = path.split("."); parts.length; parts.pop()) {
    const holder = byId(`about-${parts.join(".")}`);
    if (!holder) continue;
    if (sentence) holder.append(make("span", { className: kind, text: sentence }));
    return holder;
  }
  return null;
}

/** The range of a field in its unit, the key of config.yaml that narrows it, and whether a value is outside. */
function range(input) {
  const of = input.bounds ?? {}, [least = -Infinity, most = Infinity, key] = answer.limits?.[input.dataset.path] ?? [], [, name, places] = unit(input.dataset.path);
  const low = Math.max(of.minimum ?? of.exclusiveMinimum ?? -Infinity, least), high = Math.min(of.maximum ?? Infinity, most);
  const digits = (value) => Number(moved(value, places).toPrecision(9)), open = low === of.exclusiveMinimum;
  const words = Number.isFinite(high) ? `${open ? `above ${digits(low)}, at most` : `${digits(low)} to`} ${digits(high)} ${name}` : Number.isFinite(low) ? `at least ${digits(low)} ${name}` : "";
  const source = high < (of.maximum ?? Infinity) || low > (of.minimum ?? -Infinity) ? key : null;
  return { words: words.trim() + (source ? ` (${source})` : ""), digits, name, outside: (value) => typeof value === "number" && (value < low || value > high || (open && value === low)) };
}

function annotate() {
  for (const each of form.querySelectorAll(".about")) each.replaceChildren();
  for (const input of form.querySelectorAll("[data-path]")) {
    input.removeAttribute("aria-invalid");
    if (!input.closest("table")) note(input.dataset.path, range(input).words, "hint");
  }
  const sound = judged !== null && judged === text.value;
  if (sound) for (const path of ["press_speed_m_per_s", "search.speed_m_per_s"]) {
    const speed = path.split(".").reduce((block, key) => block[key], answer.plan), { overshoot_N: past, stiffness_N_per_m: stiffness } = answer.overshoot.find((row) => row.speed_m_per_s === speed && row.stiffness_N_per_m === answer.expected_stiffness_N_per_m);
    note(path, `a force runs ${past.toFixed(1)} N past its limit on ${stiffness} N/m`, answer.contact_limit_N + past > answer.absolute_limit_N ? "question" : "hint");
  }
  for (const path of ["sites.0.x_m", "sites.0.y_m"]) if (answer.limits?.[path] && byId(`field-${path}`)) note("sites", `${path[8]}: ${range(byId(`field-${path}`)).words}`, "hint");
  if (sound) for (const [path, sentence] of Object.entries(answer.questions)) note(path, sentence, "question");
  if (sound && outcome?.yaml === judged) showCutShort();
  return Object.entries(faults).filter(([path, sentence]) => !fault(path, sentence)).map(([, sentence]) => sentence);
}

/** Mark a field that is wrong; in its unit where the number is out of range, else in the words of the check. */
function fault(path, sentence) {
  const input = byId(`field-${path}`) ?? byId(`field-${path.replace(/\.\d+$/, "")}`);
  if (!input) return note(path, sentence, "fault");
  const of = range(input), value = [].concat(path.split(".").reduce((block, key) => block?.[key], form.values) ?? [])[0];
  input.setAttribute("aria-invalid", "true");
  byId(`about-${input.dataset.path}`)?.replaceChildren();
  return note(path, of.outside(value) ? `${of.digits(value)} ${of.name}: expected ${of.words}` : sentence, "fault");
}

const ends = (presses) => {
  const [low, high] = [Math.min, Math.max].map((most) => mm(most(...presses.map((press) => press.achieved_m))).toFixed(1));
  return low === high ? `${low} mm` : `${low} to ${high} mm`;
};
const grouped = (presses, key) => Map.groupBy(presses, (press) => press[key]);

function showCutShort() {
  const force = `${answer.soft_end_N.toFixed(1)} N`;
  for (const [depth_m, presses] of grouped(outcome.cut, "commanded_m"))
    note("depths_m", `${mm(depth_m)} mm: cut short at ${ends(presses)}, ${force} (${[...new Set(presses.map((press) => press.site))].join(", ")})`, "cut");
  for (const [name, presses] of grouped(outcome.cut, "site"))
    note(`sites.${form.values.sites.findIndex((site) => site.name === name)}`, [...grouped(presses, "commanded_m")].map(([depth_m, each]) => `${mm(depth_m)} mm: cut short at ${ends(each)}, ${force}`).join("; "), "cut");
}

// --- the judgement ---

function later() {
  choosePlan(name, text.value);
  judged = null;
  byId("start").disabled = byId("rehearse").disabled = true;
  byId("start").textContent = "Start this plan";
  clearTimeout(timer);
  rehearsing?.abort();
  timer = setTimeout(check, 400);
  kept.edited();
}

async function check() {
  const mine = ++number, yaml = text.value;
  standing.replaceChildren(make("p", { className: "faint", text: "checking …" }));
  const verdict = await ask("/plan/check", { yaml }, { patience_ms: 70000 });
  if (mine !== number || yaml !== text.value) return;
  faults = verdict.faults ?? {};
  const first = !schema;
  schema ??= verdict.plan_schema;
  if (verdict.ok) [answer, judged] = [verdict, yaml];
  const shown = !typed && !first; // whether the form has what the check has judged
  if (!shown && verdict.plan && schema) { plan = verdict.plan; showForm(); }
  if (!shown && !verdict.plan) faults = {};
  const others = annotate();
  if (!verdict.ok) { showRefusal(verdict, others); return; }
  byId("start").disabled = byId("rehearse").disabled = false;
  showForecast();
  kept.configured(answer.config_sha256);
  if (outcome?.yaml === yaml) return;
  byId("rehearsal").dataset.old = "";
  // time and largest force come by themselves, except beside a run, which the calculation would share the computer with
  if (!["checking", "running", "paused", "waiting"].includes(document.body.dataset.state)) timer = setTimeout(rehearse, BY_ITSELF_MS);
}

/** What belongs to no field stands above the form, with its line; the number of the others too. */
function showRefusal(verdict, others) {
  const count = Object.keys(faults).length - others.length;
  if (!count) refuse(standing, verdict.error + (typed && !verdict.plan && schema ? " The form below shows the plan as it was before." : ""));
  else refuse(standing, [...others, `${count === 1 ? "One value is" : `${count} values are`} not possible; what is wrong stands beside the field.`].join(" "));
  const line = /line (\d+)/.exec(standing.textContent);
  if (line) standing.firstChild.append(" ", make("button", { type: "button", text: `go to line ${line[1]}`, on: { click: () => {
    const before = text.value.split("\n").slice(0, Number(line[1]) - 1).join("\n").length;
    text.focus();
    text.setSelectionRange(before + (before ? 1 : 0), before + 1 + (text.value.split("\n")[Number(line[1]) - 1] ?? "").length);
  } } }));
}

/** The headline, the button of the start and the figures, by the check and by the rehearsal of this plan, where there is one. */
function showForecast() {
  const of = outcome?.yaml === judged ? outcome : null, cut = of?.cut.length ?? 0, stopped = Boolean(of) && of.verdict !== "done";
  const where = "on the simulated cell of config.yaml, which is not the tissue under the probe";
  const words = stopped ? `The rehearsal was stopped ${where}: ${of.reason}` : cut ? `${cut} of ${of.presses} presses would be cut short at ${answer.soft_end_N.toFixed(1)} N ${where}.`
    : `The plan is sound: its speeds and places are within the limits of the cell.${of ? ` No press is cut short ${where}.` : ""}`;
  standing.replaceChildren(make("p", { className: cut || stopped ? "warned" : "sound", text: words }));
  byId("start").classList.toggle("main", !cut && !stopped);
  byId("start").textContent = stopped ? "Start, though the rehearsal was stopped" : cut ? `Start, though ${cut} ${cut === 1 ? "press" : "presses"} would be cut short` : "Start this plan";
  byId("tiles").replaceChildren(
    tile("Duration", of ? duration(of.duration_s) : "–", of ? "rehearsed on the simulated cell" : "a rehearsal on the simulated cell tells it"),
    tile("Expected largest force", of ? `${of.peak_force_N.toFixed(1)} N` : "–", `contact limit ${answer.contact_limit_N} N`, of && of.peak_force_N >= answer.soft_end_N ? "warn" : ""),
    tile("Presses cut short", of ? `${cut} of ${of.presses}` : "–", `at ${answer.soft_end_N.toFixed(1)} N, before the contact limit`, cut ? "warn" : ""));
}

// --- the rehearsal and the start ---

async function rehearse() {
  clearTimeout(timer);
  const yaml = judged, stop = new AbortController();
  if (yaml === null) return;
  rehearsing?.abort();
  rehearsing = stop;
  byId("rehearse").disabled = true;
  const end = await work("/plan/rehearse", { yaml }, byId("rehearsing"), stop.signal);
  if (rehearsing !== stop || judged !== yaml) return;
  byId("rehearse").disabled = false;
  const course = ["done", "stopped"].includes(end.state) ? await resultOf(end) : { ok: false, error: end.sentence };
  if (judged !== yaml) return;
  if (!course.ok) { refuse(byId("outcome"), course.error); return; }
  const presses = course.result.sites.flatMap((site) => [...site.depths, ...site.presses].map((press) => ({ site: site.name, ...press })));
  outcome = { yaml, ...course.result, presses: presses.length, cut: presses.filter((press) => press.cut_short) };
  delete byId("rehearsal").dataset.old;
  showForecast();
  showRehearsal();
  annotate();
  kept.rehearsed(yaml, figures());
}

byId("rehearse").addEventListener("click", rehearse);

/** What the service keeps of a rehearsal. */
const figures = () => ({ verdict: outcome.verdict, duration_s: outcome.duration_s, peak_force_N: outcome.peak_force_N, presses: outcome.presses, cut_short: outcome.cut.length, config_sha256: outcome.config_sha256 });

function showRehearsal() {
  const columns = outcome.course, spans = spansOf(columns, outcome.sites.map((site) => site.name));
  chart(byId("force"), { label: `contact force of the rehearsal, at most ${outcome.peak_force_N.toFixed(1)} N`, yLabel: "force (N)", height: 210, spans, limits: [{ y: answer.contact_limit_N, label: "contact limit" }],
    series: [{ x: columns.t_s, low: columns.force_low_N, high: columns.force_high_N, y: columns.force_high_N }] });
  chart(byId("depth"), { label: "depth of the rehearsal below the simulated surface", yLabel: "depth (mm)", xLabel: "time (s)", height: 190,
    series: [{ x: columns.t_s, low: scaled(columns.depth_low_m, 1e3), high: scaled(columns.depth_high_m, 1e3), y: scaled(columns.depth_high_m, 1e3), colour: 1 }] });
  byId("outcome").replaceChildren(make("h3", { text: "The simulated cell gives" }),
    make("table", {}, make("thead", {}, make("tr", {}, ...["site", "largest force", "static (kPa)", "cut short"].map((each) => make("th", { text: each })))),
      make("tbody", {}, ...outcome.sites.map((site) => make("tr", {}, make("td", { text: site.name }), make("td", { text: site.peak_force_N === null ? "–" : `${site.peak_force_N.toFixed(2)} N` }),
        make("td", { text: kilopascals(site.static_youngs_modulus_Pa) }), make("td", { text: site.cut_short_depths_m.map((depth) => `${depth * 1e3} mm`).join(", ") || "none" }))))),
    make("details", {}, make("summary", { text: `${outcome.notes.length} ${outcome.notes.length === 1 ? "note" : "notes"}` }), ...outcome.notes.map((each) => make("p", { className: "faint", text: each }))));
}

byId("start").addEventListener("click", async () => {
  if (judged === null || judged !== text.value) return;
  byId("start").disabled = true;
  const answer = await request("start", { text: judged, file: name });
  byId("start").disabled = judged === null;
  if (answer.ok) location.href = "/";
});

text.addEventListener("input", () => { typed = true; later(); });
byId("save").addEventListener("click", () => {
  const link = make("a", { href: URL.createObjectURL(new Blob([text.value], { type: "text/yaml" })), download: "plan.yaml" });
  link.click();
  URL.revokeObjectURL(link.href);
});
byId("file").addEventListener("change", async (event) => {
  const file = event.target.files[0];
  if (!file) return;
  if (file.size > 262144) { refuse(standing, `${file.name} has ${file.size} bytes, expected at most 262144; is it the right file?`); return; }
  open(file.name, await file.text());
  event.target.value = "";
});
form.addEventListener("submit", (event) => event.preventDefault());

/** Take another plan into the editor. */
function open(title, yaml) {
  [name, text.value, typed] = [title, yaml, true];
  later();
  clearTimeout(timer);
  check();
}

const kept = keptPlans(() => ({ yaml: text.value, rehearsal: outcome?.yaml === text.value ? figures() : null }), open);
// The plan that is chosen for the start, else the one that the page was started with. What stands here is what Start starts.
const offered = chosenPlan()?.follows === false ? chosenPlan() : await read("/first-plan");
[name, text.value] = offered.text ? [offered.name, offered.text] : ["plan.yaml", FIRST];
if (offered.error) refuse(standing, offered.error);
else check();
