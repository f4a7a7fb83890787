"""Live pages in a real browser: the same numbers as `simulate`, by sliders, by scripts, by links and by keyboard."""

import json
import re
import runpy
from pathlib import Path

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.systems import pendulum
from click.testing import CliRunner
from harness import PROJECT
from harness.programs import complaints, prepare_zig, require

import fourbar_codegen as fb
from fourbar_codegen.building import compiler
from fourbar_codegen.cli import main
from fourbar_codegen.compiled_model import facade_of
from fourbar_codegen.page import live_page

pytestmark = pytest.mark.slow

M, G, L = sm.symbols("m g l")
EXAMPLES = PROJECT / "examples"


@pytest.fixture(scope="module", autouse=True)
def wasm_libraries():
    prepare_zig(compiler.wasm_compiler())


@pytest.fixture(scope="module")
def made(four_bar):
    """The page of the four-bar linkage."""
    return four_bar.page(traces=["P2"])


@pytest.fixture
def opened(browser, tmp_path):
    """Opens a page from disk; what it complains of or asks for is noted. A worker's own text is no request."""
    noted, pages = [], []

    def open_page(made, link="", **how):
        path = tmp_path / f"page{len(pages)}.html"
        path.write_text(made.text, encoding="utf-8")
        page = browser.new_page(**how)
        pages.append(page)
        page.on("console", lambda message: noted.extend(complaints(message.text)))
        page.on("pageerror", lambda error: noted.append(str(error)))
        page.on("request", lambda request: noted.append(request.url) if request.url[:5] != "blob:" else None)
        page.goto(path.as_uri() + link)
        noted.remove(path.as_uri())
        until(page, "shownRun !== null && !busy")
        return page

    yield open_page
    for page in pages:
        page.close()
    assert noted == []


def until(page, condition):
    """Wait for a condition in the page; its rules do not let Playwright put functions into it."""
    for _ in range(1200):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(25)
    pytest.fail(f"not in 30 s: {condition}; {page.inner_text('#status')}")


def move(page, label, value):
    """Move a slider, as a hand does: many values while it is held, then it is released."""
    page.get_by_label(label, exact=True).evaluate(
        """(range, value) => {
            for (const part of [0.5, 1]) {
                range.value = Number(range.value) + part * (value - Number(range.value));
                range.dispatchEvent(new Event("input"));
            }
            range.dispatchEvent(new Event("change"));
        }""",
        value,
    )
    until(page, "!busy")


def shown(page):
    """Times and states of the run that the page shows."""
    t, rows = page.evaluate("[Array.from(shownRun.times), Array.from(shownRun.rows)]")
    n_x = page.evaluate("data.states.length")
    return np.array(t), np.reshape(rows, (len(t), -1))[:, :n_x].T


def simulated(page, **how):
    """The result of the page's own function for scripts."""
    found = page.evaluate("how => fourbar.simulate(how)", how)
    return {**found, "t": np.array(found["t"]), "y": np.array(found["y"])}


def exact(model, t, **how):
    """A run whose tolerance does not matter: it agrees with that of a tolerance of 1e-11 to 1e-10."""
    runs = [model.simulate((t[0], t[-1]), t_eval=t, rtol=tol, atol=tol, **how) for tol in (1e-11, 1e-13)]
    np.testing.assert_allclose(runs[0].y, runs[1].y, rtol=0, atol=1e-10 * max(1.0, np.abs(runs[1].y).max()))
    return runs[1].y


def test_page_after_moves_of_sliders_shows_the_run_of_simulate(opened, made, four_bar):
    """To 1e-9 at every time that is shown, and not the run that it began with."""
    page = opened(made)
    move(page, "l2 (m)", 0.46)
    move(page, "k (N m/rad)", 150)
    move(page, "q1", -0.4)
    move(page, "End", 2)
    values = page.evaluate("[settings.parameters, settings.initial, settings.t_span]")
    assert values[0] == {**four_bar.defaults, "l2": 0.46, "k": 150}
    assert values[1:] == [{"q1": -0.4, "u1": -0.1}, [0, 2]]
    t, y = shown(page)
    np.testing.assert_array_equal(t, np.linspace(0.0, 2.0, 241))
    x0 = four_bar.initial_state({"q1": -0.4}, {"u1": -0.1}, guess=[-2.2, -1.5], parameters={"l2": 0.46, "k": 150.0})
    np.testing.assert_allclose(y, exact(four_bar, t, x0=x0, parameters={"l2": 0.46, "k": 150.0}), rtol=0, atol=1e-9)


def test_page_of_the_four_bar_shows_the_reference_state_at_4_s(opened, made, four_bar):
    t, y = shown(opened(made))
    np.testing.assert_allclose(y, exact(four_bar, t), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("given", "source"),
    [
        (12.5, 12.5),
        ({"kind": "sine", "mean": 5, "amplitude": 40, "frequency": 0.7, "phase": 0.3},
         lambda t, x: 5.0 + 40.0 * np.sin(2.0 * np.pi * 0.7 * t + 0.3)),
        ({"kind": "step", "before": -20, "after": 30, "time": 0.35}, ([np.nextafter(0.35, 0.0), 0.35], [-20.0, 30.0])),
        ({"kind": "ramp", "from": -20, "to": 30, "begin": 0.2, "end": 0.6}, ([0.2, 0.6], [-20.0, 30.0])),
        (None, None),
    ],
    ids=["number", "sine", "step", "ramp", "expression"],
)  # fmt: skip
def test_page_given_inputs_of_all_kinds_by_scripts_gives_the_run_of_simulate(opened, made, four_bar, given, source):
    page = opened(made)
    times = np.linspace(0.0, 1.5, 31)
    found = simulated(page, inputs={"F": given}, t_span=[0, 1.5], times=times.tolist(), parameters={"c": 2.0})
    assert found["success"], found["message"]
    how = {} if source is None else {"inputs": {"F": source}}
    y = exact(four_bar, times, parameters={"c": 2.0}, **how)
    np.testing.assert_allclose(found["y"], y, rtol=0, atol=1e-9)


