"""What export/c_library.h has to be told of a model, as C text: for C libraries, FMUs and pages."""

from __future__ import annotations

from fourbar_codegen.layout import Layout

__all__ = ["definitions_text"]


def definitions_text(layout: Layout) -> str:
    """Numbers of dependent coordinates and speeds, defaults, and which inputs prescribe motions.

    Parameters
    ----------
    layout : Layout
        Defaults that are missing are not numbers.

    Returns
    -------
    str
    """
    names = layout.states
    initial = ", ".join(_number(layout.initial.get(name, 0.0)) for name in names)
    defaults = ", ".join(_number(entry.default) for entry in layout.parameters) or "0.0"
    given = ", ".join(str(int(entry.expression is not None)) for entry in layout.inputs) or "0"
    rates = ", ".join(str(int(e.of in layout.has_rates and e.order < 2)) for e in layout.inputs) or "0"
    return f"""
enum {{
    N_DEPENDENT_COORDINATES = {layout.n_dependent_coordinates},
    N_DEPENDENT_SPEEDS = {layout.n_dependent_speeds},
    N_MOTION_BREAKPOINTS = {layout.breakpoints.n_motion_breakpoints}
}};

static const double default_parameters[] = {{{defaults}}};
static const double initial_state[] = {{{initial}}};
static const int has_expression[] = {{{given}}};
static const int has_next_rate[] = {{{rates}}}; /* whether an input has a rate that is an input too */
"""


def _number(value: float | None) -> str:
    """A double that C reads as the same; NaN without a value."""
    return "NAN" if value is None or value != value else repr(float(value))
