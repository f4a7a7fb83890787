// Bodies in space, shaded, by WebGL with a depth buffer: what reports and live pages show of mechanisms that leave a plane.

// Shaders. Positions are turned so that x points to the right, y upwards and z to the reader.
const SHADERS = {
  solid: [`
    attribute vec3 position, normal;
    uniform mat3 view, turn;
    uniform vec3 place, middle;
    uniform vec3 scale;
    varying vec3 outwards;
    void main() {
      vec3 seen = view * (turn * position + place) - middle;
      outwards = view * (turn * normal);
      gl_Position = vec4(seen * scale, 1.0);
    }`, `
    precision mediump float;
    uniform vec3 color;
    uniform float alpha;
    varying vec3 outwards;
    void main() {
      vec3 n = normalize(gl_FrontFacing ? outwards : -outwards);
      float light = 0.42 + 0.5 * max(dot(n, vec3(0.30, 0.60, 0.74)), 0.0) + 0.13 * n.y;
      float shine = pow(max(dot(n, vec3(0.16, 0.33, 0.93)), 0.0), 40.0);
      gl_FragColor = vec4(color * light + 0.18 * shine, 1.0) * alpha;
    }`],
  line: [`
    attribute vec3 from, to;
    attribute vec2 corner;
    uniform mat3 view;
    uniform vec3 shift, middle, scale;
    uniform vec2 size;
    uniform float width;
    void main() {
      vec3 a = (view * (from + shift) - middle) * scale, b = (view * (to + shift) - middle) * scale;
      vec2 along = (b.xy - a.xy) * size;
      float far = length(along);
      vec2 across = far > 0.0 ? vec2(-along.y, along.x) / far : vec2(0.0);
      vec3 at = mix(a, b, corner.x);
      gl_Position = vec4(at.xy + corner.y * width * across / size, at.z, 1.0);
    }`, `
    precision mediump float;
    uniform vec3 color;
    uniform float alpha;
    void main() { gl_FragColor = vec4(color, 1.0) * alpha; }`],
};

// A colour of a style sheet as three numbers.
const colorOf = text => {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 1;
  const pen = canvas.getContext("2d");
  pen.fillStyle = text;
  pen.fillRect(0, 0, 1, 1);
  return [...pen.getImageData(0, 0, 1, 1).data].slice(0, 3).map(value => value / 255);
};

const programOf = (gl, [vertex, fragment]) => {
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  const places = {program};
  for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); ++i) {
    const {name} = gl.getActiveUniform(program, i);
    places[name] = gl.getUniformLocation(program, name);
  }
  for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_ATTRIBUTES); ++i) {
    const {name} = gl.getActiveAttrib(program, i);
    places[name] = gl.getAttribLocation(program, name);
  }
  return places;
};

const bufferOf = (gl, target, values, usage = gl.STATIC_DRAW) => {
  const buffer = gl.createBuffer();
  gl.bindBuffer(target, buffer);
  gl.bufferData(target, values, usage);
  return buffer;
};

// Vectors and matrices: arrays of 3, and of 9 column by column as WebGL takes them.
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const crossed = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unitOf = a => {
  const length = Math.hypot(...a);
  return a.map(value => value / length);
};
const times3 = (m, a) => [0, 1, 2].map(i => m[i] * a[0] + m[i + 3] * a[1] + m[i + 6] * a[2]);
const product3 = (m, n) => [0, 3, 6].flatMap(j => times3(m, n.slice(j, j + 3)));
const turnOf = ([x, y, z, w]) => [
  1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w),
  2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w),
  2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)];
