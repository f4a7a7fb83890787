// A live page: settings -> a run -> pictures, plots and figures.

let settings = defaults();
document.documentElement.dataset.runs = 0; // how many have ended, for scripts that wait for one
// The run that is shown, and the one before the last change, which stays as a ghost.
let shownRun = null, before = null;
// No slider is held.
let settled = true;
// What a link has that the page does not know.
let unknownWords = "";
// For each assembly mode a closed initial state with its settings, from which it is followed: the last one.
let closedPoints = data.modes.map((_, mode) => beginningOf(mode));

// Runs, one at a time; of the moves during a run, only the last one counts.

const PATIENCE = 400, LIMIT = 20000; // ms, for a run that others wait for, and for any
const engine = engineCaller(data.wasm);
let busy = false, waiting = false, stopped = false, began = 0, runs = 0;
const stop = (text = "") => {
  stopped = true;
  if (text) say(text);
  engine.restart();
};
const update = async () => {
  if (busy) {
    const left = Math.max(0, PATIENCE - (performance.now() - began));
    if (!waiting) setTimeout(number => { if (busy && number === runs) stop(); }, left, runs);
    waiting = true;
    return;
  }
  busy = true;
  began = performance.now();
  ++runs;
  const {mode} = settings, points = closedPoints, request = requestOf(settings, points[mode]);
  const asked = structuredClone(settings);
  const limit = setTimeout(() => stop(`The run takes longer than ${LIMIT / 1000} s and was stopped: shorten it, or ` +
    "make the equations less stiff."), LIMIT);
  try {
    const run = await engine.ask("run", request);
    if (run.closed) points[mode] = {...pointOf(asked), x: Array.from(run.x0)};
    if (run.n) show({...run, settings: asked});
    say([sentence(run), unknownWords].filter(Boolean).join(" "));
    byId("mechanism").classList.toggle("stale", !run.n);
    if (settled && !waiting) writeLink();
    ++document.documentElement.dataset.runs;
  } catch (error) {
    if (!stopped) say(`${error.message}.`);
    byId("mechanism").classList.toggle("stale", !waiting);
  }
  clearTimeout(limit);
  busy = stopped = false;
  if (waiting) {
    waiting = false;
    update();
  }
};

// While a slider is held, the run before it was taken stays as a ghost, and the picture keeps its scale.
const moved = () => {
  if (settled) before = shownRun;
  settled = false;
  update();
};
const released = () => {
  settled = true;
  if (busy) return;
  if (shownRun) show(shownRun);
  writeLink();
};

// What the page says about a run that does not end as it should.

const say = text => { if (byId("status").textContent !== text) byId("status").textContent = text; };
// As for runs in Python (GROWN in simulation/integrate.py): the final kinetic energy is a thousand times both the largest
// of the first half and the range of the potential energy, and more than what rounding errors make of this.
const grown = run => {
  const kinetic = columnOf(run, data.energies), potential = columnOf(run, data.energies + 1);
  const early = Math.max(...kinetic.subarray(0, Math.ceil(run.n / 2)));
  const range = Math.max(...potential) - Math.min(...potential) || 0;
  const size = Math.max(early, range);
  const last = kinetic[run.n - 1], visible = 1e-5 * Math.abs(potential[run.n - 1]) || 0;
  return size > 0 && last > Math.max(1000 * size, visible);
};
const LOST = "The assembly mode could not be followed to these values: another one may be shown.";
const touching = (name, t) => `${name} is zero at t = ${numberText(t)} s, to within rounding errors, with the same sign ` +
  "before and after it, which is no event.";
const sentence = run => {
  if (!run.closed) {
    return `The mechanism cannot be assembled with these values: ${run.message}. The picture shows the last values ` +
      "with which it can: move the last one back, or choose another assembly mode.";
  }
  return [run.lost ? LOST : "",
    run.status === 0 ? "" : `The run ends at t = ${numberText(run.reached)} s: ${run.message}.`,
    run.ended_by < 0 ? "" : `${data.events[run.ended_by].name} ends the run at t = ${numberText(run.reached)} s.`,
    ...data.events.map(({name}, i) => Number.isFinite(run.touched[i]) ? touching(name, run.touched[i]) : ""),
    run.n_events > run.events.length ? `Of ${run.n_events} events, the first ${run.events.length} are shown.` : "",
    grown(run) ? "The energy has grown a thousandfold: loads feed the motion, or integration errors do." : ""]
    .filter(Boolean).join(" ");
};

// Positions of all rows of the picture: points, the ends of guides, and the tips of forces.

