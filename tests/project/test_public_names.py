"""The names that users call: those of the reference and of CHANGELOG stay, and others are not reachable by accident."""

import dataclasses
import inspect
import pickle
import re
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module

import numpy as np
import pytest

import fourbar_codegen as fb
from fourbar_codegen.building.stored_model import StoredModel
from fourbar_codegen.compiled_model import EVALUATED, facade_of
from fourbar_codegen.interface.registered import Registered, RegisteredAttribute
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.modeling.mechanism import Mechanism

NAMES = {
    "CompiledModel": """
    auxiliary_states constraint_jacobian constraint_violation coordinates defaults descriptions energy_without ensemble
    equilibrium
    forced_points forcing initial_state initial_state_derivatives initial_states input_jacobian
    input_jacobian_batch inputs instructions inverse_dynamics is_portable is_verified jacobian jacobian_batch
    jvp kernel kinematics kinetic_energy lacks_batch_functions lacks_derivatives lacks_drawing lacks_products
    layout linearize manifest mass_matrix momentum multipliers n_c n_h n_l n_o n_p n_q n_r n_u n_x n_z name ode output
    output_input_jacobian output_jacobian output_parameter_jacobian outputs page parameter_jacobian
    parameter_jacobian_batch parameters path points position_constraints positions potential_energy prescribed
    require_batch_functions require_derivatives require_drawing require_products residual_batch residual_jacobian_batch
    residual_sparsity rhs rhs_batch runner shapes simulate speeds stability state_space states stepper trajectory
    tree_forcing
    tree_mass_matrix units velocity_constraints vjp
    """,
    "Trajectory": """
    accelerations animate columns constraint_residual directions energy energy_without event_sensitivity forces
    gradient inputs kernel kinetic_energy message model multipliers nfev njev nlu output_sensitivity outputs
    parameters plot plot_frames plot_paths points potential_energy q r report resample residual_label save sensitivity
    settings sol status steps success t t_events to_dataframe to_xarray u vectors velocities velocity_residual y
    y_events z
    """,
    "Ensemble": """
    by_member events inputs kernel messages model n_events nfev parameters plot save settings status success t
    t_events to_xarray varied y y_events
    """,
    "Branch": """
    accelerations columns drive kernel limits model p plot_paths points positions q qd qdd r save t
    transmission_angle u ud velocities without_value
    """,
    "Kinematics": """
    branches closes dead_points drive is_complete kernel model plot plot_paths
    """,
    "AssemblyModes": """
    free freedom inputs is_complete kernel model parameters plot t x
    """,
}
"""A name leaves this list when CHANGELOG has said for a version that it will."""


RESULTS = (fb.Trajectory, fb.Ensemble, fb.Branch, fb.Kinematics, fb.AssemblyModes)


@pytest.mark.parametrize("name", NAMES)
def test_names_of_models_and_results_are_those_of_the_list(four_bar, name):
    kind = getattr(fb, name)
    found = {*dir(four_bar)} if kind is fb.CompiledModel else {*dir(kind), *(f.name for f in dataclasses.fields(kind))}
    inherited = {*dir(tuple)} if issubclass(kind, tuple) else {"count", "index"} if hasattr(kind, "index") else set()
    assert {n for n in found - inherited if not n.startswith("_")} == {*NAMES[name].split()}


def test_methods_of_the_kernel_are_reached_through_the_kernel_alone(four_bar):
    for name in ("along", "evaluate", "too_few_dependent", "has_motions", "state_rates_for", "invariant_correction"):
        assert not hasattr(four_bar, name)
    assert four_bar.kernel.layout is four_bar.layout


def methods_of(kind):
    return [name for name in NAMES[kind].split() if callable(getattr(getattr(fb, kind), name, None))]


def test_types_and_modules_of_the_models_methods_are_listed_for_the_same_names():
    """The list for type checkers, which runs never, and the list of where functions are."""
    source = inspect.getsource(fb.CompiledModel)
    typed = re.findall(r"^        (\w+) = _of_kernel\(_(\w+)\)", source, flags=re.MULTILINE)
    found = re.findall(r"^        (\w+) = _Later\(", source, flags=re.MULTILINE)
    assert [name for name, _ in typed] == [function for _, function in typed] == found
    of_kernel = re.findall(r"^    (\w+) = _of_kernel\(Kernel\.(\w+)\)", source, flags=re.MULTILINE)
    assert [name for name, _ in of_kernel] == [function for _, function in of_kernel] == [*EVALUATED]


