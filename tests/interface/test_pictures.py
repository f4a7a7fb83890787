"""Points, plots, animations and the interactive report, which a real browser opens."""

import base64
import io
import json
import re
import subprocess
import warnings

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.prescribed import driven_slider_crank
from builders.systems import pendulum
from click.testing import CliRunner
from harness.programs import complaints, require

import fourbar_codegen as fb
from fourbar_codegen.cli import main

M, G, L = sm.symbols("m g l")


@pytest.fixture(scope="module")
def trajectory(four_bar):
    return four_bar.simulate((0.0, 4.0), rtol=1e-9, atol=1e-9)


def test_points_of_a_four_bars_run_equal_trigonometry(four_bar, trajectory):
    """From the angles, by trigonometry; the last joint is where the first link begins."""
    q1, q2, q3 = trajectory.q
    points = trajectory.points
    middle = np.array([0.4 + 0.5 * np.cos(q1), 0.5 * np.sin(q1)])
    top = middle + np.array([np.cos(q1 + q2), np.sin(q1 + q2)])
    end = top + 0.7 * np.array([np.cos(q1 + q2 + q3), np.sin(q1 + q2 + q3)])
    for name, expected in (("P2", middle), ("joint3_link3_joint", top), ("P44", end), ("P41", [[-0.4], [0.0]])):
        np.testing.assert_allclose(points[name][:2] - expected, 0.0, atol=1e-15)
        np.testing.assert_array_equal(points[name][2], 0.0)
    np.testing.assert_allclose(points["P44"], points["P41"], atol=1e-12)
    one = four_bar.positions(trajectory.t[3], trajectory.q[:, 3])
    np.testing.assert_array_equal(one["P2"], points["P2"][:, 3])


@pytest.mark.slow(but=["slider_crank", "whipple_bicycle"])
@pytest.mark.parametrize("make", [fb.models.whipple_bicycle, fb.models.slider_crank, lambda: fb.models.chain(3)])
def test_points_of_ready_models_at_random_positions_equal_sympys(make):
    model = make()
    compiled = fb.compile_model(model)
    system = model.system
    generator = np.random.default_rng(1)
    q = generator.uniform(-1.0, 1.0, compiled.n_q)
    values = dict(zip((*system.q_ind, *system.q_dep), q, strict=True))
    values |= {s: p.value for s, p in model.parameter_symbols.items()}
    positions = compiled.positions(0.0, q)
    bodies = {entry["body"]: entry["name"] for entry in compiled.manifest["points"] if entry["body"]}
    assert len(bodies) == len([body for body in system.bodies if body.name in bodies]) > 0
    for body in system.bodies:
        if body.name in bodies:
            vector = body.masscenter.pos_from(system.fixed_point).to_matrix(system.frame)
            expected = np.array(vector.subs(values).evalf(), dtype=float).ravel()
            np.testing.assert_allclose(positions[bodies[body.name]], expected, rtol=0, atol=1e-13)


def test_points_that_nothing_else_needs_are_drawn_if_their_symbols_are_known(tmp_path):
    """Two points of one name, and one that has the name with a number; one by a symbol that the equations do not have,
    which is left out."""
    system = pendulum()
    origin, frame = system.fixed_point, system.frame
    origin.locatenew("mark", 2 * frame.x)
    origin.locatenew("mark", 3 * frame.x)
    origin.locatenew("mark (2)", 4 * frame.x)
    origin.locatenew("unknown", sm.Symbol("w") * frame.x)
    model = fb.compile_model(fb.Model(system, name="marked", parameters={M: 1.0, G: 9.81, L: 2.0}))
    assert model.points == ("O", "P", "mark", "mark (3)", "mark (2)")
    q = 0.3
    positions = model.positions(0.0, [q])
    np.testing.assert_allclose(positions["P"], [2.0 * np.cos(q), 2.0 * np.sin(q), 0.0], atol=1e-15)
    assert positions["mark (3)"].tolist() == [3.0, 0.0, 0.0]
    assert positions["mark (2)"].tolist() == [4.0, 0.0, 0.0]


