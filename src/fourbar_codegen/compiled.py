"""CompiledModel: a loaded extension module, its names, and what can be asked of it."""

from __future__ import annotations

import ctypes
import json
import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from importlib import import_module, machinery, util
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.arguments import Values, is_mapping, name_of, named_array, named_values
from fourbar_codegen.elimination import eliminate
from fourbar_codegen.errors import ModelError, SimulationError
from fourbar_codegen.files import path_of
from fourbar_codegen.progress import Progress
from fourbar_codegen.runtime.evaluator import NOT_FINITE, Evaluator, is_finite
from fourbar_codegen.runtime.integrator import Ode, Stepper

if TYPE_CHECKING:
    from fourbar_codegen.assembly import AssemblyModes
    from fourbar_codegen.ensemble import Ensemble
    from fourbar_codegen.simulate import EventLike, InputSource
    from fourbar_codegen.trajectory import Trajectory

__all__ = ["CompiledModel", "find", "load"]

Floats = NDArray[np.float64]

# What this process loaded from files: the system goes on giving out the first module of a path.
_LOADED: dict[str, tuple[int, int, int]] = {}


def _is_held(path: Path) -> bool:
    """Whether the system has loaded a library from this path."""
    try:
        ctypes.CDLL(str(path), mode=os.RTLD_NOLOAD)
    except OSError:
        return False
    return True


def _noexec(error: Exception) -> str:
    """A sentence, if the system refuses to run what is in a folder."""
    if "failed to map segment" not in str(error):
        return ""
    return (
        " Its file system may be mounted with noexec: name a folder elsewhere in the environment variable "
        "FOURBAR_CODEGEN_CACHE, or build elsewhere."
    )


def load(name: str | Path) -> CompiledModel:
    """Load a model that is compiled already; neither SymPy nor a compiler is needed.

    (For a module of `compile_model`, in the cache, a compiler is needed once more by its first batch or ensemble.)

    Parameters
    ----------
    name : str or Path
        The name of a model that comes with the package, ``"four_bar"``, or that was installed from a wheel
        of `build_wheel` (not what lies in the current folder); or the path of an extension module that
        ``fourbar build`` or `build_model` made. Of an installed package, nothing runs that does not say in its
        manifest.json that it is that model.

    Returns
    -------
    CompiledModel

    Raises
    ------
    ModelError
        If there is no such model, or the file is not a compiled model.

    Examples
    --------
    >>> load("four_bar").coordinates
    ('q1', 'q2', 'q3')
    """
    if not isinstance(name, str | Path):
        raise ModelError(f"A compiled model is known by its name or its path, not {name!r}.")
    path = path_of(name)
    try:
        is_module = path.suffix != "" and path.is_file()
    except OSError as error:
        raise ModelError(f"{path} cannot be loaded as a compiled model: {error.strerror}.") from error
    if is_module:
        return CompiledModel.from_file(path)
    if str(name) in _prebuilt():
        return CompiledModel.from_module(import_module(f"fourbar_codegen.prebuilt.{name}"))
    installed = _installed(str(name))
    if installed is not None:
        return CompiledModel.from_file(installed)
    known = ", ".join(_prebuilt()) or "none"
    raise ModelError(
        f"There is no compiled model {str(name)!r}: it is neither one of the package's ({known}) nor one installed "
        "from a wheel, nor the path of an extension module that fourbar build made."
    )


def find(name: str, fingerprint: str) -> CompiledModel | None:
    """The model of a name and fingerprint, if it can be had without building it.

    It is one that comes with the package, was installed from a wheel, or is in the cache of `compile_model`, built for
    this machine. Name and fingerprint may come from a stranger's file: neither becomes a path, and nothing is loaded
    but what is known to be that model.
    """
    if not name.isidentifier():
        return None
    if name in _prebuilt():
        model = load(name)
        if model.manifest["fingerprint"] == fingerprint:
            return model
    from fourbar_codegen.build import cache_key
    from fourbar_codegen.cache import find_cached

    module = _installed(name, fingerprint) or find_cached(name, cache_key(fingerprint))
    return None if module is None else CompiledModel.from_file(module)


def _prebuilt() -> list[str]:
    """The names of the models that come with the package."""
    folder = Path(__file__).parent / "prebuilt"
    return sorted({path.name.split(".")[0] for s in machinery.EXTENSION_SUFFIXES for path in folder.glob(f"*{s}")})


def _installed(name: str, fingerprint: str | None = None) -> Path | None:
    """The extension module in a package as `build_wheel` packs it; nothing is imported to find it."""
    if not name.isidentifier():
        return None
    # A data file may come with a folder beside it, which then is in the current one.
    spec = machinery.PathFinder.find_spec(name, [place for place in sys.path if not _is_current(place)])
    for folder in map(Path, (spec and spec.submodule_search_locations) or ()):
        try:
            manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
            found = manifest["name"], manifest["fingerprint"]
        except (OSError, ValueError, TypeError, KeyError, RecursionError):  # a package, but no model
            continue
        if found[0] == name and fingerprint in (None, found[1]):
            modules = (folder / f"{name}{suffix}" for suffix in machinery.EXTENSION_SUFFIXES)
            return next((module for module in modules if module.is_file()), None)
    return None


def _is_current(place: str) -> bool:
    try:
        return Path(place or ".").samefile(".")
    except OSError:  # it is not there
        return False


