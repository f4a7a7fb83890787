"""Shared fixtures, and a run on CI that fails where something was skipped."""

import os
import sys
from pathlib import Path

import pytest
from harness.programs import prepare_zig, require
from tutorial import tutorial_four_bar

import fourbar_codegen as fb
from fourbar_codegen.building.compiler import wasm_compiler

pytest_plugins = ["harness.costs"]
# In docstrings: they compile with a second compiler, or a whole FMU.
PAGE_EXAMPLE = "fourbar_codegen.page.live_page.page"
SLOW_EXAMPLES = {PAGE_EXAMPLE, "fourbar_codegen.export.packaging.export_fmu"}
LEFT_OUT = pytest.StashKey[list[str]]()


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory):
    """No test reads or writes the user's cache; they have one of their own, from run to run in a virtual environment.

    What was compiled there is found as long as it would be compiled to the same.
    """
    in_environment = sys.prefix != sys.base_prefix
    folder = Path(sys.prefix) / "cache-of-tests" if in_environment else tmp_path_factory.getbasetemp().parent / "cache"
    os.environ["FOURBAR_CODEGEN_CACHE"] = str(folder)
    return folder


@pytest.fixture
def unoptimized(monkeypatch):
    """Extension modules are compiled in a third of the time, for tests of what happens to their files."""
    monkeypatch.setenv("CFLAGS", "-O0")


@pytest.fixture(scope="session")
def four_bar():
    return fb.load("four_bar")


@pytest.fixture(scope="session")
def tutorial():
    return tutorial_four_bar()


@pytest.fixture(scope="module")
def browser():
    chromium = require("chromium")
    from playwright.sync_api import sync_playwright

    options = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update"]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=options)
        yield browser
        browser.close()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """``slow(but=["a", "b"])`` on a parametrized test leaves the cases a and b in `make test`."""
    for item in items:
        if item.name in SLOW_EXAMPLES:
            item.add_marker("slow")
        mark = item.get_closest_marker("slow")
        if mark and hasattr(item, "callspec") and item.callspec.id in mark.kwargs.get("but", ()):
            item.own_markers = [own for own in item.own_markers if own.name != "slow"]


def pytest_runtest_setup(item):
    if item.name == PAGE_EXAMPLE:
        prepare_zig(wasm_compiler())


def pytest_deselected(items):
    for item in items:
        item.config.stash.setdefault(LEFT_OUT, []).append(item.nodeid)


def pytest_terminal_summary(terminalreporter, config):
    left_out = len(config.stash.get(LEFT_OUT, []))
    if left_out and config.option.markexpr == "not slow":
        terminalreporter.write_line(f"{left_out} more tests take longer: make test-all runs them as well.")


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node, error):
    """Each process of pytest-xdist leaves out the same tests; take one's word for it."""
    node.config.stash[LEFT_OUT] = getattr(node, "workeroutput", {}).get("left out", [])


def pytest_sessionfinish(session, exitstatus):
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["left out"] = session.config.stash.get(LEFT_OUT, [])
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if os.environ.get("CI") and reporter and reporter.stats.get("skipped") and exitstatus == 0:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
        reporter.write_line("On CI every test has to run; some were skipped.", red=True)