def test_pictures_of_a_system_without_positions_are_refused(tmp_path):
    x, u = me.dynamicsymbols("x u")
    frame, point = me.ReferenceFrame("N"), me.Point("P")
    point.set_vel(frame, u * frame.x)
    bodies = [me.Particle("B", point, sm.Symbol("m"))]
    kane = me.KanesMethod(frame, [x], [u], [u - x.diff()], bodies=bodies, forcelist=[(point, -x * frame.x)])
    model = fb.compile_model(fb.Model(kane, name="unplaced", parameters={M: 1.0}))
    run = model.simulate((0.0, 1.0), [1.0, 0.0])
    assert run.points == {}
    with pytest.raises(fb.ModelError, match="nothing of unplaced to draw"):
        run.save(tmp_path / "run.html")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("how", [{}, {"dense_output": True}, {"t_eval": np.linspace(0.0, 4.0, 201)}])
@pytest.mark.parametrize("backwards", [False, True])
def test_resampled_runs_in_either_direction_equal_exact_runs_with_closed_loops(four_bar, how, backwards):
    x0 = four_bar.initial_state()
    span = (0.0, 4.0)
    if backwards:
        x0 = four_bar.simulate(span, x0, rtol=1e-10, atol=1e-10).y[:, -1]
        span, how = (4.0, 0.0), {k: v if v is True else v[::-1] for k, v in how.items()}
    run = four_bar.simulate(span, x0, rtol=1e-10, atol=1e-10, **how)
    times = np.linspace(*span, 57)
    exact = four_bar.simulate(span, x0, rtol=1e-13, atol=1e-13, t_eval=times)
    shown = run.resample(times)
    # Of DOP853's own interpolant the tolerance of some dozen steps; of cubic polynomials h^4 x'''' / 384, and x'''' is
    # below 1e3 rad/s^4, by differences of the exact states.
    error = 1e-8 if "dense_output" in how else np.abs(np.diff(run.t)).max() ** 4 / 384 * 1e3
    np.testing.assert_allclose(shown.y, exact.y, rtol=0, atol=error)
    np.testing.assert_allclose(shown.r, 100.0 * np.sin(np.pi * times)[np.newaxis], atol=1e-12)
    assert np.abs(shown.constraint_residual).max() < 1e-12
    with pytest.raises(fb.ModelError, match="times must"):
        run.resample([0.0, 5.0])


@pytest.mark.slow
def test_plot_of_a_run_has_a_panel_for_each_group_of_quantities(trajectory, tmp_path):
    figure = trajectory.plot()
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert [title.split(" (")[0] for title in titles] == [
        "Coordinates", "Speeds", "Inputs", "Energy", "Multipliers of the constraints", "Loop residual",
    ]  # fmt: skip
    assert [line.get_label() for line in figure.axes[0].lines] == ["q1", "q2", "q3"]
    assert trajectory.save(tmp_path / "run.png").stat().st_size > 10_000


@pytest.mark.slow
def test_animations_saved_as_gif_have_moving_frames(trajectory, tmp_path):
    from PIL import Image

    path = trajectory.resample(np.linspace(0.0, 1.0, 5)).save(tmp_path / "run.gif")
    with Image.open(path) as image:
        assert image.n_frames == 31
        frames = []
        for frame in (0, 15):
            image.seek(frame)
            frames.append(np.asarray(image.convert("L")))
    assert (frames[0] < 100).sum() > 500  # ink
    assert (frames[0] != frames[1]).sum() > 500
    assert list(tmp_path.iterdir()) == [path]
    animation = trajectory.resample([0.0, 0.1]).animate(traces=["P2"], speed=0.5)
    assert "<img" in animation.to_jshtml()
    with pytest.raises(fb.ModelError, match="no point P9"):
        trajectory.animate(traces=["P9"])
    with pytest.raises(fb.ModelError, match="fps"):
        trajectory.animate(fps=0.0)


