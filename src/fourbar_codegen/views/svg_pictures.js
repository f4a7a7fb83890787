// Pictures of mechanisms, plots over time and the player, in SVG: what reports and live pages have in common.
"use strict";

const byId = id => document.getElementById(id);

const SVG_ELEMENTS = new Set(["svg", "line", "circle", "path", "polygon", "polyline", "text", "title", "g", "defs",
  "marker"]);

// A new element at the end of its parent.
const make = (name, attributes, parent, text) => {
  const element = SVG_ELEMENTS.has(name) ? document.createElementNS("http://www.w3.org/2000/svg", name) :
    document.createElement(name);
  for (const key in attributes) element.setAttribute(key, attributes[key]);
  if (text !== undefined) element.textContent = text;
  return parent.appendChild(element);
};

const bytesOf = text => {
  const binary = atob(text), bytes = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; ++i) bytes[i] = binary.charCodeAt(i);
  return bytes;
};

const numberText = value => Math.abs(value) >= 1e4 || (value !== 0 && Math.abs(value) < 1e-3) ?
  value.toExponential(1) : String(Number(value.toPrecision(4)));

// Multiples of 1, 2 or 5 times a power of ten, about as many as asked for.
const ticksBetween = (low, high, count, least = 0) => {
  const rough = Math.max((high - low) / count, least), power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map(f => f * power).find(s => s >= rough);
  const ticks = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; ++i) ticks.push(i * step);
  return ticks;
};

// The text of the points of a polyline; numbers that are not finite leave gaps.
const pointsText = points => points.filter(([x, y]) => Number.isFinite(x) && Number.isFinite(y))
  .map(([x, y]) => `${x.toFixed(2)},${y.toFixed(2)}`).join(" ");

