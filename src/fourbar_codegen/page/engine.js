// Runs of a model that is compiled to WebAssembly, in a worker where there is one; export/page.h has its functions.

// Takes requests {p, x, dependent, angle, signals, tables, begin, end, method, rtol, atol, times, events, from}: parameters,
// an initial state of which some values are dependent, and guesses, and some are angles, and six numbers for each input,
// with the times and values of those that are held; six numbers for each event; `from` is a closed state {p, x, dependent,
// angle, signals, tables, begin} with other values.
// This function becomes the text of the worker, so it uses nothing from outside.
const makeEngine = async bytes => {
  const OK = 0, CONSTANT = 1, DEPTH = 8, NEAR = 1e-6, SHORT = 0.5, ROOM = 1000; // SHORT in rad; ROOM for events
  const {instance: {exports: {_initialize: initialize, __heap_base: heap, ...wasm}}} =
    await WebAssembly.instantiate(bytes, {});
  initialize();
  wasm.reset();
  const base = Math.ceil(heap.value / 16) * 16;
  const array = (at, n) => new Float64Array(wasm.memory.buffer, at, n);
  // Memory for this many numbers behind the heap's beginning.
  const reserve = n => {
    const missing = base + 8 * n - wasm.memory.buffer.byteLength;
    if (missing > 0) wasm.memory.grow(Math.ceil(missing / 65536));
  };
  const message = status => {
    const memory = new Uint8Array(wasm.memory.buffer), at = wasm.message(status);
    return new TextDecoder().decode(memory.slice(at, memory.indexOf(0, at)));
  };
  const set = ({p, x, signals, tables}) => {
    reserve(tables.length);
    array(base, tables.length).set(tables);
    wasm.set_tables(base);
    array(wasm.parameters(), p.length).set(p);
    array(wasm.state(), x.length).set(x);
    array(wasm.inputs(), signals.length).set(signals);
    return wasm.update();
  };
  // Closes the loops of a point with guesses: the state, the values of the inputs, and the sign of the constraints'
  // determinant.
  const close = (point, guess) => {
    const status = set({...point, x: point.x.map((value, i) => point.dependent[i] ? guess[i] : value)}) ||
      wasm.close_loops(point.begin);
    const inputs = Array.from({length: point.signals.length / 6}, (_, i) => wasm.input_value(i));
    return {status, x: array(wasm.state(), point.x.length).slice(), inputs, sign: status ? 0 : wasm.sign_of_determinant()};
  };
  const middle = (a, b) => a.map((value, i) => 0.5 * (value + b[i]));
  // Continues an assembly mode from one closed state to other values: two ways have to agree, at once and by the
  // middle, angles change little, and the sign of the determinant is kept; otherwise by shorter steps. The mode is lost
  // if that does not hold for short ones. Between two points, inputs are constant.
  const follow = (from, to, depth = 0) => {
    const direct = close(to, from.x);
    if (depth === DEPTH) return {...direct, lost: true};
    const inputs = middle(from.inputs, direct.inputs);
    const between = {...to, p: middle(from.p, to.p), x: middle(from.x, to.x), begin: 0.5 * (from.begin + to.begin),
      signals: inputs.flatMap((value, i) => [CONSTANT, to.signals[6 * i + 1], value, 0, 0, 0])};
    const half = close(between, from.x);
    if (direct.status === OK && half.status === OK) {
      const again = close(to, half.x);
      const agree = (value, i) => Math.abs(value - direct.x[i]) <= NEAR * (1 + Math.abs(value));
      const little = (value, i) => !to.angle[i] || Math.abs(value - from.x[i]) <= SHORT;
      const kept = [half, again, direct].every(({sign}) => sign * from.sign >= 0);
      if (again.status === OK && kept && again.x.every(agree) && again.x.every(little)) return again;
    }
    const first = follow(from, between, depth + 1);
    if (first.status !== OK) return first;
    const second = follow({...between, ...first}, to, depth + 1);
    return {...second, lost: first.lost || second.lost};
  };
  // If a mode cannot be followed all the way, the loops may still close, within a turn.
  const nearest = (from, to) => {
    const near = x => x.map((value, i) => !to.angle[i] || !Number.isFinite(value) ? value :
      value - 2 * Math.PI * Math.round((value - from.x[i]) / (2 * Math.PI)));
    const closed = close(to, from.x), again = close(to, near(closed.x));
    return {...again.status === OK ? again : closed, lost: true};
  };
  const run = ({from, begin, end, method, rtol, atol, times, events, ...point}) => {
    const began = performance.now(), n = times.length, width = point.x.length;
    const to = {...point, begin};
    const start = {...from, ...close(from, from.x)}, followed = follow(start, to);
    const closed = followed.status === OK && !followed.lost ? followed : nearest(start, to);
    const result = {status: closed.status, closed: closed.status === OK, lost: Boolean(closed.lost), x0: closed.x,
      reached: begin, n: 0, length: 0, times: new Float64Array(0), rows: new Float64Array(0), evaluations: 0,
      events: [], n_events: 0, ended_by: -1, touched: []};
    if (result.closed) {
      set({...point, x: closed.x});
      result.length = wasm.row_length();
      const of_events = wasm.place_events(0, events.length, ROOM), most = n + 1;
      reserve(point.tables.length + of_events + most * (1 + width + result.length));
      const watched = base + 8 * point.tables.length, at = watched + 8 * of_events;
      const states = at + 8 * most, rows = states + 8 * most * width;
      wasm.place_events(watched, events.length, ROOM);
      events.forEach((event, i) => wasm.set_event(i, ...event));
      array(at, n).set(times);
      result.status = wasm.simulate(method, begin, end, rtol, atol, at, n, states);
      result.reached = wasm.time_reached();
      result.evaluations = wasm.evaluations_of_run();
      result.n = wasm.states_stored();
      result.n_events = wasm.events_found();
      result.events = Array.from({length: Math.min(result.n_events, ROOM)}, (_, k) => ({event: wasm.event_number(k),
        t: wasm.event_time(k), x: Array.from(array(wasm.event_state(k), width))}));
      result.ended_by = wasm.ended_by();
      result.touched = events.map((_, i) => wasm.event_touched(i));
      // The state at an event that ends the run is the last one.
      if (result.ended_by >= 0 && !(result.n && times[result.n - 1] === result.reached)) {
        array(at, most)[result.n] = result.reached;
        array(states + 8 * width * result.n, width).set(array(wasm.state(), width));
        ++result.n;
      }
      wasm.observe(at, states, result.n, rows);
      result.times = array(at, result.n).slice();
      result.rows = array(rows, result.n * result.length).slice();
    }
    return {...result, message: message(result.status), duration: performance.now() - began};
  };
  // Nanoseconds of an evaluation of the equations of motion, for benchmarks and tests.
  const evaluation = ({begin, ...point}, count) => {
    const {x, tables} = point, at = base + 8 * tables.length;
    set(point);
    reserve(tables.length + 2 * x.length);
    array(at, x.length).set(x);
    const began = performance.now();
    for (let i = 0; i < count; ++i) wasm.evaluate(begin, at, at + 8 * x.length);
    return (performance.now() - began) * 1e6 / count;
  };
  return {run, evaluation, memory: () => wasm.memory.buffer.byteLength};
};