@pytest.mark.slow
def test_films_saved_as_mp4_have_all_frames(trajectory, tmp_path):
    require("ffmpeg")
    ffprobe = require("ffprobe")
    path = trajectory.resample(np.linspace(0.0, 1.0, 5)).save(tmp_path / "run.mp4")
    command = [ffprobe, "-v", "error", "-count_frames", "-show_entries", "stream=codec_type,nb_read_frames", path]
    told = subprocess.run([*command, "-of", "json"], capture_output=True, text=True, check=True).stdout
    assert json.loads(told)["streams"] == [{"codec_type": "video", "nb_read_frames": "31"}]


def test_forces_of_inputs_along_a_run_are_at_their_points(four_bar, trajectory):
    """The tutorial's force acts along x where links 3 and 4 meet, and is drawn there; gravity is no input's."""
    assert four_bar.forced_points == ("joint3_link3_joint",)
    [force] = trajectory.forces.values()
    np.testing.assert_allclose(force[0], 100.0 * np.sin(np.pi * trajectory.t), atol=1e-12)
    assert not force[1:].any()
    model = fb.models.slider_crank()
    crank = fb.compile_model(model)
    run = crank.simulate((0.0, 0.1), inputs={"load": -50.0, "torque": 3.0})
    assert {name: rows[:, 0].tolist() for name, rows in run.forces.items()} == {"S": [-50.0, 0.0, 0.0]}


def test_force_of_an_input_that_turns_with_its_body_is_drawn_turned():
    """Along the pendulum's arm, twice as strong as the input, at the end of it; nothing without an input."""
    system = pendulum()
    system.add_loads(me.Force(system.bodies[0].masscenter, 2 * me.dynamicsymbols("T") * _arm(system).y))
    model = fb.Model(system, name="pushed", parameters={M: 1.0, G: 9.81, L: 2.0}, inputs={me.dynamicsymbols("T"): 3})
    run = fb.compile_model(model).simulate((0.0, 1.0), [0.3, 0.0])
    [(name, force)] = run.forces.items()
    assert name == "P"
    # The other load at that point is gravity, which has no input in it.
    np.testing.assert_allclose(force, 6.0 * np.array([-np.sin(run["q"]), np.cos(run["q"]), 0.0 * run["q"]]), atol=1e-14)


def _arm(system):
    """The frame in which the pendulum's arm lies."""
    position = system.bodies[0].masscenter.pos_from(system.fixed_point)
    return position.args[0][1]


@pytest.mark.slow
def test_force_that_is_nan_has_no_arrow_and_leaves_others(tmp_path):
    """It has no arrow where it is none; another one keeps its own."""
    system, q = pendulum(), me.dynamicsymbols("q")
    F, root = me.dynamicsymbols("F"), me.dynamicsymbols("R")
    bob, frame = system.bodies[0].masscenter, system.frame
    system.add_loads(me.Force(system.fixed_point, root * sm.sqrt(q) * frame.x), me.Force(bob, F * frame.y))
    model = fb.Model(system, name="rooted", parameters={M: 1.0, G: 9.81, L: 1.0}, inputs={F: -5.0, root: 1.0})
    run = fb.compile_model(model).simulate((0.0, 1.0), [0.3, 0.0])
    assert np.isnan(run.forces["O"]).any()
    assert np.isfinite(run.forces["P"]).all()
    _, data = data_of(run.save(tmp_path / "run.html"))
    positions = np.frombuffer(base64.b64decode(data["positions"]), dtype="<f4")
    assert np.isfinite(positions).all()
    assert run.save(tmp_path / "run.gif").stat().st_size > 1000