// A mechanism in an element <svg>. The scene says which rows of positions are connected, and by what; positions are
// n times m places of three coordinates. The view is the plane of x and y, or, where points leave it, one that is
// turned by two angles about z and the horizontal.
const mechanismPicture = (svg, scene) => {
  const WIDTH = 600, HEIGHT = 450, MARGIN = 40, FOLLOWED = 1.6, FAR = 4, STILL = 1e-9;
  let turn = scene.planar ? 0 : -0.6, tilt = scene.planar ? 0 : -1.1;
  let positions = new Float64Array(0), n = 0, m = 0, moving = [], before = null, shown = 0;
  // The middle of the picture; of a mechanism that goes far, that of the mechanism at the time shown, while traces, drawn
  // about `origin`, move along.
  let scale = 1, middle = [0, 0], origin = [0, 0], follows = false;
  const project = (places, i, k) => {
    const at = 3 * (i * m + k), x = places[at], y = places[at + 1], z = places[at + 2];
    const across = x * Math.cos(turn) - y * Math.sin(turn), along = x * Math.sin(turn) + y * Math.cos(turn);
    return [across, along * Math.cos(tilt) - z * Math.sin(tilt)];
  };
  const placed = (places, i, k, center) => {
    const [a, b] = project(places, i, k);
    return [WIDTH / 2 + scale * (a - center[0]), HEIGHT / 2 - scale * (b - center[1])];
  };
  const place = (i, k) => placed(positions, i, k, middle);
  const drawn = [...new Set([...scene.shown, ...scene.arrows.flat()])];
  // Middle and size of rows at some times.
  const extent = (begin, end, rows) => {
    const low = [Infinity, Infinity], high = [-Infinity, -Infinity];
    for (let i = begin; i < end; ++i) for (const k of rows) project(positions, i, k).forEach((value, j) => {
      if (!Number.isFinite(value)) return;
      low[j] = Math.min(low[j], value);
      high[j] = Math.max(high[j], value);
    });
    return {middle: [0, 1].map(j => (low[j] + high[j]) / 2), size: [0, 1].map(j => high[j] - low[j])};
  };

  const marker = make("marker", {id: "tip", viewBox: "0 0 4 4", refX: 3, refY: 2, markerWidth: 4, markerHeight: 4,
    orient: "auto"}, make("defs", {}, svg));
  make("path", {d: "M0,0 L4,2 L0,4 Z"}, marker);
  const behind = make("g", {}, svg), back = make("g", {}, svg), front = make("g", {}, svg), traces = new Map();
  const lines = scene.lines.map(({kind, rows, closed}) =>
    [rows, make(closed ? "polygon" : "polyline", {class: kind}, kind === "guide" ? back : front)]);
  const symbols = scene.symbols.filter(({outline}) => outline.length).map(symbol =>
    [symbol, make("path", {class: symbol.kind}, front)]);
  const kinds = new Map(scene.symbols.filter(({outline}) => !outline.length).map(({kind, at}) => [at, kind]));
  const dots = [...new Set([...scene.points.keys(), ...kinds.keys()])].map(k => {
    const {name, body} = scene.points[k] ?? {}, dot = make("circle", {class: kinds.get(k) ?? "point", r: 5}, front);
    if (name) {
      dot.setAttribute("data-point", name);
      make("title", {}, dot, body === null ? name : `${name}, ${body}`);
    }
    return [k, dot];
  });
  const arrows = scene.arrows.map(([from, to]) =>
    [from, to, make("line", {class: "arrow", "marker-end": "url(#tip)", "data-force": scene.points[from].name},
      front)]);

  // The lines of a symbol: parts of the way to the point it is directed to, and displacements along and across.
  const symbolText = (i, {outline, at, toward, shift}) => {
    const [x, y] = place(i, at), [a, b] = toward === null ? [x, y] : place(i, toward);
    const far = Math.hypot(a - x, b - y);
    const u = toward === null ? [1, 0] : far > 1e-6 ? [(a - x) / far, (b - y) / far] : [0, 0];
    const size = Math.max(7, scene.unit * scale);
    return outline.map(line => "M" + line.map(([part, along, across]) =>
      [x + part * (a - x) + size * (along * u[0] + (across + shift) * u[1]),
        y + part * (b - y) + size * (along * u[1] - (across + shift) * u[0])]
        .map(value => value.toFixed(2)).join(",")).join("L")).join("");
  };

  const way = (places, k) => {
    const count = m ? places.length / 3 / m : 0, points = [];
    for (let i = 0; i < count; ++i) points.push(placed(places, i, k, origin));
    return pointsText(points);
  };
  const drawTrace = k => {
    const {ghost, line} = traces.get(k);
    line.setAttribute("points", way(positions, k));
    ghost.setAttribute("points", before ? way(before, k) : "");
  };

  const picture = {
    // The positions of a run, and those of the run before, whose traces are ghosts.
    set(places, rows, ghost = null) {
      positions = places;
      m = rows;
      n = m ? places.length / 3 / m : 0;
      before = ghost;
      moving = [];
      for (const k of drawn) {
        let moves = false;
        for (let at = 3 * k; at < places.length && !moves; at += 3 * m) {
          moves = [0, 1, 2].some(j => Math.abs(places[at + j] - places[3 * k + j]) > STILL);
        }
        if (moves) moving.push(k);
      }
    },
    // Scale and middle, so that all positions are in the picture.
    fit() {
      const whole = extent(0, n, drawn);
      if (!Number.isFinite(whole.middle[0])) return;
      const size = [0, 0];
      if (follows) for (let i = 0; i < n; ++i) extent(i, i + 1, moving).size.forEach((value, j) => {
        if (Number.isFinite(value)) size[j] = Math.max(size[j], FOLLOWED * value);
      });
      if (!follows) size.splice(0, 2, ...whole.size);
      scale = Math.min((WIDTH - 2 * MARGIN) / (size[0] || 1e-9), (HEIGHT - 2 * MARGIN) / (size[1] || 1e-9));
      origin = whole.middle;
    },
    // Whether the mechanism goes further than a few times its size.
    travels() {
      let largest = 0;
      for (let i = 0; i < n; ++i) largest = Math.max(largest, ...extent(i, i + 1, moving).size.filter(Number.isFinite));
      return moving.length > 1 && Math.max(...extent(0, n, moving).size) > FAR * largest;
    },
    follow(on) {
      follows = on;
      picture.redraw();
    },
    trace(k, on) {
      if (on && !traces.has(k)) {
        const ghost = make("polyline", {class: "ghost"}, behind), line = make("polyline", {class: "trace"}, behind);
        traces.set(k, {ghost, line});
        drawTrace(k);
      } else if (!on && traces.has(k)) {
        Object.values(traces.get(k)).forEach(line => line.remove());
        traces.delete(k);
      }
    },
    drawTraces() {
      for (const k of traces.keys()) drawTrace(k);
    },
    draw(i) {
      shown = i;
      const own = follows ? extent(i, i + 1, moving).middle : origin;
      middle = Number.isFinite(own[0] + own[1]) ? own : origin;
      const shift = [scale * (origin[0] - middle[0]), -scale * (origin[1] - middle[1])];
      behind.setAttribute("transform", `translate(${shift.map(value => value.toFixed(2)).join()})`);
      for (const [k, dot] of dots) {
        const [x, y] = place(i, k);
        dot.setAttribute("visibility", Number.isFinite(x + y) ? "visible" : "hidden");
        if (!Number.isFinite(x + y)) continue;
        dot.setAttribute("cx", x.toFixed(3));
        dot.setAttribute("cy", y.toFixed(3));
      }
      for (const [rows, line] of lines) line.setAttribute("points", pointsText(rows.map(k => place(i, k))));
      for (const [symbol, path] of symbols) {
        const text = symbolText(i, symbol);
        path.setAttribute("d", text.includes("NaN") ? "" : text);
      }
      for (const [from, to, line] of arrows) {
        const [a, b] = [place(i, from), place(i, to)];
        // A force of no length has no direction.
        const visible = Math.hypot(a[0] - b[0], a[1] - b[1]) >= 1;
        line.setAttribute("visibility", visible ? "visible" : "hidden");
        [a, b].forEach((end, number) => ["x", "y"].forEach((axis, j) => Number.isFinite(end[j]) &&
          line.setAttribute(`${axis}${number + 1}`, end[j].toFixed(3))));
      }
    },
    redraw() {
      picture.fit();
      picture.drawTraces();
      picture.draw(shown);
    },
  };

  if (!scene.planar) {
    let held = null;
    svg.style.touchAction = "none";
    const rotate = (across, up) => {
      turn += across;
      tilt += up;
      picture.redraw();
    };
    svg.addEventListener("pointerdown", event => {
      held = [event.clientX, event.clientY];
      svg.setPointerCapture(event.pointerId);
    });
    svg.addEventListener("pointermove", event => {
      if (!held) return;
      rotate((event.clientX - held[0]) / 150, (event.clientY - held[1]) / 150);
      held = [event.clientX, event.clientY];
    });
    for (const name of ["pointerup", "pointercancel"]) svg.addEventListener(name, () => { held = null; });
    svg.setAttribute("tabindex", 0);
    svg.addEventListener("keydown", event => {
      const turns = {ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1]};
      if (!(event.key in turns) || event.ctrlKey || event.altKey || event.metaKey) return;
      rotate(...turns[event.key]);
      event.preventDefault();
      event.stopPropagation();
    });
  }
  return picture;
};