// Calls the engine: `ask(name, ...arguments)` is a promise of what its function returns. Calls are answered in order;
// `restart` drops all that are not answered yet, and ends a worker that is busy.
const engineCaller = bytes => {
  const serve = `const engine = (${makeEngine})(bytes);
    onmessage = async ({data: {id, name, given}}) => {
      try { postMessage({id, value: (await engine)[name](...given)}); }
      catch (error) { postMessage({id, error: String(error)}); }
    };`;
  let waiting = new Map(), worker = null, inside = null, last = 0;
  const begin = () => {
    try {
      const text = `const bytes = Uint8Array.from(atob("${bytes}"), c => c.charCodeAt(0)); ${serve}`;
      const address = URL.createObjectURL(new Blob([text], {type: "text/javascript"}));
      const own = new Worker(address);
      worker = own;
      URL.revokeObjectURL(address);
      own.addEventListener("message", ({data: {id, value, error}}) => {
        if (!waiting.has(id)) return;
        const {resolve, reject} = waiting.get(id);
        waiting.delete(id);
        if (error === undefined) resolve(value); else reject(new Error(error));
      });
      own.addEventListener("error", event => { // where workers are not allowed, the page's own thread does it
        if (worker !== own) return;
        event.preventDefault();
        worker = null;
        for (const [id, {name, given, resolve, reject}] of waiting) {
          waiting.delete(id);
          here(name, given).then(resolve, reject);
        }
      });
    } catch { worker = null; }
  };
  const here = async (name, given) => {
    inside ??= makeEngine(bytesOf(bytes));
    return (await inside)[name](...given);
  };
  begin();
  return {
    ask: (name, ...given) => worker ? new Promise((resolve, reject) => {
      waiting.set(++last, {name, given, resolve, reject});
      worker.postMessage({id: last, name, given});
    }) : here(name, given),
    restart() {
      if (!worker) return;
      worker.terminate();
      const dropped = waiting;
      waiting = new Map();
      begin();
      for (const {reject} of dropped.values()) reject(new Error("the run was stopped"));
    },
  };
};