const turned = ([x, y, z]) => data.turn.map(row => row[0] * x + row[1] * y + row[2] * z);
const positionsOf = run => {
  const {points, guides, forces} = data, m = data.rows, found = new Float64Array(3 * run.n * m);
  const given = (i, k) => { // of points, then of forces
    const at = i * run.length + data.columns.length + 3 * k;
    return turned(run.rows.subarray(at, at + 3));
  };
  for (let i = 0; i < run.n; ++i) {
    for (let k = 0; k < points; ++k) found.set(given(i, k), 3 * (i * m + k));
  }
  guides.forEach((guide, g) => placeGuide(found, run.n, m, guide, points + 2 * g));
  // The scale of forces is kept while a slider is held: their greatest is a part of the mechanism's size.
  if (settled || !arrowScale) {
    let greatest = 0;
    for (let i = 0; i < run.n; ++i) forces.forEach((_, k) => {
      const size = Math.hypot(...given(i, points + k));
      if (Number.isFinite(size)) greatest = Math.max(greatest, size);
    });
    arrowScale = greatest > 0 ? data.arrow * data.size / greatest : 0;
  }
  for (let i = 0; i < run.n; ++i) forces.forEach((from, k) => {
    const force = given(i, points + k), at = 3 * (i * m + m - forces.length + k);
    for (let j = 0; j < 3; ++j) found[at + j] = found[3 * (i * m + from) + j] + (arrowScale * force[j] || 0);
  });
  return found;
};
let arrowScale = 0;

// The rotation matrix of a body at a time, or of the inertial frame after the bodies, in the coordinates of the view.
const turnOfRun = run => (i, k) => {
  const at = i * run.length + data.columns.length + 3 * (data.points + data.forces.length) + 9 * k;
  const given = k < data.bodies ? run.rows.subarray(at, at + 9) : [1, 0, 0, 0, 1, 0, 0, 0, 1];
  return [0, 1, 2].flatMap(j => turned([given[j], given[3 + j], given[6 + j]]));
};
// The ends of a guide that is as long as the way of the point that slides on it, and a margin.
const placeGuide = (found, n, m, [sliding, base, tip], at) => {
  const point = (i, k) => found.subarray(3 * (i * m + k), 3 * (i * m + k) + 3);
  const ways = [], along = [], margin = 2 * data.scene.unit;
  for (let i = 0; i < n; ++i) {
    const a = point(i, base), b = point(i, tip), p = point(i, sliding);
    const length = Math.hypot(b[0] - a[0], b[1] - a[1], b[2] - a[2]);
    along.push([0, 1, 2].map(j => (b[j] - a[j]) / length));
    ways.push([0, 1, 2].reduce((sum, j) => sum + (p[j] - a[j]) * along[i][j], 0));
  }
  const low = Math.min(...ways) - margin, high = Math.max(...ways) + margin;
  for (let i = 0; i < n; ++i) for (let j = 0; j < 3; ++j) {
    point(i, at)[j] = point(i, sliding)[j] + (low - ways[i]) * along[i][j];
    point(i, at + 1)[j] = point(i, sliding)[j] + (high - ways[i]) * along[i][j];
  }
};

// Picture and plots.

if (data.scene.planar) byId("turn").remove();
const picture = pictureOf(byId("mechanism"), data.scene);
const boxes = traceBoxes(byId("traces"), data.scene.points, picture, () => writeLink());
const controls = player(i => {
  picture.draw(i);
  for (const plot of plots) plot.show(i);
});
// Those that are open and in the window are drawn.
const inWindow = new Set();
const plots = data.panels.map(panel => {
  const {title, log, columns, open, bodies} = panel, details = make("details", {}, byId("plots"));
  make("summary", {}, details, title);
  details.open = open;
  const plot = timePlot(details, {title, log, names: columns.map(k => data.columns[k]), bodies}, i => controls.seek(i));
  const curves = run => columns.map(k => columnOf(run, k))
    .map(values => log ? values.map(value => Math.log10(Math.max(value, 2 ** -53))) : values);
  const draw = () => {
    if (!shownRun || !details.open || !inWindow.has(details)) return;
    plot.set(shownRun.times, curves(shownRun), before && {times: before.times, curves: curves(before)},
      shownRun.events.map(({event, t}) => ({t, text: `${data.events[event].name} at t = ${digits(t)} s`,
        curve: columns.indexOf(data.events[event].column)})));
    plot.draw();
    plot.show(controls.shown());
  };
  details.addEventListener("toggle", () => { draw(); writeLink(); });
  return {details, draw, show: i => details.open && plot.show(i), isOpenAtFirst: open};
});
const drawPlots = () => { for (const plot of plots) plot.draw(); };
const observer = new IntersectionObserver(entries => {
  for (const {target, isIntersecting} of entries) inWindow[isIntersecting ? "add" : "delete"](target);
  drawPlots();
}, {rootMargin: "200px"});
for (const {details} of plots) observer.observe(details);
let width = innerWidth;
addEventListener("resize", () => {
  if (innerWidth !== width) drawPlots();
  width = innerWidth;
});