// The least and largest of the finite values of curves; infinite if there are none.
const rangeOf = curves => {
  let low = Infinity, high = -Infinity;
  for (const curve of curves) for (const value of curve) if (Number.isFinite(value)) {
    low = Math.min(low, value);
    high = Math.max(high, value);
  }
  return [low, high];
};

// Curves over time in a section, with a legend that shows the values at the cursor, which follows the pointer: `seek`
// takes the number of a time. Widths are pixels of the page, so that labels are legible everywhere.
const COLORS = 8;
// Smaller values, relative to the largest in the same axes, are rounding errors.
const NOISE = 1e-12;
// Ranges below this, relative to the largest value in the same axes, are no motion.
const AT_REST = 1e-9;
const timePlot = (section, {title, log, names, bodies}, seek) => {
  const LEFT = 62, RIGHT = 8, TOP = 8, BOTTOM = 24, TALL = 170;
  const svg = make("svg", {role: "img", "aria-label": title, height: TALL}, section);
  // Many names are folded, so that plots stay close together. A click hides and shows their curves, and those that do not
  // move are hidden at first.
  const isMany = names.length > COLORS, fold = isMany ? make("details", {}, section) : section;
  const summary = isMany ? make("summary", {}, fold, `${names.length} curves`) : null, chosen = [], legends = new Map();
  const legendOf = body => {
    if (!legends.has(body)) {
      legends.set(body, make("div", {class: "controls"}, fold));
      if (body) make("strong", {}, legends.get(body), body);
    }
    return legends.get(body);
  };
  const entries = names.map((name, c) => {
    const entry = make(isMany ? "button" : "span", isMany ? {type: "button", class: "name"} : {}, legendOf(bodies[c] ?? ""));
    make("span", {style: `color: var(--curve${c % COLORS})`, "aria-hidden": "true"}, entry, "\u2501 ");
    entry.append(`${name} `);
    if (isMany) entry.addEventListener("click", () => {
      chosen[c] = !isShown(c);
      plot.draw();
      plot.show(instant);
    });
    return entry;
  });
  const outputs = entries.map(entry => make("output", {}, entry));
  let times = [], curves = [], ghosts = null, marks = [], across = () => LEFT, cursor = null, greatest = 0, instant = 0;
  let moves = [];
  const isShown = c => !isMany || (chosen[c] ?? moves[c]);
  const plot = {
    // Times, values of each curve, and of the run before; events, and the curves that are zero there, or -1.
    set(at, values, before = null, events = []) {
      times = at;
      curves = values;
      if (isMany) {
        const least = AT_REST * Math.max(...rangeOf(curves).map(Math.abs));
        moves = curves.map(curve => rangeOf([curve])).map(([low, high]) => high - low > least);
        if (!moves.includes(true)) moves.fill(true);
      }
      ghosts = before;
      marks = events;
    },
    draw() {
      const width = Math.max(240, svg.getBoundingClientRect().width), n = times.length;
      const first = n ? Math.min(times[0], times[n - 1]) : 0, last = n ? Math.max(times[0], times[n - 1]) : 0;
      svg.replaceChildren();
      svg.setAttribute("viewBox", `0 0 ${width} ${TALL}`);
      let [low, high] = rangeOf(curves.filter((_, c) => isShown(c)));
      if (low > high) [low, high] = [0, 1];
      greatest = Math.max(Math.abs(low), Math.abs(high));
      if (log) { low = Math.floor(low); high = Math.max(Math.ceil(high), low + 1); }
      if (!(high - low > 1e-12 * Math.max(Math.abs(low), Math.abs(high)))) {
        const half = 0.5 * Math.max(1, 1e-9 * Math.abs(low));
        low -= half;
        high += half;
      }
      across = t => LEFT + (width - LEFT - RIGHT) * (last > first ? (t - first) / (last - first) : 0.5);
      const up = value => TALL - BOTTOM - (TALL - TOP - BOTTOM) * (value - low) / (high - low);
      for (const tick of ticksBetween(low, high, 4, log ? 1 : 0)) {
        make("line", {class: "grid", x1: LEFT, x2: width - RIGHT, y1: up(tick), y2: up(tick)}, svg);
        make("text", {x: LEFT - 6, y: up(tick) + 4, "text-anchor": "end"}, svg,
          log ? `1e${numberText(tick)}` : numberText(tick));
      }
      if (last > first) for (const tick of ticksBetween(first, last, Math.max(2, width / 120))) {
        make("line", {class: "grid", x1: across(tick), x2: across(tick), y1: TOP, y2: TALL - BOTTOM}, svg);
        make("text", {x: across(tick), y: TALL - 8, "text-anchor": "middle"}, svg, numberText(tick));
      }
      const line = (at, values, style) => {
        const points = [];
        for (let i = 0; i < at.length; ++i) if (Number.isFinite(values[i]) && at[i] >= first && at[i] <= last) {
          points.push(`${across(at[i]).toFixed(1)},${Math.max(-99, Math.min(999, up(values[i]))).toFixed(1)}`);
        }
        make("polyline", {...style, points: points.join(" ")}, svg);
      };
      if (ghosts) ghosts.curves.forEach((values, c) => isShown(c) &&
        line(ghosts.times, values, {class: "curve ghost", style: `stroke: var(--curve${c % COLORS})`}));
      curves.forEach((values, c) => isShown(c) && line(times, values, {class: "curve", style: `stroke: var(--curve${c % COLORS})`}));
      for (const {t, text, curve} of marks) {
        const mark = make("g", {class: "event"}, svg), x = across(t).toFixed(1);
        make("line", {x1: x, x2: x, y1: TOP, y2: TALL - BOTTOM}, mark);
        if (curve >= 0 && isShown(curve)) make("circle", {cx: x, cy: up(0), r: 4, style: `stroke: var(--curve${curve % COLORS})`}, mark);
        make("title", {}, mark, text);
      }
      cursor = make("line", {class: "cursor", y1: TOP, y2: TALL - BOTTOM}, svg);
      if (!isMany) return;
      entries.forEach((entry, c) => entry.setAttribute("aria-pressed", isShown(c)));
      const hidden = entries.filter((_, c) => !isShown(c)).length;
      summary.textContent = `${names.length} curves` + (hidden ? `, ${hidden} of them hidden` : "");
    },
    // The cursor at a time of the run.
    show(i) {
      instant = i;
      if (!cursor || !(i < times.length)) return;
      cursor.setAttribute("x1", across(times[i]));
      cursor.setAttribute("x2", across(times[i]));
      curves.forEach((curve, c) => {
        outputs[c].textContent = !Number.isFinite(curve[i]) ? "" :
          log ? (10 ** curve[i]).toExponential(1) : Math.abs(curve[i]) < NOISE * greatest ? "0" : numberText(curve[i]);
      });
    },
  };
  const follow = event => {
    if (!times.length || !(event.buttons & 1)) return;
    const x = event.clientX - svg.getBoundingClientRect().left;
    let nearest = 0;
    for (let i = 1; i < times.length; ++i) {
      if (Math.abs(across(times[i]) - x) < Math.abs(across(times[nearest]) - x)) nearest = i;
    }
    seek(nearest);
  };
  for (const name of ["pointerdown", "pointermove"]) svg.addEventListener(name, follow);
  return plot;
};

