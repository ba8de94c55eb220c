// The Run page: live force and depth, the press under way, the plan, the sites, the loop, and how the last run ended.

import { choosePlan, chosenPlan } from "./controls.js";
import { on } from "./link.js";
import { inButtons, say } from "./message.js";
import { Rolling, drawMap, drawPress, onColours } from "./plot.js";
import { byId, kilopascals, make } from "./work.js";

const OLD_MS = 280;
const MOST_LINES = 200;
const COMPENSATED = ["palpation", "free_motion", "stiffness"]; // the others take no tare of their own: their force is the raw one
const MOST_PLAN_BYTES = 250000;
const put = (id, text) => { const each = byId(id); if (each.textContent !== text) each.textContent = text; };
const fixed = (value, digits) => (value === null || value === undefined ? "–" : value.toFixed(digits).replace(/^-0(\.0*)?$/, "0$1").replace("-", "−"));
const age = (ms) => fixed(ms === null ? null : Math.max(0, ms), 1); // a device's clock is known to a fraction of a millisecond

let limits = null;
let status = null;
let run = -1;
let press = 0;
let curve = [];
let before = [];
let sites = [];
let ticked_ms = 0;
let newest = null;
let health = null;
let curve_is_new = true;

const force = new Rolling(byId("force-chart"), {
  series: [["raw", 1.5, [1, 3]], ["inertial", 1.5, [7, 4]], ["force", 2.5]],
  unit: "N",
  range: (low, high) => [Math.min(-1, low * 1.1), Math.max((limits?.contact_N ?? 12) * 1.12, high * 1.08)],
  lines: () => (limits ? [{ at: limits.contact_N, name: `contact limit ${limits.contact_N} N` }, { at: limits.absolute_N, name: `absolute limit ${limits.absolute_N} N` }] : []),
});
const depth = new Rolling(byId("depth-chart"), {
  series: [["force", 2]],
  unit: "mm",
  range: (low, high) => [Math.min(-2, low * 1.05), Math.max(2, high * 1.1)],
});

on("frame", (frame) => {
  if (frame.run !== run || frame.readable !== undefined) { // a new run, or all of the last 25 s after the link was opened anew
    run = frame.run;
    force.clear();
    depth.clear();
    [curve, before, press, newest, curve_is_new] = [[], [], 0, null, true];
  }
  health = frame.h;
  for (const point of frame.p) {
    const [t_s, raw_N, inertial_N, force_N, z_m, depth_m, number] = point;
    force.add(t_s, raw_N, inertial_N, force_N);
    depth.add(t_s, depth_m === null ? null : depth_m * 1e3);
    if (z_m === null) continue; // here the lines end
    if (number > press) {
      if (curve.length) before = curve;
      [press, curve] = [number, []];
    }
    if (number && depth_m !== null && force_N !== null) {
      curve.push([depth_m * 1e3, force_N]);
      curve_is_new = true;
    }
    newest = point;
  }
  if (frame.p.length) ticked_ms = performance.now();
});

function draw() {
  requestAnimationFrame(draw);
  force.draw();
  depth.draw();
  if (curve_is_new) drawPress(byId("press-chart"), curve, before, limits?.contact_N);
  curve_is_new = false;
  const running = status !== null && status.job !== undefined && status.tick !== undefined;
  const old = document.body.dataset.link !== "open" || document.body.dataset.service !== "open" || (running && performance.now() - ticked_ms > OLD_MS) || !running;
  document.body.toggleAttribute("data-old", old);
  if (newest === null) return;
  const [, raw_N, inertial_N, force_N, z_m, depth_m] = newest;
  const [rate_Hz, missed, robot_ms, sensor_ms, work_us, absolute_N] = health;
  const compensated = running && COMPENSATED.includes(status.job);
  put("force-name", compensated ? "Force, compensated" : "Force against reference");
  const read = status?.probe?.date.slice(11, 19);
  put("now-head", running ? "Now" : read ? `Last read at ${read}` : "Last read");
  put("force", fixed(compensated ? force_N : absolute_N, 2));
  put("raw", fixed(raw_N, 2));
  put("inertial", fixed(inertial_N, 2));
  const known = depth_m !== null, above = known && depth_m < 0;
  put("depth-name", above ? "Above the surface" : known ? "Depth" : "Height of the tip");
  put("depth", fixed((known ? Math.abs(depth_m) : z_m) * 1e3, known && !above ? 2 : 1));
  put("absolute", limits ? `${fixed(absolute_N, 1)} of ${limits.absolute_N}` : fixed(absolute_N, 1));
  put("rate", fixed(rate_Hz, 1));
  put("missed", `${missed}`);
  put("robot-age", age(robot_ms));
  put("sensor-age", age(sensor_ms));
  put("work", fixed(work_us, 0));
}

on("status", (event) => {
  status = event;
  limits = event.limits ?? null;
  byId("steps").toggleAttribute("data-idle", event.job === undefined);
  const counted = (event.steps ?? 1) > 1;
  byId("progress").max = counted ? event.steps : 1;
  byId("progress").value = counted ? event.steps_done : 0;
  put("progress-text", event.job === undefined ? "no run is under way"
    : counted ? `${event.steps_done} of ${event.steps} steps, ${event.activity}${left(event.left_s)}`
    : event.activity);
  showLast(event);
  showProbe(event);
});
on("lost", () => {
  status = null;
  put("progress-text", "not known: the service does not answer");
});

