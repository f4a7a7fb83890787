"""HTML representations of objects in notebooks: tables, and whole pages in a frame."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

__all__ = ["Page", "names_table", "table"]


@dataclass(frozen=True, repr=False)
class Page:
    """A page of HTML that a notebook shows in a frame.

    Attributes
    ----------
    title : str
    text : str
        The whole page, self-contained.
    height : int
        Height of the frame, pixels.
    """

    title: str
    text: str
    height: int

    def __repr__(self) -> str:
        return f"<{self.title}, {self.height} pixels high>"

    def _repr_html_(self) -> str:
        return (
            f'<iframe srcdoc="{escape(self.text)}" title="{escape(self.title)}" '
            f'style="width: 100%; height: {self.height}px; border: 0"></iframe>'
        )


def table(caption: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table with a caption, an optional row of headings, and the first cell of each row as its heading.

    Examples
    --------
    >>> table("Sizes", (), [("n_q", "3")])
    '<table><caption>Sizes</caption><tr><th>n_q</th><td>3</td></tr></table>'
    """
    headings = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    lines = ["".join((f"<th>{escape(name)}</th>", *(f"<td>{escape(cell)}</td>" for cell in cells)))
             for name, *cells in rows]  # fmt: skip
    body = "".join(f"<tr>{line}</tr>" for line in ([headings] if header else []) + lines)
    return f"<table><caption>{escape(caption)}</caption>{body}</table>"


def names_table(
    caption: str,
    states: Sequence[tuple[str, Sequence[str], int]],
    parameters: Mapping[str, tuple[float | None, str, str]],
    inputs: Mapping[str, str | None],
    outputs: Sequence[str],
) -> str:
    """The names of a model: a row for each.

    Parameters
    ----------
    caption : str
    states : sequence of (str, sequence of str, int)
        The kind, the names, and how many of the last names are dependent.
    parameters : mapping
        Default, unit and description by name.
    inputs : mapping
        Expression by name; None if there is no default.
    outputs : sequence of str
    """
    nothing = ("", "", "")
    rows = []
    for kind, names, n_dependent in states:
        independent = len(names) - n_dependent
        rows += [(n, kind if i < independent else f"dependent {kind}", *nothing) for i, n in enumerate(names)]
    rows += [
        (name, "parameter", "to be given" if value is None else f"{value:g}", unit, description)
        for name, (value, unit, description) in parameters.items()
    ]
    rows += [(name, "input", expression or "to be given", "", "") for name, expression in inputs.items()]
    rows += [(name, "output", *nothing) for name in outputs]
    return table(caption, ("name", "kind", "default", "unit", "description"), rows)
