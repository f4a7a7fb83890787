"""The report of a rider on a bicycle, in headless Chromium: its time to be saved, its size, the first drawn frame, and
frames per second while it plays.

The model is that of `examples/09_rider_on_a_bicycle.py`: 27 coordinates, 16 bodies that are drawn. Chromium draws
without a graphics card.
"""

from __future__ import annotations

import runpy
import shutil
import statistics
import tempfile
import time
from pathlib import Path

from measure import circumstances, options_of, publish
from playwright.sync_api import Browser, sync_playwright

import fourbar_codegen as fb

OPTIONS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update"]
EXAMPLE = Path(__file__).parents[1] / "examples" / "09_rider_on_a_bicycle.py"
SECONDS = 2.0

PLAYED = f"""() => new Promise(resolve => {{
  let frames = 0;
  const begin = performance.now();
  const count = () => {{
    ++frames;
    if (performance.now() - begin < {SECONDS * 1000}) requestAnimationFrame(count);
    else resolve(frames / (performance.now() - begin) * 1000);
  }};
  controls.play(true);
  requestAnimationFrame(count);
}})"""


def opened(browser: Browser, path: Path) -> tuple[float, float]:
    """Seconds to the first picture, and frames per second while it plays."""
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    page.goto(path.as_uri())
    while not page.evaluate("performance.getEntriesByName('first picture').length"):
        page.wait_for_timeout(10)
    first = float(page.evaluate("performance.getEntriesByName('first picture')[0].startTime"))
    page.wait_for_timeout(300)
    rate = float(page.evaluate(PLAYED))
    page.close()
    return 1e-3 * first, rate


def saved(run: fb.Trajectory, path: Path) -> float:
    """Seconds to save a report."""
    begin = time.perf_counter()
    run.save(path)
    return time.perf_counter() - begin


def main() -> None:
    options = options_of(__doc__)
    run = runpy.run_path(str(EXAMPLE))["ride"]()
    with tempfile.TemporaryDirectory() as temporary, sync_playwright() as playwright:
        path = Path(temporary) / "rider.html"
        first = saved(run, path)
        again = statistics.median(saved(run, path) for _ in range(options.rounds))
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=OPTIONS)
        found = [opened(browser, path) for _ in range(options.rounds)]
        chromium, size = browser.version, path.stat().st_size
        browser.close()
    figures = {
        "saved, with the model's positions and orientations to load or compile": f"{first:.1f} s",
        "saved again": f"{again * 1e3:.0f} ms",
        "size": f"{size / 1000:.0f} kB",
        "first drawn frame": f"{statistics.median(first for first, _ in found) * 1e3:.0f} ms",
        "frames per second": f"{statistics.median(rate for _, rate in found):.0f}",
    }
    table = "\n".join(["| | |", "|---|---:|", *(f"| {name} | {figure} |" for name, figure in figures.items())])
    report = circumstances() | {"figures": figures}
    report["versions"]["chromium"] = chromium
    publish(options, "pictures", table, report)


if __name__ == "__main__":
    main()
