// The plan as a form and as text, judged by the same command as in the terminal, previewed and rehearsed.

import { chart, scaled, spansOf } from "./chart.js";
import { choosePlan, chosenPlan, request } from "./controls.js";
import { ask, read } from "./requests.js";
import { byId, duration, make, refuse, resultOf, work } from "./work.js";

const form = byId("form"), text = byId("yaml"), standing = byId("standing");
const FIRST = "sites:\n  - {name: A, x_m: 0.0, y_m: 0.0}\ndepths_m: [0.004]\n";
const BY_ITSELF_MS = 1500;
let plan = null, judged = null, schema = null, number = 0, timer = 0, rehearsed = "", rehearsing = null, name = "plan.yaml";

// --- from the form to text ---

const plain = (value) => (typeof value === "string" ? (/^[A-Za-z_][\w.-]*$/.test(value) && !/^(null|true|false|yes|no|on|off)$/i.test(value) ? value : JSON.stringify(value)) : String(value));
const inline = (value) => `{${Object.entries(value).map(([key, each]) => `${key}: ${plain(each)}`).join(", ")}}`;

export function yamlOf(values) {
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

// --- from the schema to the form ---

const resolved = (node) => (node.$ref ? schema.$defs[node.$ref.split("/").at(-1)] : node.allOf ? resolved(node.allOf[0]) : node);
const inner = (node) => (node.anyOf ? resolved(node.anyOf.find((each) => each.type !== "null")) : resolved(node));
const optional = (node) => Boolean(node.anyOf?.some((each) => each.type === "null"));
const UNITS = [["_m_per_s", "m/s"], ["_s", "s"], ["_m", "m"]];
const named = (key) => { const unit = UNITS.find(([end]) => key.endsWith(end)); return (unit ? key.slice(0, -unit[0].length) : key).replaceAll("_", " "); };
const unitOf = (key) => UNITS.find(([end]) => key.endsWith(end))?.[1] ?? "";
const millimetres = (key, value) => (unitOf(key) === "m" && value !== "" && Number.isFinite(Number(value)) ? `${Number((Number(value) * 1e3).toPrecision(6))} mm` : "");

function control(node, key, value, path, changed) {
  const id = `field-${path}`;
  if (node.enum || node.const) {
    const select = make("select", { id, "data-path": path, on: { change: () => changed(select.value) } }, ...(node.enum ?? [node.const]).map((each) => make("option", { value: each, text: each })));
    select.value = value;
    return select;
  }
  if (node.type === "array") {
    const field = make("input", { id, "data-path": path, inputMode: "decimal", value: (value ?? []).join(", "), on: { input: () => {
      changed(field.value.split(/[,;\s]+/).filter(Boolean).map((each) => (Number.isFinite(Number(each)) ? Number(each) : each)));
    } } });
    return field;
  }
  const numeric = node.type === "number" || node.type === "integer";
  const field = make("input", { id, "data-path": path, type: "text", inputMode: numeric ? "decimal" : "text", value: value ?? "", on: { input: () => {
    changed(numeric && field.value.trim() !== "" && Number.isFinite(Number(field.value)) ? Number(field.value) : field.value);
  } } });
  return field;
}

function limits(node) {
  const [low, high] = [node.minimum ?? node.exclusiveMinimum, node.maximum ?? node.exclusiveMaximum];
  if (low !== undefined && high !== undefined) return `${low} to ${high}`;
  return low !== undefined ? `above ${low}` : high !== undefined ? `up to ${high}` : "";
}

function field(node, key, values, path) {
  const kind = inner(node), hint = make("span", { className: "converted", text: [].concat(values[key] ?? []).map((each) => millimetres(key, each)).filter(Boolean).join(", ") });
  const input = control(kind, key, values[key], path, (value) => {
    values[key] = value;
    hint.textContent = [].concat(value).map((each) => millimetres(key, each)).filter(Boolean).join(", ");
    fromForm();
  });
  const help = [node.description ?? kind.description, limits(kind)].filter(Boolean).join(" ");
  return make("div", { className: "field" }, make("label", { htmlFor: `field-${path}`, text: named(key) + (unitOf(key) ? ` (${unitOf(key)})` : ""), title: help }), input, hint);
}

function block(node, key, values) {
  const kind = inner(node), fields = make("div", { className: "fields" });
  const about = node.description ?? kind.description ?? "";
  const fill = () => fields.replaceChildren(...(values[key] ? Object.keys(kind.properties).map((each) => field(kind.properties[each], each, values[key], `${key}.${each}`)) : [make("p", { className: "faint", text: about })]));
  fill();
  const legend = make("legend", { text: named(key), title: about });
  if (optional(node)) {
    const box = make("input", { type: "checkbox", checked: Boolean(values[key]), ariaLabel: `give ${named(key)}`, on: { change: () => {
      values[key] = box.checked ? Object.fromEntries(Object.entries(kind.properties).map(([each, of]) => [each, of.default ?? (of.type === "string" ? "" : Math.max(0, of.minimum ?? 0))])) : null;
      fill();
      fromForm();
    } } });
    legend.prepend(box);
  }
  return make("fieldset", {}, legend, fields);
}

function rows(node, key, values) {
  const kind = resolved(node.items), keys = Object.keys(kind.properties), body = make("tbody");
  const fill = () => body.replaceChildren(...values[key].map((entry, place) => make("tr", {},
    ...keys.map((each) => { const input = control(resolved(kind.properties[each]), each, entry[each], `${key}.${place}.${each}`, (value) => { entry[each] = value; fromForm(); }); input.setAttribute("aria-label", `${named(each)} of row ${place + 1}`); return make("td", {}, input); }),
    make("td", {}, make("button", { type: "button", text: "Remove", disabled: values[key].length === 1, on: { click: () => { values[key].splice(place, 1); fill(); fromForm(); } } })))));
  fill();
  const add = make("button", { type: "button", text: "Add a site", on: { click: () => {
    const used = new Set(values[key].map((entry) => entry.name));
    const name = [..."ABCDEFGHIJKLMNOPQRSTUVWXYZ"].find((letter) => !used.has(letter)) ?? `S${values[key].length + 1}`;
    values[key].push({ ...Object.fromEntries(keys.map((each) => [each, kind.properties[each].default ?? ""])), name });
    fill();
    fromForm();
  } } });
  return make("fieldset", { className: "rows" }, make("legend", { text: named(key), title: node.description ?? "" }),
    make("table", {}, make("thead", {}, make("tr", {}, ...keys.map((each) => make("th", { text: named(each) + (unitOf(each) ? ` (${unitOf(each)})` : "") })), make("th", {}, make("span", { className: "hidden", text: "remove" })))), body), add);
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
}

function fromForm() {
  text.value = yamlOf(form.values);
  later();
}

// --- the judgement ---

function later() {
  choosePlan(name, text.value);
  judged = null;
  byId("start").disabled = byId("rehearse").disabled = true;
  clearTimeout(timer);
  rehearsing?.abort();
  timer = setTimeout(check, 400);
}

async function check({ fill = document.activeElement === text || !schema } = {}) {
  const mine = ++number, yaml = text.value;
  standing.replaceChildren(make("p", { className: "faint", text: "checking …" }));
  const answer = await ask("/plan/check", { yaml }, { patience_ms: 70000 });
  if (mine !== number) return;
  for (const wrong of form.querySelectorAll("[aria-invalid]")) wrong.removeAttribute("aria-invalid");
  if (!answer.ok) { showRefusal(answer.error); return; }
  [plan, judged] = [answer.plan, yaml];
  const first = !schema;
  schema = answer.plan_schema;
  if (fill || first) showForm();
  standing.replaceChildren(make("p", { className: "sound", text: "The plan is sound, and its speeds and places are within the limits of the cell." }));
  byId("start").disabled = byId("rehearse").disabled = false;
  showForecast(answer);
  if (rehearsed === yaml) return;
  byId("rehearsal").dataset.old = "";
  // time and largest force come by themselves, except beside a run, which the calculation would share the computer with
  if (!["checking", "running", "paused", "waiting"].includes(document.body.dataset.state)) timer = setTimeout(rehearse, BY_ITSELF_MS);
}

function showRefusal(sentence) {
  refuse(standing, sentence);
  const line = /line (\d+)/.exec(sentence);
  if (line) standing.firstChild.append(" ", make("button", { type: "button", text: `go to line ${line[1]}`, on: { click: () => {
    const before = text.value.split("\n").slice(0, Number(line[1]) - 1).join("\n").length;
    text.focus();
    text.setSelectionRange(before + (before ? 1 : 0), before + 1 + (text.value.split("\n")[Number(line[1]) - 1] ?? "").length);
  } } }));
  const key = /: ([\w.]+) (?:is|:)/.exec(sentence)?.[1];
  const wrong = key && form.querySelector(`[data-path="${CSS.escape(key)}"]`);
  if (wrong) wrong.setAttribute("aria-invalid", "true");
}

function tile(name, value, more, mood = "") {
  return make("div", { className: `tile ${mood}` }, make("span", { text: name }), make("b", { text: value }), make("span", { text: more }));
}

let forecast = null;
function showForecast(answer = forecast, outcome = null) {
  forecast = answer;
  const { contact_limit_N: limit, absolute_limit_N: absolute, overshoot } = answer;
  const fastest = Math.max(...overshoot.map((row) => row.speed_m_per_s));
  const expected = overshoot.filter((row) => row.speed_m_per_s === fastest).find((row) => row.stiffness_N_per_m === answer.expected_stiffness_N_per_m) ?? overshoot.at(-1);
  const worst = expected.overshoot_N;
  byId("tiles").replaceChildren(
    outcome ? tile("Duration", duration(outcome.duration_s), "rehearsed on the simulated cell") : tile("Duration", "–", "a rehearsal on the simulated cell tells it"),
    outcome ? tile("Expected largest force", `${outcome.peak_force_N.toFixed(1)} N`, `contact limit ${limit} N`, outcome.peak_force_N > 0.9 * limit ? "warn" : "") : tile("Expected largest force", "–", `contact limit ${limit} N`),
    tile("Overshoot past the limit", `${worst.toFixed(1)} N`, `against ${expected.stiffness_N_per_m} N/m at ${fastest * 1e3} mm/s; the absolute limit is ${absolute} N`, limit + worst > absolute ? "warn" : ""));
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
  const answer = ["done", "stopped"].includes(end.state) ? await resultOf(end) : { ok: false, error: end.sentence };
  if (judged !== yaml) return;
  if (!answer.ok) { refuse(byId("outcome"), answer.error); return; }
  rehearsed = yaml;
  delete byId("rehearsal").dataset.old;
  showForecast(forecast, answer.result);
  showRehearsal(answer.result);
}

byId("rehearse").addEventListener("click", rehearse);

function showRehearsal(outcome) {
  const columns = outcome.course, spans = spansOf(columns, outcome.sites.map((site) => site.name));
  chart(byId("force"), { label: `contact force of the rehearsal, at most ${outcome.peak_force_N.toFixed(1)} N`, yLabel: "force (N)", height: 210, spans, limits: [{ y: forecast.contact_limit_N, label: "contact limit" }],
    series: [{ x: columns.t_s, low: columns.force_low_N, high: columns.force_high_N, y: columns.force_high_N }] });
  chart(byId("depth"), { label: "depth of the rehearsal below the simulated surface", yLabel: "depth (mm)", xLabel: "time (s)", height: 190,
    series: [{ x: columns.t_s, low: scaled(columns.depth_low_m, 1e3), high: scaled(columns.depth_high_m, 1e3), y: scaled(columns.depth_high_m, 1e3), colour: 1 }] });
  byId("outcome").replaceChildren(outcome.verdict === "done" ? "" : make("p", { className: "refusal", text: `The rehearsal was stopped: ${outcome.reason}` }), make("h3", { text: "The simulated cell gives" }),
    make("table", {}, make("thead", {}, make("tr", {}, ...["site", "largest force", "static (kPa)", "cut short"].map((each) => make("th", { text: each })))),
      make("tbody", {}, ...outcome.sites.map((site) => make("tr", {}, make("td", { text: site.name }), make("td", { text: site.peak_force_N === null ? "–" : `${site.peak_force_N.toFixed(2)} N` }),
        make("td", { text: site.static_youngs_modulus_Pa === null ? "–" : (site.static_youngs_modulus_Pa / 1e3).toFixed(1) }), make("td", { text: site.cut_short_depths_m.map((depth) => `${depth * 1e3} mm`).join(", ") || "none" }))))),
    ...outcome.notes.map((note) => make("p", { className: "faint", text: note })));
}

byId("start").addEventListener("click", async () => {
  if (judged === null || judged !== text.value) return;
  byId("start").disabled = true;
  const answer = await request("start", { text: judged, file: name });
  byId("start").disabled = judged === null;
  if (answer.ok) location.href = "/";
});

text.addEventListener("input", later);
byId("save").addEventListener("click", () => {
  const link = make("a", { href: URL.createObjectURL(new Blob([text.value], { type: "text/yaml" })), download: "plan.yaml" });
  link.click();
  URL.revokeObjectURL(link.href);
});
byId("file").addEventListener("change", async (event) => {
  const file = event.target.files[0];
  if (!file) return;
  if (file.size > 262144) { refuse(standing, `${file.name} has ${file.size} bytes, expected at most 262144; is it the right file?`); return; }
  [name, text.value] = [file.name, await file.text()];
  later();
  clearTimeout(timer);
  check({ fill: true });
});
form.addEventListener("submit", (event) => event.preventDefault());

// The plan that is chosen for the start, else the one that the page was started with. What stands here is what Start starts.
const offered = chosenPlan() ?? (await read("/first-plan"));
[name, text.value] = offered.text ? [offered.name, offered.text] : ["plan.yaml", FIRST];
if (offered.error) refuse(standing, offered.error);
else check({ fill: true });
