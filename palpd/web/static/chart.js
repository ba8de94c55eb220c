// Charts of what was recorded: lines with their range, points with intervals, in SVG. Texts are set as text, never as HTML.

const NS = "http://www.w3.org/2000/svg";
const LEFT = 58, RIGHT = 14, TOP = 12, BOTTOM = 38;

function element(name, attributes = {}, text = "") {
  const made = document.createElementNS(NS, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text) made.textContent = text;
  return made;
}

/** Round steps between two values. */
export function ticks(low, high, most) {
  const raw = (high - low) / Math.max(1, most);
  if (!(raw > 0)) return [low];
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((each) => each * power).find((each) => each >= raw * 0.999);
  const first = Math.ceil(low / step - 1e-9);
  return Array.from({ length: Math.floor(high / step + 1e-9) - first + 1 }, (_, k) => Number(((first + k) * step).toPrecision(12)));
}

/** Least and greatest of columns, without what is unknown; [0, 1] where nothing is known. */
export function extent(...columns) {
  let low = Infinity, high = -Infinity;
  for (const column of columns) for (const value of column) {
    if (value === null || value === undefined) continue;
    if (value < low) low = value;
    if (value > high) high = value;
  }
  if (low > high) return [0, 1];
  return low === high ? [low - 1, high + 1] : [low, high];
}

function line(xs, ys, sx, sy) {
  let path = "", drawing = false;
  for (let k = 0; k < xs.length; k++) {
    if (xs[k] === null || ys[k] === null || ys[k] === undefined) { drawing = false; continue; }
    path += `${drawing ? "L" : "M"}${sx(xs[k]).toFixed(1)} ${sy(ys[k]).toFixed(1)}`;
    drawing = true;
  }
  return path;
}

function area(xs, low, high, sx, sy) {
  let path = "", there = [], back = [];
  const close = () => {
    if (there.length) path += `M${[...there, ...back].join("L")}Z`;
    [there, back] = [[], []];
  };
  for (let k = 0; k < xs.length; k++) {
    if (xs[k] === null || low[k] === null || high[k] === null) { close(); continue; }
    there.push(`${sx(xs[k]).toFixed(1)} ${sy(high[k]).toFixed(1)}`);
    back.unshift(`${sx(xs[k]).toFixed(1)} ${sy(low[k]).toFixed(1)}`);
  }
  close();
  return path;
}

const MARKS = [null, "M-4-4H4V4H-4Z", "M0-5.5L5.5 0L0 5.5L-5.5 0Z", "M0-5L5 4H-5Z"];

/** A point: a circle, a square, a diamond or a triangle, so that series are told apart without their colours. */
function mark(colour, x, y) {
  return MARKS[colour] ? element("path", { class: `point line${colour}`, d: MARKS[colour], transform: `translate(${x} ${y})` })
    : element("circle", { class: `point line${colour}`, cx: x, cy: y, r: 4 });
}

/**
 * Draw a chart into an element, and again when its width changes.
 *
 * spec: {label, height, x: [low, high], y: [low, high], xLabel, yLabel, xTick: value -> text,
 *   equal: the same scale on both axes, series: [{x, y, low, high, label, colour (0 to 3), points, labels (of points)}], limits: [{y, label}], spans: [{from, to, label}]}
 * Returns {place: x in pixels -> value, redraw}.
 */
