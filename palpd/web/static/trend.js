// Moduli of a site and parameters of named effects over the days.

import { chart, instead, scaled } from "./chart.js";
import { read } from "./requests.js";
import { byId, make, refuse } from "./work.js";

const filter = byId("filter");
const DAY_S = 86400;
let asked = 0;

const slopeText = (slope, unit, factor) => {
  const half = ((slope.ci95_per_day[1] - slope.ci95_per_day[0]) / 2) * factor;
  return `${(slope.per_day * factor).toPrecision(3)} ± ${half.toPrecision(2)} ${unit} per day (95 %, ${slope.points} runs)`.trim();
};
const days = (points) => points.map((point) => point.started_s / DAY_S);
const zone_ms = (started) => Date.parse(`${started.slice(0, 19)}Z`) - Date.parse(started);
const date = (shift_ms) => (day) => new Date(day * DAY_S * 1000 + shift_ms).toISOString().slice(5, 10);
const interval = (values, place) => values.map((value) => (value ? value[place] / 1e3 : null));

function plot(holder, spec, points) {
  const x = days(points), low = Math.min(...x), high = Math.max(...x), room = Math.max(0.5, 0.05 * (high - low));
  const all = [];
  for (let day = Math.floor(low); day <= Math.ceil(high); day += Math.max(1, Math.ceil((high - low) / 8))) all.push(day);
  chart(holder, { ...spec, x: [low - room, high + room], xTicks: all, xTick: date(zone_ms(points[0].started)), xLabel: "day", height: 260 });
}

function show(trend) {
  const points = trend.runs, moduli = points.map((point) => point.moduli), names = points.map((point) => `${point.run}, ${point.started.slice(0, 16)}`);
  byId("slopes").textContent = Object.entries(trend.slopes).map(([kind, slope]) => `${kind}: ${slopeText(slope, "kPa", 1e-3)}`).join("; ")
    || (points.length ? "Too few runs for a change per day: it takes three." : "");
  if (points.length) plot(byId("moduli"), { label: `moduli of site ${trend.site} over the days`, yLabel: "E (kPa)", legend: true, series: [
    { x: days(points), y: scaled(moduli.map((each) => each.static_Pa), 1e-3), low: interval(moduli.map((each) => each.static_ci95_Pa), 0), high: interval(moduli.map((each) => each.static_ci95_Pa), 1), label: "static", points: true, names },
    { x: days(points), y: scaled(moduli.map((each) => each.corrected_Pa), 1e-3), low: interval(moduli.map((each) => each.corrected_ci95_Pa), 0), high: interval(moduli.map((each) => each.corrected_ci95_Pa), 1), label: "dynamic, corrected", colour: 1, points: true, names },
  ] }, points);
  else instead(byId("moduli"), make("p", { className: "faint", text: "No run has a modulus of this site." }));
  byId("effects").replaceChildren(...trend.effects.map((effect) => {
    const holder = make("div", {});
    requestAnimationFrame(() => plot(holder, { label: `${effect.effect}, ${effect.parameter}, over the days`, yLabel: effect.parameter, series: [
      { x: days(effect.points), y: effect.points.map((point) => point.value), low: effect.points.map((point) => point.low), high: effect.points.map((point) => point.high), points: true, names: effect.points.map((point) => point.run), colour: 2 },
    ] }, effect.points));
    return make("div", {}, make("h3", { text: `${effect.effect}: ${effect.parameter}` }), make("p", { className: "faint", text: effect.slope ? slopeText(effect.slope, "", 1) : `${effect.points.length} of the three diagnoses that a change per day takes` }), holder);
  }));
  if (!trend.effects.length) byId("effects").replaceChildren(make("p", { className: "faint", text: "No diagnosis beside these runs has named an effect. Diagnose a run on its page, and keep the diagnosis for the trend." }));
  const misfits = moduli.some((each) => each.hertz_misfit) ? ["Hertz does not fit in some of these runs: E changes with depth, and the bars cover its range."] : [];
  byId("notes").replaceChildren(...[...misfits, ...trend.notes].map((note) => make("li", { text: note })));
}

async function update() {
  const number = ++asked;
  const query = new URLSearchParams([...new FormData(filter)].filter(([, value]) => value));
  const answer = await read(`/runs/trend-of?${query}`, { patience_ms: 130000 });
  if (number !== asked) return;
  refuse(byId("refusal"), answer.ok ? "" : answer.error);
  if (answer.ok) show(answer);
}

const known = await read("/runs/list?most=1", { patience_ms: 130000 });
refuse(byId("refusal"), known.ok ? "" : known.error);
if (known.ok) {
  const site = new URLSearchParams(location.search).get("site");
  filter.elements.site.append(...known.sites.map((name) => make("option", { value: name, text: name })));
  filter.elements.tag.append(...known.tags.map((name) => make("option", { value: name, text: name })));
  if (known.sites.includes(site)) filter.elements.site.value = site;
  if (known.sites.length) update();
  else refuse(byId("refusal"), `no run in ${known.folder} has a modulus yet`);
}
filter.addEventListener("input", update);