def _restore(name: str, path: str | None, manifest: dict[str, Any], sources: Mapping[str, str] | None) -> CompiledModel:
    """A model from another process, which may run on another machine.

    A module that was built to travel is loaded from its path. One that was built for its machine has none here: where
    another machine sees the same folder, its processor may lack the instructions, and the cache's key knows that. What
    is not there, is another model or cannot be loaded is built from the sources that came along.
    """
    if path is not None and Path(path).is_file():
        with suppress(ModelError):
            model = CompiledModel.from_file(Path(path))
            if model.manifest == manifest:
                return model
    with suppress(ModelError):
        found = find(name, manifest["fingerprint"])
        if found is not None and found.manifest == manifest:
            return found
    if sources is None:
        raise ModelError(
            f"The model {name} that was sent is not found here, or only another one of its name, and its sources were "
            "not beside it: install its wheel, or send what build_model made, from the folder that has its sources."
        )
    from fourbar_codegen.build import build_extension

    module = _built(name, sources, lambda folder: build_extension(name, sources, folder, portable=False))
    return CompiledModel.from_file(module)


def _built(name: str, sources: Mapping[str, str], build: Callable[[Path], Path]) -> Path:
    """What is built from generated sources, in the cache."""
    from fourbar_codegen.build import cache_key
    from fourbar_codegen.cache import cached

    return cached(name, cache_key([name, sources]), build)


