"""Types of the compiled module evaluator.pyx, which holds the documentation."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Values = ArrayLike | Mapping[object, float]

OK: int
NOT_CLOSED: int

def is_finite(values: Floats) -> bool: ...

class Evaluator:
    n_q: int
    n_u: int
    n_x: int
    n_p: int
    n_r: int
    n_h: int
    n_c: int
    n_o: int
    def __init__(self, capsule: object, manifest: dict[str, Any]) -> None: ...
    def parameter_values(self, p: Values) -> Values: ...
    def input_values(self, r: Values, defaults: Sequence[float]) -> Values: ...
    def missing(self) -> str: ...
    def rhs(
        self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None, out: Floats | None = None
    ) -> Floats: ...
    def jacobian(self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None) -> Floats: ...
    def parameter_jacobian(
        self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> Floats: ...
    def input_jacobian(self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None) -> Floats: ...
    def accelerations(
        self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> tuple[Floats, Floats]: ...
    def dynamics(
        self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> tuple[Floats, Floats, Floats, Floats, Floats]: ...
    def position(
        self, t: float, q: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> tuple[Floats, Floats]: ...
    def velocity(
        self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> tuple[Floats, Floats]: ...
    def closure(
        self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> tuple[Floats, Floats]: ...
    def coordinate_change(
        self, t: float, x: ArrayLike, change: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> Floats: ...
    def constraint_sensitivity(
        self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> tuple[Floats, Floats, Floats]: ...
    def drawing(
        self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> tuple[Floats, Floats]: ...
    def drawing_along(
        self, times: ArrayLike, states: Floats, inputs: Floats, p: Values | None = None
    ) -> list[Floats]: ...
    def energy(self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None) -> Floats: ...
    def held(
        self,
        t: float,
        x: ArrayLike,
        accelerations: ArrayLike,
        multipliers: ArrayLike,
        p: Values | None = None,
        r: Values | None = None,
    ) -> list[Floats]: ...
    def parameter_vector(self, p: Values | None) -> Floats | None: ...
    def default_inputs(self, t: float, p: Values | None = None) -> Floats: ...
    def along(
        self, times: ArrayLike, states: ArrayLike, inputs: ArrayLike, p: Values | None = None
    ) -> tuple[Floats, Floats, Floats, Floats, Floats]: ...

def failure(status: int, t: float, x: ArrayLike) -> str: ...