const show = run => {
  const isFirst = shownRun === null;
  shownRun = {...run, positions: positionsOf(run)};
  picture.set(shownRun.positions, data.rows, before && before.positions, turnOfRun(run), run.settings.parameters);
  if (isFirst) followBox(byId("follow"), picture);
  else if (settled) picture.fit();
  picture.drawTraces();
  controls.set(run.times);
  drawPlots();
  controls.show(controls.shown());
  drawFigures();
  drawEvents();
  byId("cost").textContent = `${run.evaluations} evaluations, ${run.duration.toFixed(1)} ms`;
  if (!byId("code").hidden) byId("code").textContent = pythonLines();
  if (isFirst) performance.mark("first picture");
};

// Figures: a statistic of a quantity over the run, and its change.

const STATISTICS = {
  "greatest": values => Math.max(...values),
  "least": values => Math.min(...values),
  "greatest magnitude": values => Math.max(...values.map(Math.abs)),
  "range": values => Math.max(...values) - Math.min(...values),
  "mean": (values, times) => {
    let sum = 0;
    for (let i = 1; i < values.length; ++i) sum += 0.5 * (values[i] + values[i - 1]) * (times[i] - times[i - 1]);
    return times.length > 1 ? sum / (times[times.length - 1] - times[0]) : values[0];
  },
  "last": values => values[values.length - 1],
};
let figures = structuredClone(data.figures);
const valueOf = (run, [statistic, name]) =>
  STATISTICS[statistic](columnOf(run, data.columns.indexOf(name)), run.times);
const digits = value => Number.isFinite(value) ? String(Number(value.toPrecision(6))) : "";
const signed = value => `${value < 0 ? "\u2212" : "+"}${Number(Math.abs(value).toPrecision(3))}`;
const changeText = (value, old) => {
  if (!Number.isFinite(value - old) || value === old) return "";
  const percent = 100 * (value - old) / Math.abs(old);
  return signed(value - old) + (Math.abs(percent) < 1000 ? ` (${signed(percent)} %)` : "");
};
const drawFigures = () => {
  const body = byId("figures");
  if (body.rows.length !== figures.length) {
    body.replaceChildren();
    for (const figure of figures) {
      const row = make("tr", {}, body), text = `${figure[0]}, ${figure[1]}`;
      make("th", {scope: "row"}, row, text);
      make("td", {}, row);
      make("td", {}, row);
      make("button", {type: "button", "aria-label": `Remove ${text}`}, make("td", {}, row), "\u00d7")
        .addEventListener("click", () => {
          const number = figures.indexOf(figure);
          setFigures(figures.filter(each => each !== figure));
          (body.querySelectorAll("button")[number] ?? byId("add")).focus();
        });
    }
  }
  if (shownRun) figures.forEach((figure, number) => {
    const value = valueOf(shownRun, figure), {cells} = body.rows[number];
    cells[1].textContent = digits(value);
    cells[2].textContent = before ? changeText(value, valueOf(before, figure)) : "";
  });
};
const setFigures = chosen => {
  figures = chosen;
  byId("figures").replaceChildren();
  drawFigures();
  if (!busy) writeLink();
};

// The times of events.

const TIMES_SHOWN = 12;
if (!data.events.length) byId("occurred").remove();
const eventCells = data.events.map(({name}) => {
  const row = make("tr", {}, byId("events"));
  make("th", {scope: "row"}, row, name);
  return [make("td", {}, row), make("td", {}, row)];
});
const drawEvents = () => eventCells.forEach(([count, at], number) => {
  const times = foundOf(shownRun, number).map(({t}) => digits(t));
  count.textContent = times.length;
  at.textContent = [...times.slice(0, TIMES_SHOWN), ...times.length > TIMES_SHOWN ? ["..."] : []].join(", ");
});

for (const name in STATISTICS) make("option", {}, byId("statistic"), name);
for (const name of data.columns) make("option", {}, byId("quantity"), name);
byId("add").addEventListener("click", () => {
  const figure = [byId("statistic").value, byId("quantity").value];
  if (!figures.some(known => known.join() === figure.join())) setFigures([...figures, figure]);
});
