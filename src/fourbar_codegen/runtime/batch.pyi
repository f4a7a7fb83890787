"""Types of the compiled module batch.pyx, which holds the documentation."""

from collections.abc import Sequence
from typing import final

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.runtime.enumerations import EventRow
from fourbar_codegen.runtime.evaluator import Evaluator

Floats = NDArray[np.float64]

DONE: int
TERMINATED: int

def width(evaluator: Evaluator) -> int: ...

@final
class Batch:
    def __init__(
        self, evaluator: Evaluator, t: Floats, x: Floats, p: Floats, r: Floats | None, rates: Floats
    ) -> None: ...
    def evaluate(self, begin: int, end: int) -> None: ...

@final
class Jacobians:
    results: list[Floats]
    def __init__(
        self, evaluator: Evaluator, t: Floats, x: Floats, p: Floats, r: Floats | None, in_force: NDArray[np.bool_]
    ) -> None: ...
    def differentiate(self, variables: str, outputs: bool) -> None: ...
    def form(self, rates: Floats, multipliers: Floats, formulation: str, wrt: Sequence[str]) -> None: ...
    def evaluate(self, begin: int, end: int) -> None: ...

@final
class Members:
    samples: Floats
    status: NDArray[np.int8]
    n_evaluations: NDArray[np.int_]
    def __init__(
        self,
        evaluator: Evaluator,
        method: str,
        t: float,
        t_bound: float,
        x: Floats,
        p: Floats,
        sources: Sequence[object],
        max_step: float,
        rtol: Floats,
        atol: Floats,
        project: bool,
        times: Floats,
        breaks: Floats,
        max_steps: int,
        events: Sequence[EventRow],
    ) -> None: ...
    @property
    def found(self) -> Floats: ...
    def run(self) -> None: ...
    def stop(self) -> None: ...
    @property
    def n_ended(self) -> int: ...