export function chart(holder, spec) {
  const drawing = {};
  const redraw = () => {
    const width = Math.max(holder.clientWidth, 240), height = spec.height ?? 220;
    let [x0, x1] = spec.x ?? extent(...spec.series.map((each) => each.x));
    let [y0, y1] = spec.y ?? extent(...spec.series.flatMap((each) => [each.y ?? [], each.low ?? [], each.high ?? []]), (spec.limits ?? []).map((each) => each.y));
    if (!spec.y && !spec.equal) [y0, y1] = [y0 - 0.06 * (y1 - y0), y1 + (spec.limits ? 0.2 : 0.06) * (y1 - y0)];
    if (spec.equal) {
      const [wide, high] = [width - LEFT - RIGHT, height - TOP - BOTTOM], a_pixel = 1.3 * Math.max((x1 - x0) / wide, (y1 - y0) / high);
      [x0, x1] = [(x0 + x1 - a_pixel * wide) / 2, (x0 + x1 + a_pixel * wide) / 2];
      [y0, y1] = [(y0 + y1 - a_pixel * high) / 2, (y0 + y1 + a_pixel * high) / 2];
    }
    const sx = (x) => LEFT + ((x - x0) / (x1 - x0 || 1)) * (width - LEFT - RIGHT);
    const sy = (y) => height - BOTTOM - ((y - y0) / (y1 - y0 || 1)) * (height - TOP - BOTTOM);
    const svg = element("svg", { class: "drawing", viewBox: `0 0 ${width} ${height}`, width, height, role: "img", "aria-label": spec.label });
    const names = spec.series.filter((each) => each.label);
    if (names.length > 1) svg.classList.add("told");
    for (const span of spec.spans ?? []) {
      const from = Math.max(sx(span.from), LEFT), to = Math.min(sx(span.to), width - RIGHT);
      if (to <= from) continue;
      svg.append(element("rect", { class: `span span${span.colour ?? 0}`, x: from, y: TOP, width: to - from, height: height - TOP - BOTTOM }));
      if (to - from > 26) svg.append(element("text", { class: "span-name", x: (from + to) / 2, y: TOP + 13, "text-anchor": "middle" }, span.label));
    }
    for (const y of ticks(y0, y1, Math.max(2, height / 48))) {
      svg.append(element("line", { class: "grid", x1: LEFT, x2: width - RIGHT, y1: sy(y), y2: sy(y) }));
      svg.append(element("text", { class: "tick", x: LEFT - 7, y: sy(y) + 4, "text-anchor": "end" }, `${y}`));
    }
    for (const x of spec.xTicks ?? ticks(x0, x1, width / 95)) {
      svg.append(element("line", { class: "grid", x1: sx(x), x2: sx(x), y1: TOP, y2: height - BOTTOM }));
      svg.append(element("text", { class: "tick", x: sx(x), y: height - BOTTOM + 16, "text-anchor": "middle" }, spec.xTick ? spec.xTick(x) : `${x}`));
    }
    svg.append(element("text", { class: "axis", x: (LEFT + width - RIGHT) / 2, y: height - 4, "text-anchor": "middle" }, spec.xLabel ?? ""));
    svg.append(element("text", { class: "axis", x: 13, y: (TOP + height - BOTTOM) / 2, "text-anchor": "middle", transform: `rotate(-90 13 ${(TOP + height - BOTTOM) / 2})` }, spec.yLabel ?? ""));
    const inside = element("svg", { x: LEFT, y: TOP, width: width - LEFT - RIGHT, height: height - TOP - BOTTOM, viewBox: `${LEFT} ${TOP} ${width - LEFT - RIGHT} ${height - TOP - BOTTOM}` });
    for (const each of spec.series) {
      const colour = each.colour ?? 0;
      if (each.low && !each.points) inside.append(element("path", { class: `area line${colour}`, d: area(each.x, each.low, each.high, sx, sy) }));
      if (each.y && !each.bare) inside.append(element("path", { class: `line line${colour}`, d: line(each.x, each.y, sx, sy) }));
      if (each.points) each.x.forEach((x, k) => {
        if (each.y[k] === null || each.y[k] === undefined) return;
        const [low, high] = [each.low?.[k] ?? null, each.high?.[k] ?? null];
        if (low !== null && high !== null) inside.append(element("line", { class: `line line${colour}`, x1: sx(x), x2: sx(x), y1: sy(low), y2: sy(high) }));
        const point = mark(colour, sx(x), sy(each.y[k]));
        if (each.names) point.append(element("title", {}, each.names[k]));
        inside.append(point);
        if (each.labels) inside.append(element("text", { class: "span-name", x: sx(x) + 7, y: sy(each.y[k]) - 6 }, each.labels[k]));
      });
    }
    for (const limit of spec.limits ?? []) {
      inside.append(element("line", { class: "limit", x1: LEFT, x2: width - RIGHT, y1: sy(limit.y), y2: sy(limit.y) }));
      inside.append(element("text", { class: "limit-name", x: width - RIGHT - 4, y: sy(limit.y) + 14, "text-anchor": "end" }, limit.label));
    }
    svg.append(inside);
    if (spec.window) {
      const [from, to] = spec.window();
      svg.append(element("rect", { class: "shade", x: LEFT, y: TOP, width: Math.max(0, sx(from) - LEFT), height: height - TOP - BOTTOM }));
      svg.append(element("rect", { class: "shade", x: sx(to), y: TOP, width: Math.max(0, width - RIGHT - sx(to)), height: height - TOP - BOTTOM }));
      svg.append(element("rect", { class: "window", x: sx(from), y: TOP, width: Math.max(2, sx(to) - sx(from)), height: height - TOP - BOTTOM }));
    }
    drawing.place = (pixels) => x0 + ((pixels - LEFT) / (width - LEFT - RIGHT)) * (x1 - x0);
    const legend = document.createElement("p");
    legend.className = "keys";
    for (const each of names.length > 1 || spec.legend ? names : []) {
      const entry = document.createElement("span");
      entry.className = "key";
      const sample = element("svg", { class: `drawing${names.length > 1 ? " told" : ""}`, width: 34, height: 12, "aria-hidden": "true" });
      if (each.y && !each.bare) sample.append(element("path", { class: `line line${each.colour ?? 0}`, d: "M0 6H34" }));
      if (each.points) sample.append(mark(each.colour ?? 0, 17, 6));
      entry.append(sample, each.label);
      legend.append(entry);
    }
    holder.replaceChildren(...(legend.childElementCount ? [legend] : []), svg);
  };
  drawing.redraw = redraw;
  redraw();
  holder.observer?.disconnect();
  let last = holder.clientWidth;
  holder.observer = new ResizeObserver(() => {
    if (Math.abs(holder.clientWidth - last) < 2) return;
    last = holder.clientWidth;
    redraw();
  });
  holder.observer.observe(holder);
  return drawing;
}

