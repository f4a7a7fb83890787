"""Ready models, one file each: functions that return a `Model`."""

from fourbar_codegen.models.four_bar import four_bar
from fourbar_codegen.models.whipple_bicycle import whipple_bicycle

__all__ = ["four_bar", "whipple_bicycle"]
