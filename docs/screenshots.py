"""Looks at the built documentation as readers do: ``make screenshots``.

Each page, in light and dark, at 1440 and 390 pixels: a picture of some in results/screenshots, axe's findings, what is
wider than the window, what is loaded from a network, errors of scripts; and all links between pages.
"""

from __future__ import annotations

import itertools
import re
import shutil
import sys
from html import unescape
from pathlib import Path
from urllib.parse import unquote, urldefrag

from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page, sync_playwright

import fourbar_codegen as fb

BUILT = Path(__file__).parent / "_build" / "html"
RESULTS = Path(__file__).parents[1] / "results" / "screenshots"
SHOWN = ["index", "tutorial", "gallery", "reference/simulation", "benchmarks", "installation"]
SIZES = ((1440, 900), (390, 844))
SERIOUS = {"serious", "critical"}


def broken_links() -> list[str]:
    """Links from page to page whose file or heading is missing."""
    pages = {path: path.read_text(encoding="utf-8") for path in BUILT.rglob("*.html")}
    names = {path: {unescape(name) for name in re.findall(r'\bid="([^"]+)"', text)} for path, text in pages.items()}
    found = []
    for path, text in pages.items():
        for link in map(unescape, re.findall(r'<a\b[^>]*\bhref="([^"]*)"', text)):
            if re.match(r"[a-z]+:", link):
                continue
            file, fragment = urldefrag(link)
            target = (path.parent / unquote(file)).resolve() if file else path
            if not target.exists():
                found.append(f"{path.relative_to(BUILT)}: {link}")
            elif fragment and target in names and unquote(fragment) not in names[target] and target.suffix == ".html":
                found.append(f"{path.relative_to(BUILT)}: {link} has no such heading")
    return sorted({*found})


def faults(page: Page, *, axe: bool) -> list[str]:
    """What is wrong with the page that is open."""
    found = []
    if page.evaluate("document.documentElement.scrollWidth > document.documentElement.clientWidth + 1"):
        found.append("is wider than the window")
    blocks = "[...document.querySelectorAll('div.highlight pre')]"
    clipped = page.evaluate(f"{blocks}.filter(e => e.scrollWidth > e.clientWidth + 1).length")
    if clipped and page.evaluate("innerWidth") > 1000:
        found.append(f"clips {clipped} blocks of code")
    for violation in Axe().run(page).response["violations"] if axe else ():
        if violation["impact"] in SERIOUS:
            places = "; ".join(" ".join(map(str, node["target"])) for node in violation["nodes"][:3])
            found.append(f"{violation['id']} ({violation['impact']}), {len(violation['nodes'])} times: {places}")
    return found


def look(page: Page, path: Path, picture: Path | None, *, axe: bool) -> list[str]:
    """Open a page; what is wrong with it."""
    found: list[str] = []
    loaded: list[str] = []
    page.on("request", lambda request: loaded.append(request.url))
    page.on("pageerror", lambda error: found.append(str(error)))
    page.goto(path.as_uri())
    page.wait_for_timeout(100)
    found += [f"loads {url}" for url in loaded if not url.startswith(("file:", "data:", "about:", "blob:"))]
    found += faults(page, axe=axe)
    if picture:
        page.screenshot(path=picture, full_page=page.evaluate("innerWidth") < 1000)
    return found


def main() -> None:
    """Look at all pages, and say what is wrong with them."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    bicycle = fb.compile_model(fb.models.whipple_bicycle())
    places = {
        "report": fb.load("four_bar").simulate((0.0, 4.0), rtol=1e-9, atol=1e-9).save(RESULTS / "report.html"),
        "report_in_space": bicycle.simulate((0.0, 2.0)).save(RESULTS / "report_in_space.html"),
        "page_in_space": RESULTS / "page_in_space.html",
    }
    bicycle.page(places["page_in_space"], t_span=(0.0, 2.0))
    own = frozenset(places)
    for path in sorted(BUILT.rglob("*.html")):
        name = str(path.relative_to(BUILT).with_suffix(""))
        if not name.startswith("_") and name not in {"genindex", "py-modindex", "search"}:
            places[name] = path
    wrong = [f"broken link in {link}" for link in broken_links()]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        for scheme, (width, height) in itertools.product(("light", "dark"), SIZES):
            for name, path in places.items():
                page = browser.new_page(viewport={"width": width, "height": height}, color_scheme=scheme)
                shown = name in own or name in SHOWN
                picture = RESULTS / f"{name.replace('/', '_')}_{width}_{scheme}.png" if shown else None
                # Each scheme and each width once: colours do not depend on the width.
                axe = (scheme, width) in {("light", 1440), ("dark", 390)}
                wrong += [f"{name}, {scheme}, {width}: {fault}" for fault in look(page, path, picture, axe=axe)]
                page.close()
        browser.close()
    for fault in dict.fromkeys(wrong):
        print(fault)
    print(f"{len(places)} pages, {len(wrong)} faults; pictures in {RESULTS}")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