const PAUSED = [8, 12]; // phases of a recording: it waits, or goes up to wait
const BROKEN_S = 0.25;

/** Columns of a course with an unknown row wherever a line must end: at a gap in time, at another site, and around a pause. */
export function broken(columns) {
  const t_s = columns.t_s, steps = t_s.slice(1).map((t, k) => t - t_s[k]).sort((one, other) => one - other);
  const longest_s = Math.max(BROKEN_S, 4 * (steps[steps.length >> 1] ?? 0));
  const paused = columns.phase.map((phase) => PAUSED.includes(phase));
  const before = t_s.map((t, k) => k > 0 && (t - t_s[k - 1] > longest_s || columns.site[k] !== columns.site[k - 1] || paused[k] !== paused[k - 1]));
  return Object.fromEntries(Object.entries(columns).map(([name, values]) => [name, values.flatMap((value, k) =>
    before[k] ? [name === "t_s" ? (t_s[k - 1] + t_s[k]) / 2 : name === "site" || name === "phase" ? value : null, value] : [value])]));
}

/** Take a chart away, and put something else in its place. */
export function instead(holder, ...others) {
  holder.observer?.disconnect();
  holder.replaceChildren(...others);
}

/** Columns in another unit: metres to millimetres, pascals to kilopascals. */
export function scaled(column, factor) {
  return column.map((value) => (value === null || value === undefined ? null : value * factor));
}

/** Stretches of a course at one site, for the background of its charts. */
export function spansOf(columns, names) {
  const spans = [];
  columns.site.forEach((site, k) => {
    const open = spans.at(-1);
    if (open && open.site === site) open.to = columns.t_s[k];
    else {
      if (open) open.to = columns.t_s[k];
      spans.push({ site, from: columns.t_s[k], to: columns.t_s[k], label: names[site] ?? `${site}`, colour: Math.abs(site) % 2 });
    }
  });
  return spans.filter((span) => span.site >= 0);
}