def test_paths_of_points_are_drawn_as_arcs(four_bar, trajectory):
    """The path of the crank's end is an arc about the joint of the ground."""
    figure = trajectory.plot_paths(["P2"])
    path = figure.axes[0].lines[-1]
    assert path.get_label() == "P2"
    np.testing.assert_allclose(np.hypot(path.get_xdata() - 0.4, path.get_ydata()), 0.5, atol=1e-12)
    bicycle = fb.compile_model(fb.models.whipple_bicycle())
    for lean in (0.0, 0.5):  # also straight on, wheels are seen in space
        run = bicycle.simulate((0.0, 0.2), bicycle.initial_state(speeds={"u4": lean, "u6": -15.0}))
        assert run.plot_paths().axes[0].name == "3d"
    labels = [line.get_label() for line in trajectory.plot_paths().axes[0].lines]
    # Two joints move. What lies at one place is traced once, and the pin that closes the loop is at rest.
    assert [label for label in labels if not label.startswith("_")] == ["P2", "joint3_link3_joint"]
    assert trajectory.plot_paths(name for name in ["P2"]).axes[0].lines[-1].get_label() == "P2"
    assert len(trajectory.resample([1.0]).plot_paths(["P2"]).axes) == 1


def test_films_without_ffmpeg_are_refused(trajectory, tmp_path, monkeypatch):
    monkeypatch.setattr("matplotlib.animation.FFMpegWriter.isAvailable", lambda: False)
    with pytest.raises(fb.ModelError, match="MP4 needs ffmpeg"):
        trajectory.save(tmp_path / "run.mp4")
    assert not list(tmp_path.iterdir())


def data_of(path):
    text = path.read_text(encoding="utf-8")
    return text, json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text)[1])


def test_report_as_a_file_is_small_and_loads_nothing_from_elsewhere(trajectory, tmp_path):
    path = trajectory.save(tmp_path / "run.html")
    text, data = data_of(path)
    assert len(text.encode()) < 300_000
    assert re.findall(r"https?://[^\"' ]+", text) == ["http://www.w3.org/2000/svg"]  # a name, not an address
    table = dict(data["table"])
    assert table["method"] == "DOP853"
    assert table["rtol"] == "1e-09"
    assert table["k"] == "100 N m/rad"
    assert table["fingerprint"] == trajectory.model.manifest["fingerprint"][:16]


def test_report_with_script_tags_in_names_keeps_its_data_whole(tmp_path):
    model = fb.Model(pendulum(), name="sharp", parameters={M: fb.Parameter(1.0, "</script><b>kg"), G: 9.81, L: 1.0})
    run = fb.compile_model(model).simulate((0.0, 0.1), [0.1, 0.0])
    text, data = data_of(run.save(tmp_path / "run.html"))
    assert dict(data["table"])["m"] == "1 </script><b>kg"
    assert text.count("</script>") == 2


def test_report_and_animate_commands_write_their_files_and_refuse_other_suffixes(tmp_path):
    report, animation = tmp_path / "run.html", tmp_path / "run.gif"
    for command, path in (("report", report), ("animate", animation)):
        result = CliRunner().invoke(main, [command, "-t", "0", "0.2", "-p", "l2=0.45", "-o", str(path)])
        assert result.exit_code == 0, result.output
        assert f"Written: {path}" in result.output
        assert path.is_file()
        wrong = CliRunner().invoke(main, [command, "-o", str(tmp_path / "run.txt")])
        assert wrong.exit_code == 1
        assert "must end with" in wrong.output


@pytest.fixture
def opened(browser, tmp_path):
    """Opens a trajectory's report from disk; what the page complains of or asks for is noted."""
    noted = []

    def open_report(trajectory, *, has_webgl=True, **how):
        path = trajectory.save(tmp_path / "run.html")
        page = browser.new_page(**how)
        if not has_webgl:
            page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
        page.on("console", lambda message: noted.extend(complaints(message.text)))
        page.on("pageerror", lambda error: noted.append(str(error)))
        page.on("request", lambda request: noted.append(request.url))
        page.goto(path.as_uri())
        noted.remove(path.as_uri())
        return page

    yield open_report
    assert noted == []


