"""A compiled model in JAX: its right-hand side and simulations as functions that JAX differentiates.

Needs the extra ``jax``.

Source: JAX documentation, "Custom derivative rules for JAX-transformable Python functions" and "External callbacks",
https://docs.jax.dev.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.analysis.initial_state import dependent_guess
from fourbar_codegen.compiled_model import CompiledModel
from fourbar_codegen.errors import AssemblyError, ModelError, SimulationError, shown
from fourbar_codegen.interface.arguments import Values, flag, is_mapping, listed, name_of, named, numbers
from fourbar_codegen.kernel.inputs import InputSource
from fourbar_codegen.kernel.kernel import Kernel, parameter_array
from fourbar_codegen.kernel.sensitivity import independent_states, moving_breakpoints
from fourbar_codegen.results.trajectory import Trajectory
from fourbar_codegen.simulation.methods import MethodLike
from fourbar_codegen.simulation.run_options import RunOptions, RunStart

__all__ = ["JaxModel", "to_jax"]

Floats = NDArray[np.float64]
Arrays = Mapping[str, Any]

TIME_STEP = 1e-5
"""Of differences in time, relative to times above 1 s."""


def to_jax(model: CompiledModel) -> JaxModel:
    """A model whose functions JAX can call, differentiate, compile and vectorize; needs the extra ``jax``.

    Parameters
    ----------
    model : CompiledModel

    Returns
    -------
    JaxModel

    Raises
    ------
    ModelError
        If JAX is not installed, or computes in single precision: ``jax.config.update("jax_enable_x64", True)``.

    Examples
    --------
    >>> import jax
    >>> import fourbar_codegen as fb
    >>> jax.config.update("jax_enable_x64", True)
    >>> four_bar = fb.to_jax(fb.load("four_bar"))
    >>> simulate = four_bar.simulation((0.0, 1.0), [0.5, 1.0])
    >>> loss = lambda parameters: (simulate(parameters)["q2"] ** 2).sum()
    >>> round(float(jax.grad(loss)({"k": 2.0})["k"]), 4)
    0.0149
    """
    if not isinstance(model, CompiledModel):
        raise ModelError(f"to_jax takes a compiled model, as compile_model and load return it, not {shown(model)}.")
    try:
        import jax
    except ImportError as error:
        raise ModelError("JAX is not installed: pip install 'fourbar_codegen[jax]'.") from error
    if not jax.config.jax_enable_x64:
        raise ModelError(
            "JAX computes in single precision, which is not enough for a mechanism: call "
            'jax.config.update("jax_enable_x64", True) at the beginning of the program.'
        )
    return JaxModel(model)


@dataclass(frozen=True)
class JaxModel:
    """Functions of a compiled model for JAX, made by `to_jax`.

    They run on the CPU, by callbacks. Where the equations cannot be evaluated, results are NaN.

    Attributes
    ----------
    model : CompiledModel
    """

    model: CompiledModel

    def rhs(self, t: Any, x: Any, p: Any = None, r: Any = None) -> Any:
        """The right-hand side x' = f(t, x, p, r), with derivatives in forward and reverse mode, and `jax.vmap`.

        Derivatives are with respect to x, p and r, also through the expressions of inputs; those with respect to t are
        central differences.

        Parameters
        ----------
        t : scalar
        x : array, shape (n_x,)
        p : array, shape (n_p,), or mapping of names to scalars, optional
            What is not given has the model's value.
        r : array, shape (n_r,), or mapping of names to scalars, optional
            Inputs; what is not given has the value of its expression.

        Returns
        -------
        array, shape (n_x,)

        Raises
        ------
        ModelError
            If a parameter or an input has no value, or an argument a wrong shape; and for second derivatives.

        Examples
        --------
        >>> import jax
        >>> import fourbar_codegen as fb
        >>> jax.config.update("jax_enable_x64", True)
        >>> four_bar = fb.load("four_bar")
        >>> x = four_bar.initial_state()
        >>> d_state = jax.jacobian(lambda x: fb.to_jax(four_bar).rhs(0.0, x))(x)
        >>> bool(abs(d_state - four_bar.jacobian(0.0, x)).max() == 0.0)
        True
        """
        import jax.numpy as jnp

        model = self.model.kernel
        given = {} if p is None else p
        if is_mapping(given):
            of_p = named(given, model.parameters, "parameter")
            model.parameter_vector(dict.fromkeys(of_p, 1.0))  # raises if another one has no value
            p = _replaced(parameter_array(model, None), model.parameters, of_p)
        t, x, p = _shaped("t", t, ()), _shaped("x", x, (model.n_x,)), _shaped("p", p, (model.n_p,))
        given = {} if r is None else r
        if is_mapping(given):
            of_r = named(given, model.inputs, "input")
            if any(e.expression is None and e.name not in of_r for e in model.layout.inputs):
                raise ModelError(model.missing())
            r = _replaced(_inputs(model)(t, p) if model.n_r else jnp.zeros(0), model.inputs, of_r)
        return _rhs(self.model)(t, x, p, _shaped("r", r, (model.n_r,)))

    def simulation(
        self,
        t_span: Sequence[float],
        t_eval: ArrayLike,
        *,
        guess: Values | None = None,
        inputs: Mapping[Any, InputSource] | None = None,
        outputs: Sequence[Any] = (),
        forward: bool = False,
        method: MethodLike = "DOP853",
        rtol: float | None = None,
        atol: float | None = None,
        constraints: str = "project",
    ) -> Callable[..., dict[str, Any]]:
        """A simulation as a function of parameters, initial values and values of input tables.

        The function ``simulate(parameters={}, initial={}, inputs={})`` takes mappings from names to scalars, and for
        inputs to the values of their tables. What is not named has the model's value; dependent initial values follow.
        It returns a dict of the states and the given outputs over time, each of shape (n_t,), NaN where the simulation
        failed.

        Parameters
        ----------
        t_span, t_eval, inputs, method, rtol, atol, constraints
            As for `CompiledModel.simulate`. An input to be differentiated is a table ``(times, values)`` here, whose
            values the function may replace.
        guess : array_like or mapping, optional
            Starting values of the dependent coordinates, which decide the assembly mode, as for
            `CompiledModel.initial_state`.
        outputs : sequence of names, optional
        forward : bool, optional
            Whether derivatives are found in forward mode: faster for few unknowns and many results, as for a Jacobian.
            Otherwise they are found by the discrete adjoint, which is faster for gradients; `jax.jvp` is then refused
            by JAX.

        Returns
        -------
        callable

        Raises
        ------
        ModelError
            If an argument has a wrong name or shape.

        Examples
        --------
        >>> import jax
        >>> import fourbar_codegen as fb
        >>> jax.config.update("jax_enable_x64", True)
        >>> simulate = fb.to_jax(fb.load("four_bar")).simulation((0.0, 1.0), [0.5, 1.0], forward=True)
        >>> jax.jacobian(lambda l2: simulate({"l2": l2})["q2"])(0.6).shape
        (2,)
        """
        kernel = self.model.kernel
        options = RunOptions.of(
            kernel,
            t_span,
            t_eval=t_eval,
            method=method,
            rtol=rtol,
            atol=atol,
            tolerances=(1e-8, 1e-10),
            constraints=constraints,
            sensitivities=self.model.states[:1] if flag(forward, "forward") else (),
            gradient=not forward,
        )
        # Parameters are arguments of the function.
        given = RunStart.of(kernel, options, None, dict.fromkeys(self.model.parameters, 1.0), inputs)
        how: dict[str, Any] = {
            "method": options.method,
            "rtol": options.rtol,
            "atol": options.atol,
            "constraints": constraints,
        }
        how |= {"max_step": options.max_step, "max_steps": options.max_steps, "progress": False}
        return _Simulation.of(self.model, options, given, guess, outputs, how).function(forward=forward)


def _replaced(values: Any, names: Sequence[str], given: Mapping[str, Any]) -> Any:
    """An array with the values of some names replaced."""
    import jax.numpy as jnp

    if not given:
        return values
    return jnp.stack([_shaped(name, given.get(name, value), ()) for name, value in zip(names, values, strict=True)])


def _shaped(name: str, value: Any, shape: tuple[int, ...]) -> Any:
    import jax.numpy as jnp

    try:
        # JAX would leave an imaginary part out without a word.
        array = jnp.asarray(value, complex if jnp.iscomplexobj(value) else float)
    except (TypeError, ValueError, OverflowError) as error:
        raise ModelError(f"{name} must be an array of the shape {shape}, not {shown(value)}.") from error
    if jnp.iscomplexobj(array):
        raise ModelError(f"{name} must be real numbers, not {shown(value)}.")
    if array.shape != shape:
        raise ModelError(f"{name} must have the shape {shape}, not {array.shape}; for several, use jax.vmap.")
    return array


def _inputs(model: Kernel) -> Callable[..., Any]:
    """The values of inputs' expressions at a time and parameters."""

    def evaluate(t: Any, p: Any) -> Floats:
        return model.default_inputs(float(t), np.asarray(p))

    def wrt_time(t: Any, p: Any) -> Floats:
        return _difference(lambda time: evaluate(time, p), float(t))

    def differentiate(t: Any, p: Any) -> tuple[Floats, ...]:
        return (model.default_input_partials(float(t), np.asarray(p)),)

    return _function(evaluate, wrt_time, differentiate, model.n_r, (model.n_p,), "sequential")