/** The time that is left, as roughly as it is known. */
function left(left_s) {
  if (left_s === null || left_s === undefined) return "";
  if (left_s < 10) return ", some seconds left";
  return left_s < 90 ? `, about ${Math.ceil(left_s / 10) * 10} s left` : `, about ${Math.ceil(left_s / 60)} min left`;
}

/** Whether the probe is free, where the tip stands, and what a start would ask. */
function showProbe({ probe, place, job }) {
  const state = { free: "free", pressed: "pressed", unknown: "not known to be free" };
  const line = byId("probe-state");
  line.dataset.kind = probe && probe.state !== "free" ? "bad" : "";
  put("probe-state", !probe || job !== undefined ? "" : `The probe is ${state[probe.state]}${probe.reasons.length ? `: ${probe.reasons.join("; ")}` : ""}; looked at ${probe.date.slice(11, 19)}.${probe.state === "free" ? "" : ` ${inButtons(probe.advice)}.`}`);
  const mm = (value) => fixed(value * 1e3, 1);
  put("place-state", !place || place.x_m === null ? "" : `Tip at x = ${mm(place.x_m)} mm, y = ${mm(place.y_m)} mm${place.site ? `, over site ${place.site} of the last plan` : ""}.`);
}

function showLast({ latched, last, protective }) {
  byId("fault").dataset.kind = latched ? "bad" : last && last.verdict !== "done" ? "warn" : "";
  put("fault", latched ? `Stopped: ${latched}` : !last ? "nothing has run since the service began" : `${last.verdict}${last.reason ? `: ${inButtons(last.reason)}` : ""}`);
  const notes = [...(last?.notes ?? []).map(inButtons), ...(last?.recording ? [`recording ${last.recording.split("/").at(-1)}`] : []),
    ...(protective ?? []).map(({ date, cause, by }) => `protective stop of ${date.slice(0, 10)} at ${date.slice(11, 19)}${cause ? `: ${cause}, written by ${by}` : ", no cause written down"}`)];
  const list = byId("fault-notes");
  if (list.dataset.shown === notes.join("\n")) return;
  list.dataset.shown = notes.join("\n");
  list.replaceChildren(...notes.map((note) => make("li", { text: note })));
}

function row(site) {
  const interval = (ci, value) => (ci === null ? "–" : `${kilopascals(ci[0], value)} – ${kilopascals(ci[1], value)}`);
  const star = (value) => kilopascals(value) + (value !== null && site.hertz_misfit ? " *" : "");
  const cells = [star(site.static_Pa), interval(site.static_ci95_Pa, site.static_Pa), star(site.dynamic_Pa), interval(site.dynamic_ci95_Pa, site.dynamic_Pa), site.peak_N === null ? "–" : site.peak_N.toFixed(1) + (site.cut_short ? " ✂" : "")];
  return make("tr", {}, make("th", { scope: "row", text: site.name }), ...cells.map((text) => make("td", { text })));
}

on("sites", (event) => {
  sites = event.sites;
  byId("sites").replaceChildren(...sites.map(row));
  const notes = [sites.some((site) => site.cut_short) && "✂ a press was cut short below the contact limit",
    ...sites.filter((site) => site.hertz_misfit).map((site) => `* ${site.name}: ${site.hertz_misfit}`)].filter(Boolean);
  put("sites-note", event.error || (sites.length ? notes.join(". ") : "moduli come when a site is over"));
  showMap();
});

function showMap() {
  const places = sites
    .map((site) => ({ ...site, E_Pa: site.static_Pa ?? site.dynamic_Pa }))
    .filter((site) => site.E_Pa !== null && site.x_m !== null)
    .map((site) => ({ name: site.name, x_mm: site.x_m * 1e3, y_mm: site.y_m * 1e3, kPa: site.E_Pa / 1e3 }));
  drawMap(byId("map"), places);
}

on("log", ({ line }) => {
  const list = byId("log");
  const low = list.scrollTop + list.clientHeight >= list.scrollHeight - 4;
  list.append(make("li", { text: line }));
  while (list.children.length > MOST_LINES) list.firstChild.remove();
  if (low) list.scrollTop = list.scrollHeight;
});

// --- the distance view: state, force and depth as large as the screen allows ---

function view(distant) {
  document.body.toggleAttribute("data-distance", distant);
  put("distance", distant ? "Close the distance view" : "Distance view");
}
byId("distance").addEventListener("click", () => {
  const distant = !document.body.hasAttribute("data-distance");
  history.replaceState(null, "", distant ? "/?view=distance" : "/");
  view(distant);
});
view(new URLSearchParams(location.search).get("view") === "distance");

// --- the camera, where one is configured ---

const CAMERA_AGAIN_MS = 5000;
const camera = byId("camera");
camera?.addEventListener("error", () => {
  byId("camera-note").textContent = `no picture from ${new URL(camera.src).host}; trying again`;
  setTimeout(() => { camera.src = camera.getAttribute("src"); }, CAMERA_AGAIN_MS);
});
camera?.addEventListener("load", () => { byId("camera-note").textContent = ""; });

const showPlan = () => put("plan-name", chosenPlan()?.name ?? "none chosen");
document.addEventListener("palpd-plan", showPlan);
byId("plan-file").addEventListener("change", async ({ target }) => {
  const [file] = target.files;
  if (!file) return;
  if (file.size > MOST_PLAN_BYTES) say(`${file.name} has ${file.size} bytes, expected at most ${MOST_PLAN_BYTES}; is it a plan?`, "refused");
  else choosePlan(file.name, await file.text());
  target.value = "";
});

const again = () => { curve_is_new = true; showMap(); };
onColours(again);
addEventListener("resize", again);
showPlan();
showMap();
draw();