def test_public_names_of_the_package_have_a_module_and_a_type():
    typed = inspect.getsource(fb).partition("if TYPE_CHECKING:")[2].partition("__all__")[0]
    for name in fb._HOME:
        assert re.search(rf"\b{name}\b", typed), name
    assert {*fb.__all__} >= {*fb._HOME}


@pytest.mark.parametrize("method", sorted(fb._METHODS))
def test_registered_methods_are_declared_and_their_functions_exist(method):
    name, _, attribute = method.partition(".")
    [kind] = {
        kind
        for kind in (fb.CompiledModel, *RESULTS, fb.Runner, fb.Model, fb.Linearization, Kernel, Mechanism, StoredModel)
        if kind.__name__ == name
    }
    assert isinstance(inspect.getattr_static(kind, attribute), Registered | RegisteredAttribute)
    module, _, function = fb._METHODS[method].partition(":")
    assert callable(getattr(import_module(f"fourbar_codegen.{module}"), function))


def test_method_that_nobody_has_registered_is_no_attribute():
    class Result:
        draw = Registered[[], None]()

    assert not hasattr(Result(), "draw")


def test_help_of_a_method_is_that_of_its_function(four_bar):
    for name in methods_of("CompiledModel"):
        method = getattr(four_bar, name)
        assert method.__doc__ == getattr(fb.CompiledModel, name).__doc__
        assert method.__doc__
        assert "model" not in str(inspect.signature(method)).partition(",")[0]


def test_methods_called_by_the_class_take_a_model(four_bar):
    x = four_bar.initial_state()
    np.testing.assert_array_equal(fb.CompiledModel.rhs(four_bar, 0.0, x), four_bar.rhs(0.0, x))
    np.testing.assert_array_equal(fb.CompiledModel.initial_state(four_bar), x)
    assert fb.CompiledModel.simulate(four_bar, (0.0, 0.1)).success
    for name in methods_of("CompiledModel"):
        with pytest.raises((TypeError, AttributeError, fb.ModelError)):
            getattr(fb.CompiledModel, name)(None, None)


def test_subclass_of_a_model_calls_its_own_methods_each_time(four_bar):
    called = []

    class Counting(fb.CompiledModel):
        def rhs(self, *arguments):
            called.append("rhs")
            return super().rhs(*arguments)

        def simulate(self, *arguments, **options):
            called.append("simulate")
            return super().simulate(*arguments, **options)

    model = Counting(four_bar.kernel)
    for _ in range(3):
        assert np.isfinite(model.rhs(0.0, model.initial_state())).all()
        assert model.simulate((0.0, 0.1)).success
    assert called == ["rhs", "simulate"] * 3


def test_method_that_is_replaced_in_the_class_is_the_one_that_is_called(four_bar, monkeypatch):
    assert four_bar.simulate((0.0, 0.1)).success
    monkeypatch.setattr(fb.CompiledModel, "simulate", lambda self, span: span)
    assert four_bar.simulate((0.0, 0.1)) == (0.0, 0.1)


def test_model_of_a_kernel_is_one_for_all_threads():
    for _ in range(20):
        kernel = fb.load("four_bar").kernel
        with ThreadPoolExecutor(8) as pool:
            found = [*pool.map(facade_of, [kernel] * 8)]
        assert all(model is found[0] for model in found)


def test_result_knows_its_model_also_after_pickling(four_bar):
    run = four_bar.simulate((0.0, 0.1), t_eval=[0.0, 0.1])
    assert run.model is four_bar
    assert four_bar.ensemble((0.0, 0.1)).model is four_bar
    again = pickle.loads(pickle.dumps(run))
    assert again.model.states == four_bar.states
    np.testing.assert_array_equal(again["energy"], run["energy"])


@pytest.mark.parametrize("make", ["simulate", "ensemble", "kinematics", "initial_states"])
def test_results_are_frozen_and_pickled_whole(four_bar, make):
    arguments = {"kinematics": ({"q1": [-0.5, -0.4]},), "initial_states": ({"q1": -0.5},)}
    result = getattr(four_bar, make)(*arguments.get(make, ((0.0, 0.1),)))
    with pytest.raises(dataclasses.FrozenInstanceError):
        result.kernel = None
    again = pickle.loads(pickle.dumps(result))
    assert repr(again) == repr(result)