def center(page, point):
    dot = page.locator(f'circle[data-point="{point}"]')
    return np.array([float(dot.get_attribute("cx")), float(dot.get_attribute("cy"))])


def wait(page, condition):
    """The page's own rules let nobody run a function of theirs in it until something holds."""
    for _ in range(400):
        if condition():
            return
        page.wait_for_timeout(25)
    pytest.fail("nothing happened in 10 s")


@pytest.mark.slow
def test_report_scrubbed_to_a_time_shows_the_state_at_that_time(opened, trajectory):
    page = opened(trajectory)
    scrub = page.locator("#scrub")
    assert scrub.get_attribute("max") == "240"
    times = np.linspace(0.0, 4.0, 241)
    points = trajectory.resample(times).points
    # The page chooses scale and place: they follow from two points at rest, the ground's, 0.8 m apart.
    ends = center(page, "P41"), center(page, "P1")
    scale = (ends[1][0] - ends[0][0]) / 0.8
    for frame in (0, 1, 77, 240):
        scrub.fill(str(frame))
        assert page.locator("#time").text_content() == f"t = {times[frame]:.3f} s"
        for name in ("P2", "joint3_link3_joint", "link3_masscenter"):
            x, y, _ = points[name][:, frame]
            expected = ends[0] + scale * np.array([x + 0.4, -y])
            # To the third decimal of a pixel that the page writes, and single precision.
            np.testing.assert_allclose(center(page, name), expected, rtol=0, atol=2e-3)
        # The arrow of the force: a quarter of the mechanism's size at its greatest.
        size = max(np.ptp([rows[axis] for rows in points.values()]) for axis in range(3))
        arrow = page.locator('line[data-force="joint3_link3_joint"]')
        x1, x2, y1, y2 = (float(arrow.get_attribute(name)) for name in ("x1", "x2", "y1", "y2"))
        np.testing.assert_allclose([x1, y1], center(page, "joint3_link3_joint"), atol=2e-3)
        greatest = np.abs(np.sin(np.pi * times)).max()
        assert x2 - x1 == pytest.approx(0.25 * size * scale * np.sin(np.pi * times[frame]) / greatest, abs=4e-3)
        assert y2 == y1
        assert arrow.get_attribute("visibility") == ("hidden" if abs(x2 - x1) < 1 else "visible")
    shown = page.locator("#plots output").first.text_content()
    assert float(shown) == pytest.approx(trajectory.q[0, -1], abs=1e-3)


@pytest.mark.slow
def test_report_has_closed_plots_of_momenta_that_open(opened, trajectory):
    page = opened(trajectory)
    summary = page.get_by_text("Linear momentum (kg m/s)", exact=True)
    values = summary.locator("xpath=..").locator("output")
    assert not values.first.is_visible()
    page.keyboard.press("End")
    summary.click()
    # The links' masses are 100 kg/m times their lengths; the shown digits are those of the label.
    masses = {"link2_masscenter": 50.0, "link3_masscenter": 100.0, "link4_masscenter": 70.0}
    expected = sum(m * trajectory.velocities[name][:, -1] for name, m in masses.items())
    assert [float(value) for value in values.all_text_contents()] == pytest.approx(expected, rel=1e-3, abs=1e-12)
    assert values.first.is_visible()


@pytest.mark.slow
def test_report_play_moves_the_linkage_until_the_end(opened, trajectory):
    page = opened(trajectory)
    before = center(page, "P2")
    page.locator("#play").click()
    wait(page, lambda: int(page.locator("#scrub").input_value()) > 5)
    assert page.locator("#play").text_content() == "Pause"
    page.locator("#play").click()
    held = page.locator("#scrub").input_value()
    assert np.abs(center(page, "P2") - before).max() > 0.5
    page.wait_for_timeout(100)
    assert page.locator("#scrub").input_value() == held
    page.locator("#speed").select_option("4")
    page.locator("#scrub").fill("235")
    page.locator("#play").click()
    wait(page, lambda: page.locator("#play").text_content() == "Play")
    assert page.locator("#scrub").input_value() == "240"


