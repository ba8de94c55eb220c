// Charts: rolling ones by uPlot, and two small drawings of our own where x is no time (force against depth, the map).

import { ticks } from "./chart.js";

const resolved = (name) => {
  const probe = document.createElement("span");
  probe.style.color = `var(${name})`;
  document.body.append(probe);
  const value = getComputedStyle(probe).color;
  probe.remove();
  return value;
};

let colours = {};
function readColours() {
  colours = Object.fromEntries(["ink", "faint", "line", "force", "raw", "inertial", "limit", "sheet"].map((name) => [name, resolved(`--${name}`)]));
}

const redraw = new Set();
readColours();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { readColours(); for (const each of redraw) each(); });

const FONT = "12px system-ui, sans-serif";

/** A chart of the last `window_s` seconds. `series` are [colour name, width, dash]; `range` gives the y limits; `lines` the horizontal ones. */
export class Rolling {
  constructor(element, { series, unit, range, lines = () => [], window_s = 20, keep = 3000 }) {
    Object.assign(this, { element, series, unit, range, lines, window_s, keep });
    this.data = [[], ...series.map(() => [])];
    this.dirty = true;
    this.make();
    redraw.add(() => this.make());
    new ResizeObserver(() => this.plot.setSize(this.size())).observe(element);
  }

  size() {
    return { width: Math.max(120, this.element.clientWidth), height: Math.max(80, this.element.clientHeight) };
  }

  make() {
    this.plot?.destroy();
    const axis = { stroke: () => colours.faint, font: FONT, grid: { stroke: () => colours.line, width: 1 }, ticks: { show: false } };
    this.plot = new uPlot({
      ...this.size(),
      legend: { show: false },
      cursor: { show: false },
      padding: [8, 16, 0, 0],
      scales: { x: { time: false, range: () => { const end = Math.max(this.window_s, this.data[0].at(-1) ?? 0); return [end - this.window_s, end]; } }, y: { range: (_, low, high) => this.range(low ?? 0, high ?? 0) } },
      axes: [{ ...axis, size: 26, values: (_, at) => at.map((t) => `${t} s`) }, { ...axis, size: 52, values: (_, at) => at.map((v) => `${v} ${this.unit}`) }],
      series: [{}, ...this.series.map(([name, width, dash]) => ({ stroke: () => colours[name], width, dash, points: { show: false } }))],
      hooks: { draw: [(plot) => this.drawLines(plot)] },
    }, this.data, this.element);
  }

  drawLines(plot) {
    const { ctx, bbox } = plot;
    const scale = devicePixelRatio;
    ctx.save();
    ctx.strokeStyle = ctx.fillStyle = colours.limit;
    ctx.lineWidth = 1.5 * scale;
    ctx.setLineDash([6 * scale, 4 * scale]);
    ctx.font = `${12 * scale}px system-ui, sans-serif`;
    ctx.textAlign = "right";
    ctx.textBaseline = "bottom";
    for (const { at, name } of this.lines()) {
      if (at > plot.scales.y.max || at < plot.scales.y.min) continue;
      const y = plot.valToPos(at, "y", true);
      ctx.beginPath();
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(bbox.left + bbox.width, y);
      ctx.stroke();
      ctx.fillText(name, bbox.left + bbox.width - 4 * scale, y - 3 * scale);
    }
    ctx.restore();
  }

  /** Add a point: time, then one value for each series. */
  add(...values) {
    values.forEach((value, at) => this.data[at].push(value));
    if (this.data[0].length > this.keep + 500) for (const each of this.data) each.splice(0, each.length - this.keep);
    this.dirty = true;
  }

  clear() {
    for (const each of this.data) each.length = 0;
    this.dirty = true;
  }

  draw() {
    if (!this.dirty) return;
    this.dirty = false;
    this.plot.setData(this.data);
  }
}

function prepared(canvas) {
  const scale = devicePixelRatio;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (canvas.width !== Math.round(width * scale)) canvas.width = Math.round(width * scale);
  if (canvas.height !== Math.round(height * scale)) canvas.height = Math.round(height * scale);
  const ctx = canvas.getContext("2d");
  ctx.setTransform(scale, 0, 0, scale, 0, 0);
  ctx.clearRect(0, 0, width, height);
  ctx.font = FONT;
  return { ctx, width, height };
}

const number = (value) => `${Number(value.toPrecision(3))}`;

