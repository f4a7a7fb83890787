// A report: one run, with its numbers in the page.
const data = JSON.parse(byId("data").textContent);
const floats = text => new Float32Array(bytesOf(text).buffer);
const times = new Float64Array(bytesOf(data.times).buffer), positions = floats(data.positions);
if (data.scene.planar) byId("turn").remove();

const picture = pictureOf(byId("mechanism"), data.scene);
// The rotation matrix of a quaternion, column by column.
const turnOf = ([x, y, z, w]) => [
  1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w),
  2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w),
  2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)];
const rotations = floats(data.rotations), turns = rotations.length / 4 / times.length;
picture.set(positions, positions.length / 3 / times.length, null,
  (i, k) => turnOf(rotations.subarray(4 * (i * turns + k), 4 * (i * turns + k + 1))));
followBox(byId("follow"), picture);
let plots = [], width = 0;
const controls = player(i => {
  picture.draw(i);
  for (const plot of plots) plot.show(i);
});
controls.set(times);
const drawPlots = () => {
  if (byId("plots").clientWidth === width) return;
  width = byId("plots").clientWidth;
  for (const plot of plots) plot.draw();
  controls.show(controls.shown());
};
addEventListener("resize", drawPlots);

const plotOf = ({title, log, open, bodies, curves}) => {
  const details = make("details", {}, byId("plots"));
  make("summary", {}, details, title);
  details.open = open;
  const plot = timePlot(details, {title, log, names: curves.map(({name}) => name), bodies}, i => controls.seek(i));
  plot.set(times, curves.map(({values}) => floats(values)));
  details.addEventListener("toggle", () => {
    plot.draw();
    plot.show(controls.shown());
  });
  return plot;
};
const fillPage = () => {
  if (data.longest > 0) {
    make("p", {}, byId("mechanism").parentElement, `Arrows are forces of inputs; the longest is ${numberText(data.longest)} N.`);
  }
  traceBoxes(byId("traces"), data.scene.points, picture);
  for (const [name, value] of data.table) {
    const row = make("tr", {}, byId("settings"));
    make("th", {scope: "row"}, row, name);
    make("td", {}, row, value);
  }
  plots = data.plots.map(plotOf);
  drawPlots();
};
if (data.scene.solids.length) { // bodies take longer to draw, and people look at them first
  controls.show(0);
  requestAnimationFrame(() => setTimeout(() => {
    performance.mark("first picture");
    fillPage();
  }));
} else fillPage();