@pytest.mark.slow
def test_report_by_keyboard_on_a_phone_scrubs_and_fits_the_window(opened, trajectory):
    page = opened(trajectory, viewport={"width": 390, "height": 800})
    page.keyboard.press("End")
    assert page.locator("#scrub").input_value() == "240"
    page.keyboard.press("ArrowLeft")
    assert page.locator("#scrub").input_value() == "239"
    page.keyboard.press("Home")
    page.keyboard.press("Space")
    wait(page, lambda: int(page.locator("#scrub").input_value()) > 2)
    page.keyboard.press("Space")
    page.get_by_label("P2", exact=True).check()
    assert len(page.locator("polyline.trace").first.get_attribute("points").split()) == 241
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")


@pytest.mark.slow
def test_report_of_a_spatial_mechanism_turns_by_the_mouse(opened):
    bicycle = fb.compile_model(fb.models.whipple_bicycle())
    x0 = bicycle.initial_state({"q4": 0.1}, {"u6": -15.0})
    page = opened(bicycle.simulate((0.0, 1.0), x0), has_webgl=False)  # lines, then
    before = center(page, "fo")
    box = page.locator("#mechanism").bounding_box()
    page.mouse.move(box["x"] + 100, box["y"] + 100)
    page.mouse.down()
    page.mouse.move(box["x"] + 200, box["y"] + 130)
    page.mouse.up()
    assert np.abs(center(page, "fo") - before).max() > 5.0


