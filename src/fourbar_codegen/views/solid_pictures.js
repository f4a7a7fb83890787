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
    varying vec3 outwards;
    void main() {
      vec3 n = normalize(gl_FrontFacing ? outwards : -outwards);
      float light = 0.42 + 0.5 * max(dot(n, vec3(0.30, 0.60, 0.74)), 0.0) + 0.13 * n.y;
      float shine = pow(max(dot(n, vec3(0.16, 0.33, 0.93)), 0.0), 40.0);
      gl_FragColor = vec4(color * light + 0.18 * shine, 1.0);
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

// A colour, #rrggbb or rgb(...), as three numbers.
const colorOf = text => (text[0] === "#" ? [1, 3, 5].map(k => Number.parseInt(text.slice(k, k + 2), 16)) :
  text.match(/[\d.]+/g).slice(0, 3).map(Number)).map(value => value / 255);

// The context of a new canvas, or null where the browser has no WebGL. Without a graphics card, smooth edges would take
// half of the time.
const contextOf = (antialias = false) => {
  const canvas = document.createElement("canvas"), how = {antialias, alpha: false};
  const gl = canvas.getContext("webgl2", how) ?? canvas.getContext("webgl", how);
  if (!gl || antialias) return gl;
  const names = gl.getExtension("WEBGL_debug_renderer_info");
  const name = String(names ? gl.getParameter(names.UNMASKED_RENDERER_WEBGL) : "");
  if (/SwiftShader|llvmpipe|Basic Render/.test(name)) return gl;
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return contextOf(true);
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

const bufferOf = (gl, target, values) => {
  const buffer = gl.createBuffer();
  gl.bindBuffer(target, buffer);
  gl.bufferData(target, values, gl.STATIC_DRAW);
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
const transposed = m => [m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]];
const isKnown = a => Number.isFinite(a[0] + a[1] + a[2]);
// An axis far from a direction.
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

// Values that depend linearly on parameters, for some of these: of each change, its parameter's name and value, and slopes.
const resized = (values, changes, parameters) => {
  const found = values.slice();
  for (const [name, value, slopes] of changes) {
    const more = (parameters[name] ?? value) - value;
    if (more) for (let i = 0; i < found.length; ++i) found[i] += more * slopes[i];
  }
  return found;
};

// The corners of the box about points.
const cornersOf = points => {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (let i = 0; i < points.length; ++i) {
    low[i % 3] = Math.min(low[i % 3], points[i]);
    high[i % 3] = Math.max(high[i % 3], points[i]);
  }
  return Array.from({length: 8}, (_, k) => [0, 1, 2].map(j => (k >> j) & 1 ? high[j] : low[j]));
};

// Draws meshes, of which solids are made, and lines, as a camera sees them: `see` begins a picture, of a matrix whose rows
// are the directions to the right, upwards and to the reader, the point in the middle, the pixels for a unit of length,
// and the depth of what is shown.
const rendererOf = (gl, scene) => {
  const meshProgram = programOf(gl, SHADERS.solid), lineProgram = programOf(gl, SHADERS.line);
  const meshOf = ({vertices, normals, faces, changes}) => {
    const points = new Float32Array(bytesOf(vertices).buffer), numbers = bytesOf(faces);
    return {points, corners: cornersOf(points), vertices: bufferOf(gl, gl.ARRAY_BUFFER, points),
      normals: bufferOf(gl, gl.ARRAY_BUFFER, bytesOf(normals)), faces: bufferOf(gl, gl.ELEMENT_ARRAY_BUFFER, numbers),
      count: numbers.length / 2,
      changes: changes.map(([name, value, slopes]) => [name, value, new Float32Array(bytesOf(slopes).buffer)])};
  };
  const meshes = [meshOf(scene.meshes[0])];
  let ratio = 1;
  const attribute = (place, buffer, size, kind, stride = 0, start = 0) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, size, kind, kind === gl.BYTE, stride, start);
  };
  const renderer = {
    corners: number => meshes[number].corners,
    // Sizes of meshes follow parameters.
    resize(values) {
      for (const mesh of meshes) {
        const moved = mesh.changes.filter(([name, value]) => (values[name] ?? value) !== (mesh.sizes?.[name] ?? value));
        if (!moved.length) continue;
        mesh.sizes = {...values};
        const points = resized(mesh.points, mesh.changes, values);
        mesh.corners = cornersOf(points);
        gl.bindBuffer(gl.ARRAY_BUFFER, mesh.vertices);
        gl.bufferData(gl.ARRAY_BUFFER, points, gl.STATIC_DRAW);
      }
    },
    see({canvas, page, matrix, middle, pixels, depth}) {
      ratio = devicePixelRatio || 1;
      const [width, height] = [canvas.clientWidth, canvas.clientHeight].map(size => Math.max(1, Math.round(size * ratio)));
      if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
      gl.viewport(0, 0, width, height);
      gl.clearColor(...page, 1);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      for (const program of [meshProgram, lineProgram]) {
        gl.useProgram(program.program);
        gl.uniformMatrix3fv(program.view, false, matrix);
        gl.uniform3fv(program.middle, middle);
        gl.uniform3fv(program.scale, [2 * pixels * ratio / width, 2 * pixels * ratio / height, -2 / depth]);
      }
      gl.uniform2fv(lineProgram.size, [width, height]);
    },
    line(points) {
      const [values, indices] = segmentsOf(points);
      return {values: bufferOf(gl, gl.ARRAY_BUFFER, values), indices: bufferOf(gl, gl.ELEMENT_ARRAY_BUFFER, indices),
        count: indices.length};
    },
    free({values, indices}) {
      gl.deleteBuffer(values);
      gl.deleteBuffer(indices);
    },
    drawLine(lines, color, width, alpha = 1) {
      if (!lines || !lines.count) return;
      const {from, to, corner} = lineProgram;
      gl.useProgram(lineProgram.program);
      for (const [place, size, start] of [[from, 3, 0], [to, 3, 12], [corner, 2, 24]]) {
        attribute(place, lines.values, size, gl.FLOAT, 32, start);
      }
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, lines.indices);
      gl.uniform3fv(lineProgram.color, color);
      gl.uniform1f(lineProgram.alpha, alpha);
      gl.uniform1f(lineProgram.width, width * ratio);
      gl.drawElements(gl.TRIANGLES, lines.count, gl.UNSIGNED_SHORT, 0);
      for (const place of [from, to, corner]) gl.disableVertexAttribArray(place);
    },
    // A line that is drawn once.
    drawPoints(points, color, width) {
      const lines = renderer.line(points);
      renderer.drawLine(lines, color, width);
      renderer.free(lines);
    },
    drawMesh(number, place, matrix, color) {
      const {vertices, normals, faces, count} = meshes[number];
      gl.useProgram(meshProgram.program);
      attribute(meshProgram.position, vertices, 3, gl.FLOAT);
      attribute(meshProgram.normal, normals, 3, gl.BYTE);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, faces);
      gl.uniformMatrix3fv(meshProgram.turn, false, matrix);
      gl.uniform3fv(meshProgram.place, place);
      gl.uniform3fv(meshProgram.color, color);
      gl.drawElements(gl.TRIANGLES, count, gl.UNSIGNED_SHORT, 0);
      for (const at of [meshProgram.position, meshProgram.normal]) gl.disableVertexAttribArray(at);
    },
  };
  gl.enable(gl.DEPTH_TEST);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  // Shaders are compiled when something is first drawn with them: now, beside what follows, something that is not seen.
  renderer.drawPoints([[0, 0, 0], [0, 0, 0]], [0, 0, 0], 0);
  renderer.drawMesh(0, [0, 0, 0], [0, 0, 0, 0, 0, 0, 0, 0, 0], [0, 0, 0]);
  gl.fenceSync?.(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
  gl.flush();
  meshes.push(...scene.meshes.slice(1).map(meshOf));
  return renderer;
};

