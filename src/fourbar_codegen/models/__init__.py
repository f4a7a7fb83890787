"""Ready models, one file each: functions that return a `Model`."""

from fourbar_codegen.models.cartesian_pendulum import cartesian_pendulum
from fourbar_codegen.models.chain import chain
from fourbar_codegen.models.four_bar import four_bar
from fourbar_codegen.models.n_four_bar import n_four_bar
from fourbar_codegen.models.rolling_disc import rolling_disc
from fourbar_codegen.models.slider_crank import slider_crank
from fourbar_codegen.models.whipple_bicycle import whipple_bicycle

__all__ = [
    "cartesian_pendulum",
    "chain",
    "four_bar",
    "n_four_bar",
    "rolling_disc",
    "slider_crank",
    "whipple_bicycle",
]