def test_resampled_run_with_a_prescribed_motion_takes_its_source_in_between():
    """Not with what lies on lines between stored times, which would close the loop in the wrong place."""
    model = fb.compile_model(driven_slider_crank())
    times = np.linspace(0.0, 1.0, 101)
    how = {"parameters": {"w": 0.0}, "inputs": {"s": (times, 4.0 * times**2)}, "rtol": 1e-9}
    x0 = model.initial_state(t=0.0, guess=[0.0, 0.9], parameters=how["parameters"], inputs=how["inputs"])
    shown = np.linspace(0.05, 0.95, 7)
    exact = model.simulate((0.0, 1.0), x0, t_eval=shown, **how)
    dense = model.simulate((0.0, 1.0), x0, dense_output=True, **how)
    np.testing.assert_allclose(dense.resample(shown).y, exact.y, rtol=0, atol=1e-9)
    np.testing.assert_allclose(dense.resample(shown).r, exact.r, rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("first", ["P", "Q"])
def test_positions_of_a_system_with_two_roots_are_from_the_fixed_point(first):
    q1, q2, u1, u2 = me.dynamicsymbols("q1 q2 u1 u2")
    frame, fixed, other = me.ReferenceFrame("N"), me.Point("O"), me.Point("A")
    fixed.set_vel(frame, 0)
    other.set_vel(frame, 0)
    on_other, on_fixed = me.Point("P"), me.Point("Q")
    on_other.set_pos(other, q1 * frame.x)
    on_fixed.set_pos(fixed, q2 * frame.y)
    on_other.set_vel(frame, u1 * frame.x)
    on_fixed.set_vel(frame, u2 * frame.y)
    system = me.System(frame, fixed)
    bodies = [me.Particle("bp", on_other, 1), me.Particle("bq", on_fixed, 1)]
    system.add_bodies(*(bodies if first == "P" else bodies[::-1]))
    system.add_coordinates(q1, q2)
    system.add_speeds(u1, u2)
    system.add_kdes(u1 - q1.diff(), u2 - q2.diff())
    model = fb.compile_model(fb.Model(system, name="two_roots"))
    positions = model.positions(0.0, [1.0, 2.0])
    assert {name: place.tolist() for name, place in positions.items()} == {"O": [0.0, 0.0, 0.0], "Q": [0.0, 2.0, 0.0]}


@pytest.mark.slow
def test_pictures_and_datasets_of_runs_with_one_time_or_none_are_made_or_refused(four_bar, tmp_path):
    at_once = four_bar.simulate((0.0, 1.0), events=fb.Event(lambda t, x: t, terminal=True, at_start=True))
    assert at_once.t.tolist() == [0.0]
    for ending in ("html", "png", "gif"):
        at_once.save(tmp_path / f"run.{ending}")
    none = four_bar.simulate((0.0, 8.0), t_eval=[7.9, 8.0])
    assert none.t.size == 0
    with pytest.raises(fb.ModelError, match="no states"):
        none.resample([0.0])
    assert none.to_xarray()["q1"].shape == (0,)


def test_animation_on_a_full_disk_leaves_no_file(trajectory, tmp_path, monkeypatch):
    def save(image, *_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("PIL.Image.Image.save", save)
    with pytest.raises(fb.ModelError, match="No space left"):
        trajectory.resample([0.0, 0.1]).save(tmp_path / "run.gif")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_report_of_many_curves_at_late_times_shows_its_end(opened, tmp_path):
    """More numbers than a function takes arguments; times that single precision cannot tell apart."""
    q = me.dynamicsymbols("q")
    many = {f"o{i}": (i + 1) * q for i in range(230)}
    model = fb.compile_model(fb.Model(pendulum(), name="many", parameters={M: 1.0, G: 9.81, L: 1.0}, outputs=many))
    page = opened(model.simulate((1e8, 1e8 + 10.0), [0.3, 0.0]))
    page.keyboard.press("End")
    assert page.locator("#time").text_content() == "t = 100000010.000 s"


@pytest.fixture(scope="module")
def nine_masses():
    """Each on its spring, of which the last is at rest."""
    frame, origin = me.ReferenceFrame("N"), me.Point("O")
    system = me.System(frame, origin)
    origin.set_vel(frame, 0)
    for number in range(1, 10):
        (x, v), point = me.dynamicsymbols(f"x{number} v{number}"), me.Point(f"P{number}")
        point.set_pos(origin, x * frame.x + number * frame.y)
        point.set_vel(frame, v * frame.x)
        system.add_coordinates(x)
        system.add_speeds(v)
        system.add_kdes(v - x.diff())
        system.add_bodies(me.Particle(f"mass{number}", point, 1))
        system.add_loads(me.Force(point, -x * frame.x))
    model = fb.compile_model(fb.Model(system, name="nine_masses"))
    return model.simulate((0.0, 3.0), [*([0.5] * 8), 0.0, *([0.0] * 9)])


@pytest.mark.slow
def test_many_curves_are_grouped_by_body_and_hidden_at_rest_and_by_a_click(opened, nine_masses):
    page = opened(nine_masses)
    coordinates = page.locator("#plots > details").first
    summary = coordinates.locator("details summary")
    assert summary.inner_text() == "9 curves, 1 of them hidden"
    assert coordinates.locator("polyline.curve").count() == 8
    summary.click()
    assert coordinates.locator("strong").all_inner_texts() == [f"mass{number}" for number in range(1, 10)]
    for name, count in (("x9", 9), ("x1", 8), ("x1", 9)):
        coordinates.get_by_role("button", name=name).click()
        assert coordinates.locator("polyline.curve").count() == count


def test_plots_of_many_curves_have_a_legend_below_with_the_bodies(nine_masses):
    figure = nine_masses.plot()
    nine_masses.report()  # which compiles positions
    figure = nine_masses.plot()
    names = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert names == [name for number in range(1, 10) for name in (f"mass{number}:", f"x{number}")]
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # Matplotlib's, if there is no room
        figure.savefig(io.BytesIO())