def _function(
    evaluate: Callable[..., Floats],
    wrt_time: Callable[..., Floats],
    differentiate: Callable[..., tuple[Floats, ...]],
    n: int,
    widths: Sequence[int],
    vmap_method: str,
) -> Callable[..., Any]:
    """A function of time and vectors of these widths, of n values, with its derivatives."""
    import jax
    from jax.custom_derivatives import SymbolicZero

    shape = jax.ShapeDtypeStruct((n,), float)
    shapes = tuple(jax.ShapeDtypeStruct((n, width), float) for width in widths)

    def call(*arguments: Any) -> Any:
        return jax.pure_callback(evaluate, shape, *arguments, vmap_method=vmap_method)

    function = jax.custom_jvp(call)

    def jvp(primals: Any, tangents: Any) -> Any:
        rate, (of_time, *others) = jax.numpy.zeros(n), tangents
        if not isinstance(of_time, SymbolicZero):
            rate += of_time * _called(wrt_time, shape, vmap_method)(*primals)
        if not all(isinstance(change, SymbolicZero) for change in others):
            for matrix, change in zip(_called(differentiate, shapes, vmap_method)(*primals), others, strict=True):
                rate += 0.0 if isinstance(change, SymbolicZero) else matrix @ change
        return function(*primals), rate

    function.defjvp(jvp, symbolic_zeros=True)
    return function  # type: ignore[no-any-return]