// Plays a run: buttons, the slider of time, and keys. `show` draws the state of a number.
const player = show => {
  const scrub = byId("scrub"), play = byId("play");
  let times = [0], shown = 0, playing = false, clock = 0, since = 0, decimals = 3;
  const begin = () => { clock = performance.now(); since = Math.abs(times[shown] - times[0]); };
  const controls = {
    // The times of a run; the number of the shown state is kept, if there is such a state.
    set(at) {
      times = at;
      const length = Math.abs(times[times.length - 1] - times[0]);
      decimals = Math.min(15, length > 0 ? Math.max(3, 3 - Math.floor(Math.log10(length))) : 3);
      scrub.max = times.length - 1;
      shown = Math.min(shown, times.length - 1);
    },
    show(i) {
      shown = Math.max(0, Math.min(times.length - 1, i));
      scrub.value = shown;
      const text = `t = ${times[shown].toFixed(decimals)} s`;
      byId("time").textContent = text;
      scrub.setAttribute("aria-valuetext", text);
      show(shown);
    },
    shown: () => shown,
    seek(i) {
      controls.play(false);
      controls.show(i);
    },
    play(on) {
      playing = on;
      play.textContent = on ? "Pause" : "Play";
      play.setAttribute("aria-pressed", on);
      if (!on) return;
      if (shown === times.length - 1) controls.show(0);
      begin();
      requestAnimationFrame(advance);
    },
  };
  const advance = now => {
    if (!playing) return;
    const elapsed = since + Math.max(0, now - clock) / 1000 * Number(byId("speed").value), last = times.length - 1;
    let i = shown;
    while (i < last && Math.abs(times[i + 1] - times[0]) <= elapsed) ++i;
    if (i !== shown) controls.show(i);
    if (i >= last) controls.play(false); else requestAnimationFrame(advance);
  };
  play.addEventListener("click", () => controls.play(!playing));
  scrub.addEventListener("input", () => controls.seek(Number(scrub.value)));
  byId("speed").addEventListener("change", begin);
  document.addEventListener("keydown", event => {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    if (event.target.closest("input, select, button, summary, a, [tabindex]")) return;
    const moves = {ArrowRight: shown + 1, ArrowLeft: shown - 1, Home: 0, End: times.length - 1};
    if (event.key === " ") controls.play(!playing);
    else if (event.key in moves) controls.seek(moves[event.key]);
    else return;
    event.preventDefault();
  });
  return controls;
};

