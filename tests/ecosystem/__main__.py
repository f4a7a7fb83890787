"""Writes the table of docs/ecosystem.md: ``make ecosystem``."""

from __future__ import annotations

import os
import tempfile
from importlib.metadata import version

import click
from measure import DOCS, circumstances, replace_in_page

from ecosystem.cases import LONG, QUICK, Case
from ecosystem.conformance import Found, run
from ecosystem.tutorial_run import main as tutorial_run

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


def main() -> None:
    """Run all cases, each with an empty cache."""
    lines = [HEAD]
    for case in (*QUICK, *LONG):
        with tempfile.TemporaryDirectory() as folder:
            os.environ["FOURBAR_CODEGEN_CACHE"] = folder
            lines.append(row(case, run(case, is_timed=True)))
        click.echo(lines[-1])
    lines.append(f"\n{tutorial_run()}")
    click.echo(lines[-1])
    report = circumstances()
    report["versions"]["symbrim"] = version("symbrim")
    replace_in_page(DOCS / "ecosystem.md", "ecosystem", "\n".join(lines), "make ecosystem", report)


if __name__ == "__main__":
    main()
