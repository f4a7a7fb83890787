"""How a compiled model is compared with its equations, and what is said where it cannot be."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from fourbar_codegen.building.loading import load_file
from fourbar_codegen.errors import ModelWarning
from fourbar_codegen.interface.progress import Progress
from fourbar_codegen.kernel.comparison import compare_batch_functions, compare_products
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.runtime.evaluator import versions

if TYPE_CHECKING:
    from fourbar_codegen.dynamics.derivatives import Derivatives
    from fourbar_codegen.dynamics.equations import Equations

__all__ = ["comparison", "not_compared", "warn"]


def comparison(
    progress: Progress, equations: Equations, derivatives: Derivatives | None = None
) -> Callable[[Path], int]:
    """A function that compares a compiled model with its equations; it returns at how many states."""

    def compare(module: Path) -> int:
        from fourbar_codegen.pipeline.verify import verify

        progress.stage("checking")
        loaded, compared = load_file(module), []
        for capsule in versions(loaded.capsule):
            kernel = Kernel(capsule, loaded.layout)
            compared.append(verify(kernel, equations, derivatives))
            if not kernel.lacks_batch_functions:
                compare_batch_functions(kernel)
            if not kernel.lacks_products:
                compare_products(kernel)
        return min(compared)

    return compare


def not_compared(name: str) -> str:
    """The warning where a model could not be compared with its equations."""
    from fourbar_codegen.pipeline.verify import DISTANCES

    return (
        f"The compiled motion of model {name} was not compared with its equations, which have no real value at any of "
        f"{len(DISTANCES)} states: random ones, some near the initial values, and these. Give the Model initial values "
        "(initial=) and parameters (parameters=) at which its expressions have a value."
    )


def warn(sentences: Iterable[str], level: int) -> None:
    """Warn with a ModelWarning for each sentence, on the caller's line."""
    for sentence in sentences:
        warnings.warn(sentence, ModelWarning, stacklevel=level)
