"""Types of the compiled module implicit.pyx, which holds the documentation."""

from typing import final

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.runtime.integrator import Ode

Floats = NDArray[np.float64]

FORMULATIONS: tuple[str, ...]

@final
class Rates:
    def __init__(self, ode: Ode) -> None: ...
    def evaluate(self, t: float, x: Floats, rates: Floats) -> None: ...
    def jacobian(self, t: float, x: Floats, rates: object, matrix: Floats) -> None: ...

@final
class Residual:
    def __init__(self, ode: Ode, formulation: str) -> None: ...
    @property
    def n_y(self) -> int: ...
    def scale(self, t: float, c: float, y: Floats, y_rate: Floats, weights: Floats, metric: Floats) -> None: ...
    def evaluate(self, t: float, y: Floats, y_rate: Floats, residual: Floats) -> None: ...
    def jacobian(self, t: float, y: Floats, y_rate: Floats, residual: object, c: float, matrix: Floats) -> None: ...
