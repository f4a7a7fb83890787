// The controls of a live page: sliders with numbers, inputs, assembly modes.

// Functions that show the settings in their controls.
const shows = [];
const showSettings = () => { for (const each of shows) each(); };

let sliders = 0;
// A slider with a box for its number, which may leave the slider's range. Returns a function that shows a value.
const slider = (parent, {label, note = "", low, high, value}, set) => {
  const id = `slider${++sliders}`, row = make("div", {class: "row"}, parent);
  const title = make("div", {}, row);
  make("label", {for: id}, title, label);
  title.append(" ");
  make("small", {id: `${id}-note`}, title, note);
  const range = make("input", {type: "range", id, step: "any", "aria-describedby": `${id}-note`}, row);
  // Numbers with few digits, about 500 of them along the slider.
  const step = 10 ** Math.floor(Math.log10((high - low) / 500));
  const box = make("input", {type: "number", step, "aria-label": `${label}, number`}, row);
  let current = value;
  const showValue = number => {
    current = number;
    range.min = Math.min(low, number);
    range.max = Math.max(high, number);
    range.value = number;
    range.setAttribute("aria-valuetext", digits(number));
    if (box.value === "" || Number(box.value) !== number) box.value = Number(number.toPrecision(6));
  };
  const change = number => {
    if (number === current) return;
    showValue(number);
    set(number);
    moved();
  };
  const rounded = number => Number((Math.round(number / step) * step).toPrecision(12));
  range.addEventListener("input", () => change(rounded(Number(range.value))));
  range.addEventListener("change", () => released());
  range.addEventListener("keydown", event => {
    const steps = {ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -10, PageUp: 10};
    if (!(event.key in steps) || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    const next = rounded(current + steps[event.key] * (high - low) / 100);
    change(Math.max(Number(range.min), Math.min(Number(range.max), next)));
    released();
  });
  box.addEventListener("change", () => {
    const number = box.value === "" ? NaN : Number(box.value);
    if (!Number.isFinite(number)) {
      box.value = "";
      showValue(current);
      return;
    }
    change(number);
    released();
  });
  showValue(value);
  return showValue;
};

const group = (title, open) => {
  const details = make("details", {}, byId("groups"));
  make("summary", {}, details, title);
  details.open = open;
  return details;
};
const choice = (parent, label, options, set) => {
  const select = make("select", {}, make("label", {class: "choice"}, parent, `${label} `));
  for (const [value, text] of options) make("option", {value}, select, text);
  select.addEventListener("change", () => {
    set(select.value);
    moved();
    released();
  });
  return select;
};

if (data.modes.length > 1) {
  // With the initial values of two coordinates that tell them apart.
  const differs = i => data.modes.some(x => Math.abs(x[i] - data.modes[0][i]) > 0.01);
  const telling = [...dependent.keys()].filter(i => i < data.n_q && dependent[i] && differs(i)).slice(0, 2);
  const options = data.modes.map((x, mode) =>
    [mode, `${mode + 1}: ${telling.map(i => `${data.states[i]} = ${x[i].toFixed(2)}`).join(", ")}`]);
  const select = choice(byId("groups"), "Assembly mode", options, value => {
    settings.mode = Number(value);
    closedPoints[settings.mode] = beginningOf(settings.mode);
  });
  shows.push(() => { select.value = settings.mode; });
}

if (data.parameters.length) {
  const parent = group("Parameters", true);
  for (const {name, unit, description, low, high, value} of data.parameters) {
    const label = unit ? `${name} (${unit})` : name;
    const showValue = slider(parent, {label, note: description, low, high, value},
      number => { settings.parameters[name] = number; });
    shows.push(() => showValue(settings.parameters[name]));
  }
}

if (data.initial.length) {
  const parent = group("Initial values", true);
  for (const {name, low, high, value} of data.initial) {
    const showValue = slider(parent, {label: name, low, high, value}, number => { settings.initial[name] = number; });
    shows.push(() => showValue(settings.initial[name]));
  }
}

// What an input begins as if it becomes another function of time, and the ranges of its coefficients.
const signalOf = (kind, input) => {
  const {scale, signal} = input;
  const [begin, end] = settings.t_span, middle = 0.5 * (begin + end), length = Math.abs(end - begin) || 1;
  const values = {expression: [], constant: signal.kind === "constant" ? signal.values : [scale],
    sine: [0, scale, 1 / length, 0], step: [0, scale, middle], ramp: [0, scale, begin, middle], line: [0, scale]};
  return signalWith(kind, [...values[kind] ?? []], input);
};
const coefficientRange = (name, scale) => {
  const [begin, end] = settings.t_span, length = Math.abs(end - begin) || 1;
  const ranges = {time: [begin, end], begin: [begin, end], end: [begin, end], frequency: [0, 10 / length],
    phase: [-Math.PI, Math.PI]};
  const [low, high] = ranges[name] ?? [-2 * scale, 2 * scale];
  return low < high ? [low, high] : [high - length, low + length];
};
const showSignals = [];
const NOTES = {frequency: "1/s", phase: "rad", time: "s", begin: "s", end: "s"};
if (data.inputs.length) {
  const all = group("Inputs", true);
  for (const input of data.inputs) {
    const {name, expression, kinds, scale} = input, parent = make("fieldset", {}, all);
    make("legend", {}, parent, name);
    const options = kinds.map(kind => [kind, kind === "expression" ? expression : KINDS[kind].title]);
    const select = choice(parent, "As", options, kind => {
      settings.inputs[name] = signalOf(kind, input);
      showSignal();
    });
    const rows = make("div", {}, parent);
    const showSignal = () => {
      const {kind, values} = settings.inputs[name];
      select.value = kind;
      rows.replaceChildren();
      KINDS[kind].names.forEach((coefficient, k) => {
        const [low, high] = coefficientRange(coefficient, scale), label = `${name}, ${coefficient}`;
        slider(rows, {label, note: NOTES[coefficient], low, high, value: values[k]},
          number => { settings.inputs[name].values[k] = number; });
      });
    };
    shows.push(showSignal);
    showSignals.push(showSignal);
    showSignal();
  }
}

{
  const setTime = (which, number) => {
    settings.t_span[which] = number;
    for (const each of showSignals) each(); // the ranges of times and frequencies follow
  };
  const parent = group("Time", true), [begin, end] = data.t_span, length = end - begin || 1;
  const [low, high] = [begin + 0.1 * length, begin + 4 * length].toSorted((a, b) => a - b);
  const showEnd = slider(parent, {label: "End", note: "s", low, high, value: end},
    number => setTime(1, number));
  const ends = {low: Math.min(begin, end), high: Math.max(begin, end, begin + length)};
  const showBegin = slider(parent, {label: "Begin", note: "s", ...ends, value: begin},
    number => setTime(0, number));
  shows.push(() => { showEnd(settings.t_span[1]); showBegin(settings.t_span[0]); });
}

// Everything as the page began. A run that goes on ends with the old closed states, which nobody needs any more.
const startAnew = () => {
  before = shownRun;
  settled = true;
  unknownWords = "";
  settings = defaults();
  closedPoints = data.modes.map((_, mode) => beginningOf(mode));
  data.scene.points.forEach(({traced}, k) => { boxes[k].checked = traced; picture.trace(k, traced); });
  for (const {details, isOpenAtFirst} of plots) details.open = isOpenAtFirst;
  setFigures(structuredClone(data.figures));
};
byId("reset").addEventListener("click", () => {
  startAnew();
  showSettings();
  update();
});
