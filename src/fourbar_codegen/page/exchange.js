// What a live page gives to others: a link with all settings, CSV, lines of Python, and window.fourbar for scripts.

// The settings that differ from the page's own, as the part of an address behind #.
const linkText = () => {
  const words = new URLSearchParams(), usual = defaults();
  for (const [letter, kind] of [["p", "parameters"], ["i", "initial"]]) {
    for (const [name, value] of Object.entries(settings[kind])) {
      if (value !== usual[kind][name]) words.set(`${letter}.${name}`, value);
    }
  }
  for (const [name, {kind, values}] of Object.entries(settings.inputs)) {
    const text = [kind, ...values].join(), own = usual.inputs[name];
    if (text !== [own.kind, ...own.values].join()) words.set(`r.${name}`, text);
  }
  if (settings.t_span.join() !== usual.t_span.join()) words.set("t", settings.t_span.join());
  if (settings.mode) words.set("mode", settings.mode);
  // The dependent states tell how the assembly mode was followed.
  if (words.size && dependent.some(Boolean)) {
    const guess = closedPoints[settings.mode].x.filter((_, i) => dependent[i]);
    words.set("guess", guess.map(value => Number(value.toPrecision(9))).join());
  }
  const numbersOf = flags => flags.flatMap((flag, k) => flag ? [k] : []).join();
  const traces = numbersOf(boxes.map(box => box.checked)), open = numbersOf(plots.map(({details}) => details.open));
  if (traces !== numbersOf(data.scene.points.map(({traced}) => traced))) words.set("traces", traces);
  if (open !== numbersOf(plots.map(({isOpenAtFirst}) => isOpenAtFirst))) words.set("plots", open);
  if (JSON.stringify(figures) !== JSON.stringify(data.figures)) words.set("figures", JSON.stringify(figures));
  return words.toString();
};
let written = "";
const writeLink = () => {
  written = linkText();
  try {
    history.replaceState(null, "", written ? `#${written}` : location.pathname + location.search);
  } catch { /* in a frame */ }
};

const numbersIn = text => text === "" ? [] : text.split(",").map(word => word.trim() === "" ? NaN : Number(word));
// Takes over one setting of a link; false if the page does not know it.
const readWord = (key, value) => {
  const letter = key.slice(0, 2), name = key.slice(2), numbers = numbersIn(value);
  const finite = numbers.every(Number.isFinite);
  const kept = {"p.": settings.parameters, "i.": settings.initial}[letter];
  if (kept) {
    if (!Object.hasOwn(kept, name) || numbers.length !== 1 || !finite) return false;
    kept[name] = numbers[0];
  } else if (letter === "r.") {
    const input = data.inputs.find(each => each.name === name), [kind, ...words] = value.split(",");
    if (!input || !input.kinds.includes(kind)) return false;
    const values = numbersIn(words.join());
    if (values.length !== KINDS[kind].names.length || !values.every(Number.isFinite)) return false;
    settings.inputs[name] = signalWith(kind, values, input);
  } else if (key === "t") {
    if (numbers.length !== 2 || !finite) return false;
    settings.t_span = numbers;
  } else if (key === "mode") {
    if (numbers.length !== 1 || !data.modes[numbers[0]]) return false;
    [settings.mode] = numbers;
  } else if (key === "traces") boxes.forEach((box, k) => {
    box.checked = numbers.includes(k);
    picture.trace(k, box.checked);
  });
  else if (key === "plots") plots.forEach(({details}, k) => { details.open = numbers.includes(k); });
  else if (key === "figures") {
    try {
      const known = ([statistic, name_]) => Object.hasOwn(STATISTICS, statistic) && data.columns.includes(name_);
      const given = JSON.parse(value);
      if (!given.every(known)) return false;
      figures = given.filter((each, k) => given.findIndex(other => other.join() === each.join()) === k);
      byId("figures").replaceChildren();
    } catch { return false; }
  } else return key === "guess";
  return true;
};
// Takes over the settings of a link, and runs; what it does not know is left out, and said.
const readLink = text => {
  const words = new URLSearchParams(text);
  startAnew();
  const unknown = [...words].filter(([key, value]) => !readWord(key, value)).map(([key]) => key);
  const guess = numbersIn(words.get("guess") ?? "");
  if (guess.length === dependent.filter(Boolean).length && guess.every(Number.isFinite)) {
    let k = 0;
    const point = pointOf(settings);
    closedPoints[settings.mode] = {...point, x: point.x.map((value, i) => dependent[i] ? guess[k++] : value)};
  }
  const named = unknown.slice(0, 5).join(", ") + (unknown.length > 5 ? ", ..." : "");
  if (unknown.length) unknownWords = `The link has settings that this page does not know: ${named}.`;
  written = text;
  showSettings();
  update();
};
addEventListener("hashchange", () => {
  const text = location.hash.slice(1);
  if (text !== written) readLink(text);
});