// Turns, moves and enlarges a picture by pointers, wheel and keys.
const handle = (canvas, {rotate, shift, enlarge, look}) => {
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
      const [, other] = [...held].find(([id]) => id !== event.pointerId);
      const apart = point => Math.hypot(point[0] - other[0], point[1] - other[1]);
      enlarge(apart(now) / (apart(last) || 1));
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
    const ways = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]}, way = ways[event.key];
    const views = {0: "home", 1: "front", 2: "side", 3: "top"};
    if (way) (event.shiftKey ? shift : rotate)(...way.map(value => value * (event.shiftKey ? 20 : 0.1)));
    else if (event.key in views) look(views[event.key]);
    else if (event.key === "+" || event.key === "=") enlarge(1.15);
    else if (event.key === "-") enlarge(1 / 1.15);
    else return;
    event.preventDefault();
    event.stopPropagation();
  });
};

// The least and largest coordinates of points, as far as they are known.
const boundsOf = points => {
  const ends = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
  for (const a of points) if (isKnown(a)) for (let j = 0; j < 3; ++j) {
    ends[0][j] = Math.min(ends[0][j], a[j]);
    ends[1][j] = Math.max(ends[1][j], a[j]);
  }
  return ends;
};
const diagonalOf = ([least, most]) => Math.hypot(...minus(most, least));