def _called(function: Callable[..., Any], shapes: Any, vmap_method: str) -> Callable[..., Any]:
    """Derivatives by a callback: they have no derivatives themselves."""
    import jax

    def call(*arguments: Any) -> Any:
        return jax.pure_callback(function, shapes, *arguments, vmap_method=vmap_method)

    def refuse(*_: Any) -> Any:
        raise ModelError("A compiled model has no second derivatives: use a method that needs first derivatives alone.")

    called = jax.custom_jvp(call)
    called.defjvp(refuse)
    return called  # type: ignore[no-any-return]


def _difference(function: Callable[[Any], Floats], t: Any) -> Floats:
    """The derivative with respect to time, of order 2: other derivatives are exact."""
    h = TIME_STEP * np.maximum(1.0, np.abs(t))
    rate: Floats = (function(t + h) - function(t - h)) / (2.0 * h)
    return rate


def _rhs(model: CompiledModel) -> Callable[..., Any]:
    n_x, n_p, n_r = model.n_x, model.n_p, model.n_r

    def columns(t: Any, x: Any, p: Any, r: Any) -> tuple[Any, ...]:
        """States in columns, of any leading axes that `vmap` has added."""
        shape = np.shape(x)[:-1]
        flat = [np.ascontiguousarray(np.reshape(a, (-1, n)).T) for a, n in ((x, n_x), (p, n_p), (r, n_r))]
        return shape, np.ravel(np.broadcast_to(t, shape)), *flat

    def evaluate(t: Any, x: Any, p: Any, r: Any) -> Floats:
        shape, times, *flat = columns(t, x, p, r)
        return np.ascontiguousarray(model.rhs_batch(times, *flat).T).reshape(*shape, n_x)

    def differentiate(t: Any, x: Any, p: Any, r: Any) -> tuple[Floats, ...]:
        shape, times, *flat = columns(t, x, p, r)
        functions = (model.jacobian_batch, model.parameter_jacobian_batch, model.input_jacobian_batch)
        found = [np.moveaxis(function(times, *flat), -1, 0) for function in functions]
        return tuple(np.ascontiguousarray(each).reshape(*shape, *each.shape[1:]) for each in found)

    def wrt_time(t: Any, x: Any, p: Any, r: Any) -> Floats:
        shape, times, *flat = columns(t, x, p, r)
        rates = _difference(lambda time: model.rhs_batch(time, *flat), times)
        return np.ascontiguousarray(rates.T).reshape(*shape, n_x)

    return _function(evaluate, wrt_time, differentiate, n_x, (n_x, n_p, n_r), "broadcast_all")


