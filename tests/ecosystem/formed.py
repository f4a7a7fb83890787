"""What others form equations of: every KanesMethod and System within a context."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Iterator
from typing import Any
from unittest import mock

import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

Formed = list[System | me.KanesMethod]


class _EnoughError(Exception):
    """No more models are wanted."""


@contextlib.contextmanager
def taken(models: Formed, enough: int | None = None) -> Iterator[None]:
    """Add the models that equations are formed of, each once; a System's own KanesMethod is not one of them.

    What is within the context ends, quietly, at its first error, or as soon as there are enough.
    """
    of_system, of_kane = System.form_eoms, me.KanesMethod.kanes_equations
    inside = False

    def take(model: System | me.KanesMethod) -> None:
        if not any(model is known for known in models):
            models.append(model)
        if len(models) == enough:
            raise _EnoughError

    def form_eoms(system: System, *arguments: Any, **more: Any) -> Any:
        nonlocal inside
        take(system)
        inside = True
        try:
            return of_system(system, *arguments, **more)
        finally:
            inside = False

    def kanes_equations(kane: me.KanesMethod, *arguments: Any, **more: Any) -> Any:
        result = of_kane(kane, *arguments, **more)
        if not inside:
            take(kane)
        return result

    with (
        warnings.catch_warnings(),
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.suppress(Exception, SystemExit),
        mock.patch.object(System, "form_eoms", form_eoms),
        mock.patch.object(me.KanesMethod, "kanes_equations", kanes_equations),
    ):
        warnings.simplefilter("ignore")
        yield
