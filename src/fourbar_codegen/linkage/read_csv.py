"""Tables of points and links in CSV files."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from pathlib import Path

from fourbar_codegen.errors import ModelError
from fourbar_codegen.interface.paths import path_of

__all__ = ["name_of_file", "rows"]


def name_of_file(path: str | Path) -> str:
    """A name for what is in a file."""
    name = re.sub(r"\W", "_", Path(str(path)).stem)
    return name if re.match(r"[A-Za-z]", name) else f"linkage_{name}"


def rows(path: str | Path) -> Iterator[tuple[int, dict[str, str]]]:
    """The numbers of lines of a table, and what stands in the columns; blank lines and comments are left out."""
    try:
        text = path_of(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ModelError(f"{path} cannot be read: {error}") from error
    lines = [(k, line) for k, line in enumerate(text.splitlines(), start=1) if line.strip(" ,;\t")]
    lines = [(k, line) for k, line in lines if not line.lstrip().startswith("#")]
    if len(lines) < 2:
        raise ModelError(f"{path} has no points. The columns are point, x, y, links, with a row for each point.")
    gap = next((mark for mark in ",;\t" if mark in lines[0][1]), ",")
    header, *cells = csv.reader((line for _, line in lines), delimiter=gap)
    columns = [title.strip().lower() for title in header]
    for (number, _), row in zip(lines[1:], cells, strict=True):
        yield number, dict(zip(columns, map(str.strip, row), strict=False))
