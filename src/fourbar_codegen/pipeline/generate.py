"""Model -> Equations -> Program -> Schedule -> C and Cython text."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

from fourbar_codegen.body_shapes import data_of
from fourbar_codegen.errors import ModelError
from fourbar_codegen.expressions.fingerprint import fingerprint
from fourbar_codegen.interface.progress import Progress
from fourbar_codegen.layout import Layout
from fourbar_codegen.modeling.model import Model
from fourbar_codegen.pipeline.check import warn

if TYPE_CHECKING:
    from fourbar_codegen.dynamics.derivatives import Derivatives
    from fourbar_codegen.dynamics.equations import Equations
    from fourbar_codegen.lowering.program import Program
    from fourbar_codegen.lowering.schedule import Schedule, ScheduledFunction

__all__ = [
    "Generated",
    "described",
    "generate_all",
    "generate_derivatives",
    "generate_kernel",
    "generate_sources",
    "require_model",
]


def generate_sources(model: Model) -> dict[str, str]:
    """Generate a model's sources.

    Parameters
    ----------
    model : Model

    Returns
    -------
    dict of str to str
        Text by file name: the C sources and header, the Cython wrapper, and manifest.json. The same
        model gives the same text, on every machine and in every process.

    Raises
    ------
    ModelError
        If the model has something that cannot be compiled.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> sources = fb.generate_sources(fb.models.four_bar())
    >>> sorted(name for name in sources if "avx" not in name)
    ['four_bar.pyx', 'four_bar_batch.c', 'four_bar_derivatives.c', 'four_bar_kernel.c',
     'four_bar_kernel.h', 'four_bar_products.c', 'manifest.json']
    """
    with Progress(f"fourbar_codegen: {getattr(model, 'name', '')}") as progress:
        equations, _, sources = generate_all(model, progress)
    warn(equations.warnings, 3)
    return sources


@dataclass(frozen=True)
class Generated:
    """The sources of a kernel, and what derivatives are generated from."""

    equations: Equations
    scheduled: Schedule
    names: dict[str, tuple[str, ...]]
    sources: dict[str, str]
    layout: Layout

    def later(self) -> bytes:
        """A pickled function from the name of a part, compiled at its first use, to its source."""
        return pickle.dumps(partial(_source_of, self.equations, self.scheduled.program, self.names))


def generate_kernel(model: Model, progress: Progress) -> Generated:
    """The equations, and the sources that a simulation needs."""
    require_model(model)
    # Imported here, since a model in the cache does not need it.
    from fourbar_codegen.codegen.c_source import kernel_sources
    from fourbar_codegen.codegen.manifest import layout_of, names_of
    from fourbar_codegen.dynamics.formation import form_equations
    from fourbar_codegen.lowering.lower import lower
    from fourbar_codegen.lowering.schedule import schedule

    progress.stage("forming the equations")
    equations = form_equations(model)
    progress.stage("eliminating common subexpressions")
    program = lower(model.name, equations)
    scheduled = schedule(program)
    progress.stage("printing")
    names = names_of(model, program)
    sources = kernel_sources(scheduled, names)
    layout = layout_of(model, equations, program, names, fingerprint(described(model)))
    return Generated(equations, scheduled, names, sources, layout)


def generate_derivatives(equations: Equations, program: Program) -> tuple[Derivatives, list[ScheduledFunction]]:
    """The derivatives, and their functions."""
    from fourbar_codegen.dynamics.derivatives import form_derivatives
    from fourbar_codegen.lowering.lower import lower_derivatives
    from fourbar_codegen.lowering.schedule import schedule_function

    derivatives = form_derivatives(equations, by_columns=program.form == "recursive")
    functions = lower_derivatives(program, equations, derivatives)
    return derivatives, [schedule_function(function, inline_angles=False) for function in functions]


def _generate_drawing(equations: Equations, program: Program) -> list[ScheduledFunction]:
    """What pictures need."""
    from fourbar_codegen.lowering.lower import lower_drawing
    from fourbar_codegen.lowering.schedule import schedule_function

    return [schedule_function(function, inline_angles=False) for function in lower_drawing(program, equations)]


def _generate_products(equations: Equations, program: Program) -> list[ScheduledFunction]:
    """Products of derivatives with vectors."""
    from fourbar_codegen.dynamics.products import form_products
    from fourbar_codegen.lowering.lower import lower_products
    from fourbar_codegen.lowering.schedule import schedule_function

    functions = lower_products(program, equations, form_products(equations))
    return [schedule_function(function, inline_angles=True) for function in functions]


def _source_of(equations: Equations, program: Program, names: dict[str, tuple[str, ...]], part: str) -> str:
    """The C source of a part that is compiled at its first use."""
    from fourbar_codegen.codegen.c_source import derivatives_text, drawing_text, products_text

    if part == "drawing":
        return drawing_text(program.name, _generate_drawing(equations, program), names)
    if part == "derivatives":
        return derivatives_text(program.name, generate_derivatives(equations, program)[1], names)
    return products_text(program.name, _generate_products(equations, program), names)


def generate_all(model: Model, progress: Progress) -> tuple[Equations, Derivatives, dict[str, str]]:
    """The equations, their derivatives, and all sources made from them."""
    generated = generate_kernel(model, progress)
    from fourbar_codegen.codegen.c_source import derivatives_text, products_text, version_texts
    from fourbar_codegen.codegen.cython_source import wrapper_text
    from fourbar_codegen.codegen.manifest import operations_of

    equations, program, names = generated.equations, generated.scheduled.program, generated.names
    # On a tape of their own, as at their first use: the text of a part does not depend on what was formed before.
    varied = _generate_products(*pickle.loads(pickle.dumps((equations, program))))
    derivatives, scheduled = generate_derivatives(equations, program)
    functions = (*program.functions, *(f.function for f in (*scheduled, *varied)))
    layout = generated.layout.with_body_shapes(data_of(model.shapes))
    layout = replace(layout, operations=operations_of(functions))
    return (
        equations,
        derivatives,
        {
            **generated.sources,
            **{f"{model.name}{suffix}": text for suffix, text in version_texts(generated.scheduled).items()},
            f"{model.name}_derivatives.c": derivatives_text(model.name, scheduled, names),
            f"{model.name}_products.c": products_text(model.name, varied, names),
            f"{model.name}.pyx": wrapper_text(model, layout),
            "manifest.json": layout.to_text(),
        },
    )


def described(model: Model) -> tuple[object, ...]:
    """Everything in a model that its equations and their arguments depend on."""
    return (
        model.name,
        model.mechanism,
        model.parameters,
        model.named_parameters,
        model.input_expressions,
        model.derived_parameters,
        model.initial,
        model.reactions,
        model.potential_energy,
        model.output_expressions,
        model.state_equations,
        *((model.drawn_frames,) if model.drawn_frames else ()),
    )


def require_model(model: object) -> None:
    """Raise a ModelError if this is no Model."""
    if not isinstance(model, Model):
        raise ModelError(f"A Model is needed, not a {type(model).__name__}: wrap a System in fourbar_codegen.Model.")