// Whether the picture follows a mechanism that goes far, in a box that is hidden for others.
const followBox = (box, picture) => {
  const far = picture.travels();
  box.closest("label").hidden = !far;
  box.checked = far;
  picture.follow(far);
  box.addEventListener("change", () => picture.follow(box.checked));
};

// A box for each point, that shows and hides its trace; many are folded, and stand behind the name of their body, which
// checks all of them or none.
const FEW_POINTS = 12;
const traceBoxes = (parent, points, picture, changed = () => {}) => {
  const fold = parent.closest("details"), isMany = points.length > FEW_POINTS, groups = new Map();
  if (fold?.classList.contains("few")) fold.open = !isMany;
  if (isMany && points.some(({holder}) => !holder)) groups.set("", {place: make("div", {class: "controls"}, parent), boxes: []});
  const groupOf = holder => {
    if (!isMany) return {place: parent, boxes: []};
    if (!groups.has(holder)) {
      const place = make("div", {class: "controls"}, parent), boxes = [];
      make("strong", {}, make("button", {type: "button", class: "name", "aria-label": `Traces of ${holder}`}, place), holder).parentElement
        .addEventListener("click", () => {
          const on = !boxes.every(({checked}) => checked);
          for (const box of boxes) if (box.checked !== on) box.click();
        });
      groups.set(holder, {place, boxes});
    }
    return groups.get(holder);
  };
  return points.map(({name, traced, holder}, k) => {
    const {place, boxes} = groupOf(holder), label = make("label", {}, place);
    const box = make("input", {type: "checkbox"}, label);
    label.append(` ${name}`);
    boxes.push(box);
    box.checked = traced;
    picture.trace(k, traced);
    box.addEventListener("change", () => { picture.trace(k, box.checked); changed(); });
    return box;
  });
};
