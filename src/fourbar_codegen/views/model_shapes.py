"""The shapes of a model: those that were given, and those that are found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fourbar_codegen.body_shapes import BodyShape, check_names, data_of, named_shapes, shapes_of
from fourbar_codegen.kernel.kernel import Kernel, parameter_array
from fourbar_codegen.layout import ShapeKind
from fourbar_codegen.views.scene import scene

__all__ = ["ShapesLike", "all_shapes", "given_shapes", "set_shapes"]

ShapesLike = Mapping[Any, BodyShape | Sequence[BodyShape]]


def given_shapes(model: Kernel, shapes: ShapesLike | None = None) -> dict[str, tuple[BodyShape, ...]]:
    """The shapes that were given for a model, some of which may be replaced."""
    own = shapes_of(model.body_shapes)
    return own if shapes is None else {**own, **named_shapes(shapes, _names(model))}


def _names(model: Kernel) -> list[str]:
    """What can have a shape: bodies, links without mass, frames, and the ground."""
    drawing = model.layout.drawing
    names = [*drawing.bodies, *(point.body for point in drawing.points if point.body)]
    names += [shape.name for shape in drawing.shapes if shape.kind in (ShapeKind.LINK, ShapeKind.GROUND)]
    return list(dict.fromkeys(names))


def all_shapes(model: Kernel) -> dict[str, tuple[BodyShape, ...]]:
    """The shapes of a model: see `CompiledModel.shapes`."""
    values = parameter_array(model, None)
    if np.isnan(values).any():
        return given_shapes(model)
    x = np.array([model.layout.initial.get(name, 0.0) for name in model.states])[:, np.newaxis]
    r = np.zeros((model.n_r, 1))
    positions, _ = model.drawing_along([0.0], x, r, values)
    rotations = model.orientations_along([0.0], x, r, values)
    given = given_shapes(model)
    return {**scene(model, positions, rotations=rotations, p=values, given=given, in_space=True).shapes}


def set_shapes(model: Kernel, shapes: ShapesLike) -> None:
    """Give a model shapes: see `CompiledModel.shapes`."""
    given = named_shapes(shapes, _names(model))
    check_names(given, model.parameters, model.points)
    model.body_shapes = data_of(given)
