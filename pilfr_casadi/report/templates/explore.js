/* Replaces each picture that carries its data by an interactive chart of uPlot: values, zoom, lines on and off, also by
   keyboard. Without this script the reader sees the pictures. */
(() => {
"use strict";
const INK = { "#222222": "--ink", "#dddddd": "--line", "#7a7a7a": "--soft", "#0072b2": "--blue" };  // colours of plots/canvas.py for a white background
const AREA = { "#eeeeee": "--line", "#e8f1f7": "--line" };
const REACH = 40;  // pixels: a point this close to the pointer shows its values
const style = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const make = (tag, parent, settings = {}) => parent.appendChild(Object.assign(document.createElement(tag), settings));
const typeset = text => text.replace(/e([+-]\d+)$/, (_, power) => "·10" + String(+power).replace(/./g, c => "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".indexOf(c)])).replace("-", "−");
const digits = v => typeset(Math.abs(v) >= 1e6 || (v && Math.abs(v) < 1e-4) ? v.toExponential(3) : String(+v.toPrecision(5)));
const quantity = label => /^(.*?)(?: \[(.*)\])?$/.exec(label).slice(1);

function numbers(packed) {
  if (Array.isArray(packed)) return Float64Array.from({ length: packed[2] }, (_, k) => packed[0] + k * packed[1]);
  return new Float32Array(Uint8Array.from(atob(packed), c => c.charCodeAt(0)).buffer);
}

function nearest(x, at) {  // of increasing x
  let low = 0, high = x.length - 1;
  while (high - low > 1) { const k = (low + high) >> 1; if (x[k] < at) low = k; else high = k; }
  return at - x[low] < x[high] - at ? low : high;
}

function tickTexts(at, step) {  // of a linear axis: as many digits as tell neighbours apart, and one power of ten for all
  const most = Math.max(...at.map(Math.abs)), power = most >= 1e6 || most < 1e-3 ? Math.floor(Math.log10(most)) : 0;
  const unit = step / 10 ** power, places = Math.max(0, Math.min(12, -Math.floor(Math.log10(unit) + 1e-9)));
  const exact = Math.abs(unit * 10 ** places - Math.round(unit * 10 ** places)) < 1e-6 ? places : places + 1;  // a step may be 2.5
  return at.map(v => v === 0 || !isFinite(v) ? "0" : typeset((v / 10 ** power).toFixed(exact) + (power ? `e${power > 0 ? "+" : ""}${power}` : "")));
}

function ticks(low, high) {  // of a logarithmic axis, few enough to label each
  const decades = Math.log10(high / low), out = [];
  const steps = decades > 3 ? [1] : decades > 1.4 ? [1, 3] : decades > 0.7 ? [1, 2, 5] : [1, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8, 9];
  const every = Math.ceil(decades / 6);
  for (let k = Math.floor(Math.log10(low)); k <= Math.log10(high); k++)
    for (const step of k % every ? [] : steps) if (step * 10 ** k >= low && step * 10 ** k <= high) out.push(+(step * 10 ** k).toPrecision(6));
  return out;
}

function colour(line) {
  const name = (line.area && AREA[line.colour]) || INK[line.colour];
  return name ? style(name) : line.colour;
}

function path(line, log) {  // a builder of uPlot
  return (u, i) => uPlot.orient(u, i, (_, dx, dy, sx, sy, across, up, left, top, width, height) => {
    const stroke = new Path2D(), r = (line.size || 0) / 2 * devicePixelRatio * 1.35;
    const inside = v => Math.max(-1e5, Math.min(1e5, v));
    for (let k = 0, pen = false; k < dx.length; k++) {
      const lost = !isFinite(dx[k]) || !isFinite(dy[k]) || (log.y && dy[k] <= 0 && !line.area);
      if (lost) { pen = false; continue; }
      const floor = (v, logged) => logged ? Math.max(v, 1e-300) : v;
      const x = inside(across(floor(dx[k], log.x), sx, width, left)), y = inside(up(floor(dy[k], log.y), sy, height, top));
      if (line.mark === "cross") {
        stroke.moveTo(x - r, y - r); stroke.lineTo(x + r, y + r); stroke.moveTo(x - r, y + r); stroke.lineTo(x + r, y - r);
      } else if (line.mark && !line.width) {
        stroke.moveTo(x + r, y); stroke.arc(x, y, r, 0, 7);
      } else if (pen) stroke.lineTo(x, y); else stroke.moveTo(x, y);
      pen = true;
    }
    const filled = line.area || (line.mark === "dot" && !line.width);
    return { stroke: filled ? null : stroke, fill: filled ? stroke : null, clip: null, band: null, gaps: null, flags: 0 };
  });
}

function explore(figure) {
  const spec = JSON.parse(figure.dataset.chart), image = figure.querySelector("img"), log = { x: spec.x.log, y: spec.y.log };
  const lines = spec.lines.map(l => ({ ...l, x: numbers(l.x), y: numbers(l.y), shown: true }));
  const told = lines.filter(l => !l.area && !l.level);
  const rises = l => l.x.every((v, k) => !k || v >= l.x[k - 1]);
  const overTime = told.every(l => l.width && rises(l));
  const [[nameX, unitX], [nameY, unitY]] = [quantity(spec.x.label), quantity(spec.y.label)];
  const fwd = { x: v => log.x ? Math.log10(v) : v, y: v => log.y ? Math.log10(v) : v };
  const back = { x: v => log.x ? 10 ** v : v, y: v => log.y ? 10 ** v : v };

  const box = document.createElement("div"), tools = document.createElement("div");
  figure.insertBefore(box, image);
  box.className = "chart"; box.tabIndex = 0; box.setAttribute("role", "group");
  box.setAttribute("aria-label", `Chart. ${image.alt} Arrow keys tell values; with shift they move; plus and minus zoom; 0 resets.`);
  image.classList.add("still");
  if (spec.title) make("p", box, { className: "chart-title", textContent: spec.title });
  const legend = make("div", box, { className: "legend" }), plot = make("div", box, { className: "plot" });
  tools.className = "tools"; box.appendChild(tools);
  const spoken = make("output", box, { className: "spoken" });

  function extent(axis, within) {  // of the visible lines; for y within a range of x
    let low = Infinity, high = -Infinity;
    for (const l of lines) {
      if (!l.shown || (l.level && axis === "x")) continue;
      for (let k = 0; k < l.x.length; k++) {
        const v = l[axis][k];
        if (!isFinite(v) || Math.abs(v) > 1e38 || (log[axis] && v <= 0)) continue;
        if (within && !l.level && (l.x[k] < within[0] || l.x[k] > within[1])) continue;
        if (v < low) low = v;
        if (v > high) high = v;
      }
    }
    if (!(low <= high)) return null;
    const [a, b] = [fwd[axis](low), fwd[axis](high)], room = (axis === "y" ? 0.06 : 0.01) * (b - a) || Math.abs(a) * 0.05 || 1;
    return [back[axis](a - room), back[axis](b + room)];
  }

  const home = spec.views[""];
  let [x, y] = home;
  function look(toX, toY) {
    x = toX;
    y = toY || (overTime && extent("y", x)) || y;
    const scales = { x: [...x], y: [...y] };
    if (spec.equal) {  // equal scales on both axes
      const perX = (x[1] - x[0]) / (u.over.clientWidth || 1), perY = (y[1] - y[0]) / (u.over.clientHeight || 1);
      const [axis, per, size] = perX < perY ? ["x", perY, u.over.clientWidth] : ["y", perX, u.over.clientHeight];
      const middle = (scales[axis][0] + scales[axis][1]) / 2;
      scales[axis] = [middle - per * size / 2, middle + per * size / 2];
    }
    u.batch(() => { for (const k of ["x", "y"]) u.setScale(k, { min: scales[k][0], max: scales[k][1] }); });
    box.dataset.range = JSON.stringify(scales);
  }
  const moved = ([a, b], axis, low, high) => {
    const [p, q] = [fwd[axis](a), fwd[axis](b)];
    return [back[axis](p + low * (q - p)), back[axis](p + high * (q - p))];
  };
  const zoom = (low, high, both) => look(moved(x, "x", low, high), overTime && both ? null : both ? moved(y, "y", low, high) : overTime ? null : y);

  function tell(u) {
    const { left, top } = u.cursor, found = [];
    marks.forEach(m => m.hidden = true);
    if (left == null || left < 0) { tip.hidden = true; return; }
    const at = u.posToVal(left, "x");
    for (const l of told) {
      if (!l.shown || (!l.label && told.some(o => o.label))) continue;
      let best = null, least = Infinity;
      if (overTime) { best = nearest(l.x, at); least = isFinite(l.y[best]) ? 0 : Infinity; }
      else for (let k = 0; k < l.x.length; k++) {
        const d = Math.hypot(u.valToPos(l.x[k], "x") - left, u.valToPos(l.y[k], "y") - top);
        if (d < least) { least = d; best = k; }
      }
      if (least < REACH) found.push({ line: l, k: best, distance: least });
    }
    if (!overTime) found.sort((a, b) => a.distance - b.distance).splice(1);
    tip.replaceChildren(); tip.hidden = !found.length;
    if (!found.length) return;
    const first = found[0], told_x = `${nameX} ${digits(first.line.x[first.k])}${unitX ? " " + unitX : ""}`;
    make("div", tip, { textContent: told_x });
    found.forEach(({ line, k }, i) => {
      const row = make("div", tip), note = (spec.notes.find(n => Math.abs(n.x - line.x[k]) + Math.abs(n.y - line.y[k]) < 1e-5) || {}).text;
      make("span", row, { className: "swatch" }).style.background = colour(line);
      const value = `${digits(line.y[k])}${unitY ? " " + unitY : ""}`;
      make("span", row, { textContent: note ? `${line.label}: ${value}, ${note}` : line.label ? `${line.label}: ${value}` : `${nameY} ${value}` });
      const mark = marks[i] || (marks[i] = make("div", u.over, { className: "mark" }));
      mark.hidden = false; mark.style.borderColor = colour(line);
      mark.style.transform = `translate(${u.valToPos(line.x[k], "x")}px, ${u.valToPos(line.y[k], "y")}px)`;
    });
    tip.style.left = left > u.over.clientWidth / 2 ? "auto" : `${left + 14}px`;
    tip.style.right = left > u.over.clientWidth / 2 ? `${u.over.clientWidth - left + 14}px` : "auto";
    tip.style.top = `${Math.max(0, Math.min(top, u.over.clientHeight - tip.offsetHeight))}px`;
  }

  function select(u) {  // a drag mostly across keeps y, a drag mostly up keeps x
    const { left, top, width, height } = u.select;
    if (width < 5 && height < 5) return;
    const across = [u.posToVal(left, "x"), u.posToVal(left + width, "x")], up = [u.posToVal(top + height, "y"), u.posToVal(top, "y")];
    const wide = width >= u.over.clientWidth - 1, high = height >= u.over.clientHeight - 1;
    look(wide ? x : across, high ? (overTime ? null : y) : up);
    u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
  }

  const pen = document.createElement("canvas").getContext("2d");
  pen.font = "13px system-ui, sans-serif";
  const labelled = Math.min(pen.measureText(spec.y.label).width + 75, 460);  // the label beside the axis is not cut
  const size = () => ({ width: plot.clientWidth, height: Math.round(Math.max(250, labelled, Math.min(0.62 * plot.clientWidth, 380))) });
  const axis = (label, logged, whole) => ({
    ...(logged ? { splits: (_, __, low, high) => ticks(low, high), values: (_, at) => at.map(digits), filter: (_, at) => at } : { values: (_, at, __, ___, step) => tickTexts(at, step) }),
    ...(whole ? { incrs: [...Array(9).keys()].flatMap(k => [1, 2, 5].map(v => v * 10 ** k)) } : {}),
    label, labelSize: 20, font: "13px system-ui, sans-serif", labelFont: "13px system-ui, sans-serif", labelGap: 2,
    stroke: () => style("--ink"), grid: { stroke: () => style("--line"), width: 1 }, ticks: { stroke: () => style("--line"), width: 1, size: 5 },
  });
  const marks = [];
  const u = new uPlot({
    mode: 2, ...size(), legend: { show: false }, padding: [10, 12, 0, 0],
    cursor: { points: { show: false }, drag: { x: true, y: true, uni: 30, setScale: false }, bind: { dblclick: () => () => { look(...home); return null; } } },
    scales: {
      x: { time: false, auto: false, distr: log.x ? 3 : 1, min: x[0], max: x[1], range: (_, a, b) => [a, b] },
      y: { auto: false, distr: log.y ? 3 : 1, min: y[0], max: y[1], range: (_, a, b) => [a, b] },
    },
    axes: [{ ...axis(spec.x.label, log.x, spec.x.whole), size: 30 }, {
      ...axis(spec.y.label, log.y),
      size: (_, values) => spec.equal ? 62 : 14 + 8 * Math.max(3, ...(values || []).map(v => v == null ? 0 : String(v).length)),
    }],
    series: [null, ...lines.map(l => ({
      facets: [{ scale: "x", auto: false }, { scale: "y", auto: false }], paths: path(l, log), points: { show: false },
      stroke: () => colour(l), fill: () => colour(l), width: l.width || (l.mark ? 1.6 : 0), dash: l.dash, alpha: l.area ? Math.min(l.alpha, 0.6) : l.mark ? Math.max(l.alpha, 0.6) : l.alpha,
    }))],
    hooks: { setCursor: [u => tell(u)], setSelect: [select], draw: [drawNotes] },
  }, [null, ...lines.map(l => [l.x, l.y])], plot);
  const tip = make("div", u.over, { className: "tip", hidden: true });

  function drawNotes(u) {
    const pen = u.ctx, scale = devicePixelRatio;
    pen.save();
    pen.font = `${12 * scale}px system-ui, sans-serif`;
    for (const note of spec.notes) {
      const px = u.valToPos(note.x, "x", true), py = u.valToPos(note.y, "y", true);
      if (px < u.bbox.left || px > u.bbox.left + u.bbox.width || py < u.bbox.top || py > u.bbox.top + u.bbox.height) continue;
      pen.fillStyle = colour(note); pen.textAlign = note.align;
      pen.fillText(note.text, px + 1.3 * note.right * scale, py - 1.3 * note.up * scale);
    }
    pen.restore();
  }

  for (const label of new Set(lines.map(l => l.label).filter(Boolean))) {
    const own = lines.filter(l => l.label === label), button = make("button", legend, { type: "button" });
    button.setAttribute("aria-pressed", "true");
    const swatch = make("span", button, { className: own[0].mark && !own[0].width ? "swatch round" : own[0].area ? "swatch square" : "swatch" });
    const paint = () => { swatch.style.background = own[0].dash ? `repeating-linear-gradient(90deg, ${colour(own[0])} 0 5px, transparent 5px 8px)` : colour(own[0]); };
    paint(); repaint.push(paint);
    make("span", button, { textContent: label });
    button.addEventListener("click", () => {
      const shown = !own[0].shown;
      button.setAttribute("aria-pressed", String(shown));
      own.forEach(l => { l.shown = shown; u.setSeries(lines.indexOf(l) + 1, { show: shown }); });
      look(x, overTime ? null : y);
    });
  }
  const tool = (text, name, act) => make("button", tools, { type: "button", textContent: text, title: name, ariaLabel: name, onclick: act });
  for (const [name, range] of Object.entries(spec.views)) if (name) tool(name, name, () => look(...range));
  tool("everything", "everything", () => look(extent("x") || home[0], extent("y")));
  tool("+", "Zoom in", () => zoom(0.25, 0.75, true));
  tool("−", "Zoom out", () => zoom(-0.5, 1.5, true));
  tool("◀", "Move left", () => zoom(-0.25, 0.75));
  tool("▶", "Move right", () => zoom(0.25, 1.25));
  box.addEventListener("keydown", event => {
    if (event.target !== box || event.ctrlKey || event.altKey || event.metaKey) return;
    const side = { ArrowLeft: -1, ArrowRight: 1 }[event.key], rise = { ArrowUp: -1, ArrowDown: 1 }[event.key];
    const { clientWidth: w, clientHeight: h } = u.over;
    if (side && event.shiftKey) zoom(0.25 * side, 1 + 0.25 * side);
    else if (side || (rise && !overTime)) {
      const { left, top } = u.cursor, known = left >= 0;
      u.setCursor({ left: Math.max(0, Math.min(w - 1, (known ? left : w / 2) + (side || 0) * w / 60)), top: Math.max(0, Math.min(h - 1, (known ? top : h / 2) + (rise || 0) * h / 40)) });
      spoken.textContent = [...tip.children].map(e => e.textContent).join("; ");
    } else if (event.key === "+" || event.key === "=") zoom(0.25, 0.75, true);
    else if (event.key === "-") zoom(-0.5, 1.5, true);
    else if (event.key === "0" || event.key === "Escape") look(...home);
    else return;
    event.preventDefault();
  });
  new ResizeObserver(() => { if (plot.clientWidth && plot.clientWidth !== u.width) { u.setSize(size()); look(x, y); } }).observe(plot);
  repaint.push(() => u.redraw(false));
  look(...home);
  if (spec.equal) setTimeout(() => look(...home));  // after the axes have got their size
}

const repaint = [];
for (const figure of document.querySelectorAll("figure[data-chart]")) {
  const known = repaint.length;
  try { explore(figure); } catch (error) {  // the picture stays
    console.error(error);
    repaint.length = known;
    for (const box of figure.querySelectorAll(".chart")) box.remove();
  }
}
if (!repaint.length) return;
document.querySelectorAll("figure.replaced").forEach(f => { f.hidden = true; });
document.querySelectorAll(".explore-help").forEach(p => { p.hidden = false; });
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => repaint.forEach(paint => paint()));
})();
