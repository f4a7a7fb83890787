"""Live pages in Chromium: their size, the first picture, a move of a slider, and an evaluation beside native code.

A move is everything between the event of the slider and the new picture: the simulation, drawing and layout. Its figure
is the median of 50, those of others are medians of interleaved measurements.
"""

from __future__ import annotations

import shutil
import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from measure import circumstances, compare, evaluation_inside_c, options_of, publish
from playwright.sync_api import Browser, Page, sync_playwright

import fourbar_codegen as fb

OPTIONS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update"]
PORTABLE = ("-O2", "-fpeel-loops", "-fno-tree-vectorize")
"""As modules that are shipped, for any processor of this kind."""

EVALUATIONS = 100_000
MOVE = """async turn => {
  const range = document.querySelector("#groups .row input[type=range]"), page = document.documentElement;
  const low = Number(range.min), high = Number(range.max), runs = page.dataset.runs;
  const drawn = new Promise(resolve => {
    const observer = new MutationObserver(() => {
      if (page.dataset.runs === runs) return;
      observer.disconnect();
      document.body.getBoundingClientRect();  // layout
      resolve(performance.now());
    });
    observer.observe(page, {attributes: true});
  });
  const begin = performance.now();
  range.value = low + (high - low) * (0.45 + 0.05 * Math.sin(turn));
  range.dispatchEvent(new Event("input"));
  return await drawn - begin;
}"""


def four_bar() -> tuple[fb.Model, Callable[[fb.CompiledModel], Any]]:
    return fb.models.four_bar(), lambda model: model.page(t_span=(0.0, 4.0))


def slider_crank() -> tuple[fb.Model, Callable[[fb.CompiledModel], Any]]:
    return fb.models.slider_crank(), lambda model: model.page(t_span=(0.0, 4.0), inputs={"torque": 0.005})


def whipple_bicycle() -> tuple[fb.Model, Callable[[fb.CompiledModel], Any]]:
    def page(model: fb.CompiledModel) -> Any:
        x0 = model.initial_state(speeds={"u4": 0.5, "u6": -5.0 / model.defaults["rr"]})
        return model.page(t_span=(0.0, 4.0), x0=x0)

    return fb.models.whipple_bicycle(), page


def opened(browser: Browser, path: Path) -> Page:
    """The page, with its first picture."""
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    page.goto(path.as_uri())
    while not page.evaluate("performance.getEntriesByName('first picture').length"):
        page.wait_for_timeout(10)
    return page


def first_picture(browser: Browser, path: Path) -> Callable[[], float]:
    """A measure of the time from the beginning of the navigation to the first picture."""

    def measure() -> float:
        page = opened(browser, path)
        found = float(page.evaluate("performance.getEntriesByName('first picture')[0].startTime"))
        page.close()
        return 1e-3 * found

    return measure


def measurements(browser: Browser, make: Callable[[], Any], rounds: int) -> dict[str, float]:
    """Figures of a model's page: bytes and seconds."""
    model, paged = make()
    compiled = fb.compile_model(model)
    text = paged(compiled).text
    with tempfile.TemporaryDirectory() as temporary:
        path = Path(temporary) / "page.html"
        path.write_text(text, encoding="utf-8")
        page = opened(browser, path)
        page.wait_for_timeout(300)
        moves = []
        for turn in range(60):
            moves.append(float(page.evaluate(MOVE, turn)))
            page.wait_for_timeout(20)
        at = page.evaluate("({p: closedPoints[0].p, x: closedPoints[0].x})")
        ask = f"engine.ask('evaluation', closedPoints[0], {EVALUATIONS})"
        native = evaluation_inside_c(model.name, fb.generate_sources(model), "rhs", 0.0, at["x"], at["p"], PORTABLE)
        picture, in_browser, in_c = compare(
            first_picture(browser, path), lambda: 1e-9 * float(page.evaluate(ask)), native, rounds=rounds
        )
        page.close()
    return {
        "bytes": len(text.encode()),
        "first picture": picture,
        "move": 1e-3 * statistics.median(moves[10:]),
        "evaluation in the browser": in_browser,
        "evaluation, portable C": in_c,
    }


def table(found: dict[str, dict[str, float]]) -> str:
    """The table of the page."""
    rows = [
        "| | size | first picture | a move: 4 s simulated and drawn | evaluation in the browser | portable C | ratio |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for name, figures in found.items():
        browser, native = figures["evaluation in the browser"], figures["evaluation, portable C"]
        cells = [
            name.replace("_", " "),
            f"{figures['bytes'] / 1000:.0f} kB",
            f"{figures['first picture'] * 1e3:.0f} ms",
            f"{figures['move'] * 1e3:.1f} ms",
            f"{browser * 1e9:.0f} ns",
            f"{native * 1e9:.0f} ns",
            f"{browser / native:.2f}",
        ]
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows)


def main() -> None:
    options = options_of(__doc__)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=OPTIONS)
        found = {
            make.__name__: measurements(browser, make, options.rounds)
            for make in (four_bar, slider_crank, whipple_bicycle)
        }
        chromium = browser.version
        browser.close()
    report = circumstances() | {"figures": found}
    report["versions"]["chromium"] = chromium
    publish(options, "page", table(found), report)


if __name__ == "__main__":
    main()
