"""Writes the table of docs/ecosystem.md: ``make ecosystem``."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable
from importlib.metadata import version
from itertools import chain

import click
from measure import DOCS, circumstances, replace_in_page

from ecosystem.cases import LONG, QUICK, Case
from ecosystem.conformance import Found, refusal, run
from ecosystem.pages import pages, sympys_tests
from ecosystem.tutorial_run import main as tutorial_run
from fourbar_codegen import FourbarError

PAGES = """## Unchanged tests, tutorials and examples

SymPy's tests and tutorials and the examples of PyDy and opty are run from their source distributions, unchanged. Each
KanesMethod and System for which they form equations is compiled. Parameters without a value are 1.
"""
REFUSED = """## Refused models

| model | of | message |
|---|---|---|"""
HEAD = (
    "| model | of | states | constraints | operations | compiled, s | SymPy, s | faster | difference | residual |\n"
    "|---|---|---|---|---|---|---|---|---|---|"
)


def row(case: Case, found: Found) -> str:
    """A line of the table."""
    remark = case.warned or found.message
    theirs = f"{found.reference_time:.2g} | {found.ratio:.0f} | {found.error:.0e}" if case.is_compared else "- | - | -"
    return (
        f"| {case.name}{f': {remark}' if remark else ''} | {case.source} | {found.n_q + found.n_u} | "
        f"{found.n_constraints} | {found.operations} | {found.compile_time:.2g} | {theirs} | {found.residual:.0e} |"
    )


def tables(cases: Iterable[Case], disagreements: list[str]) -> tuple[list[str], list[str]]:
    """The lines of those that are taken and of those that are refused; what is not as it should be is noted."""
    taken, refused = [], []
    for case in cases:
        with tempfile.TemporaryDirectory() as folder:
            os.environ["FOURBAR_CODEGEN_CACHE"] = folder
            if case.refused:
                sentence = refusal(case)
                refused.append(f"| {case.name} | {case.source} | {sentence} |")
                wrong = "" if case.refused in sentence else f"refused with: {sentence or 'nothing'}"
                click.echo(refused[-1])
            else:
                try:
                    found = run(case, is_timed=True)
                except FourbarError as error:
                    wrong = f"refused with: {error}"
                else:
                    taken.append(row(case, found))
                    wrong = found.disagreement(case)
                    click.echo(taken[-1])
        if wrong:
            disagreements.append(f"{case.source}, {case.name}: {wrong}")
            click.echo(disagreements[-1], err=True)
    return taken, refused


def main() -> None:
    """Run all cases, each with an empty cache."""
    disagreements: list[str] = []
    taken, refused = tables((*QUICK, *LONG), disagreements)
    from_pages, more_refused = tables(chain(sympys_tests(), pages()), disagreements)
    lines = [HEAD, *taken, f"\n{tutorial_run()}\n", PAGES, HEAD, *from_pages, f"\n{REFUSED}", *refused, *more_refused]
    report = circumstances()
    report["versions"]["symbrim"] = version("symbrim")
    if disagreements:
        raise click.ClickException("\n".join(disagreements))
    replace_in_page(DOCS / "ecosystem.md", "ecosystem", "\n".join(lines), "make ecosystem", report)


if __name__ == "__main__":
    main()