@dataclass(frozen=True)
class _Simulation:
    """Simulations with the same times, as functions of three vectors: parameters, initial values, input values."""

    model: CompiledModel
    t_span: tuple[float, float]
    t_eval: Floats
    guess: Floats | None
    sources: dict[str, Any]
    tables: tuple[str, ...]
    initial: tuple[str, ...]
    outputs: tuple[str, ...]
    how: dict[str, Any]

    @classmethod
    def of(
        cls,
        model: CompiledModel,
        options: RunOptions,
        given: RunStart,
        guess: Values | None,
        outputs: Sequence[Any],
        how: dict[str, Any],
    ) -> _Simulation:
        own = model.layout.own_inputs
        sources = named(given.inputs or {}, own, "input")
        wanted = map(name_of, listed(outputs, "outputs is a sequence of names"))
        names = tuple(named(dict.fromkeys(wanted), model.outputs, "output"))
        tables = tuple(name for name, source in sources.items() if isinstance(source, tuple))
        q, u, z = independent_states(model.kernel)
        start = None if guess is None else dependent_guess(model.kernel, guess)
        times = numbers(options.t_eval, "t_eval")
        return cls(model, options.t_span, times, start, sources, tables, (*q, *u, *z), names, how)

    def function(self, *, forward: bool) -> Callable[..., dict[str, Any]]:
        import jax
        import jax.numpy as jnp

        model, names = self.model, (*self.model.states, *self.outputs)
        shape = jax.ShapeDtypeStruct((len(names), len(self.t_eval)), float)
        # Forwards, derivatives are taken with respect to what a call gives alone: others may have no derivative, and
        # NaN times 0 is NaN.
        solve = functools.cache(functools.partial(_forward if forward else _reverse, self, shape))
        start = {**dict.fromkeys(self.initial, 0.0), **model.layout.initial}

        def simulate(parameters: Arrays = {}, initial: Arrays = {}, inputs: Arrays = {}) -> dict[str, Any]:  # noqa: B006
            p, x, r = (
                _vector(given, known, kind)
                for given, known, kind in (
                    (parameters, model.defaults, "parameter"),
                    (initial, {name: start[name] for name in self.initial}, "initial value"),
                    (inputs, {name: self.sources[name][1] for name in self.tables}, "input with a table"),
                )
            )
            given = [name_of(key) for part in (parameters, initial, inputs) for key in part] if forward else []
            found = solve(tuple(given))(p, x, r)
            return dict(zip(names, jnp.unstack(found), strict=True))

        return simulate

    def run(self, p: Any, x: Any, r: Any, **more: Any) -> Trajectory | None:
        """The run from a consistent initial state, or None where it fails."""
        model, p = self.model, np.asarray(p)
        if not all(np.isfinite(part).all() for part in (p, x, r)):
            return None
        values = dict(zip(self.initial, np.asarray(x).tolist(), strict=True))
        given = [{name: values[name] for name in part} or None for part in independent_states(model.kernel)]
        sources, begin = dict(self.sources), 0
        for name in self.tables:
            times, old, *kind = sources[name]
            sources[name] = (times, np.asarray(r)[begin : begin + len(old)], *kind)
            begin += len(old)
        try:
            x0, dx0 = model.initial_state_derivatives(
                given[0],
                given[1],
                auxiliary_states=given[2],
                t=self.t_span[0],
                guess=self.guess,
                parameters=p,
                inputs=sources,
            )
            if "sensitivities" in more:  # without parameters that redundant constraints lock
                more["sensitivities"] = [name for name in more["sensitivities"] if name in dx0]
                dx0 = {name: dx0[name] for name in more["sensitivities"]}
            if more:
                more["dx0"] = dx0
            run = model.simulate(self.t_span, x0, parameters=p, inputs=sources, t_eval=self.t_eval, **self.how, **more)
        except (AssemblyError, SimulationError):
            return None
        return run if run.success else None

    def results(self, p: Any, x: Any, r: Any) -> Floats:
        """The states and outputs over time, in rows; NaN where the run fails."""
        run = self.run(p, x, r)
        if run is None:
            return np.full((self.model.n_x + len(self.outputs), len(self.t_eval)), np.nan)
        return np.vstack((run.y, *(run[name] for name in self.outputs)))


