// What a run of a live page depends on, and what the engine takes of it.
const data = JSON.parse(byId("data").textContent);

// Inputs as functions of time, with the numbers and the order of coefficients of export/page.h: their titles, and the
// names of their coefficients.
const KINDS = {
  expression: {number: 0, title: "", names: []},
  constant: {number: 1, title: "number", names: ["value"]},
  sine: {number: 2, title: "sine", names: ["mean", "amplitude", "frequency", "phase"]},
  step: {number: 3, title: "step", names: ["before", "after", "time"]},
  ramp: {number: 4, title: "ramp", names: ["from", "to", "begin", "end"]},
  line: {number: 5, title: "constant rate", names: ["value", "rate"]},
  hold: {number: 6, title: "recorded values", names: []}, // the times and values that the page was made with
};
// An input of a kind with these coefficients.
const signalWith = (kind, values, {signal}) => kind === "hold" ? structuredClone(signal) : {kind, values};
// A ramp that does not end after it begins is a step.
const signalAs = ({kind, values}) => kind === "ramp" && values[2] >= values[3] ?
  {kind: "step", values: values.slice(0, 3)} : {kind, values};

// Parameters, initial values of the independent states, inputs, first and last time, and the assembly mode.
const defaults = () => ({
  parameters: Object.fromEntries(data.parameters.map(({name, value}) => [name, value])),
  initial: Object.fromEntries(data.initial.map(({name, value}) => [name, value])),
  inputs: Object.fromEntries(data.inputs.map(({name, signal}) => [name, structuredClone(signal)])),
  t_span: [...data.t_span],
  mode: 0,
});

const initialPlaces = data.initial.map(({name}) => data.states.indexOf(name));
const dependent = data.states.map((_, i) => !initialPlaces.includes(i));
const angle = data.states.map(name => data.angles.includes(name));

// Settings as the engine takes them; the dependent states are guesses, by default those of the assembly mode.
const pointOf = ({parameters, initial, inputs, t_span: [begin], mode}, guess = data.modes[mode]) => {
  const x = [...guess];
  data.initial.forEach(({name}, i) => { x[initialPlaces[i]] = initial[name]; });
  let tables = [];
  const signals = data.entries.flatMap(({name, order}) => {
    const {kind, values} = signalAs(inputs[name]);
    if (kind === "hold") {
      tables = tables.concat(values);
      return [KINDS[kind].number, order, values.length / 2, tables.length - values.length, 0, 0];
    }
    return [KINDS[kind].number, order, ...values, 0, 0, 0, 0].slice(0, 6);
  });
  return {p: data.parameters.map(({name}) => parameters[name]), x, dependent, angle, begin, signals, tables};
};

// The closed initial state of an assembly mode, from which it is followed to other settings.
const beginningOf = mode => ({...pointOf({...defaults(), mode}), x: data.modes[mode]});

// The times that are shown.
const framesBetween = (begin, end) => {
  const {rate, least, most} = data.frames;
  const n = begin === end ? 1 : Math.max(least, Math.min(most, Math.round(Math.abs(end - begin) * rate)));
  const step = (end - begin) / (n - 1);
  return Float64Array.from({length: n}, (_, i) => i === n - 1 ? end : begin + i * step);
};

const requestOf = (settings, from, times = framesBetween(...settings.t_span)) =>
  ({...pointOf(settings, from.x), from, end: settings.t_span[1], method: data.methods[data.method],
    rtol: data.rtol, atol: data.atol, times, events: data.events.map(({numbers}) => numbers)});

// What was found of an event in a run.
const foundOf = (run, number) => run.events.filter(({event}) => event === number);

// Values of a column over a run.
const columnOf = (run, k) => Float64Array.from({length: run.n}, (_, i) => run.rows[i * run.length + k]);
