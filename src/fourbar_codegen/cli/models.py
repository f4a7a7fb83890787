"""Models on the command line: models of the package, and functions in users' files."""

from __future__ import annotations

import importlib
import importlib.util
import sys
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

import fourbar_codegen as fb
from fourbar_codegen.errors import meant

if TYPE_CHECKING:
    from fourbar_codegen import CompiledModel, Linkage, Model

__all__ = ["MODEL", "MODEL_HELP", "compiled_model", "source_model"]

# Read from the folder: the modules import SymPy.
NAMES = sorted(file.stem for file in (Path(fb.__file__).parent / "models").glob("[a-z]*.py"))

MODEL_HELP = (
    f"MODEL is one of {', '.join(NAMES)} (four_bar, the default, is compiled already), or FILE.py:FUNCTION or "
    "MODULE:FUNCTION, a function without arguments that returns a Model or a Linkage."
)


class _ModelName(click.ParamType):  # type: ignore[type-arg]  # generic in newer versions alone
    """The name of a model, or a file and a function that returns one."""

    name = "model"

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:  # noqa: ARG002  # click's
        """The names of the package's models, and files."""
        names = [name for name in NAMES if name.startswith(incomplete)]
        return [*map(CompletionItem, names)] or [CompletionItem(incomplete, type="file")]


MODEL = click.argument("model", default="four_bar", type=_ModelName())


def compiled_model(text: str) -> CompiledModel:
    """The compiled model of the argument MODEL, compiled now if necessary."""
    if ":" not in text and text not in NAMES:
        _check_name(text)
        try:
            return fb.load(text)  # a model installed from a wheel
        except fb.ModelError as error:
            raise _unknown(text) from error
    return fb.load(text) if text == "four_bar" else fb.compile_model(source_model(text))


def source_model(text: str) -> Model:
    """The Model of the argument MODEL."""
    place, colon, function = text.rpartition(":")
    if not colon:
        _check_name(text)
        if text not in NAMES:
            raise _unknown(text)
        return getattr(fb.models, text)()  # type: ignore[no-any-return]
    try:
        module = _module(place)
        make = getattr(module, function, None)
        if isinstance(make, fb.Model | fb.Linkage):
            return _model_of(make)
        if not callable(make):
            own = [name for name, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__]
            raise fb.ModelError(f"{place} has no function {function}; it has {', '.join(own) or 'none'}.")
        model = make()
    except fb.FourbarError:
        raise
    except (Exception, SystemExit) as error:  # any error of the user's code
        raise fb.ModelError(f"{text} could not be called: {_said(error, place)}") from error
    if not isinstance(model, fb.Model | fb.Linkage):
        raise fb.ModelError(f"{text}() returned a {type(model).__name__}, not a fourbar_codegen.Model or Linkage.")
    return _model_of(model)


def _model_of(made: Model | Linkage) -> Model:
    return made.model() if isinstance(made, fb.Linkage) else made


def _check_name(text: str) -> None:
    if text.endswith(".py"):
        raise fb.ModelError(f"Name the function in {text} that returns the Model: {text}:FUNCTION.")


def _unknown(text: str) -> fb.ModelError:
    return fb.ModelError(
        f"There is no model {text!r}.{meant(text, NAMES)} There are {', '.join(NAMES)}; "
        "for a model of your own, give FILE.py:FUNCTION or MODULE:FUNCTION."
    )


def _said(error: BaseException, place: str) -> str:
    """An error in the user's code, with the line number of its last frame there."""
    name = Path(place).name
    lines = [frame for frame in traceback.extract_tb(error.__traceback__) if Path(frame.filename).name == name]
    where = f"{name}, line {lines[-1].lineno}: " if lines else ""
    return f"{where}{type(error).__name__}: {error}"


def _module(place: str) -> Any:
    """Import a module by its name, also from the current folder, or from its file.

    The user's folder is appended to the path, so that a json.py there does not replace that of the standard library.
    For the same reason, the module of a file gets a name of its own.
    """
    if not place.endswith(".py"):
        sys.path.append("")
        return importlib.import_module(place)
    path = Path(place)
    sys.path.append(str(path.absolute().parent))  # for imports beside the file, as in `python FILE.py`
    spec = importlib.util.spec_from_file_location(f"fourbar_model_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{place} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
