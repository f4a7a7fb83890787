"""Methods that are declared where data are, and whose functions are registered from above, such as `Trajectory.plot`.

xarray registers its accessors in the same way: https://docs.xarray.dev/en/stable/internals/extending-xarray.html
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from types import MethodType
from typing import Any, Generic, ParamSpec, TypeVar

__all__ = ["Registered", "RegisteredAttribute", "register"]

P = ParamSpec("P")
R = TypeVar("R")

_FUNCTIONS: dict[str, str] = {}
"""Where the function of a method is, as ``"module:function"``, by ``"Class.method"``."""


def register(functions: Mapping[str, str]) -> None:
    """Say where functions of methods are, by ``"Class.method"``; they are imported when they are first called.

    Examples
    --------
    >>> register({"Trajectory.plot": "fourbar_codegen.views.figures:plot_trajectory"})
    """
    _FUNCTIONS.update(functions)


def _function_of(key: str) -> Callable[..., Any]:
    """The function that is registered for ``"Class.method"``."""
    if key not in _FUNCTIONS:
        raise AttributeError(f"There is no function for {key}: nothing above has registered one.")
    module, _, name = _FUNCTIONS[key].partition(":")
    function: Callable[..., Any] = getattr(import_module(module), name)
    return function


class Registered(Generic[P, R]):
    """A method whose function is registered. Its types are those of the arguments after the first, and of the result.

    Examples
    --------
    >>> class Result:
    ...     save = Registered[[str], None]()
    >>> register({"Result.save": "builtins:print"})
    >>> Result().save("run.csv")  # doctest: +ELLIPSIS
    <...Result object at 0x...> run.csv
    """

    def __set_name__(self, owner: type, name: str) -> None:
        self._key = f"{owner.__name__}.{name}"

    def __get__(self, instance: object, owner: type | None = None) -> Callable[P, R]:
        function = _function_of(self._key)
        return function if instance is None else MethodType(function, instance)


class RegisteredAttribute:
    """An attribute whose function is registered, and takes the instance."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._key = f"{owner.__name__}.{name}"

    def __get__(self, instance: object, owner: type | None = None) -> Any:
        return self if instance is None else _function_of(self._key)(instance)