// Points of a spring between two places, or a straight line.
const coiled = (a, b, {kind, outline}, unit) => {
  const way = minus(b, a), far = Math.hypot(...way);
  if (kind !== "spring" || !(far > 0)) return [a, b];
  const z = unitOf(way), x = unitOf(crossed(farthest(z), z)), y = crossed(z, x), ROUND = 12;
  const coils = Math.round((outline[0].length - 4) / 2), points = [a];
  for (let i = 0; i <= coils * ROUND; ++i) {
    const angle = 2 * Math.PI * i / ROUND, part = 0.15 + 0.7 * i / (coils * ROUND), r = 0.6 * unit;
    points.push([0, 1, 2].map(j => a[j] + part * way[j] + r * (Math.cos(angle) * x[j] + Math.sin(angle) * y[j])));
  }
  return [...points, b];
};

// The picture in the canvas of a context, with the methods of `mechanismPicture`; `set` also takes a function from the
// number of a time and that of a rotation of the scene's to its matrix.
const solidPicture = (gl, scene) => {
  const FAR = 4, STILL = 1e-9, MARGIN = 0.86, HOME = [-0.6, -1.15];
  const VIEWS = {front: [0, -Math.PI / 2], side: [-Math.PI / 2, -Math.PI / 2], top: [0, 0], home: HOME};
  const {canvas} = gl, renderer = rendererOf(gl, scene), traces = new Map(), colors = {};
  const solids = scene.solids.map(entry => ({...entry, rotation: transposed(entry.rotation), tone: colorOf(entry.color)}));
  const drawn = [...new Set([...scene.shown, ...solids.flatMap(({row, to}) => to === null ? [row] : [row, to]),
    ...scene.arrows.flat()])];
  let look = HOME, zoom = 1, pan = [0, 0], positions = new Float32Array(0), turnAt = () => [], n = 0, m = 0;
  let sizes = {}, before = null, follows = false, shown = 0, grid = null;
  let moving = [], moves = new Set(), turning = new Set(); // rows, and rotations
  // Places at some instants, and of what moves at each of these; bounds of all; the size of what moves at one instant, and
  // of all; sizes on the screen, and what is in the middle of it.
  let every = [], atOnce = [], bounds = [[], []], radius = 1, whole = 1, span = [1, 1], middleSeen = [0, 0, 0];

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
  // Rows of the matrix are the directions to the right, upwards, and to the reader.
  const matrixOf = ([turn, tilt]) => {
    const [c, s, ct, st] = [Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt)];
    return transposed([c, -s, 0, s * ct, c * ct, -st, s * st, c * st, ct]);
  };
  // Where a solid is, and the matrix that turns and scales it; null where that is not known.
  const placedAt = (i, {row, turn, offset, rotation, to, length, changes}) => {
    let place = at(i, row), matrix = rotation;
    if (to !== null) {
      const end = at(i, to), way = minus(end, place), z = unitOf(way), x = unitOf(crossed(farthest(z), z));
      const longer = Math.hypot(...way) / length;
      matrix = [...x, ...crossed(z, x), ...z.map(entry => longer * entry)];
      place = place.map((entry, j) => (entry + end[j]) / 2);
    } else if (turn !== null) {
      const own = turnAt(i, turn), moved = times3(own, resized(offset, changes, sizes));
      matrix = product3(own, rotation);
      place = place.map((entry, j) => entry + moved[j]);
    }
    return isKnown(place) && matrix.every(Number.isFinite) ? [place, matrix] : null;
  };
  // All points that are drawn, or those that move, and the corners of the solids there, at an instant.
  const placesOf = (i, all) => [...(all ? drawn : moving).map(k => at(i, k)), ...solids.flatMap(solid => {
    const found = all || moves.has(solid.row) || moves.has(solid.to) || turning.has(solid.turn) ? placedAt(i, solid) : null;
    if (!found) return [];
    const [place, matrix] = found;
    return renderer.corners(solid.mesh).map(corner => times3(matrix, corner).map((value, j) => place[j] + value));
  })];
  const some = most => {
    const count = Math.min(n, most), last = Math.max(1, count - 1);
    return Array.from({length: count}, (_, k) => Math.round(k * (n - 1) / last));
  };
  // Pixels of the page for a unit of length.
  const scaleNow = () => zoom * MARGIN * Math.min(canvas.clientWidth / span[0], canvas.clientHeight / span[1]);

  // A grid in the ground, whose axes are two directions in it and its normal.
  const makeGrid = () => {
    if (grid) renderer.free(grid);
    grid = null;
    const toInertial = scene.groundAxes.flat(), toGround = transposed(toInertial);
    const heights = scene.ground.map(k => times3(toGround, at(0, k))[2]).filter(Number.isFinite);
    if (!heights.length) return;
    // Fine enough to see the motion, but with not too many lines under a long run.
    const [least, most] = boundsOf(every.map(a => times3(toGround, a)));
    const z = Math.min(...heights), room = 0.6 * radius, step = ticksBetween(0, Math.max(2 * radius, whole / 10), 8)[1] ?? 1;
    const [x0, y0] = least.map(value => Math.floor((value - room) / step) * step);
    const [x1, y1] = most.map(value => Math.ceil((value + room) / step) * step);
    const points = [], gap = [NaN, NaN, NaN];
    for (let x = x0; x < x1 + step / 2; x += step) points.push([x, y0, z], [x, y1, z], gap);
    for (let y = y0; y < y1 + step / 2; y += step) points.push([x0, y, z], [x1, y, z], gap);
    grid = renderer.line(points.map(a => times3(toInertial, a)));
  };
  const drawTrace = k => {
    const trace = traces.get(k);
    for (const name of ["line", "ghost"]) if (trace[name]) renderer.free(trace[name]);
    const way = places => Array.from({length: places.length / 3 / m}, (_, i) => at(i, k, places));
    trace.line = m ? renderer.line(way(positions)) : null;
    trace.ghost = before && m ? renderer.line(way(before)) : null;
  };
  const drawArrow = ([a, b], matrix) => {
    const way = minus(b, a), length = Math.hypot(...way), pixels = scaleNow();
    if (!(length * pixels > 1)) return;
    const along = unitOf(way), side = crossed(along, times3(transposed(matrix), [0, 0, 1]));
    const back = Math.min(0.3 * length, 9 / pixels);
    const [left, right] = [-0.5, 0.5].map(sign => b.map((value, j) => value - back * (along[j] + sign * side[j])));
    renderer.drawPoints([a, b], colors.force, 3);
    renderer.drawPoints([left, b, right], colors.force, 3);
  };

  let frame = null;
  const render = () => {
    frame = null;
    const matrix = matrixOf(look), own = follows ? boundsOf(placesOf(shown, false)) : null;
    // What is in the middle: the mechanism that is followed, or what is in the middle of the first view.
    const about = own && Number.isFinite(own[0][0]) ? [0, 1, 2].map(j => (own[0][j] + own[1][j]) / 2) :
      times3(transposed(matrixOf(HOME)), middleSeen);
    const middle = times3(matrix, about).map((value, j) => value - (pan[j] ?? 0));
    renderer.see({canvas, page: colors.page, matrix, middle, pixels: scaleNow(), depth: 2 * (whole + 4 * radius)});
    if (!n) return;
    gl.enable(gl.POLYGON_OFFSET_FILL); // under traces in the same plane
    gl.polygonOffset(1, 4);
    renderer.drawLine(grid, colors.faint, 1);
    gl.disable(gl.POLYGON_OFFSET_FILL);
    for (const {line, ghost} of traces.values()) {
      renderer.drawLine(ghost, colors.soft, 1, 0.7);
      renderer.drawLine(line, colors.accent, 2);
    }
    for (const {kind, rows} of scene.lines) if (kind === "actuator" || kind === "line") {
      const points = rows.map(k => at(shown, k));
      renderer.drawPoints(points, kind === "line" ? colors.ink : colors.force, kind === "line" ? 2 : 3);
    }
    for (const symbol of scene.symbols) if (symbol.kind === "spring" || symbol.kind === "damper") {
      renderer.drawPoints(coiled(at(shown, symbol.at), at(shown, symbol.toward), symbol, scene.unit), colors.curve2, 2);
    }
    for (const ends of scene.arrows) drawArrow(ends.map(k => at(shown, k)), matrix);
    for (const solid of solids) {
      const found = placedAt(shown, solid);
      if (found) renderer.drawMesh(solid.mesh, ...found, solid.tone);
    }
  };
  const soon = () => { frame ??= requestAnimationFrame(render); };

  const picture = {
    // The positions of a run and of the run before, the rotations of the bodies, and parameters that are sizes.
    set(given, rows, ghost = null, turns = turnAt, values = {}) {
      positions = given;
      turnAt = turns;
      sizes = values;
      renderer.resize(sizes);
      m = rows;
      n = m ? given.length / 3 / m : 0;
      before = ghost;
      moving = drawn.filter(k => {
        const first = at(0, k);
        for (let i = 1; i < n; ++i) if (minus(at(i, k), first).some(value => Math.abs(value) > STILL)) return true;
        return false;
      });
      moves = new Set(moving);
      const instants = some(12);
      turning = new Set(solids.map(({turn}) => turn).filter(turn => turn !== null && instants.some(i => {
        const first = turnAt(0, turn);
        return turnAt(i, turn).some((entry, j) => Math.abs(entry - first[j]) > STILL);
      })));
      atOnce = instants.map(i => placesOf(i, false));
      every = [...n ? placesOf(0, true) : [], ...some(60).flatMap(i => moving.map(k => at(i, k))), ...atOnce.flat()];
      bounds = boundsOf(every);
      whole = diagonalOf(bounds) || 1;
      radius = Math.max(...atOnce.map(places => diagonalOf(boundsOf(places))).filter(Number.isFinite), 0) || whole;
      picture.fit();
    },
    // The scale is that of the first view, so that it stays as the picture is turned.
    fit() {
      if (!Number.isFinite(bounds[0][0])) return;
      const home = matrixOf(HOME), windows = (follows ? atOnce : [every]).map(places => boundsOf(places.map(a => times3(home, a))));
      span = [0, 1].map(j => Math.max(...windows.map(([a, b]) => b[j] - a[j]).filter(Number.isFinite), 1e-3 * radius));
      middleSeen = [0, 1, 2].map(j => (windows[0][0][j] + windows[0][1][j]) / 2);
      makeGrid();
    },
    travels() {
      return moving.length > 1 && diagonalOf(boundsOf(atOnce.flat())) > FAR * radius;
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
        for (const line of Object.values(traces.get(k))) if (line) renderer.free(line);
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
      look = VIEWS[name];
      if (name === "home") { zoom = 1; pan = [0, 0]; }
      soon();
    },
  };
  handle(canvas, {
    look: picture.look,
    rotate(across, up) {
      look = [look[0] + across, Math.max(-Math.PI, Math.min(0, look[1] + up))];
      soon();
    },
    shift(x, y) {
      pan = [pan[0] + x / scaleNow(), pan[1] - y / scaleNow()];
      soon();
    },
    enlarge(factor) {
      zoom = Math.max(0.1, Math.min(100, zoom * factor));
      soon();
    },
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { readColors(); soon(); });
  new ResizeObserver(soon).observe(canvas);
  readColors();
  return picture;
};

// The picture in an element <svg>, or in a canvas in its place if there are bodies in space.
const pictureOf = (svg, scene) => {
  if (!scene.solids.length) return mechanismPicture(svg, scene);
  const gl = contextOf();
  if (!gl) return mechanismPicture(svg, scene);
  const {canvas} = gl, picture = solidPicture(gl, scene);
  for (const name of ["id", "role", "aria-label"]) canvas.setAttribute(name, svg.getAttribute(name));
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