def _vector(given: Arrays, known: Mapping[str, Any], kind: str) -> Any:
    """The values of all known names as one vector."""
    import jax.numpy as jnp

    if not is_mapping(given):
        raise ModelError(f"Values of each {kind} are given as a mapping from names, not {type(given).__name__}.")
    parts = {**known, **named(given, [*known], kind)}
    for name, value in parts.items():
        if value is None:
            raise ModelError(f"The {kind} {name} has no value in the model: give one.")
        shape = () if known[name] is None else np.shape(known[name])
        parts[name] = jnp.ravel(_shaped(f"The {kind} {name}", value, shape))
    return jnp.concatenate([*parts.values()] or [jnp.zeros(0)])


def _reverse(simulation: _Simulation, shape: Any, _: tuple[str, ...]) -> Callable[..., Any]:
    import jax

    model, names = simulation.model, (*simulation.model.states, *simulation.outputs)

    def gradient(p: Any, x: Any, r: Any, weights: Any) -> tuple[Floats, ...]:
        run = simulation.run(p, x, r, gradient=True)
        if run is None:
            return tuple(np.full(np.shape(part), np.nan) for part in (p, x, r))
        by_name = run.gradient(dict(zip(names, np.asarray(weights), strict=True)))
        return (
            np.array([by_name.get(name, np.nan) for name in model.parameters]),
            np.array([by_name[name] for name in simulation.initial]),
            np.concatenate([np.zeros(0), *(by_name[name] for name in simulation.tables)]),
        )

    def call(p: Any, x: Any, r: Any) -> Any:
        return jax.pure_callback(simulation.results, shape, p, x, r, vmap_method="sequential")

    solve = jax.custom_vjp(call)

    def forward(p: Any, x: Any, r: Any) -> Any:
        return solve(p, x, r), (p, x, r)

    def backward(given: Any, weights: Any) -> Any:
        shapes = tuple(jax.ShapeDtypeStruct(part.shape, float) for part in given)
        return _called(gradient, shapes, "sequential")(*given, weights)

    solve.defvjp(forward, backward)
    return solve  # type: ignore[no-any-return]


def _forward(simulation: _Simulation, shape: Any, given: tuple[str, ...]) -> Callable[..., Any]:
    import jax
    import jax.numpy as jnp

    model = simulation.model
    unknowns = (*model.parameters, *simulation.initial)
    places: dict[str, int | slice] = {name: i for i, name in enumerate(unknowns)}
    n = len(unknowns)
    for name in simulation.tables:
        begin, n = n, n + len(simulation.sources[name][1])
        places[name] = slice(begin, n)
    # Parameters that move the times of jumps have no sensitivity: NaN.
    left_out = moving_breakpoints(model.kernel, None, model.parameters)
    wanted = [name for name in given if name not in left_out]
    rows = [model.outputs.index(name) for name in simulation.outputs]

    def matrix(p: Any, x: Any, r: Any) -> Floats:
        found = np.zeros((*shape.shape, n))
        for name in given:
            found[..., places[name]] = np.nan
        run = simulation.run(p, x, r, sensitivities=wanted)
        if run is not None and run.sensitivity is not None:
            for name in run.sensitivity:
                place, parts = places[name], [run.sensitivity[name]]
                if rows:
                    parts.append(run.output_sensitivity[name][..., rows, :])
                both = np.concatenate(parts, axis=-2)
                found[..., place] = np.moveaxis(both, 0, -1) if isinstance(place, slice) else both
        return found

    def call(p: Any, x: Any, r: Any) -> Any:
        return jax.pure_callback(simulation.results, shape, p, x, r, vmap_method="sequential")

    solve = jax.custom_jvp(call)

    def jvp(primals: Any, tangents: Any) -> Any:
        of_all = jax.ShapeDtypeStruct((*shape.shape, n), float)
        wrt_all = _called(matrix, of_all, "sequential")(*primals)
        return solve(*primals), wrt_all @ jnp.concatenate(tangents)

    solve.defjvp(jvp)
    return solve  # type: ignore[no-any-return]