byId("link").hidden = location.protocol === "about:"; // a page in a frame has no address of its own
byId("link").addEventListener("click", async () => {
  const address = `${location.href.split("#")[0]}#${written}`;
  try {
    await navigator.clipboard.writeText(address);
    byId("link").textContent = "Copied";
    setTimeout(() => { byId("link").textContent = "Copy link"; }, 1500);
  } catch { prompt("The link:", address); }
});

const csvText = () => {
  const cell = name => /[",\n]/.test(name) ? `"${name.replaceAll('"', '""')}"` : name;
  const lines = [["t", ...data.columns].map(cell).join()];
  for (let i = 0; i < shownRun.n; ++i) {
    const row = shownRun.rows.subarray(i * shownRun.length, i * shownRun.length + data.columns.length);
    lines.push([shownRun.times[i], ...row].map(value => Number.isNaN(value) ? "" : String(value)).join());
  }
  return `${lines.join("\n")}\n`;
};
byId("csv").addEventListener("click", () => {
  if (!shownRun) return;
  const address = URL.createObjectURL(new Blob([csvText()], {type: "text/csv"}));
  const anchor = make("a", {href: address, download: `${data.name}.csv`}, document.body);
  anchor.click();
  anchor.remove();
  setTimeout(() => URL.revokeObjectURL(address), 1000);
});

// Lines of Python that make the run that is shown.
const pythonLines = () => {
  if (!shownRun) return "";
  const {settings: {parameters, initial, inputs, t_span}, x0} = shownRun, {n_q: q, n_u: u, states} = data;
  const number = value => /[.e]/.test(String(value)) ? String(value) : `${value}.0`;
  const dict = entries => `{${entries.map(([name, text]) => `${JSON.stringify(name)}: ${text}`).join(", ")}}`;
  const values = (from, to, chosen) => dict(states.map((name, i) => [name, i]).slice(from, to)
    .filter(([, i]) => chosen(i)).map(([name, i]) => [name, number(dependent[i] ? x0[i] : initial[name])]));
  const notes = [], sources = [];
  for (const {name, prescribed} of data.inputs) {
    const {kind, values: given} = signalAs(inputs[name]), [a, b, c, d] = given.map(number);
    const sine = module => `${a} + ${b} * ${module}.sin(2 * ${module}.pi * ${c} * t + ${d})`;
    const text = {constant: a, sine: `lambda t, x: ${sine("np")}`, ramp: `([${c}, ${d}], [${a}, ${b}])`,
      step: `([${number(given[2] - Math.max(1, Math.abs(given[2])))}, ${c}], [${a}, ${b}], "hold")`,
      hold: `([${given.slice(0, given.length / 2).map(number).join(", ")}], ` +
        `[${given.slice(given.length / 2).map(number).join(", ")}], "hold")`}[kind];
    if (prescribed && ["sine", "line"].includes(kind)) {
      notes.push(`# The rates of ${name} are needed: compile the Model with this expression of t.`,
        `# inputs={${name}: ${kind === "sine" ? sine("sm") : `${a} + ${b} * t`}}`);
    } else if (text) sources.push([name, text]);
  }
  const changed = data.parameters.filter(({name, own}) => parameters[name] !== own)
    .map(({name}) => [name, number(parameters[name])]);
  const given = [changed.length ? "parameters=parameters" : "", sources.length ? "inputs=inputs" : ""].filter(Boolean);
  const state = [values(0, q, i => !dependent[i]), values(q, q + u, i => !dependent[i]), `t=${number(t_span[0])}`,
    ...dependent.slice(0, q).some(Boolean) ? [`guess=${values(0, q, i => dependent[i])}`] : [],
    ...states.length > q + u ? [`auxiliary_states=${values(q + u, states.length, () => true)}`] : [], ...given];
  const method = data.method === "DOP853" ? [] : [`method="${data.method}"`];
  const events = data.events.length ? [`events=[${data.events.map(({python}) => python).join(", ")}]`] : [];
  const run = [`(${t_span.map(number).join(", ")})`, "x0", ...method, ...given, ...events, `rtol=${data.rtol}`,
    `atol=${data.atol}`];
  const called = (name, words) => [`${name}(`, ...words.map(word => `    ${word},`), ")"];
  if (notes.length) return [...notes, ""].join("\n");
  return [...sources.some(([, text]) => text.includes("np.")) ? ["import numpy as np", ""] : [],
    "import fourbar_codegen as fb", "", data.python,
    ...changed.length ? [`parameters = ${dict(changed)}`] : [], ...sources.length ? [`inputs = ${dict(sources)}`] : [],
    ...called("x0 = model.initial_state", state), ...called("run = model.simulate", run), ""].join("\n");
};
byId("python").addEventListener("click", () => {
  const code = byId("code");
  code.hidden = !code.hidden;
  byId("python").setAttribute("aria-expanded", !code.hidden);
  code.textContent = pythonLines();
});

// For other pages, notebooks and tests.

const finiteNumber = (value, what) => {
  if (typeof value === "number" && Number.isFinite(value)) return value;
  throw new TypeError(`${what} must be a finite number, not ${value}.`);
};
const checkNames = (given, names, what) => {
  const wrong = Object.keys(given).find(name => !names.includes(name));
  if (wrong === undefined) return;
  throw new RangeError(`There is no ${what} ${JSON.stringify(wrong)}; there are: ${names.join(", ") || "none"}.`);
};
// An input as scripts give it: a number, null for its expression, or {kind, ...coefficients}.
const signalFrom = (name, given) => {
  const input = data.inputs.find(each => each.name === name), {kinds} = input;
  const {kind, ...coefficients} = given === null ? {kind: "expression"} :
    typeof given === "object" ? given : {kind: "constant", value: given};
  if (!kinds.includes(kind)) {
    const own = kinds.includes("expression") ? ", null for its expression" : "";
    throw new RangeError(`${name} is a number${own}, or an object whose kind is one of ` +
      `${kinds.filter(each => each !== "expression").join(", ")}; not ${kind}.`);
  }
  checkNames(coefficients, KINDS[kind].names, `coefficient of a ${kind}`);
  const values = KINDS[kind].names.map(each => finiteNumber(coefficients[each], `${name}, ${each},`));
  return signalWith(kind, values, input);
};
let scriptEngine = null; // its own, so that sliders and scripts do not wait for each other
const MOST_TIMES = 100000;
const simulate = async (options = {}) => {
  if (typeof options !== "object" || options === null) throw new TypeError(`Options are an object, not ${options}.`);
  const {parameters = {}, initial = {}, inputs = {}, t_span = data.t_span, times = null,
    method = data.method, rtol = data.rtol, atol = data.atol, mode = 0} = options;
  checkNames(options, ["parameters", "initial", "inputs", "t_span", "times", "method", "rtol", "atol", "mode"],
    "option");
  checkNames({[method]: 0}, Object.keys(data.methods), "method");
  for (const [name, given] of Object.entries({parameters, initial, inputs})) {
    if (typeof given !== "object" || given === null) throw new TypeError(`${name} is an object, not ${given}.`);
  }
  if (!Array.isArray(t_span) || t_span.length !== 2) throw new RangeError("t_span has two times.");
  const chosen = {...defaults(), mode, t_span: t_span.map(t => finiteNumber(t, "A time"))};
  checkNames(parameters, Object.keys(chosen.parameters), "parameter");
  checkNames(initial, data.states, "state");
  checkNames(inputs, Object.keys(chosen.inputs), "input");
  const n = data.modes.length;
  if (!Number.isInteger(mode) || !data.modes[mode]) {
    throw new RangeError(`There is no assembly mode ${mode}; there are ${n}, from 0.`);
  }
  for (const name in parameters) chosen.parameters[name] = finiteNumber(parameters[name], name);
  for (const name in inputs) chosen.inputs[name] = signalFrom(name, inputs[name]);
  const guess = [...data.modes[mode]];
  let guesses = false;
  for (const name in initial) {
    const i = data.states.indexOf(name), value = finiteNumber(initial[name], name);
    guesses ||= dependent[i];
    if (dependent[i]) guess[i] = value; else chosen.initial[name] = value;
  }
  if (times !== null && !((Array.isArray(times) || ArrayBuffer.isView(times)) && times.length <= MOST_TIMES)) {
    throw new RangeError(`times is an array of ${MOST_TIMES} times at most.`);
  }
  const [begin, end] = chosen.t_span, direction = Math.sign(end - begin);
  const at = times === null ? framesBetween(begin, end) : Float64Array.from(times, t => finiteNumber(t, "A time"));
  const outside = (t, i) => t < Math.min(begin, end) || t > Math.max(begin, end) ||
    (i > 0 && (t - at[i - 1]) * direction < 0);
  if (at.some(outside)) throw new RangeError("times lie within t_span, in its order.");
  for (const [name, value] of [["rtol", rtol], ["atol", atol]]) {
    if (!(finiteNumber(value, name) > 0)) throw new RangeError(`${name} is positive.`);
  }
  scriptEngine ??= engineCaller(data.wasm);
  const from = guesses ? {...pointOf(chosen), x: guess} : beginningOf(mode);
  const run = await scriptEngine.ask("run", {...requestOf(chosen, from, at), method: data.methods[method],
    rtol, atol});
  const found = data.events.map((_, number) => foundOf(run, number));
  return {t: Array.from(run.times), y: data.states.map((_, k) => Array.from(columnOf(run, k))),
    t_events: found.map(each => each.map(({t}) => t)), y_events: found.map(each => each.map(({x}) => x)),
    success: run.status === 0, status: run.status !== 0 ? -1 : run.ended_by < 0 ? 0 : 1, nfev: run.evaluations,
    message: run.closed && run.lost ? `${run.message}. ${LOST}` : run.ended_by < 0 ? run.message :
      `${data.events[run.ended_by].name} ends the run`};
};
window.fourbar = Object.freeze({
  name: data.name,
  names: Object.freeze({
    states: [...data.states], coordinates: data.states.slice(0, data.n_q),
    speeds: data.states.slice(data.n_q, data.n_q + data.n_u), independent: data.initial.map(({name}) => name),
    parameters: data.parameters.map(({name}) => name), inputs: data.inputs.map(({name}) => name),
  }),
  get defaults() { return defaults(); },
  simulate,
});

// First as the page was made, so that there is a picture whatever a link asks for.
const link = location.hash.slice(1);
update().then(() => { if (link) readLink(link); });