// The quaternion of a rotation matrix of three columns. Source: S. W. Shepperd, "Quaternion from rotation matrix",
// Journal of Guidance and Control 1 (1978): the largest component is found first.
const quaternionOf = ([a, b, c]) => {
  const squares = [a[0] - b[1] - c[2], b[1] - a[0] - c[2], c[2] - a[0] - b[1], a[0] + b[1] + c[2]];
  const largest = squares.indexOf(Math.max(...squares)), r = Math.sqrt(1 + squares[largest]) / 2, f = 0.25 / r;
  const [x, y, z] = [b[2] - c[1], c[0] - a[2], a[1] - b[0]], [xy, xz, yz] = [a[1] + b[0], c[0] + a[2], b[2] + c[1]];
  return [[r, f * xy, f * xz, f * x], [f * xy, r, f * yz, f * y], [f * xz, f * yz, r, f * z],
    [f * x, f * y, f * z, r]][largest] ?? [NaN, NaN, NaN, NaN];
};
const transposed = m => [m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]];
const farthest = z => Math.abs(z[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];

// Four corners of a quadrilateral for each segment between points that follow each other; not where one is unknown.
const segmentsOf = points => {
  const values = [], indices = [];
  for (let i = 0; i + 1 < points.length; ++i) {
    const [a, b] = [points[i], points[i + 1]];
    if (!Number.isFinite(a[0] + a[1] + a[2] + b[0] + b[1] + b[2])) continue;
    const first = values.length / 8;
    for (const corner of [[0, 1], [0, -1], [1, 1], [1, -1]]) values.push(...a, ...b, ...corner);
    indices.push(first, first + 1, first + 2, first + 1, first + 3, first + 2);
  }
  return [new Float32Array(values), new Uint16Array(indices)];
};

// The corners of the box about points.
const cornersOf = points => {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  points.forEach((value, i) => {
    low[i % 3] = Math.min(low[i % 3], value);
    high[i % 3] = Math.max(high[i % 3], value);
  });
  return Array.from({length: 8}, (_, k) => [0, 1, 2].map(j => (k >> j) & 1 ? high[j] : low[j]));
};

// The picture in an element <canvas>, with the methods of `mechanismPicture`; `set` also takes quaternions of the
// bodies, n times as many as the scene's solids turn with. Null where the browser has no WebGL.
const solidPicture = (canvas, scene) => {
  const gl = canvas.getContext("webgl", {antialias: true, alpha: false});
  if (!gl) return null;
  const FAR = 4, STILL = 1e-9, MARGIN = 0.86, HOME = [-0.6, -1.15];
  const TURNS = {front: [0, -Math.PI / 2], side: [-Math.PI / 2, -Math.PI / 2], top: [0, 0], home: HOME};
  let [turn, tilt] = HOME, zoom = 1, pan = [0, 0];
  let positions = new Float32Array(0), rotations = new Float32Array(0), n = 0, m = 0, bodies = 0, shown = 0;
  let sizes = {}, before = null, moving = [], moves = new Set(), follows = false;
  // All that is shown, in the inertial frame; its size at one instant; and the sizes on the screen.
  let low = [0, 0, 0], high = [0, 0, 0], radius = 1, span = [1, 1], middleSeen = [0, 0, 0];
  const drawn = [...new Set([...scene.shown, ...scene.solids.flatMap(({row, to}) => to === null ? [row] : [row, to]),
    ...scene.arrows.flat()])];
  const solid = programOf(gl, SHADERS.solid), line = programOf(gl, SHADERS.line);
  const meshes = scene.meshes.map(({vertices, normals, faces}) => ({
    vertices: bufferOf(gl, gl.ARRAY_BUFFER, bytesOf(vertices)), normals: bufferOf(gl, gl.ARRAY_BUFFER, bytesOf(normals)),
    faces: bufferOf(gl, gl.ELEMENT_ARRAY_BUFFER, bytesOf(faces)), count: bytesOf(faces).length / 2,
    corners: cornersOf(new Float32Array(bytesOf(vertices).buffer)),
  }));
  const solids = scene.solids.map(entry => ({...entry, rotation: transposed(entry.rotation), tone: colorOf(entry.color)}));
  const colors = {};
  const traces = new Map();
  const readColors = () => {
    const probe = make("span", {hidden: ""}, document.body);
    for (const name of ["page", "ink", "faint", "soft", "accent", "force", "curve2"]) {
      probe.style.color = `var(--${name})`;
      colors[name] = colorOf(getComputedStyle(probe).color);
    }
    probe.remove();
  };
  const at = (i, k, places = positions) => {
    const place = 3 * (i * m + k);
    return [places[place], places[place + 1], places[place + 2]];
  };
  const isKnown = a => Number.isFinite(a[0] + a[1] + a[2]);
  // Rows of the matrix are the directions to the right, upwards, and to the reader.
  const turned = ([turn, tilt]) => {
    const [c, s, ct, st] = [Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt)];
    return transposed([c, -s, 0, s * ct, c * ct, -st, s * st, c * st, ct]);
  };
  // Where a solid is, and the matrix that turns and scales it; null where that is not known.
  const placedAt = (i, {row, turn: body, offset, rotation, to, length, parameter, value}) => {
    let place = at(i, row), matrix = rotation;
    if (to !== null) {
      const end = at(i, to), way = minus(end, place), z = unitOf(way), x = unitOf(crossed(farthest(z), z));
      const longer = Math.hypot(...way) / length;
      matrix = [...x, ...crossed(z, x), ...z.map(entry => longer * entry)];
      place = place.map((entry, j) => (entry + end[j]) / 2);
    } else if (body !== null) {
      const start = 4 * (i * bodies + body), own = turnOf(rotations.subarray(start, start + 4));
      const moved = times3(own, offset);
      matrix = product3(own, rotation);
      place = place.map((entry, j) => entry + moved[j]);
    }
    if (parameter in sizes) matrix = matrix.map(entry => entry * sizes[parameter] / value);
    return isKnown(place) && matrix.every(Number.isFinite) ? [place, matrix] : null;
  };
  // The least and largest coordinates of rows and of moving or all solids, turned by a matrix, at some instants.
  const extent = (instants, rows, all, matrix = null) => {
    const ends = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
    const add = a => {
      const b = matrix ? times3(matrix, a) : a;
      if (isKnown(b)) for (let j = 0; j < 3; ++j) {
        ends[0][j] = Math.min(ends[0][j], b[j]);
        ends[1][j] = Math.max(ends[1][j], b[j]);
      }
    };
    for (const i of instants) {
      for (const k of rows) add(at(i, k));
      for (const solid of solids) if (all || moves.has(solid.row) || solid.to !== null && moves.has(solid.to)) {
        const found = placedAt(i, solid);
        if (found) for (const corner of meshes[solid.mesh].corners) {
          const b = times3(found[1], corner);
          add([found[0][0] + b[0], found[0][1] + b[1], found[0][2] + b[2]]);
        }
      }
    }
    return ends;
  };
  const sizeOf = ([low, high]) => Math.hypot(...minus(high, low));
  const some = most => Array.from({length: Math.min(n, most)}, (_, k) => Math.round(k * (n - 1) / Math.max(1, Math.min(n, most) - 1)));

  const lineOf = points => {
    const [values, indices] = segmentsOf(points);
    return {values: bufferOf(gl, gl.ARRAY_BUFFER, values), indices: bufferOf(gl, gl.ELEMENT_ARRAY_BUFFER, indices),
      count: indices.length};
  };
  const free = ({values, indices}) => { gl.deleteBuffer(values); gl.deleteBuffer(indices); };
  let grid = null;
  const makeGrid = () => {
    if (grid) free(grid);
    grid = null;
    const heights = scene.ground.map(k => at(0, k)[2]).filter(Number.isFinite);
    if (!heights.length) return;
    const z = Math.min(...heights), room = 0.6 * radius, step = ticksBetween(0, 2 * radius, 8)[1] ?? 1;
    const [x0, y0] = low.map(value => Math.floor((value - room) / step) * step);
    const [x1, y1] = high.map(value => Math.ceil((value + room) / step) * step);
    const points = [], gap = [NaN, NaN, NaN];
    for (let x = x0; x < x1 + step / 2; x += step) points.push([x, y0, z], [x, y1, z], gap);
    for (let y = y0; y < y1 + step / 2; y += step) points.push([x0, y, z], [x1, y, z], gap);
    grid = lineOf(points);
  };

  const drawTrace = k => {
    const trace = traces.get(k);
    for (const each of ["line", "ghost"]) if (trace[each]) free(trace[each]);
    const way = places => Array.from({length: places.length / 3 / m}, (_, i) => at(i, k, places));
    trace.line = m ? lineOf(way(positions)) : null;
    trace.ghost = before && m ? lineOf(way(before)) : null;
  };

  // Points of a spring between two places, or a straight line.
  const coiled = (a, b, {kind, outline}) => {
    const way = minus(b, a), far = Math.hypot(...way);
    if (kind !== "spring" || !(far > 0)) return [a, b];
    const z = unitOf(way), x = unitOf(crossed(farthest(z), z)), y = crossed(z, x);
    const coils = Math.round((outline[0].length - 4) / 2), round = 12, points = [a];
    for (let i = 0; i <= coils * round; ++i) {
      const angle = 2 * Math.PI * i / round, part = 0.15 + 0.7 * i / (coils * round), r = 0.6 * scene.unit;
      points.push([0, 1, 2].map(j => a[j] + part * way[j] + r * (Math.cos(angle) * x[j] + Math.sin(angle) * y[j])));
    }
    return [...points, b];
  };

  let frame = null;
  const render = () => {
    frame = null;
    const ratio = devicePixelRatio || 1, width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.viewport(0, 0, width, height);
    gl.clearColor(...colors.page, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    if (!m || !n) return;
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    const seen = turned([turn, tilt]), per = scaleNow();
    const own = follows ? extent([shown], moving, false) : null;
    // What is in the middle: the mechanism that is followed, or what is in the middle of the first view.
    const about = own && Number.isFinite(own[0][0]) ? [0, 1, 2].map(j => (own[0][j] + own[1][j]) / 2) :
      times3(transposed(turned(HOME)), middleSeen);
    const middle = times3(seen, about).map((value, j) => value - (pan[j] ?? 0));
    const depth = 2 * (sizeOf([low, high]) + 4 * radius);
    const scale = [2 * per * ratio / width, 2 * per * ratio / height, -2 / depth];
    const common = program => {
      gl.useProgram(program.program);
      gl.uniformMatrix3fv(program.view, false, seen);
      gl.uniform3fv(program.middle, middle);
      gl.uniform3fv(program.scale, scale);
    };
    const strokes = (lines, color, wide, alpha = 1) => {
      if (!lines || !lines.count) return;
      gl.bindBuffer(gl.ARRAY_BUFFER, lines.values);
      for (const [name, size, start] of [["from", 3, 0], ["to", 3, 12], ["corner", 2, 24]]) {
        gl.enableVertexAttribArray(line[name]);
        gl.vertexAttribPointer(line[name], size, gl.FLOAT, false, 32, start);
      }
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, lines.indices);
      gl.uniform3fv(line.color, color);
      gl.uniform1f(line.alpha, alpha);
      gl.uniform1f(line.width, wide * ratio);
      gl.drawElements(gl.TRIANGLES, lines.count, gl.UNSIGNED_SHORT, 0);
      for (const name of ["from", "to", "corner"]) gl.disableVertexAttribArray(line[name]);
    };
    common(line);
    gl.uniform3fv(line.shift, [0, 0, 0]);
    gl.uniform2fv(line.size, [width, height]);
    strokes(grid, colors.faint, 1);
    for (const {line: way, ghost} of traces.values()) {
      strokes(ghost, colors.soft, 1, 0.7);
      strokes(way, colors.accent, 2);
    }
    const moved = (points, color, wide) => {
      const lines = lineOf(points);
      strokes(lines, color, wide);
      free(lines);
    };
    for (const {kind, rows} of scene.lines) if (kind === "actuator" || kind === "line") {
      moved(rows.map(k => at(shown, k)), kind === "actuator" ? colors.force : colors.ink, kind === "actuator" ? 3 : 2);
    }
    for (const symbol of scene.symbols) if (symbol.kind === "spring" || symbol.kind === "damper") {
      moved(coiled(at(shown, symbol.at), at(shown, symbol.toward), symbol), colors.curve2, 2);
    }
    for (const [from, to] of scene.arrows) {
      const [a, b] = [at(shown, from), at(shown, to)], way = minus(b, a);
      if (!isKnown(way) || !(Math.hypot(...way) * per > 1)) continue;
      moved([a, b], colors.force, 3);
      const side = crossed(unitOf(way), times3(transposed(seen), [0, 0, 1]));
      const head = Math.min(0.3 * Math.hypot(...way), 9 / per);
      for (const sign of [-1, 1]) {
        moved([b, b.map((value, j) => value - head * (unitOf(way)[j] + sign * 0.5 * side[j]))], colors.force, 3);
      }
    }
    common(solid);
    gl.uniform1f(solid.alpha, 1);
    for (const entry of solids) {
      const found = placedAt(shown, entry), {mesh, tone} = entry;
      if (!found) continue;
      const [place, matrix] = found;
      gl.bindBuffer(gl.ARRAY_BUFFER, meshes[mesh].vertices);
      gl.enableVertexAttribArray(solid.position);
      gl.vertexAttribPointer(solid.position, 3, gl.FLOAT, false, 0, 0);
      gl.bindBuffer(gl.ARRAY_BUFFER, meshes[mesh].normals);
      gl.enableVertexAttribArray(solid.normal);
      gl.vertexAttribPointer(solid.normal, 3, gl.BYTE, true, 0, 0);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, meshes[mesh].faces);
      gl.uniformMatrix3fv(solid.turn, false, matrix);
      gl.uniform3fv(solid.place, place);
      gl.uniform3fv(solid.color, tone);
      gl.drawElements(gl.TRIANGLES, meshes[mesh].count, gl.UNSIGNED_SHORT, 0);
    }
  };
  const soon = () => { frame ??= requestAnimationFrame(render); };
  // Pixels of the page for a unit of length.
  const scaleNow = () => zoom * MARGIN * Math.min(canvas.clientWidth / span[0], canvas.clientHeight / span[1]);

  const picture = {
    // The positions of a run and of the run before, quaternions of the bodies, and parameters that are sizes.
    set(places, rows, ghost = null, turns = rotations, values = {}) {
      positions = places;
      sizes = values;
      rotations = turns;
      m = rows;
      n = m ? places.length / 3 / m : 0;
      bodies = n ? rotations.length / 4 / n : 0;
      before = ghost;
      moving = drawn.filter(k => {
        const first = at(0, k);
        for (let i = 1; i < n; ++i) if (minus(at(i, k), first).some(value => Math.abs(value) > STILL)) return true;
        return false;
      });
      moves = new Set(moving);
      picture.fit();
    },
    // The scale is that of the first view, so that it stays as the picture is turned.
    fit() {
      const home = turned(HOME), rows = follows ? moving : drawn;
      const whole = extent(some(200), drawn, true);
      if (!Number.isFinite(whole[0][0])) return;
      [low, high] = whole;
      radius = Math.max(...some(30).map(i => sizeOf(extent([i], moving, false))).filter(Number.isFinite), 0) || sizeOf(whole) || 1;
      const windows = follows ? some(30).map(i => extent([i], rows, false, home)) : [extent(some(200), rows, true, home)];
      span = [0, 1].map(j => Math.max(...windows.map(([a, b]) => b[j] - a[j]).filter(Number.isFinite), 1e-3 * radius));
      middleSeen = [0, 1, 2].map(j => (windows[0][0][j] + windows[0][1][j]) / 2);
      makeGrid();
    },
    travels() {
      return moving.length > 1 && sizeOf(extent(some(200), moving, false)) > FAR * radius;
    },
    follow(on) {
      follows = on;
      picture.redraw();
    },
    trace(k, on) {
      if (on && !traces.has(k)) {
        traces.set(k, {line: null, ghost: null});
        drawTrace(k);
      } else if (!on && traces.has(k)) {
        for (const each of Object.values(traces.get(k))) if (each) free(each);
        traces.delete(k);
      }
      soon();
    },
    drawTraces() {
      for (const k of traces.keys()) drawTrace(k);
      soon();
    },
    draw(i) {
      shown = i;
      soon();
    },
    redraw() {
      picture.fit();
      soon();
    },
    // Looks along an axis, or as at first.
    look(name) {
      [turn, tilt] = TURNS[name];
      if (name === "home") { zoom = 1; pan = [0, 0]; }
      soon();
    },
  };

  const rotate = (across, up) => {
    turn += across;
    tilt = Math.max(-Math.PI, Math.min(0, tilt + up));
    soon();
  };
  const shift = (x, y) => {
    pan = [pan[0] + x / scaleNow(), pan[1] - y / scaleNow()];
    soon();
  };
  const enlarge = factor => {
    zoom = Math.max(0.1, Math.min(100, zoom * factor));
    soon();
  };
  const held = new Map();
  canvas.style.touchAction = "none";
  canvas.addEventListener("pointerdown", event => {
    held.set(event.pointerId, [event.clientX, event.clientY]);
    canvas.setPointerCapture(event.pointerId);
    canvas.focus({preventScroll: true});
  });
  canvas.addEventListener("pointermove", event => {
    const last = held.get(event.pointerId), now = [event.clientX, event.clientY];
    if (!last) return;
    const [x, y] = [now[0] - last[0], now[1] - last[1]];
    if (held.size > 1) {
      const [[, other]] = [...held].filter(([id]) => id !== event.pointerId);
      enlarge(Math.hypot(now[0] - other[0], now[1] - other[1]) / (Math.hypot(last[0] - other[0], last[1] - other[1]) || 1));
      shift(x / 2, y / 2);
    } else if (event.shiftKey || event.buttons & 6) shift(x, y);
    else rotate(x / 150, y / 150);
    held.set(event.pointerId, now);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, event => { held.delete(event.pointerId); });
  }
  canvas.addEventListener("contextmenu", event => event.preventDefault());
  canvas.addEventListener("wheel", event => {
    if (document.activeElement !== canvas && !event.ctrlKey) return; // the page scrolls
    enlarge(Math.exp(-event.deltaY / 400));
    event.preventDefault();
  }, {passive: false});
  canvas.setAttribute("tabindex", 0);
  canvas.addEventListener("keydown", event => {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    const arrows = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]}, way = arrows[event.key];
    const views = {0: "home", 1: "front", 2: "side", 3: "top"};
    if (way) (event.shiftKey ? shift : rotate)(...way.map(value => value * (event.shiftKey ? 20 : 0.1)));
    else if (event.key in views) picture.look(views[event.key]);
    else if (event.key === "+" || event.key === "=") enlarge(1.15);
    else if (event.key === "-") enlarge(1 / 1.15);
    else return;
    event.preventDefault();
    event.stopPropagation();
  });
  const restyle = () => { readColors(); soon(); };
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", restyle);
  new ResizeObserver(soon).observe(canvas);
  readColors();
  return picture;
};

// The picture in an element <svg>, or in a canvas in its place if there are bodies in space.
const pictureOf = (svg, scene) => {
  if (!scene.solids.length) return mechanismPicture(svg, scene);
  const canvas = document.createElement("canvas");
  for (const name of ["id", "role", "aria-label"]) canvas.setAttribute(name, svg.getAttribute(name));
  const picture = solidPicture(canvas, scene);
  if (!picture) return mechanismPicture(svg, scene);
  const views = make("div", {class: "controls", role: "group", "aria-label": "Views"}, svg.parentElement);
  for (const name of ["home", "front", "side", "top"]) {
    make("button", {type: "button"}, views, name[0].toUpperCase() + name.slice(1))
      .addEventListener("click", () => picture.look(name));
  }
  svg.after(canvas, views);
  svg.remove();
  byId("turn").textContent = " In the picture: drag to turn, Shift and drag or two fingers to move, pinch, + and - to " +
    "enlarge; with the focus there, arrows turn, with Shift move, the wheel enlarges, 1, 2, 3, 0 are views.";
  return picture;
};