class CompiledModel(Evaluator):
    """A mechanism's equations of motion, compiled.

    Made by `compile_model` and `load`. Arguments stand in the order (t, x, p, r): time, state x = [q; u],
    parameters, inputs. Parameters and inputs are arrays in order, or mappings from names or SymPy symbols
    that may leave out what has a default. Several threads may use one model at the same time.

    Attributes
    ----------
    name : str
    coordinates, speeds : tuple of str
        Generalized coordinates and speeds, the independent ones first.
    states : tuple of str
        Both.
    parameters, inputs, outputs : tuple of str
    points : tuple of str
        The points that are drawn: those whose positions the System gives, as its own points are called.
    forced_points : tuple of str
        Those of them on which forces act that depend on inputs.
    defaults : dict of str to float or None
        Parameter values; None where every call has to give one.
    units, descriptions : dict of str to str
        Of the parameters.
    path : Path
        The extension module.
    manifest : dict
        All that is known of the model, as in the manifest.json beside the generated sources.
    n_q, n_u, n_x, n_p, n_r : int
        Numbers of coordinates, speeds, states, parameters and inputs.
    n_h, n_c, n_o : int
        Numbers of position constraints, of velocity constraints, and of outputs.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> four_bar = fb.load("four_bar")
    >>> trajectory = four_bar.simulate((0.0, 1.0))
    >>> trajectory.success
    True
    """

    def __init__(self, capsule: object, manifest: dict[str, Any]) -> None:  # noqa: ARG002  # Evaluator takes it
        self.path = Path()
        self.name: str = manifest["name"]
        self.coordinates: tuple[str, ...] = tuple(manifest["coordinates"])
        self.speeds: tuple[str, ...] = tuple(manifest["speeds"])
        self.states = (*self.coordinates, *self.speeds)
        self.parameters: tuple[str, ...] = tuple(entry["name"] for entry in manifest["parameters"])
        self.inputs: tuple[str, ...] = tuple(entry["name"] for entry in manifest["inputs"])
        self.outputs: tuple[str, ...] = tuple(manifest["outputs"])
        self.points: tuple[str, ...] = tuple(entry["name"] for entry in manifest["points"])
        self.forced_points: tuple[str, ...] = tuple(self.points[place] for place in manifest["forced_points"])
        self.defaults: Mapping[str, float | None] = MappingProxyType(
            {e["name"]: e["default"] for e in manifest["parameters"]}
        )
        self.units: dict[str, str] = {e["name"]: e["unit"] for e in manifest["parameters"]}
        self.descriptions: dict[str, str] = {e["name"]: e["description"] for e in manifest["parameters"]}

    @classmethod
    def from_module(cls, module: Any) -> CompiledModel:
        """The model that an imported extension module holds."""
        try:
            model = cls(module.kernel, json.loads(module.manifest))
        except ModelError:  # is one, of another layout
            raise
        except (AttributeError, ValueError) as error:
            raise ModelError(f"{module.__name__} is not a compiled model: {error}.") from error
        model.path = Path(module.__file__)
        return model

    @classmethod
    def from_file(cls, path: Path) -> CompiledModel:
        """The model in an extension module that is not on Python's path."""
        name = path.name.split(".")[0]
        status = path.stat()
        identity = (status.st_ino, status.st_size, status.st_mtime_ns)
        place = str(path.resolve())
        if _LOADED.setdefault(place, identity) != identity:
            raise ModelError(
                f"{path} was built again after this process loaded it, and a module cannot be loaded anew: restart "
                "Python, or build into another folder."
            )
        loader = machinery.ExtensionFileLoader(name, str(path))
        taken = name in sys.modules
        try:
            spec = util.spec_from_file_location(name, path, loader=loader)
            assert spec is not None
            module = util.module_from_spec(spec)
            loader.exec_module(module)
        except ImportError as error:
            if not _is_held(path):
                del _LOADED[place]
            raise ModelError(f"{path} cannot be loaded as a compiled model: {error}.{_noexec(error)}") from error
        finally:
            if not taken:  # Cython enters its modules there, and the next import of that name would end at this one
                sys.modules.pop(name, None)
        return cls.from_module(module)

    def __reduce__(self) -> tuple[Any, ...]:
        path = str(self.path) if self.is_portable else None
        return _restore, (self.name, path, self.manifest, self._sources())

    def _sources(self) -> dict[str, str] | None:
        """The sources beside the module, or None where they are missing or damaged."""
        from fourbar_codegen.cache import is_whole

        if not is_whole(self.path.parent):
            return None
        endings = (".pyx", "_kernel.c", "_kernel.h", "_lanes.c", "_derivatives.c")
        files = [file for ending in endings if (file := self.path.with_name(f"{self.name}{ending}")).is_file()]
        return {file.name: file.read_text(encoding="utf-8") for file in files} or None

    def require_lanes(self) -> None:
        """Build and load the functions for several states side by side, where the module was built without them.

        They are in modules that were built to travel. `compile_model` leaves them to the first batch or ensemble, which
        calls this.

        Raises
        ------
        BuildError, CacheError
            As for `compile_model`.
        ModelError
            If the sources are no longer beside the module.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> four_bar.require_lanes()
        >>> four_bar.lacks_lanes
        False
        """
        if not self.lacks_lanes:
            return
        name = f"{self.name}_lanes"
        sources = self._sources() or {}
        if f"{name}.c" not in sources:
            raise ModelError(
                f"Batches and ensembles need functions that compile_model leaves for later, and their sources are not "
                f"beside {self.path} any more, or damaged: compile the model again. A module of build_model has them "
                "inside."
            )
        from fourbar_codegen.build import build_lanes

        with Progress(f"fourbar_codegen: {self.name}") as progress:
            progress.stage("compiling for many states at once")
            path = _built(name, sources, lambda folder: build_lanes(self.name, sources, folder))
        try:
            library = ctypes.CDLL(str(path))  # which stays loaded as long as the process runs
        except OSError as error:
            raise ModelError(f"{path} cannot be loaded: {error}.{_noexec(error)}") from error
        self._attach_lanes(ctypes.addressof(ctypes.c_char.in_dll(library, name)))

    def __repr__(self) -> str:
        return (
            f"<CompiledModel {self.name}: coordinates {', '.join(self.coordinates)}; speeds {', '.join(self.speeds)}; "
            f"parameters {', '.join(self.parameters) or 'none'}; inputs {', '.join(self.inputs) or 'none'}>"
        )

    def _repr_html_(self) -> str:
        from fourbar_codegen.tables import names_table

        return names_table(
            f"Compiled model {self.name}: {self.n_h} constraints on positions, {self.n_c} on velocities",
            [
                ("coordinate", self.coordinates, self.manifest["n_dependent_coordinates"]),
                ("speed", self.speeds, self.manifest["n_dependent_speeds"]),
            ],
            {name: (value, self.units[name], self.descriptions[name]) for name, value in self.defaults.items()},
            {entry["name"]: entry["expression"] for entry in self.manifest["inputs"]},
            self.outputs,
        )

    # Names to arrays.

    def parameter_values(self, p: Values) -> Values:
        """All parameter values in order, for an array or a mapping.

        Raises
        ------
        ModelError
            If a name is not a parameter's, or a parameter has neither value nor default.
        """
        if not is_mapping(p):
            return p
        return named_values(p, self.parameters, self.defaults, "parameter")

    def input_values(self, r: Values, defaults: Sequence[float]) -> Values:
        """All input values in order, for an array or a mapping."""
        if not is_mapping(r):
            return r
        known = {name: None if math.isnan(value) else value for name, value in zip(self.inputs, defaults, strict=True)}
        return named_values(r, self.inputs, known | self.rates_at_rest(r), "input")

    def rates_at_rest(self, r: Mapping[Any, Any]) -> dict[str, float]:
        """The rates of motions that r gives, 0 each: an input that is given without its rates is at rest."""
        in_force = zip(self.manifest["inputs"], self.defaults_in_force(r), strict=True)
        return {entry["name"]: 0.0 for entry, expression in in_force if entry["order"] and not expression}

    def defaults_in_force(self, r: Values | None) -> list[bool]:
        """For each input, whether it is what its expression gives: r names neither it nor what it is a rate of."""
        if r is None or not is_mapping(r):
            return super().defaults_in_force(r)
        given = {name_of(key) for key in r}
        return [given.isdisjoint({entry["name"], entry["of"]}) for entry in self.manifest["inputs"]]

    def missing(self) -> str:
        """What has to be given in every call."""
        parameters = [name for name, value in self.defaults.items() if value is None]
        inputs = [entry["name"] for entry in self.manifest["inputs"] if entry["expression"] is None]
        parts = [
            f"{kind} {', '.join(names)}" for kind, names in (("parameters", parameters), ("inputs", inputs)) if names
        ]
        return f"The model {self.name} has no default for its {' and '.join(parts)}: give them in the call."

    # Matrices and vectors.

    def tree_mass_matrix(self, t: float, x: ArrayLike, p: Values | None = None) -> Floats:
        """M of Kane's equations M u' = f with all speeds independent, shape (n_u, n_u).

        Parameters
        ----------
        t, x, p
            As for `rhs`.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> fb.load("four_bar").tree_mass_matrix(0.0, [0.0] * 6).shape
        (3, 3)
        """
        return self._finite(self.dynamics(t, x, p, np.zeros(self.n_r))[1], t, x)

    def tree_forcing(self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None) -> Floats:
        """The vector f of Kane's equations M u' = f with all speeds independent, shape (n_u,).

        Parameters
        ----------
        t, x, p, r
            As for `rhs`.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> fb.load("four_bar").tree_forcing(0.0, [0.0] * 6).round(1).tolist()
        [-2374.0, -1417.5, -240.3]
        """
        return self._finite(self.dynamics(t, x, p, r)[2], t, x)

    def mass_matrix(self, t: float, x: ArrayLike, p: Values | None = None) -> Floats:
        """SymPy's ``System.mass_matrix``, shape (n_u, n_u).

        In the model's own partition: Kane's equations projected on the independent speeds, above the
        constraints' Jacobian. See `forcing`.

        Parameters
        ----------
        t, x, p
            As for `rhs`.

        Raises
        ------
        SimulationError
            If the model's own dependent speeds do not follow from the independent ones in this configuration.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> four_bar.mass_matrix(0.0, four_bar.initial_state()).shape
        (3, 3)
        """
        _, mass_matrix, _, jacobian, _ = self.dynamics(t, x, p, np.zeros(self.n_r))
        self._finite(jacobian, t, x)
        return self._finite(np.vstack((self._projection(jacobian).T @ mass_matrix, jacobian)), t, x)

    def forcing(self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None) -> Floats:
        """SymPy's ``System.forcing``, shape (n_u,): ``mass_matrix @ u' = forcing``.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`.

        Raises
        ------
        SimulationError
            If the model's own dependent speeds do not follow from the independent ones in this configuration.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> x0 = four_bar.initial_state()
        >>> residual = four_bar.mass_matrix(0.0, x0) @ four_bar.rhs(0.0, x0)[3:] - four_bar.forcing(0.0, x0)
        >>> bool(abs(residual).max() < 1e-9)
        True
        """
        _, _, forcing, jacobian, bias = self.dynamics(t, x, p, r)
        self._finite(jacobian, t, x)
        return self._finite(np.concatenate((self._projection(jacobian).T @ forcing, -bias)), t, x)

    def _finite(self, values: Floats, t: float, x: ArrayLike) -> Floats:
        """The values; a SimulationError where the equations have none that is finite."""
        if not is_finite(np.ascontiguousarray(values)):
            raise SimulationError(self.failure(NOT_FINITE, t, x))
        return values

    def _projection(self, jacobian: Floats) -> Floats:
        """T with u = T u_i + ... for the model's own independent speeds, shape (n_u, n_ui)."""
        n_i = self.n_u - self.manifest["n_dependent_speeds"]
        return np.vstack((np.eye(n_i), eliminate(jacobian, n_i, self.speeds[n_i:])))

    def position_constraints(self, t: float, q: ArrayLike, p: Values | None = None, r: Values | None = None) -> Floats:
        """Residuals of the holonomic constraints, shape (n_h,), in the constraints' units.

        Parameters
        ----------
        t : float
        q : array_like, shape (n_q,)
        p, r : array_like or mapping, optional
            As for `rhs`; the inputs count where they prescribe a motion.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> fb.load("four_bar").position_constraints(0.0, [0.0, 0.0, 0.0]).tolist()
        [3.0, 0.0]
        """
        return self._finite(self.position(t, q, p, r)[0], t, q)

    def positions(self, t: float, q: ArrayLike, p: Values | None = None, r: Values | None = None) -> dict[str, Floats]:
        """Positions of the mechanism's points, by name, m, each of shape (3,), from the System's fixed point.

        Parameters
        ----------
        t : float
        q : array_like, shape (n_q,)
        p, r : array_like or mapping, optional
            As for `position_constraints`.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> q = four_bar.initial_state()[:3]
        >>> four_bar.positions(0.0, q)["joint3_link3_joint"].round(3).tolist()
        [-0.084, -0.625, 0.0]
        """
        coordinates = named_array(q, self.coordinates, {}, "coordinate")
        positions, _ = self.drawing(t, np.concatenate((coordinates, np.zeros(self.n_u))), p, r)
        return dict(zip(self.points, positions, strict=True))

    def velocity_constraints(self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None) -> Floats:
        """Residuals J u + b of the velocity constraints, shape (n_c,), holonomic ones first.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`; the inputs count where they prescribe a motion.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> bool(abs(four_bar.velocity_constraints(0.0, four_bar.initial_state())).max() < 1e-14)
        True
        """
        jacobian, bias = self.velocity(t, x, p, r)
        residual: Floats = jacobian @ np.asarray(x, dtype=float)[self.n_q :] + bias
        return self._finite(residual, t, x)

    def constraint_jacobian(self, t: float, q: ArrayLike, p: Values | None = None, r: Values | None = None) -> Floats:
        """J of the velocity constraints J u + b = 0, shape (n_c, n_u).

        Parameters
        ----------
        t : float
        q : array_like, shape (n_q,)
        p, r : array_like or mapping, optional
            As for `rhs`; the inputs count where they prescribe a motion.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> abs(fb.load("four_bar").constraint_jacobian(0.0, [0.0, 0.0, 0.0])).round(3).tolist()
        [[0.0, 0.0, 0.0], [2.2, 1.7, 0.7]]
        """
        coordinates = named_array(q, self.coordinates, {}, "coordinate")
        return self._finite(self.velocity(t, np.concatenate((coordinates, np.zeros(self.n_u))), p, r)[0], t, q)

    def multipliers(self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None) -> Floats:
        """Multipliers lambda of M u' = f + J^T lambda, shape (n_c,).

        They are the generalized reactions conjugate to the constraints as they were written: for the four-bar,
        the force (N) of the ground on the end of link 4.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`.

        Raises
        ------
        SimulationError
            In a singular position.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> four_bar.multipliers(0.0, four_bar.initial_state()).shape
        (2,)
        """
        return self.accelerations(t, x, p, r)[1]

    def output(self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None) -> Floats:
        """The outputs, shape (n_o,), in the order of ``outputs``.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`.

        Raises
        ------
        SimulationError
            In a singular position.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> four_bar.outputs, four_bar.output(0.0, four_bar.initial_state()).shape
        ((), (0,))
        """
        return self.held(t, x, *self.accelerations(t, x, p, r), p, r)[0]

    def kinetic_energy(self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None) -> float:
        """Kinetic energy, J.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`; the inputs count where they prescribe a motion.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> fb.load("four_bar").kinetic_energy(0.0, [0.1, 0.2, 0.3, 0.0, 0.0, 0.0])
        0.0
        """
        return float(self._finite(self.energy(t, x, p, r)[:1], t, x)[0])

    def potential_energy(self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None) -> float:
        """Potential energy, J: as given with the Model, or of the forces that are constant, such as gravity.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`; the inputs count where they prescribe a motion.

        Raises
        ------
        ModelError
            If the System does not define the position of a point that a constant force acts on; or the energy
            depends on an input that has no expression and is not given.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> fb.load("four_bar").potential_energy(0.0, [0.0] * 6)
        0.0
        """
        if not self.manifest["has_potential_energy"]:
            raise ModelError(
                f"The potential energy of {self.name} is not known: a constant force acts on a point whose position "
                "from the System's fixed point is not defined. Give potential_energy= to the Model."
            )
        energy = float(self.energy(t, x, p, r)[1])
        if r is None and math.isnan(energy) and any(e["expression"] is None for e in self.manifest["inputs"]):
            raise ModelError(self.missing())
        return float(self._finite(np.array([energy]), t, x)[0])

    # Linearization, initial states and simulation.

    def linearize(
        self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> tuple[Floats, Floats]:
        """A and B of d(q_i, u_i)/dt = A d(q_i, u_i) + B dr near a state that satisfies the constraints.

        In the independent coordinates q_i and speeds u_i, as ``KanesMethod.linearize(A_and_B=True)``: the
        dependent ones follow the constraints to first order, also where inputs stand in these.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`.

        Returns
        -------
        A : ndarray, shape (n_qi + n_ui, n_qi + n_ui)
        B : ndarray, shape (n_qi + n_ui, n_r)

        Raises
        ------
        ModelError
            If an argument has a wrong shape or name, or is not finite, or the state violates the constraints.
        SimulationError
            If the dependent coordinates or speeds do not follow from the independent ones at this state.

        Source: D. L. Peterson, G. Gede, M. Hubbard, "Symbolic linearization of equations of motion of
        constrained multibody systems", *Multibody System Dynamics* 33 (2015).

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> A, B = four_bar.linearize(0.0, four_bar.initial_state())
        >>> A.shape, B.shape
        ((2, 2), (2, 1))
        """
        from fourbar_codegen.linearize import linearize

        return linearize(self, t, x, p, r)

    def equilibrium(
        self,
        guess: Values | None = None,
        *,
        t: float = 0.0,
        parameters: Values | None = None,
        inputs: Mapping[Any, InputSource] | None = None,
    ) -> Floats:
        """A state of rest in which the mechanism stays.

        Found by SciPy's ``least_squares`` on constraints and accelerations with compiled Jacobians. It may be
        stable or not: the eigenvalues of `linearize` tell.

        Parameters
        ----------
        guess : array_like, shape (n_q,), or mapping, optional
            Coordinates at which to begin; the model's initial values, or 0, where left out.
        t : float, optional
            Time, s, at which inputs are taken.
        parameters : array_like or mapping, optional
            The defaults otherwise.
        inputs : mapping, optional
            As for `simulate`, but no callables.

        Returns
        -------
        ndarray, shape (n_x,)
            The coordinates, and speeds of 0.

        Raises
        ------
        ModelError
            If an argument has a wrong shape or name, or is not finite.
        SimulationError
            If no equilibrium was found; with where the search ended.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> x = four_bar.equilibrium(four_bar.initial_state()[:3], inputs={"F": 0.0})
        >>> bool(abs(four_bar.rhs(0.0, x, r={"F": 0.0})).max() < 1e-9)
        True
        """
        from fourbar_codegen.linearize import equilibrium

        return equilibrium(self, guess, t=t, parameters=parameters, inputs=inputs)

    def initial_state(
        self,
        coordinates: Values | None = None,
        speeds: Values | None = None,
        *,
        t: float = 0.0,
        guess: Values | None = None,
        parameters: Values | None = None,
        inputs: Mapping[Any, InputSource] | None = None,
    ) -> Floats:
        """A state that satisfies all constraints, from the independent coordinates and speeds.

        The dependent coordinates are found by Newton's method where each of its steps halves the residual at least,
        otherwise by SciPy's ``fsolve``, on the position constraints with their Jacobian; the dependent speeds from the
        velocity constraints, which are linear in them.

        Parameters
        ----------
        coordinates, speeds : array_like or mapping, optional
            Values of the independent ones; the model's initial values where left out.
        t : float, optional
            Time, s.
        guess : array_like or mapping, optional
            Where to start the search for the dependent coordinates; the model's guess, or 0, otherwise. It
            decides which of several ways to close the loop is found.
        parameters : array_like or mapping, optional
            The defaults otherwise.
        inputs : mapping, optional
            As for `simulate`; those count that prescribe a motion.

        Returns
        -------
        ndarray, shape (n_x,)

        Raises
        ------
        ModelError
            If an argument has a wrong shape or name, or is not finite.
        AssemblyError
            If the loops do not close, or the dependent speeds are not determined.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> x0 = fb.load("four_bar").initial_state({"q1": -0.5}, {"u1": -0.1}, guess=[-1.5, -1.5])
        >>> x0.round(6).tolist()
        [-0.5, -2.246416, -1.497827, -0.1, 0.071583, -0.027469]
        """
        from fourbar_codegen.initial import given, initial_state

        return initial_state(*given(self, coordinates, speeds, t, guess, parameters, inputs))

    def initial_states(
        self,
        coordinates: Values | None = None,
        speeds: Values | None = None,
        *,
        t: float = 0.0,
        parameters: Values | None = None,
        inputs: Mapping[Any, InputSource] | None = None,
    ) -> AssemblyModes:
        """The assembly modes: all states that satisfy the constraints with these independent coordinates and speeds.

        They are complete where the loops are those of dyads, one after another: constraints, one or two at a time, in
        no more unknown coordinates, that are trigonometric in angles and polynomial in displacements. So are the
        four-bar linkage, the slider-crank, and chains of them. Other loops are searched from many beginnings, and the
        number of modes is a lower bound. See `fourbar_codegen.assembly` for the method.

        Parameters
        ----------
        coordinates, speeds, t, parameters, inputs
            As for `initial_state`.

        Returns
        -------
        AssemblyModes
            A sequence of states, empty if the loops cannot be closed; with ``is_complete``, and ``plot()``.

        Raises
        ------
        ModelError
            If an argument has a wrong shape or name, or is not finite.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> modes = fb.load("four_bar").initial_states({"q1": -0.5})
        >>> len(modes), modes.is_complete
        (2, True)
        """
        from fourbar_codegen.initial import given, initial_states

        return initial_states(*given(self, coordinates, speeds, t, None, parameters, inputs))

    def ode(self, parameters: Values | None = None, inputs: Mapping[Any, InputSource] | None = None) -> Ode:
        """The right-hand side as a callable f(t, x), for `scipy.integrate.solve_ivp` and its like.

        Parameters
        ----------
        parameters : array_like or mapping, optional
            The defaults otherwise.
        inputs : mapping, optional
            As for `simulate`.

        Returns
        -------
        Ode
            Callable, with its Jacobian as ``.jac``. The integrators in `fourbar_codegen.solvers` call it from C.
            Several threads may use one at the same time.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> from scipy.integrate import solve_ivp
        >>> four_bar = fb.load("four_bar")
        >>> f = four_bar.ode({"l2": 0.45})
        >>> x0 = four_bar.initial_state(parameters={"l2": 0.45})
        >>> solve_ivp(f, (0.0, 1.0), x0, method="Radau", jac=f.jac).success
        True
        >>> solve_ivp(f, (0.0, 1.0), x0, method=fb.solvers.DOP853).success
        True
        """
        from fourbar_codegen.simulate import bind

        return bind(self, parameters, inputs)

    def simulate(
        self,
        t_span: Sequence[float],
        x0: ArrayLike | None = None,
        *,
        method: str = "DOP853",
        parameters: Values | None = None,
        inputs: Mapping[Any, InputSource] | None = None,
        t_eval: ArrayLike | None = None,
        rtol: float = 1e-6,
        atol: float | ArrayLike = 1e-9,
        events: EventLike | Sequence[EventLike] | None = None,
        constraints: str = "project",
        stabilization: float = 10.0,
        dense_output: bool = False,
        max_step: float = math.inf,
        max_steps: int | Literal["auto"] | None = "auto",
        formulation: str | None = None,
        progress: Callable[[float], object] | Literal[False] | None = None,
    ) -> Trajectory:
        """Integrate the equations of motion, with the loops closed.

        Parameters
        ----------
        t_span : (float, float)
            First and last time, s.
        x0 : array_like, shape (n_x,), optional
            Initial state, taken as it is (`initial_state` makes consistent ones); the one that follows from
            the model's initial values otherwise.
        method : {"DOP853", "RK45", "ALI3P", "RK23", "Radau", "BDF", "LSODA", "CVODE", "IDA"}, optional
            The first two run in C, with the coefficients and the step control of SciPy's. ALI3P passes singular
            positions: an augmented Lagrangian of index 3, by the trapezoidal rule, with projections; it runs in C and
            takes steps of `max_step`, shorter ones where their equations cannot be solved. At a singular position,
            where a mechanism may go on in more than one way, it takes the one on which its velocities are continuous,
            since inertia does not let them jump. The next are SciPy's by `fourbar_codegen.solvers`: of RK23 the steps
            are in C, the implicit ones are given the compiled Jacobian. CVODE, for what is stiff, and IDA, which keeps
            the constraints as equations, are SUNDIALS' by scikit-sundae (``pip install 'fourbar_codegen[dae]'``), with
            compiled functions.
        parameters : array_like or mapping, optional
            The defaults otherwise.
        inputs : mapping of input to source, optional
            For each input a number, a table ``(times, values)`` or ``(times, values, kind)``, held constant beyond its
            ends, or a callable of (t, x); its expression otherwise. The kinds are "linear", "pchip" and "cubic":
            lines, monotone cubics, which do not overshoot, and a cubic spline. By default it is the first, and the last
            where an input prescribes a motion and its rates are needed; a callable is refused there.
        t_eval : array_like, optional
            Times at which to store the state.
        rtol, atol : float, optional
            Relative and absolute tolerance of the integrator; ALI3P has none.
        events : sequence, or one of its entries, optional
            Names of outputs, callables of (t, x) as for ``solve_ivp``, with attributes ``terminal`` and ``direction``,
            or `Event` objects, which have these. Each change of sign is located on the interpolant. Outputs are
            evaluated in C; callables after each step.
        constraints : {"project", "baumgarte", "none"}, optional
            How to keep the loops closed. With "project", the positions and then the speeds are moved onto the
            constraints after each accepted step, by the change that is least in the metric of the mass matrix; so is
            every state that is handed out. With "baumgarte", the
            accelerations are such that violations decay, and these stay as large as what an integrator's error adds
            within 1 / `stabilization`. With "none", only the accelerations satisfy the constraints, and the loops
            drift open by the integrator's error. LSODA, CVODE and IDA have a history of their own, so that only the
            states that they hand out are moved.
        stabilization : float, optional
            The rate a, 1/s, at which "baumgarte" lets violations decay: Phi'' + 2 a Phi' + a^2 Phi = 0. Rates beyond
            one by the step make the equations stiff. Source: J. Baumgarte, "Stabilization of constraints and integrals
            of motion in dynamical systems", *Computer Methods in Applied Mechanics and Engineering* 1 (1972).
        dense_output : bool, optional
            Whether to keep an interpolant as ``trajectory.sol``.
        max_step : float, optional
            The longest step, s; ALI3P needs it. One that is lost in the rounding of the run's length is refused.
        max_steps : int, "auto" or None, optional
            The most steps: a run that has taken them ends there, with what it has. None is no limit. By default
            1,000,000 of the methods in C (DOP853, RK45, ALI3P) and 100,000 of the others, or ten times those that
            `max_step` asks for, where that is more.
        formulation : {"gear-gupta-leimkuhler", "index-1", "index-3"}, optional
            For IDA, the first one if left out: whether positions and velocities satisfy the constraints in each step;
            or accelerations alone, so that the loops drift open; or positions alone, with only the coordinates under
            the step control. See `fourbar_codegen.solvers.IDA`.
        progress : callable or False, optional
            A callable is called with the time reached, some times a second. Without one, a run that takes longer than a
            second says on stderr how far it is: on a terminal in a line that vanishes, elsewhere in a line a second,
            after a minute in fewer. False is silence.

        Returns
        -------
        Trajectory
            With ``success`` False and a sentence in ``message`` if the integrator could not finish: for instance at a
            singular position, where the constraints' Jacobian loses rank. Another sentence says from what to what the
            energy has grown, where it ends with a thousand times the largest kinetic energy of the run's first half and
            the range of its potential energy; a constant force makes four times.

        Raises
        ------
        ModelError
            If an argument has a wrong shape or name, or is not finite.
        AssemblyError
            If `x0` is left out and the loops do not close.
        SimulationError
            If the equations cannot be evaluated at the initial state.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> trajectory = fb.load("four_bar").simulate((0.0, 4.0), inputs={"F": 0.0}, rtol=1e-8, atol=1e-8)
        >>> bool(abs(trajectory.constraint_residual).max() < 1e-12)
        True
        """
        from fourbar_codegen.simulate import simulate

        return simulate(
            self,
            t_span,
            x0,
            method=method,
            parameters=parameters,
            inputs=inputs,
            t_eval=t_eval,
            rtol=rtol,
            atol=atol,
            events=events,
            constraints=constraints,
            stabilization=stabilization,
            dense_output=dense_output,
            max_step=max_step,
            max_steps=max_steps,
            formulation=formulation,
            progress=progress,
        )

    def rhs_batch(
        self,
        t: ArrayLike,
        x: ArrayLike,
        p: Values | None = None,
        r: Values | None = None,
        *,
        out: Floats | None = None,
        workers: int | None = 1,
    ) -> Floats:
        """The right-hand side x' = f(t, x) at many states, side by side in vectors.

        Parameters
        ----------
        t : float or array_like, shape (n,)
        x : array_like, shape (n_x, n)
            States in columns; or a mapping from names to arrays.
        p : array_like, shape (n_p,) or (n_p, n), or mapping to numbers or arrays of length n, optional
            Parameters; the defaults otherwise.
        r : array_like, shape (n_r,) or (n_r, n), or mapping, optional
            Inputs; their expressions otherwise.
        out : ndarray, shape (n_x, n), optional
            Where the results come, contiguous, without memory shared with the arguments; a fresh array otherwise.
        workers : int or None, optional
            Number of threads; None for one on each core.

        Returns
        -------
        ndarray, shape (n_x, n)
            x', NaN in the columns of states at which the equations cannot be evaluated. A state's rates are the same
            to the bit whatever stands beside it.

        Raises
        ------
        ModelError
            If an argument has a wrong shape or name.

        Examples
        --------
        >>> import numpy as np
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> states = np.tile(four_bar.initial_state(), (1000, 1)).T
        >>> four_bar.rhs_batch(0.0, states, {"k": np.linspace(1.0, 5.0, 1000)}).shape
        (6, 1000)
        """
        from fourbar_codegen.ensemble import evaluate

        return evaluate(self, t, x, p, r, out=out, workers=workers)

    def ensemble(
        self,
        t_span: Sequence[float],
        x0: ArrayLike | Mapping[Any, ArrayLike] | None = None,
        *,
        method: str = "DOP853",
        parameters: ArrayLike | Mapping[Any, ArrayLike] | None = None,
        inputs: Mapping[Any, InputSource | Floats] | None = None,
        t_eval: ArrayLike | None = None,
        rtol: float = 1e-6,
        atol: float | ArrayLike = 1e-9,
        constraints: str = "project",
        max_step: float = math.inf,
        max_steps: int | Literal["auto"] | None = "auto",
        workers: int | None = None,
        parallel: Any = None,
        progress: bool = True,
    ) -> Ensemble:
        """Many runs over the same time, several side by side in vectors, and on all cores.

        Models with redundant or with many constraints run one member at a time on each core.

        Parameters
        ----------
        t_span : (float, float)
            First and last time, s.
        x0 : array_like, shape (n_x,) or (n, n_x), or mapping, optional
            Initial states of all members, or of each; by name, numbers or arrays of length n. Where they are left out,
            `initial_state` makes one for each set of parameters.
        method : {"DOP853", "RK45"}, optional
        parameters : array_like, shape (n_p,) or (n, n_p), or mapping, optional
            Likewise; the defaults otherwise.
        inputs : mapping of input to source, optional
            As for `simulate`, or an array of shape (n,) with a number for each member. With a callable, members run
            one after the other.
        t_eval : array_like, optional
            Times at which to store the states; the first and the last one otherwise.
        rtol, atol, constraints, max_step, max_steps
            As for `simulate`.
        workers : int, optional
            Number of threads; one on each core otherwise.
        parallel : joblib.Parallel, optional
            An engine that runs blocks of members instead of threads, with any of its backends: in processes, or on a
            cluster. Where a worker does not find the compiled model, it builds it from its sources, once on each node.
        progress : bool, optional
            Whether a bar on the terminal says how far it is, where it takes longer than a second.

        Returns
        -------
        Ensemble
            A member that fails is marked there; the others go on. What a member gives is the same to the bit whatever
            runs beside it, on however many threads. `simulate` gives the same up to rounding errors, which kinks of an
            input, or a position close to a singular one, can make large.

        Raises
        ------
        ModelError
            If an argument has a wrong shape or name, or is not finite.
        AssemblyError
            If `x0` is left out and the loops of a member do not close.

        Examples
        --------
        >>> import numpy as np
        >>> import fourbar_codegen as fb
        >>> ensemble = fb.load("four_bar").ensemble((0.0, 4.0), parameters={"k": np.linspace(2.0, 4.0, 100)})
        >>> ensemble.success.all(), ensemble["q1"].shape
        (np.True_, (100, 2))
        """
        from fourbar_codegen.ensemble import run

        return run(
            self, t_span, x0, method=method, parameters=parameters, inputs=inputs, t_eval=t_eval, rtol=rtol, atol=atol,
            constraints=constraints, max_step=max_step, max_steps=max_steps, workers=workers, parallel=parallel,
            progress=progress,
        )  # fmt: skip

    def stepper(
        self,
        h: float,
        x0: ArrayLike | None = None,
        *,
        t: float = 0.0,
        parameters: Values | None = None,
        inputs: Mapping[Any, InputSource] | None = None,
        constraints: str = "project",
    ) -> Stepper:
        """An object that advances the mechanism by steps of one length, for control loops and real time.

        Parameters
        ----------
        h : float
            The step, s.
        x0 : array_like, shape (n_x,), optional
            The state to begin from; the one that follows from the model's initial values otherwise.
        t : float, optional
            Time to begin at, s.
        parameters : array_like or mapping, optional
            The defaults otherwise.
        inputs : mapping, optional
            As for `simulate`; ``step(r)`` holds others.
        constraints : {"project", "none"}, optional
            As for `simulate`.

        Returns
        -------
        Stepper
            With the method ``step(r)`` and the attributes ``t`` and ``x``; each thread needs one of its own.

        Raises
        ------
        ModelError
            If an argument has a wrong shape or name, or is not finite.
        AssemblyError
            If `x0` is left out and the loops do not close.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> stepper = fb.load("four_bar").stepper(1e-3)
        >>> for _ in range(100):
        ...     x = stepper.step({"F": -20.0 * stepper.x[3]})
        >>> round(stepper.t, 9), x.shape
        (0.1, (6,))
        """
        from fourbar_codegen.simulate import make_stepper

        return make_stepper(self, h, x0, t=t, parameters=parameters, inputs=inputs, constraints=constraints)
