// The list of the runs, with a filter, and the choice of two to compare.

import { begin } from "./controls.js";
import { read } from "./requests.js";
import { byId, kilopascals, make, refuse } from "./work.js";

const filter = byId("filter"), list = byId("runs"), compare = byId("compare");
const chosen = new Map();
let asked = 0, most = 100, timer = 0;

const when = (started) => started.slice(0, 16).replace("T", " ");

function choices(select, values, all) {
  const now = select.value;
  select.replaceChildren(make("option", { value: "", text: all }), ...values.map((value) => make("option", { value, text: value })));
  select.value = values.includes(now) ? now : "";
}

function row(run) {
  const box = make("input", { type: "checkbox", checked: chosen.has(run.key), ariaLabel: `choose ${run.name} to compare` });
  box.addEventListener("change", () => {
    if (box.checked) chosen.set(run.key, run.name);
    else chosen.delete(run.key);
    showChosen();
  });
  const moduli = run.sites.filter((site) => site.static_Pa !== null).map((site) => `${site.site} ${kilopascals(site.static_Pa)}${site.hertz_misfit ? " (Hertz does not fit)" : ""}`).join(", ");
  const kind = [run.kind === "palpation" ? "" : run.kind.replace("_", " "), run.dry ? "dry" : ""].filter(Boolean).join(", ");
  const link = make("a", { href: `/runs/view?run=${encodeURIComponent(run.key)}`, text: run.name });
  return make("tr", {},
    make("td", {}, box),
    make("td", { className: "name" }, link),
    make("td", { className: "when", text: when(run.started) }),
    make("td", {}, make("span", { className: `chip ${run.verdict}`, text: run.verdict }), make("span", { className: "faint", text: kind ? ` ${kind}` : "" })),
    make("td", { className: "number", text: run.peak_force_N === null ? "–" : `${run.peak_force_N.toFixed(2)} N` }),
    make("td", { text: moduli || "–" }),
    make("td", {}, ...run.tags.map((tag) => make("span", { className: "tag", text: tag }))),
    make("td", { className: "words", text: [run.reason, run.note].filter(Boolean).join("; ") }));
}

/** A recording that was cut off: the service writes what is whole of it into a new file. */
function unfinished(name) {
  const recover = make("button", { type: "button", text: "Recover", ariaLabel: `recover ${name}`, on: { click: () => begin("recover", { name }) } });
  return make("tr", {}, make("td"), make("td", { className: "name", text: name }), make("td"),
    make("td", {}, make("span", { className: "chip unfinished", text: "unfinished" })), make("td", { className: "number", text: "–" }), make("td", { text: "–" }), make("td"),
    make("td", { className: "words" }, "it was cut off, and its file was never closed ", recover));
}
document.addEventListener("palpd-job", show);

function showChosen() {
  const names = [...chosen.values()];
  compare.disabled = names.length !== 2;
  byId("chosen").textContent = names.length === 2 ? `${names[0]} and ${names[1]}` : `choose two runs (${names.length} chosen)`;
}

async function show() {
  const number = ++asked;
  const query = new URLSearchParams([...new FormData(filter)].filter(([, value]) => value));
  history.replaceState(null, "", `/runs${query.size ? `?${query}` : ""}`);
  query.set("most", most);
  byId("count").textContent = "looking for runs …";
  const answer = await read(`/runs/list?${query}`, { patience_ms: 130000 });
  if (number !== asked) return;
  refuse(byId("refusal"), answer.ok ? "" : answer.error);
  if (!answer.ok) { byId("count").textContent = ""; list.replaceChildren(); return; }
  choices(filter.elements.tag, answer.tags, "any tag");
  choices(filter.elements.site, answer.sites, "any site");
  choices(filter.elements.verdict, answer.verdicts, "any end");
  list.replaceChildren(...answer.unfinished.map(unfinished), ...answer.runs.map(row));
  const some = answer.runs.length < answer.count ? `the newest ${answer.runs.length} of ` : "";
  byId("count").textContent = answer.count ? `${some}${answer.count} ${answer.count === 1 ? "run" : "runs"} in ${answer.folder}` : `No run in ${answer.folder} is like that.`;
  byId("more").hidden = answer.runs.length >= answer.count;
  byId("notes").replaceChildren(...answer.notes.map((note) => make("li", { text: note })));
}

for (const [name, value] of new URLSearchParams(location.search)) {
  const field = filter.elements[name];
  if (field instanceof HTMLSelectElement) field.append(make("option", { value, text: value }));
  if (field) field.value = value;
}
filter.addEventListener("input", () => { clearTimeout(timer); timer = setTimeout(show, 250); });
filter.addEventListener("submit", (event) => { event.preventDefault(); show(); });
filter.addEventListener("reset", () => setTimeout(show));
byId("more").addEventListener("click", () => { most *= 5; show(); });
compare.addEventListener("click", () => {
  const [one, other] = [...chosen.keys()];
  location.href = `/runs/view?run=${encodeURIComponent(one)}&beside=${encodeURIComponent(other)}`;
});
showChosen();
show();