/** Draw force (N) against depth (mm); `before` is the press before, faint. */
export function drawPress(canvas, points, before, contact_N) {
  const { ctx, width, height } = prepared(canvas);
  const all = [...before, ...points];
  const x_max = Math.max(2, ...all.map((p) => p[0])) * 1.05;
  const y_max = Math.max(2, ...all.map((p) => p[1])) * 1.1;
  const left = 44, right = 10, top = 10, bottom = 26;
  const x = (v) => left + (v / x_max) * (width - left - right);
  const y = (v) => height - bottom - (v / y_max) * (height - top - bottom);
  ctx.strokeStyle = colours.line;
  ctx.fillStyle = colours.faint;
  ctx.lineWidth = 1;
  ctx.textAlign = "center";
  for (const at of ticks(0, x_max, 5)) {
    ctx.beginPath(); ctx.moveTo(x(at), top); ctx.lineTo(x(at), height - bottom); ctx.stroke();
    ctx.fillText(`${number(at)} mm`, x(at), height - 8);
  }
  ctx.textAlign = "right";
  for (const at of ticks(0, y_max, 4)) {
    ctx.beginPath(); ctx.moveTo(left, y(at)); ctx.lineTo(width - right, y(at)); ctx.stroke();
    ctx.fillText(`${number(at)} N`, left - 6, y(at) + 4);
  }
  const line = (each, stroke, thick, dash = []) => {
    ctx.setLineDash(dash);
    ctx.strokeStyle = stroke;
    ctx.lineWidth = thick;
    ctx.lineJoin = "round";
    ctx.beginPath();
    each.forEach(([depth, force], at) => (at ? ctx.lineTo(x(depth), y(force)) : ctx.moveTo(x(depth), y(force))));
    ctx.stroke();
  };
  ctx.save();
  ctx.beginPath(); ctx.rect(left, top, width - left - right, height - top - bottom); ctx.clip();
  line(before, colours.raw, 1.5, [1, 3]);
  line(points, colours.force, 2.5);
  if (contact_N && contact_N < y_max) {
    line([[0, contact_N], [x_max, contact_N]], colours.limit, 1.5, [6, 4]);
  }
  ctx.restore();
}

// From soft to stiff, in steps of equal lightness that colour-blind people see too (viridis).
const STIFF = ["#440154", "#482878", "#3e4989", "#31688e", "#26828e", "#1f9e89", "#35b779", "#6ece58", "#b5de2b", "#fde725"];

/** Draw moduli (kPa) at their places (mm): circles with the name and the value, coloured by the value. */
export function drawMap(canvas, places) {
  const { ctx, width, height } = prepared(canvas);
  ctx.textAlign = "center";
  ctx.fillStyle = colours.faint;
  if (!places.length) {
    ctx.fillText("grows with each site", width / 2, height / 2);
    return;
  }
  const span = (values) => [Math.min(...values), Math.max(...values)];
  const [x0, x1] = span(places.map((p) => p.x_mm)), [y0, y1] = span(places.map((p) => p.y_mm));
  const [e0, e1] = span(places.map((p) => p.kPa));
  const margin = 34, foot = 30;
  const room = Math.max((x1 - x0) / (width - 2 * margin), (y1 - y0) / (height - 2 * margin - foot), 0.02);
  const x = (v) => width / 2 + (v - (x0 + x1) / 2) / room;
  const y = (v) => (height - foot) / 2 - (v - (y0 + y1) / 2) / room;
  const radius = Math.max(7, Math.min(24, 0.42 * Math.sqrt(((width - 2 * margin) * (height - 2 * margin)) / places.length)));
  for (const place of places) {
    const share = e1 > e0 ? (place.kPa - e0) / (e1 - e0) : 0.5;
    const at = Math.round(share * (STIFF.length - 1));
    ctx.fillStyle = STIFF[at];
    ctx.beginPath();
    ctx.arc(x(place.x_mm), y(place.y_mm), radius, 0, 2 * Math.PI);
    ctx.fill();
    ctx.lineWidth = 1;
    ctx.strokeStyle = colours.line;
    ctx.stroke();
    if (radius >= 16) {
      ctx.fillStyle = at > 5 ? "#000" : "#fff";
      ctx.fillText(number(place.kPa), x(place.x_mm), y(place.y_mm) + 4);
      ctx.fillStyle = colours.faint;
      if (places.length <= 12) ctx.fillText(place.name, x(place.x_mm), y(place.y_mm) + radius + 13);
    }
  }
  const bar = Math.min(180, width - 140), from = (width - bar) / 2;
  STIFF.forEach((fill, at) => { ctx.fillStyle = fill; ctx.fillRect(from + (at * bar) / STIFF.length, height - 16, bar / STIFF.length + 1, 8); });
  ctx.fillStyle = colours.faint;
  ctx.textAlign = "right";
  ctx.fillText(`${number(e0)} kPa`, from - 6, height - 8);
  ctx.textAlign = "left";
  ctx.fillText(`${number(e1)} kPa`, from + bar + 6, height - 8);
}

/** Call `again` whenever the colours change. */
export const onColours = (again) => redraw.add(again);