def test_page_runs_by_the_method_asked_for(opened, four_bar):
    """The method of the page, and that of a script; at a tolerance of 1e-4 others differ by that."""
    page = opened(four_bar.page(method="RK45", t_span=(0.0, 1.0)))
    times = np.linspace(0.0, 1.0, 11)
    for method, given in (("RK45", {}), ("DOP853", {"method": "DOP853"}), ("Radau", {"method": "Radau"})):
        found = simulated(page, times=times.tolist(), rtol=1e-4, atol=1e-4, **given)
        run = four_bar.simulate((0.0, 1.0), method=method, t_eval=times, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(found["y"], run.y, rtol=0, atol=1e-10)
        assert found["nfev"] == run.nfev
    place = {"fb": fb}
    exec(page.evaluate("pythonLines()"), place)
    assert place["run"].settings["method"] == "RK45"
    with pytest.raises(Exception, match=r"no method .*Euler.*DOP853"):
        simulated(page, method="Euler")


def test_page_marks_events_where_simulate_finds_them(opened, four_bar):
    events = ["u1", fb.Event("u3", direction=1), "lambda1", "kinetic_energy", "t"]
    page = opened(four_bar.page(events=events, t_span=(0.0, 2.0)))
    move(page, "l2 (m)", 0.45)
    expected = four_bar.simulate((0.0, 2.0), events=events, parameters={"l2": 0.45}, rtol=1e-11, atol=1e-11)
    assert [len(times) for times in expected.t_events] == [2, 1, 3, 0, 0]
    found = simulated(page, parameters={"l2": 0.45})
    assert (found["status"], found["success"]) == (0, True)
    marks = page.evaluate("shownRun.events.map(({event, t}) => [event, t])")
    assert [t for _, t in marks] == sorted(t for _, t in marks)
    for number, (times, states) in enumerate(zip(expected.t_events, expected.y_events, strict=True)):
        # a tolerance of 1e-11, over the least slope, 1 / s^2
        np.testing.assert_allclose(found["t_events"][number], times, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose([t for event, t in marks if event == number], times, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(np.reshape(found["y_events"][number], (-1, 6)), states, rtol=0.0, atol=1e-8)
    cells = [page.locator("#events tr").nth(row).locator("td") for row in range(5)]
    assert [row.nth(0).inner_text() for row in cells] == ["2", "1", "3", "0", "0"]
    assert "kinetic_energy is zero at t = " in page.inner_text("#status")
    assert cells[0].nth(1).inner_text() == ", ".join(f"{t:.6g}" for t in expected.t_events[0])
    # in each open plot all marks; those of u1 and u3 are dots on their curves
    speeds = page.locator("details", has=page.get_by_text("Speeds (rad/s or m/s)"))
    if not speeds.get_attribute("open"):
        speeds.locator("summary").click()
    until(
        page, "document.querySelectorAll('.event').length > 0 && document.querySelectorAll('.event circle').length > 0"
    )
    assert speeds.locator(".event").count() == 6
    assert speeds.locator(".event circle").count() == 3


def test_page_ends_its_run_at_a_terminal_event(opened, four_bar):
    """The state there is the last frame, and Python makes the same run from the page's lines."""
    page = opened(four_bar.page(events=[fb.Event("u1", terminal=3, direction=0), fb.Event("q2", all_roots=False)]))
    expected = four_bar.simulate((0.0, 4.0), events=fb.Event("u1", terminal=3), rtol=1e-11, atol=1e-11)
    assert "u1 ends the run at t = 2.284 s." in page.inner_text("#status")
    t, y = shown(page)
    assert t[-1] == pytest.approx(expected.t[-1], abs=1e-9)
    np.testing.assert_allclose(y[:, -1], expected.y[:, -1], rtol=0, atol=1e-8)
    found = simulated(page, times=[0.0, 1.0, 3.0])
    assert (found["status"], found["success"], found["message"]) == (1, True, "u1 ends the run")
    np.testing.assert_allclose(found["t"], [0.0, 1.0, t[-1]], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(found["y"][:, -1], y[:, -1], rtol=0, atol=1e-12)
    place = {"fb": fb}
    exec(page.evaluate("pythonLines()"), place)
    assert place["run"].status == 1
    assert place["run"].t[-1] == pytest.approx(t[-1], abs=1e-12)


def test_page_writes_odd_names_of_events_as_python(opened):
    """Quotes and backslashes, as in names of LaTeX."""
    model, q = fb.models.four_bar(), me.dynamicsymbols("q1")
    names = [r"\alpha", 'it\'s "q"', "θ_1"]
    given = {"parameters": model.parameters, "initial": model.initial}
    outputs = dict.fromkeys(names, q + 1.5)
    made = fb.compile_model(fb.Model(model.system, inputs={"F": 0}, outputs=outputs, **given)).page(
        events=[names[0], fb.Event(names[1], direction=-1), names[2]], t_span=(0.0, 1.0)
    )
    place = {"fb": fb, "model": None}
    page = opened(made)
    lines = page.evaluate("pythonLines()")
    text = next(line for line in lines.splitlines() if "events=" in line)
    assert [getattr(event, "function", event) for event in eval(f"dict({text.strip()})", place)["events"]] == names


def test_page_with_more_events_than_it_keeps_says_so(opened, four_bar):
    """A motor's torque that changes its sign 2,000 times within 1 s."""
    page = opened(four_bar.page(events="F", t_span=(0.0, 1.0)))
    wave = {"kind": "sine", "mean": 0, "amplitude": 1, "frequency": 1000.25, "phase": 0}
    found = simulated(page, inputs={"F": wave})
    np.testing.assert_allclose(found["t_events"][0], np.arange(1, 1001) / 2000.5, rtol=0.0, atol=1e-12)
    page.evaluate("settings.inputs.F = {kind: 'sine', values: [0, 1, 1000.25, 0]}; update()")
    until(page, "!busy")
    assert "Of 2000 events, the first 1000 are shown." in page.inner_text("#status")


def test_page_with_a_held_table_keeps_it_in_runs_scripts_and_links(opened, four_bar):
    """A table that is held: in the run, in scripts, in lines of Python, in a link; and what takes its place."""
    times = 0.01 * np.arange(150)
    table = (times, np.random.default_rng(5).normal(0.0, 50.0, 150), "hold")
    page = opened(four_bar.page(inputs={"F": table}, t_span=(0.0, 2.0)))
    t, states = shown(page)
    y = exact(four_bar, t, inputs={"F": table})
    np.testing.assert_allclose(states, y, rtol=0, atol=1e-9)
    at = np.linspace(0.0, 2.0, 41)
    found = simulated(page, inputs={"F": {"kind": "hold"}}, times=at.tolist(), parameters={"c": 2.0})
    np.testing.assert_allclose(
        found["y"], exact(four_bar, at, inputs={"F": table}, parameters={"c": 2.0}), rtol=0, atol=1e-9
    )
    place = {"fb": fb}
    exec(page.evaluate("pythonLines()"), place)
    np.testing.assert_array_equal(place["inputs"]["F"][1], table[1])
    np.testing.assert_allclose(place["run"].y[:, -1], y[:, -1], rtol=0, atol=1e-9)
    page.locator("#groups select").nth(1).select_option("constant")
    until(page, "!busy")
    assert "r.F=constant" in page.evaluate("linkText()")
    page.locator("#groups select").nth(1).select_option("hold")
    until(page, "!busy")
    assert page.evaluate("linkText()") == ""
    np.testing.assert_array_equal(shown(page)[1], states)


def test_page_answers_scripts_with_names_and_runs_and_refuses_wrong_ones(opened, made, four_bar):
    page = opened(made)
    names = page.evaluate("fourbar.names")
    assert names["states"] == list(four_bar.states)
    assert names["parameters"] == list(four_bar.parameters)
    assert names["independent"] == ["q1", "u1"]
    defaults = page.evaluate("fourbar.defaults")
    assert defaults["parameters"] == dict(four_bar.defaults)
    # Backwards to where it began, and the times given.
    forwards = simulated(page, t_span=[0, 0.5], times=[0, 0.5])
    end = dict(zip(four_bar.states, forwards["y"][:, 1], strict=True))
    back = simulated(page, t_span=[0.5, 0], times=[0], initial=end)
    np.testing.assert_allclose(back["y"][:, 0], forwards["y"][:, 0], rtol=0, atol=1e-9)
    # The other assembly mode.
    modes = np.exp(1j * four_bar.initial_states({"q1": -0.5}, {"u1": -0.1}).x[:, :3])
    found = [np.exp(1j * simulated(page, mode=mode, times=[0])["y"][:3, 0]) for mode in (0, 1)]
    assert sorted(np.abs(modes - place).max(axis=1).argmin() for place in found) == [0, 1]
    np.testing.assert_allclose([np.abs(modes - place).max(axis=1).min() for place in found], 0.0, atol=1e-12)
    for how, sentence in (
        ({"parameters": {"l9": 1}}, 'There is no parameter "l9"; there are: rho'),
        ({"initial": {"q9": 1}}, 'There is no state "q9"'),
        ({"inputs": {"F": {"kind": "noise"}}}, "one of constant, sine, step, ramp; not noise"),
        ({"inputs": {"F": {"kind": "sine", "mean": 1}}}, "F, amplitude, must be a finite number, not undefined"),
        ({"inputs": {"F": {"kind": "sine", "size": 1}}}, "There is no coefficient of a sine"),
        ({"parameters": {"l2": "0.4"}}, "l2 must be a finite number"),
        ({"times": [0, 9]}, "times lie within t_span"),
        ({"t_span": [0]}, "t_span has two times"),
        ({"mode": 7}, "There is no assembly mode 7; there are 2"),
        ({"rtol": 0}, "rtol is positive"),
        ({"speed": 2}, 'There is no option "speed"; there are: parameters, initial, inputs, t_span'),
        ({"mode": "length"}, "There is no assembly mode length"),
        ({"t_span": None}, "t_span has two times"),
        ({"parameters": None}, "parameters is an object, not null"),
    ):
        with pytest.raises(Exception, match=re.escape(sentence)):
            simulated(page, **how)


def test_page_writes_lines_of_python_that_make_its_run(opened, made, four_bar):
    """What the page writes makes the run that it shows."""
    page = opened(made)
    move(page, "l3 (m)", 0.95)
    move(page, "u1", -0.3)
    move(page, "End", 1)
    for kind in ("sine", "step", "step at 0", "ramp", "ramp to 0", "constant", "expression"):
        page.locator("#groups select").nth(1).select_option(kind.split()[0])
        until(page, "!busy")
        if kind == "step at 0":
            move(page, "F, time", 0)
        if kind == "ramp to 0":  # it ends before it begins
            move(page, "F, begin", 0.4)
            move(page, "F, end", 0)
        if page.locator("#code").is_hidden():
            page.locator("#python").click()
        names = {}
        exec(page.locator("#code").text_content(), names)
        assert names["model"].name == "four_bar"
        t, y = shown(page)
        assert names["run"].t[-1] == t[-1]
        np.testing.assert_allclose(names["run"].y[:, -1], y[:, -1], rtol=0, atol=1e-9)


def test_page_opened_by_its_link_has_all_settings_and_names_unknown_ones(opened, made):
    page = opened(made)
    move(page, "l2 (m)", 0.42)
    move(page, "q1", -0.3)
    page.locator("#groups select").first.select_option("1")
    until(page, "!busy")
    page.locator("#groups select").nth(1).select_option("sine")
    until(page, "!busy")
    move(page, "F, amplitude", 55)
    move(page, "End", 3)
    page.locator("#statistic").select_option("mean")
    page.locator("#quantity").select_option("kinetic energy")
    page.locator("#add").click()
    page.locator("summary", has_text="Speeds").click()
    page.locator("summary", has_text="Traces").click()
    page.get_by_label("P44", exact=True).check()
    until(page, "location.hash.includes('traces')")
    link = page.evaluate("location.hash")
    other = opened(made, link)
    for what in ("settings", "figures", "boxes.map(b => b.checked)", "plots.map(p => p.details.open)"):
        assert other.evaluate(what) == page.evaluate(what), what
    # The guess in the link has nine digits.
    np.testing.assert_allclose(shown(other)[1], shown(page)[1], rtol=0, atol=1e-9)
    wrong = opened(made, "#p.l9=1&p.l2=x&r.F=noise,1&mode=9&i.q1=-0.45")
    assert "does not know: p.l9, p.l2, r.F, mode." in wrong.inner_text("#status")
    assert wrong.evaluate("settings.initial.q1") == -0.45


def test_page_resets_its_settings_and_saves_the_shown_run_as_csv(opened, made, four_bar):
    page = opened(made)
    t, y = shown(page)
    move(page, "l2 (m)", 0.42)
    assert np.abs(shown(page)[1] - y).max() > 0.01
    assert page.locator("polyline.ghost").first.get_attribute("points") != ""
    assert re.fullmatch(r"[+\u2212][\d.]+ \([+\u2212][\d.]+ %\)", page.locator("#figures td").nth(1).text_content())
    page.locator("#reset").click()
    until(page, "!busy")
    np.testing.assert_array_equal(shown(page)[1], y)
    assert page.evaluate("location.hash") == ""
    with page.expect_download() as download:
        page.locator("#csv").click()
    lines = Path(download.value.path()).read_text().splitlines()
    header = lines[0].split(",")
    table = np.array([line.split(",") for line in lines[1:]], dtype=float)
    np.testing.assert_array_equal(table[:, 0], t)
    np.testing.assert_array_equal(table[:, 1:7].T, y)
    # Inputs, energies and multipliers are those of the package, to rounding errors times the condition.
    run = four_bar.simulate((0.0, 4.0), t_eval=t, rtol=1e-11, atol=1e-11)
    for name, values in (("F", run.r[0]), ("kinetic energy", run.kinetic_energy), ("total energy", run.energy),
                         ("lambda1", run.multipliers[0]), ("lambda2", run.multipliers[1]),
                         ("momentum_y", run.vectors["momentum"][1]), ("spin_z", run.vectors["spin"][2])):  # fmt: skip
        column = table[:, header.index(name)]
        np.testing.assert_allclose(column, values, rtol=0, atol=1e-7 * np.abs(values).max(), err_msg=name)
    # Both are rounding errors of the same loops, of positions alone.
    assert table[:, header.index("largest residual")].max() < 10 * np.abs(run.constraint_residual).max()


def test_page_draws_points_and_force_arrows_of_the_run(opened, made, four_bar):
    page = opened(made)
    t, _ = shown(page)
    run = four_bar.simulate((0.0, 4.0), t_eval=t, rtol=1e-11, atol=1e-11)
    places = np.reshape(page.evaluate("Array.from(shownRun.positions)"), (len(t), -1, 3))
    for row, name in enumerate(four_bar.points):
        np.testing.assert_allclose(places[:, row].T, run.points[name], rtol=0, atol=1e-8)
    force = run.forces["joint3_link3_joint"]
    arrow = places[:, -1] - places[:, four_bar.points.index("joint3_link3_joint")]
    np.testing.assert_allclose(arrow[:, 0] / np.abs(arrow).max(), force[0] / np.abs(force).max(), rtol=0, atol=1e-9)


def test_page_with_lengths_that_do_not_close_says_so_and_recovers(opened, made):
    page = opened(made)
    before = shown(page)[1]
    move(page, "l1 (m)", 1.6)
    assert "cannot be assembled with these values: no state nearby" in page.inner_text("#status")
    assert "stale" in page.locator("#mechanism").get_attribute("class")
    move(page, "l1 (m)", 0.8)
    assert page.inner_text("#status") == ""
    np.testing.assert_allclose(shown(page)[1], before, rtol=0, atol=1e-9)


def test_page_whose_run_reaches_a_singular_position_ends_there_with_a_message(opened, made):
    """The tutorial's linkage comes to one at t = 5.34 s."""
    page = opened(made)
    move(page, "End", 8)
    assert "The run ends at t = 5.337 s: the mechanism reaches a singular position" in page.inner_text("#status")
    t, y = shown(page)
    assert t[-1] == pytest.approx(5.34, abs=0.02)
    assert np.isfinite(y).all()


def test_page_replaces_a_worker_that_takes_too_long(opened, made):
    """The worker is busy for minutes; a run behind that and the next move wait, until the worker is replaced."""
    page = opened(made)
    page.evaluate("void engine.ask('evaluation', closedPoints[0], 1e10).catch(() => {})")
    page.evaluate("settings.t_span[1] = 0.7; moved()")
    page.evaluate("settings.t_span[1] = 0.8; moved()")
    until(page, "!busy && !waiting && shownRun.settings.t_span[1] === 0.8")
    assert shown(page)[0][-1] == 0.8
    assert page.inner_text("#status") == ""


def test_page_without_a_worker_simulates_in_its_own_thread(browser, made, tmp_path):
    """Where these are not allowed, the page's own thread simulates."""
    path = tmp_path / "page.html"
    path.write_text(made.text.replace("worker-src blob:", "worker-src 'none'"), encoding="utf-8")
    page = browser.new_page()
    page.goto(path.as_uri())
    until(page, "shownRun !== null && !busy")
    move(page, "l2 (m)", 0.45)
    assert page.evaluate("shownRun.settings.parameters.l2") == 0.45
    page.close()


def test_page_shows_no_states_after_a_run_that_ends_early(opened, four_bar):
    """A run that ends by the number of its steps, and one whose prescribed speed jumps before it begins."""
    model = fb.compile_model(fb.models.cartesian_pendulum())
    page = opened(model.page())
    found = simulated(page, t_span=[0, 1e6])
    assert not found["success"]
    assert "number of steps" in found["message"]
    x0 = page.evaluate("data.modes[0]")
    np.testing.assert_allclose(found["y"][:, 0], x0, rtol=0, atol=1e-12)
    assert np.abs(np.hypot(found["y"][0], found["y"][1]) - np.hypot(x0[0], x0[1])).max() < 1e-9
    linkage = fb.Linkage("jumping", points={"A": (0, 0), "B": (1, 0)}, ground="A", links=["AB"], density=1.0)
    t = me.dynamicsymbols._t
    linkage.drive("A", angle=sm.Piecewise((t, t < 1), (2 * t - 1, True)))
    page = opened(fb.compile_model(linkage.model()).page(t_span=(0.0, 0.5)))
    found = simulated(page, t_span=[0, 2])
    assert "speed of a prescribed motion jumps" in found["message"]
    assert found["t"].size == 0
    assert all(len(row) == 0 for row in found["y"])


def test_page_writes_the_guess_of_the_closed_state_into_its_address(opened, made):
    page = opened(made)
    box = page.get_by_label("l2 (m), number", exact=True)
    box.fill("0.7")
    box.press("Enter")
    until(page, "!busy && location.hash.includes('0.7')")
    guess = np.array(page.evaluate("new URLSearchParams(location.hash.slice(1)).get('guess').split(',').map(Number)"))
    np.testing.assert_allclose(guess, page.evaluate("closedPoints[0].x.filter((_, i) => dependent[i])"), atol=1e-8)


def test_page_given_a_link_during_a_run_takes_the_links_guess(opened, made):
    """What the old run finds is not the new settings' guess; what the page does not know is said."""
    page = opened(made)
    other = page.evaluate("data.modes[1].filter((_, i) => dependent[i]).join()")
    page.evaluate(f"void (moved(), readLink('p.l2=0.51&p.l9=1&guess={other}'))")
    until(page, "!busy && !waiting")
    angles = page.evaluate("[shownRun.x0[2], data.modes[1][2]]")
    assert np.sin(angles[0]) * np.sin(angles[1]) > 0.0
    assert "does not know: p.l9" in page.inner_text("#status")
    page.locator("summary", has_text="Traces").click()
    page.get_by_label("P44", exact=True).check()
    page.evaluate("readLink('p.l2=0.5')")
    until(page, "!busy && !waiting")
    assert not page.get_by_label("P44", exact=True).is_checked()


def test_page_with_random_lengths_keeps_the_assembly_mode_or_says_so(opened, made):
    """The two of a four-bar differ in the sign of sin q3."""
    page = opened(made)
    rng = np.random.default_rng(1)
    lengths = ["l1", "l2", "l3", "l4"]
    told = closed = 0
    for _ in range(150):
        chosen = dict(zip(lengths, rng.uniform(0.3, 1.5, 4).tolist(), strict=True)) | {"q1": float(rng.uniform(-3, 3))}
        run = page.evaluate(
            """async ({q1, ...lengths}) => {
                Object.assign(settings.parameters, lengths);
                settings.initial.q1 = q1;
                settings.t_span = [0, 0.01];
                const before = closedPoints[0].x[2];
                await update();
                return [before, shownRun.x0[2], byId("status").textContent];
            }""",
            chosen,
        )
        if "cannot be assembled" in run[2]:
            continue
        closed += 1
        if np.sin(run[0]) * np.sin(run[1]) < 0.0:
            told += 1
            assert "The assembly mode could not be followed" in run[2]
    assert closed > 50
    assert told > 0
    begin = page.evaluate("data.modes[0][2]")
    told = 0
    for _ in range(100):
        chosen = dict(zip(lengths, rng.uniform(0.3, 1.5, 4).tolist(), strict=True))
        found = simulated(page, parameters=chosen, initial={"q1": float(rng.uniform(-3, 3))}, times=[0])
        if found["success"] and np.sin(begin) * np.sin(found["y"][2, 0]) < 0.0:
            told += 1
            assert "The assembly mode could not be followed" in found["message"]
    assert told > 0


def test_page_follows_a_crank_rocker_in_its_mode_round_all_angles(opened):
    """It is never singular: the angle between coupler and rocker keeps the sign of its sine, wherever the crank is."""
    linkage = runpy.run_path(str(EXAMPLES / "11_mechanisms.py"))["crank_rocker"]()
    linkage.drive("OA", speed=10.0)
    page = opened(fb.compile_model(linkage.model()).page(t_span=(0.0, 0.1)))
    signs = []
    for value in np.linspace(-15.0, 15.0, 61).tolist():
        for given in (value, {"kind": "line", "value": value, "rate": 2.0}):
            found = simulated(page, inputs={"drive_OA": given}, times=[0])
            assert found["success"], found["message"]
            q = found["y"][:3, 0]
            signs.append(np.sign(np.sin(q[1] - q[2])))
    assert len(set(signs)) == 1


def test_page_follows_a_slider_crank_by_relative_angles_on_its_side(opened):
    """By relative angles; its rod is longer than the crank, and the slide stays on its side."""
    q1, q2, q3, u1, u2, u3 = me.dynamicsymbols("q1:4 u1:4")
    frame, crank, rod = (me.ReferenceFrame(name) for name in "NAB")
    crank.orient_axis(frame, frame.z, q1)
    rod.orient_axis(crank, frame.z, q2)
    origin = me.Point("O")
    origin.set_vel(frame, 0)
    pin = origin.locatenew("P", 0.2 * crank.x)
    end = pin.locatenew("Q", 0.5 * rod.x)
    block = origin.locatenew("S", q3 * frame.x)
    system = me.System(frame, origin)
    system.add_bodies(me.Particle("end", block, 1))
    system.add_coordinates(q1, q2, q3, independent=[True, False, False])
    system.add_speeds(u1, u2, u3, independent=[True, False, False])
    system.add_kdes(*(u - q.diff() for q, u in ((q1, u1), (q2, u2), (q3, u3))))
    gap = end.pos_from(block)
    system.add_holonomic_constraints(gap.dot(frame.x), gap.dot(frame.y))
    initial = {q1: 0.6, q2: -0.8, q3: 0.6, u1: 0.0}
    page = opened(fb.compile_model(fb.Model(system, name="crank_and_slide", initial=initial)).page(t_span=(0.0, 0.01)))
    rng = np.random.default_rng(2)
    for value in rng.uniform(-3.14, 3.14, 60).tolist():
        run = page.evaluate("async q1 => { settings.initial.q1 = q1; await update(); return shownRun.x0; }", value)
        x = np.array([run[str(k)] for k in range(6)] if isinstance(run, dict) else run)
        assert x[2] == pytest.approx(0.2 * np.cos(value) + np.sqrt(0.25 - (0.2 * np.sin(value)) ** 2), abs=1e-9)
    found = simulated(page, initial={"q1": 5.5}, times=[0])["y"][2, 0]
    assert found == pytest.approx(0.2 * np.cos(5.5) + np.sqrt(0.25 - (0.2 * np.sin(5.5)) ** 2), abs=1e-9)


def test_page_shows_figures_that_equal_statistics_of_the_run(opened, four_bar):
    names = ["greatest", "least", "greatest magnitude", "range", "mean", "last"]
    page = opened(four_bar.page(t_span=(0.0, 2.0), watch=[(name, "u1") for name in names]))
    assert page.evaluate("Object.keys(STATISTICS)") == names
    t, y = shown(page)
    u = y[3]
    mean = ((u[1:] + u[:-1]) / 2 * np.diff(t)).sum() / (t[-1] - t[0])
    cells = [float(text) for text in page.locator("#figures td:nth-child(2)").all_text_contents()]
    np.testing.assert_allclose(cells, [u.max(), u.min(), np.abs(u).max(), np.ptp(u), mean, u[-1]], rtol=1e-5)


def test_page_with_a_run_at_rest_at_first_gives_no_warning_of_energy(opened):
    """A step in the middle of the run: nothing moves in its first half."""
    model = fb.compile_model(fb.models.slider_crank())
    page = opened(model.page(inputs={"torque": 0.0}, t_span=(0.0, 1.0)))
    page.locator("#groups select").last.select_option("step")
    until(page, "!busy")
    assert page.evaluate("columnOf(shownRun, data.energies).slice(-1)[0]") > 0.0
    assert page.inner_text("#status") == ""


def test_page_after_200_moves_has_no_errors_and_no_more_memory(opened, made):
    """200 random moves: no errors, no more memory of the module, and of the page what garbage collection leaves."""
    page = opened(made)
    session = page.context.new_cdp_session(page)
    session.send("HeapProfiler.enable")

    def used():
        session.send("HeapProfiler.collectGarbage")
        return session.send("Runtime.getHeapUsage")["usedSize"]

    rng = np.random.default_rng(0)
    n = page.locator("#groups input[type=range]").count()
    sizes = []
    for turn in range(200):
        page.evaluate(
            """([number, part]) => {
                const range = document.querySelectorAll("#groups input[type=range]")[number];
                range.value = Number(range.min) + part * (Number(range.max) - Number(range.min));
                range.dispatchEvent(new Event("input"));
                range.dispatchEvent(new Event("change"));
            }""",
            [int(rng.integers(n)), float(rng.random())],
        )
        until(page, "!busy")
        if turn in (99, 199):
            sizes.append((page.evaluate("engine.ask('memory')"), used()))
            page.locator("#reset").click()
            until(page, "!busy")
    assert sizes[0][0] == sizes[1][0]
    assert sizes[1][1] - sizes[0][1] < 500_000


def test_page_by_keyboard_alone_reaches_sliders_and_reset(opened, made):
    page = opened(made)

    def reach(script):
        for _ in range(120):
            if page.evaluate(f"(e => {script})(document.activeElement)"):
                return
            page.keyboard.press("Tab")
        pytest.fail(f"the keyboard does not reach {script}")

    reach("e.id === 'slider3'")
    assert page.evaluate("document.activeElement.labels[0].textContent") == "l2 (m)"
    page.keyboard.press("ArrowRight")
    until(page, "!busy")
    moved = page.evaluate("settings.parameters.l2")
    assert 0.5 < moved < 0.52
    reach("e.type === 'number'")
    page.keyboard.press("Control+A")
    page.keyboard.type("0.47")
    page.keyboard.press("Enter")
    until(page, "!busy && settings.parameters.l2 === 0.47")
    reach("e.tagName === 'SELECT' && e.closest('fieldset')")
    page.keyboard.press("ArrowDown")
    until(page, "!busy && settings.inputs.F.kind === 'constant'")
    reach("e.tagName === 'SUMMARY' && e.textContent.startsWith('Speeds')")
    page.keyboard.press("Enter")
    until(page, "plots[1].details.open")
    reach("e.id === 'play'")
    page.keyboard.press("Space")
    until(page, "controls.shown() > 3")
    page.keyboard.press("Space")
    reach("e.ariaLabel === 'Remove range, q1'")
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.ariaLabel") == "Remove range, q2"
    reach("e.id === 'python'")
    page.keyboard.press("Enter")
    reach("e.id === 'code'")
    frame = page.evaluate("controls.shown()")
    page.keyboard.press("ArrowRight")
    assert page.evaluate("controls.shown()") == frame
    reach("e.id === 'reset'")
    page.keyboard.press("Enter")
    until(page, "!busy && settings.parameters.l2 === 0.5")


@pytest.mark.parametrize("width", [390, 1440])
def test_page_on_phones_and_screens_is_not_wider_than_the_window(opened, made, width):
    page = opened(made, viewport={"width": width, "height": 800}, has_touch=width < 500)
    for summary in page.locator("summary").all():
        if summary.evaluate("e => !e.parentElement.open"):
            summary.click()
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    if width < 500:  # the picture stays in sight while sliders are moved
        page.get_by_label("u1", exact=True).scroll_into_view_if_needed()
        assert page.locator("#mechanism").bounding_box()["y"] < 60


def jansen():
    mechanisms = runpy.run_path(str(EXAMPLES / "11_mechanisms.py"))
    leg = mechanisms["jansen"]()
    leg.drive("OA", speed=2.0)
    return fb.compile_model(leg.model()).page(), 1.0


def slider_crank():
    return fb.compile_model(fb.models.slider_crank()).page(inputs={"torque": 0.005}, t_span=(0.0, 1.0)), 1.0


def bicycle():
    model = fb.compile_model(fb.models.whipple_bicycle())
    x0 = model.initial_state(speeds={"u4": 0.5, "u6": -5.0 / model.defaults["rr"]})
    return model.page(x0=x0, t_span=(0.0, 2.0)), 2.0


def cart():
    """No constraints, an auxiliary state, an output, and an input that is not one of time."""
    q, u, z, force = me.dynamicsymbols("q u z f")
    frame, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(frame, 0)
    point.set_pos(origin, q * frame.x)
    point.set_vel(frame, u * frame.x)
    system = me.System(frame, origin)
    system.add_bodies(me.Particle("cart", point, M))
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_kdes(u - q.diff())
    system.add_loads(me.Force(point, (force - L * q - z) * frame.x))
    model = fb.Model(
        system, name="cart", parameters={M: 1.0, L: 4.0}, inputs={force: 0.0}, state_equations={z: u - z},
        outputs={"pull": L * q}, initial={q: 1.0, u: 0.0, z: 0.0},
    )  # fmt: skip
    return fb.compile_model(model).page(t_span=(0.0, 3.0)), 3.0


@pytest.mark.parametrize("make", [jansen, slider_crank, bicycle, cart])
def test_pages_of_other_mechanisms_show_the_runs_of_simulate(opened, make, monkeypatch):
    kept = []
    monkeypatch.setattr(live_page, "simulate", recorded(live_page.simulate, kept))
    made, end = make()
    (kernel, how), *_ = kept
    model = facade_of(kernel)
    monkeypatch.undo()
    page = opened(made)
    times = np.linspace(0.0, end, 101)
    found = simulated(page, t_span=[0, end], times=times.tolist())
    assert found["success"], found["message"]
    y = exact(model, times, **how)
    np.testing.assert_allclose(found["y"], y, rtol=0, atol=1e-9 * max(1.0, np.abs(y).max()))


def recorded(function, kept):
    def simulate(self, t_span, x0=None, **how):
        kept.append((self, {"x0": x0, "parameters": how.get("parameters"), "inputs": how.get("inputs")}))
        return function(self, t_span, x0, **how)

    return simulate


def test_page_with_a_prescribed_motion_as_a_sine_moves_the_crank_by_it(opened):
    """As a sine, with its rates: the crank's angle, and from it all others."""
    mechanisms = runpy.run_path(str(EXAMPLES / "11_mechanisms.py"))
    linkage = mechanisms["crank_rocker"]()
    linkage.drive("OA", speed=1.0)
    model = fb.compile_model(linkage.model())
    page = opened(model.page(t_span=(0.0, 2.0)))
    a, b, c, d = 0.9, 0.3, 0.4, 0.2
    sine = {"kind": "sine", "mean": a, "amplitude": b, "frequency": c, "phase": d}
    times = np.linspace(0.0, 2.0, 21)
    found = simulated(page, inputs={"drive_OA": sine}, times=times.tolist())
    assert found["success"], found["message"]
    turn = 2 * np.pi * c
    start = model.initial_state()[0] - model.defaults["start_OA"]
    np.testing.assert_allclose(found["y"][0] - start, a + b * np.sin(turn * times + d), rtol=0, atol=1e-9)
    np.testing.assert_allclose(found["y"][3], b * turn * np.cos(turn * times + d), rtol=0, atol=1e-9)
    # A constant rate is what the model has by itself.
    line = {"kind": "line", "value": model.defaults["start_OA"], "rate": 1.0}
    rows = [simulated(page, inputs={"drive_OA": given}, times=times.tolist())["y"] for given in (line, None)]
    np.testing.assert_allclose(rows[0], rows[1], rtol=0, atol=1e-12)


def test_page_in_a_notebooks_frame_simulates_without_errors(browser, made):
    """By srcdoc, without a kernel and without an address of its own."""
    page = browser.new_page()
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.set_content(f"<html><body>{made._repr_html_()}</body></html>")
    frame = page.frames[1]
    for _ in range(400):
        if frame.evaluate("typeof shownRun !== 'undefined' && shownRun !== null"):
            break
        page.wait_for_timeout(25)
    assert frame.evaluate("fourbar.simulate({times: [4]}).then(run => run.success)")
    assert errors == []
    page.close()


def test_page_as_a_file_is_small_and_loads_nothing_from_elsewhere(made):
    assert len(made.text.encode()) < 400_000
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', made.text)[1]
    assert policy == (
        "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'unsafe-inline'; worker-src blob:"
    )
    assert set(re.findall(r"https?://[^\"' ]+", made.text)) == {"http://www.w3.org/2000/svg"}  # a name, no address
    assert repr(made) == "<Live page of four_bar, 900 pixels high>"


def data_of(made):
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', made.text)[1])


def test_page_takes_ranges_of_sliders_from_parameters_arguments_and_defaults(four_bar):
    a, b, c, d = sm.symbols("a b c d")
    values = {M: fb.Parameter(2.0, "kg", range=(1.0, 9.0)), G: -9.81, L: 1.0, a: 0.0, b: fb.Parameter(0.0, "rad"),
              c: 30.0, d: None}  # fmt: skip
    more = {"sum": a + b + c + d}
    model = fb.compile_model(fb.Model(pendulum(), name="ranges", parameters=values, outputs=more))
    page = data_of(model.page(parameters={"d": 5.0}, x0=[0.1, 0.0], ranges={"c": (20, 40), "q": (-1, 1)}))
    found = {entry["name"]: (entry["low"], entry["high"]) for entry in page["parameters"]}
    assert found == {
        "m": (1.0, 9.0), "g": (-20.0, -2.0), "l": (0.2, 2.0), "a": (-1.0, 1.0), "b": (-np.pi, np.pi),
        "c": (20.0, 40.0), "d": (1.0, 10.0),
    }  # fmt: skip
    assert page["initial"][0] == {"name": "q", "value": 0.1, "low": -1.0, "high": 1.0}
    for wrong in ((1.0, 1.0), (2.0, 1.0), "ab", (1.0,), (0.0, np.inf)):
        with pytest.raises(fb.ModelError, match="range of a parameter"):
            fb.Parameter(1.0, range=wrong)
        with pytest.raises(fb.ModelError, match="range of k"):
            four_bar.page(ranges={"k": wrong})


def test_page_without_a_known_potential_plots_the_kinetic_energy_alone():
    system = pendulum()
    system.bodies[0].potential_energy = M * me.dynamicsymbols("q") ** 4  # which is not that of its weight
    model = fb.compile_model(fb.Model(system, name="unknown", parameters={M: 1.0, G: 9.81, L: 1.0}))
    page = data_of(model.page(x0=[0.1, 0.0]))
    [panel] = [panel for panel in page["panels"] if panel["title"] == "Energy (J)"]
    assert [page["columns"][number] for number in panel["columns"]] == ["kinetic energy"]


def test_page_of_a_run_that_begins_after_whole_turns_has_each_assembly_mode_once(four_bar):
    turned = np.add(four_bar.initial_state(), [0.0, 2.0 * np.pi, 0.0, 0.0, 0.0, 0.0])
    modes = data_of(four_bar.page(x0=turned))["modes"]
    assert len(modes) == 2
    np.testing.assert_allclose(modes[0], turned, rtol=0, atol=1e-12)


def test_page_of_a_model_that_cannot_run_in_a_browser_is_refused(four_bar, tmp_path, monkeypatch):
    path = tmp_path / "page.html"
    with pytest.raises(fb.ModelError, match=r"saved as \.html"):
        four_bar.page(tmp_path / "page.txt")
    taken = fb.Model(pendulum(), name="taken", parameters={M: 1.0, G: 9.81, L: 1.0}, outputs={"kinetic energy": M})
    with pytest.raises(fb.ModelError, match="names kinetic energy are reserved"):
        fb.compile_model(taken).page(path, x0=[0.1, 0.0])
    unset = fb.compile_model(fb.Model(pendulum(), name="unset", parameters={M: 1.0, G: 9.81, L: None}))
    with pytest.raises(fb.ModelError, match="no default for its parameters l"):
        unset.page(path)
    monkeypatch.setattr(compiler, "_ziglang", lambda: None)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(fb.BuildError, match=re.escape("pip install 'fourbar_codegen[page]'")):
        four_bar.page(path)
    assert not list(tmp_path.iterdir())


def test_page_compiled_by_clang_gives_the_states_of_ziglangs(opened, four_bar, made, monkeypatch):
    """Debian's clang and C library for WebAssembly, in place of zig's."""
    require("clang")
    require("wasm-ld")
    monkeypatch.setattr(compiler, "_ziglang", lambda: None)
    other = four_bar.page()
    assert data_of(other)["wasm"] != data_of(made)["wasm"]
    ends = [simulated(opened(page), t_span=[0, 1], times=[1])["y"] for page in (made, other)]
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=1e-11)


def test_page_command_writes_a_page_with_its_settings(opened, tmp_path):
    path = tmp_path / "four_bar.html"
    how = ["page", "four_bar", "-p", "l2=0.45", "-i", "q1=-0.4", "-r", "F=7", "-t", "0", "2", "--event", "u1",
           "-o", str(path)]  # fmt: skip
    result = CliRunner().invoke(main, how)
    assert result.exit_code == 0, result.output
    assert f"Written: {path}" in result.output
    data = data_of(type("Made", (), {"text": path.read_text()}))
    assert data["t_span"] == [0.0, 2.0]
    assert [event["name"] for event in data["events"]] == ["u1"]
    assert data["inputs"][0]["signal"] == {"kind": "constant", "values": [7.0]}
    assert next(p["value"] for p in data["parameters"] if p["name"] == "l2") == 0.45
    assert data["modes"][0][0] == -0.4
    wrong = CliRunner().invoke(main, ["page", "four_bar", "-r", "F=sin(t)", "-o", str(path)])
    assert wrong.exit_code == 1
    assert "a callable cannot be put into a file" in wrong.output
