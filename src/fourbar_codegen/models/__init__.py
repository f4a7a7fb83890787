"""Ready models, one file each: functions that return a `Model`."""

from fourbar_codegen.models.four_bar import four_bar

__all__ = ["four_bar"]
