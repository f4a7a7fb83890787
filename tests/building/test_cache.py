"""The cache: keys that digest everything, warm calls that form nothing, builds that are whole or absent."""

import codecs
import contextlib
import ctypes
import errno
import json
import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import sympy as sm
from builders.friction import MU, model_of, rod
from builders.systems import slider
from harness import PROJECT

import fourbar_codegen as fb
from fourbar_codegen.building import cache, cached_models, kernel_library, stored_model, toolchain
from fourbar_codegen.expressions import fingerprint
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.pipeline import compile as pipeline


@pytest.fixture(scope="module", autouse=True)
def unoptimized():
    """What is compiled here need not be fast."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CFLAGS", "-O0")
        yield


CHANGES = [
    "orientation", "angular velocity", "position", "velocity", "mass", "inertia", "body", "load", "point of a load",
    "actuator", "partition of the coordinates", "partition of the speeds", "kinematic equation", "holonomic constraint",
    "velocity constraint", "default", "unit", "order of the parameters", "name", "input", "initial value",
    "potential energy", "output", "parameter as an expression",
]  # fmt: skip


@pytest.mark.slow(but=["actuator", "angular velocity", "body", "default"])
@pytest.mark.parametrize("change", CHANGES)
def test_cache_key_changes_with_every_part_of_the_model(change):
    assert pipeline.key_of(slider()) == pipeline.key_of(slider())
    assert pipeline.key_of(slider(change)) != pipeline.key_of(slider())


@pytest.mark.parametrize(
    "change",
    ["package", "abi", "sympy", "compiler", "compiler file", "flags", "CFLAGS", "processor"],
)
def test_cache_key_changes_with_every_part_of_the_toolchain(change, monkeypatch, tmp_path):
    model = slider()
    key = pipeline.key_of(model)
    forget_digests()
    if change in {"package", "abi"}:
        # The kernel's interface is one of the package's headers: any change to a source file counts.
        for path in toolchain.PACKAGE.rglob("*"):
            if path.suffix in {".py", ".h"}:
                (tmp_path / path.relative_to(toolchain.PACKAGE)).parent.mkdir(exist_ok=True)
                text = path.read_text()
                if path.name == ("fourbar_kernel.h" if change == "abi" else "lower.py"):
                    text += "\n"
                (tmp_path / path.relative_to(toolchain.PACKAGE)).write_text(text)
        monkeypatch.setattr(toolchain, "PACKAGE", tmp_path)
    elif change == "sympy":
        monkeypatch.setattr(sm, "__version__", "0")
    elif change == "compiler":
        monkeypatch.setenv("CC", "clang")
    elif change == "compiler file":
        compiler = tmp_path / "mycc"
        compiler.write_text("#!/bin/sh\n")
        compiler.chmod(0o755)
        monkeypatch.setenv("CC", str(compiler))
        key = pipeline.key_of(model)
        compiler.write_text("#!/bin/sh\n# another version\n")
    elif change == "flags":
        monkeypatch.setattr(toolchain, "KERNEL_FLAGS", ("-O2",))
    elif change == "CFLAGS":
        monkeypatch.setenv("CFLAGS", "-ffast-math")
    elif change == "processor":
        monkeypatch.setattr(toolchain, "_processor", lambda: "another")
    changed = pipeline.key_of(model)
    forget_digests()
    assert changed != key


def forget_digests():
    toolchain._package_digest.cache_clear()
    toolchain._headers_digest.cache_clear()


@pytest.mark.slow
def test_cache_key_is_the_same_in_processes_with_other_hash_seeds():
    code = (
        "import fourbar_codegen as fb\nfrom fourbar_codegen.pipeline.compile import key_of\n"
        "print(key_of(fb.models.four_bar()))"
    )
    import os

    keys = {
        subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "PYTHONHASHSEED": seed},
        ).stdout
        for seed in ("1", "2")
    }
    assert keys == {pipeline.key_of(fb.models.four_bar()) + "\n"}


def test_fingerprints_of_different_structures_differ_and_objects_are_refused():
    x = sm.Symbol("x")
    different = [
        (1, 2),
        (1, (2,)),
        ((1,), 2),
        ("1", 2),
        (1.0, 2),
        (x, 2),
        ("x", 2),
        (sm.Function("x")(x), 2),
        {1: 2},
        None,
    ]
    assert len({fingerprint.fingerprint(data) for data in different}) == len(different)
    with pytest.raises(TypeError, match="object"):
        fingerprint.fingerprint(object())


def test_fingerprints_of_dummies_depend_on_their_first_appearance():
    def digest(*symbols):
        a, b, c = symbols
        return fingerprint.fingerprint((sm.sin(a) ** b, a / c))

    x, y = sm.Symbol("x"), sm.Symbol("y")
    d, e, f = (sm.Dummy(name) for name in "xyx")
    assert digest(d, e, e) == digest(sm.Dummy("x"), *2 * [sm.Dummy("y")])
    different = [digest(*s) for s in ((d, e, e), (d, e, d), (d, e, f), (x, y, y), (sm.Dummy("x", positive=True), e, e))]
    assert len(set(different)) == len(different)


@pytest.mark.slow
def test_fingerprints_of_expressions_deeper_than_pythons_stack_differ():
    expr = sm.Symbol("x")
    for _ in range(5 * sys.getrecursionlimit()):
        expr = sm.sin(expr, evaluate=False)
    assert fingerprint.fingerprint(expr) != fingerprint.fingerprint(expr.args[0])


@pytest.mark.slow
@pytest.mark.parametrize("make", [slider, fb.models.whipple_bicycle, lambda: fb.models.chain(8, closed=True)])
def test_parts_of_a_model_are_formed_at_their_first_use_with_a_modules_text(monkeypatch, tmp_path, make):
    """From the folder in the cache, to the text that a module has."""
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    model = fb.compile_model(make())
    assert model.rhs(0.0, np.full(model.n_x, 0.1)).shape == (model.n_x,)
    assert entries(tmp_path) == [model.name, f"{model.name}_kernel"]
    sent = pickle.loads(pickle.dumps(fb.load(model.path)))
    sent.require_products()
    expected = fb.generate_sources(make())
    for part in ("derivatives", "products"):
        [found] = [path.read_text() for path in tmp_path.glob(f"*/{model.name}_{part}.c")]
        assert found == expected[f"{model.name}_{part}.c"]


def test_compile_model_of_a_cached_model_forms_no_equations(monkeypatch):
    cold = fb.compile_model(slider())

    def forbidden(*_):
        raise AssertionError("a warm call must not come here")

    monkeypatch.setattr(pipeline, "generate_kernel", forbidden)
    warm = fb.compile_model(slider())
    x = [0.5, 0.1, 0.2, 0.3]
    assert warm.rhs(0.0, x).tolist() == cold.rhs(0.0, x).tolist()


@pytest.mark.slow
def test_failed_build_leaves_nothing_and_the_next_one_succeeds(monkeypatch, tmp_path):
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    monkeypatch.setenv("CC", "false")
    with pytest.raises(fb.BuildError, match="exit code: 1"):
        fb.compile_model(slider())
    assert [path for path in tmp_path.iterdir() if path.is_dir()] == []
    monkeypatch.delenv("CC")
    assert fb.compile_model(slider()).n_x == 4


def test_cache_that_is_removed_during_a_build_is_told_from_one_that_cannot_be_used(monkeypatch, tmp_path):
    def build(folder):
        shutil.rmtree(tmp_path / "cache")
        return folder / "module.so"

    for folder, words in ((tmp_path / "cache", "was removed by another process"), ("/proc/cache", "cannot be used")):
        monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(folder))
        with pytest.raises(fb.CacheError, match=words):
            cache.cached("removed", "0" * 64, build)


@pytest.mark.slow
def test_concurrent_compilations_of_one_model_build_it_once(monkeypatch, tmp_path):
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    calls = compilations(monkeypatch)
    models = [slider() for _ in range(3)]
    results = []
    threads = [threading.Thread(target=lambda m=m: results.append(fb.compile_model(m))) for m in models]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 3
    assert calls == ["slider_kernel.so"]


def compilations(monkeypatch):
    """The libraries that are compiled from now on."""
    calls = []
    real = toolchain.compile_library
    monkeypatch.setattr(
        kernel_library, "compile_library", lambda path, *more: calls.append(path.name) or real(path, *more)
    )
    return calls


@pytest.mark.slow
def test_change_of_a_default_unit_or_initial_value_compiles_nothing(monkeypatch, tmp_path):
    """Defaults, units and initial values are no part of a library."""
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    calls = compilations(monkeypatch)
    first = fb.compile_model(slider())
    assert calls == ["slider_kernel.so"]
    for change in ("default", "unit", "initial value"):
        other = fb.compile_model(slider(change))
        assert other.manifest != first.manifest
        assert fb.load(other.path).manifest == other.manifest
        assert uncounted(other.manifest) == uncounted(json.loads(sources_of(change)["manifest.json"]))
    assert fb.compile_model(slider(), check=False).manifest == first.manifest
    assert calls == ["slider_kernel.so"]
    assert fb.compile_model(slider("mass")).manifest != first.manifest
    assert calls == ["slider_kernel.so"] * 2


def uncounted(manifest):
    """Without the operations, which are counted of all functions in the manifest of a module, and what was compared."""
    return {key: value for key, value in manifest.items() if key != "compared" and not key.startswith("operations")}


def sources_of(change):
    return fb.generate_sources(slider(change))


@pytest.mark.slow
def test_change_of_the_package_with_equal_sources_compiles_nothing(monkeypatch, tmp_path):
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    first = fb.compile_model(slider())
    first.require_derivatives()
    calls = compilations(monkeypatch)
    monkeypatch.setattr(toolchain, "_package_digest", lambda: "of another version")
    second = fb.compile_model(slider())
    assert second.path != first.path
    assert second.jacobian(0.0, np.full(4, 0.3)).tolist() == first.jacobian(0.0, np.full(4, 0.3)).tolist()
    assert calls == []
    monkeypatch.setattr(toolchain, "_headers_digest", lambda: "of another version")
    fb.compile_model(slider()).require_derivatives()
    assert calls == ["slider_kernel.so", "slider_derivatives.so"]


@pytest.mark.slow
def test_folder_in_the_cache_after_a_build_holds_known_files_only(monkeypatch, tmp_path):
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    model = fb.compile_model(slider())
    names = sorted(path.name for path in model.path.parent.iterdir())
    assert names == ["checksum", "slider_batch.c", "slider_kernel.c", "slider_kernel.h", "slider_kernel.so",
                     "slider_later.pickle", "slider_numbers.json"]  # fmt: skip


def test_library_without_its_file_of_numbers_is_refused(tmp_path):
    path = fb.compile_model(slider()).path
    alone = shutil.copy(path, tmp_path)
    numbers = tmp_path / "slider_numbers.json"
    for text in (None, "", "{}", '{"parameters": []}'):
        if text is not None:
            numbers.write_text(text)
        with pytest.raises(fb.ModelError, match=r"slider_numbers\.json beside it"):
            fb.load(alone)
    shutil.copy(path.with_name(numbers.name), numbers)
    assert fb.load(alone).defaults == fb.load(path).defaults


@pytest.mark.slow
def test_derivatives_are_compiled_at_their_first_use_and_not_by_explicit_runs(monkeypatch, tmp_path):
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    model = fb.compile_model(slider())
    start = model.initial_state({"q1": 0.48}, {"u1": 0.0})
    for how in ({}, {"method": "RK45"}, {"constraints": "baumgarte"}, {"constraints": "none", "dense_output": True}):
        assert model.simulate((0.0, 0.1), start, **how).success
    assert len(model.simulate((0.0, 0.1), start).multipliers) == model.n_c
    assert model.lacks_derivatives
    whole = fb.load(fb.build_model(slider(), tmp_path / "whole"))
    x = np.array([0.5, 0.1, 0.2, 0.3])
    asked = {
        "jacobian": lambda m: m.jacobian(0.0, x),
        "parameter_jacobian": lambda m: m.parameter_jacobian(0.0, x),
        "input_jacobian": lambda m: m.input_jacobian(0.0, x),
        "linearize": lambda m: m.linearize(0.0, start)[0],
        "positions": lambda m: np.array(list(m.positions(0.0, x[:2]).values())),
        "points": lambda m: np.array(list(m.simulate((0.0, 0.1), start).points.values())),
        "Radau": lambda m: m.simulate((0.0, 0.1), start, method="Radau").y,
        "ALI3P": lambda m: m.simulate((0.0, 0.1), start, method="ALI3P", max_step=0.01).y,
        "IDA": lambda m: m.simulate((0.0, 0.1), start, method="IDA").y,
        "CVODE": lambda m: m.simulate((0.0, 0.1), start, method="CVODE").y,
        "ode": lambda m: m.ode().jac(0.0, x),
    }
    for name, ask in asked.items():
        model = fb.compile_model(slider())
        assert model.lacks_derivatives, name
        # With other instructions: rounding, and what the solvers' tolerance of 1e-6 makes of it.
        np.testing.assert_allclose(ask(model), ask(whole), rtol=1e-6, atol=1e-9, err_msg=name)
        # Positions are in a part of their own.
        assert model.lacks_derivatives == (name in ("positions", "points")), name


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "pattern", "replacement", "message"),
    [
        ("derivatives", r"(residual_jacobian\[1\] = )", r"\g<1>0.1 + ", "derivative dx'/dx"),
        ("derivatives", r"(parameter_jacobian\[1\] = )", r"\g<1>0.1 + ", "derivative"),
        ("derivatives", r"(velocity_jacobian\[0\] = )", r"\g<1>0.1 + ", r"derivative d\(J u \+ b\)/dq"),
        ("products", r"(residual_tangent\[1\] = )", r"\g<1>0.1 + ", "along a direction"),
        ("products", r"(gradient\[2\] = )", r"\g<1>0.1 + ", "product gradient of"),
        ("products", r"(velocity_tangent\[0\] = )", r"\g<1>0.1 + ", "product constraint violations"),
        ("batch", r"(forcing\[1\] = )", r"\g<1>1.1*", "for batches of states"),
    ],
)
def test_defect_of_a_part_compiled_later_is_found_and_not_kept(
    monkeypatch, tmp_path, part, pattern, replacement, message
):
    """What is compiled later is compared without SymPy, and not kept where it does not agree."""
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    sources = fb.generate_sources(slider())
    sources["slider_batch.c"] = "#define FB_LANES\n" + sources["slider_kernel.c"]  # as it includes it
    original = sources[f"slider_{part}.c"]
    damaged, count = re.subn(pattern, replacement, original, count=1)
    assert count == 1
    monkeypatch.setattr(f"fourbar_codegen.codegen.c_source.{part}_text", lambda *_: damaged)
    model = fb.compile_model(slider())
    for _ in range(2):
        with pytest.raises(fb.BuildError, match=message):
            getattr(model, f"require_{'batch_functions' if part == 'batch' else part}")()
    made = {
        "derivatives": ["derivatives_source"],
        "products": ["derivatives", "derivatives_source", "products_source"],
    }
    assert entries(tmp_path) == sorted(["slider", "slider_kernel", *(f"slider_{name}" for name in made.get(part, []))])


def entries(folder):
    """Of the cache, without their keys."""
    return sorted(path.name.rpartition("-")[0] for path in folder.iterdir() if path.is_dir())


@pytest.mark.slow
def test_batch_functions_are_compiled_at_the_first_batch_or_ensemble(monkeypatch, tmp_path):
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    first = fb.compile_model(slider())
    start = first.initial_state({"q1": 0.48}, {"u1": 0.0})
    assert first.simulate((0.0, 0.1), start).success
    assert first.ensemble((0.0, 0.1), start, inputs={"F": lambda t, x: 1.0}).success.all()
    assert first.lacks_batch_functions
    assert entries(tmp_path) == ["slider", "slider_kernel"]
    x = np.linspace(0.1, 2.0, 40).reshape(4, 10)
    rates = first.rhs_batch(0.0, x)
    assert not first.lacks_batch_functions
    assert entries(tmp_path) == ["slider", "slider_batch_functions", "slider_kernel"]
    np.testing.assert_allclose(rates, np.transpose([first.rhs(0.0, column) for column in x.T]), rtol=1e-12)
    calls = compilations(monkeypatch)
    second = fb.compile_model(slider())
    np.testing.assert_array_equal(second.rhs_batch(0.0, x), rates)
    assert second.ensemble((0.0, 0.1), start).success.all()
    assert calls == []


@pytest.mark.slow
def test_batch_functions_that_cannot_be_compiled_raise_and_are_tried_again(monkeypatch, tmp_path):
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    model = fb.compile_model(slider())
    x = np.full((4, 3), 0.5)
    monkeypatch.setenv("CC", "false")
    for _ in range(2):
        with pytest.raises(fb.BuildError, match="exit code: 1"):
            model.rhs_batch(0.0, x)
    assert entries(tmp_path) == ["slider", "slider_kernel"]
    assert np.isfinite(model.rhs(0.0, x[:, 0])).all()
    monkeypatch.delenv("CC")
    assert np.isfinite(model.rhs_batch(0.0, x)).all()


@pytest.mark.slow
def test_batch_functions_without_sources_are_refused_unless_the_model_is_loaded(monkeypatch, tmp_path):
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    model = fb.compile_model(slider())
    x = np.full((4, 3), 0.5)
    alone = tmp_path / "alone"
    alone.mkdir()
    for name in ("slider_kernel.so", "slider_numbers.json"):
        shutil.copy(model.path.with_name(name), alone)
    with pytest.raises(fb.ModelError, match="compile the model again"):
        fb.load(alone / "slider_kernel.so").rhs_batch(0.0, x)
    # A model that is loaded has what it needs, and can be compiled again.
    cache.clear()
    rates = model.rhs_batch(0.0, x)
    again = fb.compile_model(slider())
    assert again.path == model.path
    np.testing.assert_array_equal(again.rhs_batch(0.0, x), rates)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(model)).rhs_batch(0.0, x), rates)


@pytest.mark.slow
def test_cache_with_a_limit_of_one_byte_serves_models_and_their_parts(monkeypatch, tmp_path):
    """What was just made stays, and a model does not need what went."""
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE_SIZE", "1")
    model = fb.compile_model(slider())
    x = np.full((4, 3), 0.5)
    assert model.jacobian(0.0, x[:, 0]).shape == (4, 4)
    np.testing.assert_allclose(model.rhs_batch(0.0, x)[:, 0], fb.compile_model(slider()).rhs(0.0, x[:, 0]), rtol=1e-14)


@pytest.mark.slow
def test_library_that_vanishes_during_a_compilation_is_built_again(monkeypatch, tmp_path):
    """Another process may clear the cache between two steps of a compilation."""
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    original, removed = kernel_library.build_part, []

    def build_part(*arguments, **options):
        path = original(*arguments, **options)
        if len(removed) < 2:
            shutil.rmtree(path.parent)
            removed.append(path)
        return path

    monkeypatch.setattr(kernel_library, "build_part", build_part)
    assert np.isfinite(fb.compile_model(slider()).rhs(0.0, [0.5, 0.1, 0.2, 0.3])).all()
    assert len(removed) == 2


@pytest.mark.slow
def test_batch_source_of_another_model_in_the_folder_is_not_used(tmp_path):
    """Unknown forces are not found in lanes; what is left of another model of the same name does not count."""
    batch = tmp_path / "rod_batch.c"
    batch.write_text("of another model")
    model = fb.load(fb.build_model(model_of(rod(lambda normal: MU * normal, "rod")), tmp_path))
    assert not batch.exists()
    batch.write_text("of another model")
    x = np.full((model.n_x, 2), 0.1)
    np.testing.assert_array_equal(model.rhs_batch(0.0, x)[:, 0], model.rhs(0.0, x[:, 0]))


@pytest.mark.slow
def test_batch_functions_of_a_loaded_library_need_no_sympy(tmp_path, monkeypatch):
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    path = fb.compile_model(slider()).path
    code = f"""
import sys
sys.modules["sympy"] = None  # importing it fails
import fourbar_codegen as fb
print(fb.load({str(path)!r}).rhs_batch(0.0, [[0.5], [0.1], [0.2], [0.3]]).shape)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout == "(4, 1)\n", done.stderr


@pytest.mark.slow
def test_module_moved_out_of_its_folder_has_all_functions(monkeypatch, tmp_path):
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path / "cache"))
    module = fb.build_model(slider(), tmp_path / "folder")
    shutil.move(module, tmp_path / module.name)
    model = fb.load(tmp_path / module.name)
    assert not model.lacks_batch_functions
    assert np.isfinite(model.rhs_batch(0.0, np.full((4, 3), 0.5))).all()
    assert not (tmp_path / "cache").exists()


def test_pickled_model_on_another_processor_is_built_anew(monkeypatch, tmp_path):
    """They see the same folders, and must not execute what was built for the other."""
    model = fb.compile_model(slider())
    sent, x = pickle.dumps(model), [0.5, 0.1, 0.2, 0.3]
    assert not model.is_portable
    assert pickle.loads(sent).path == model.path
    monkeypatch.setattr(toolchain, "_processor", lambda: "another")
    other = pickle.loads(sent)
    assert other.path != model.path
    np.testing.assert_array_equal(other.rhs(0.0, x), model.rhs(0.0, x))  # it is the same processor after all
    assert pickle.loads(sent).path == other.path
    shutil.copytree(model.path.parent, tmp_path / "folder")
    copied = fb.load(tmp_path / "folder" / model.path.name)  # wherever it lies
    assert pickle.loads(pickle.dumps(copied)).path == other.path


@pytest.mark.slow
def test_pickled_module_on_another_processor_is_used_unless_replaced(monkeypatch, tmp_path):
    model = fb.load(fb.build_model(slider(), tmp_path))
    sent, x = pickle.dumps(model), [0.5, 0.1, 0.2, 0.3]
    assert model.is_portable
    monkeypatch.setattr(toolchain, "_processor", lambda: "another")
    assert pickle.loads(sent).path == model.path
    other = fb.build_model(slider("default"), tmp_path / "other")
    other.replace(model.path)
    for damage in (lambda: None, lambda: model.path.write_text("none"), model.path.unlink):
        damage()
        again = pickle.loads(sent)
        assert again.path.is_relative_to(cache.cache_folder())
        assert uncounted(again.manifest) == uncounted(model.manifest)
        np.testing.assert_allclose(again.rhs(0.0, x), model.rhs(0.0, x), rtol=1e-12)  # with other instructions


@pytest.mark.slow
def test_pickled_module_without_sources_is_refused_where_it_is_missing(tmp_path):
    model = fb.load(fb.build_model(slider("name"), tmp_path))
    for path in tmp_path.glob("*.[ch]"):
        path.unlink()
    sent = pickle.dumps(model)
    assert pickle.loads(sent).path == model.path
    model.path.unlink()
    with pytest.raises(fb.ModelError, match=r"not found here, .* its sources were not beside it"):
        pickle.loads(sent)


@pytest.mark.slow
def test_module_built_with_other_structs_is_refused_on_loading(monkeypatch, tmp_path):
    """Built with the headers of another version, in which a struct of ensembles has one more member."""
    headers = shutil.copytree(fb.get_include(), tmp_path / "headers")
    text = (headers / "lanes/batch.h").read_text()
    assert "    int64_t n_times;\n" in text
    (headers / "lanes/batch.h").write_text(text.replace("    int64_t n_times;\n", "    int64_t n_times, more;\n"))
    with monkeypatch.context() as patched:
        patched.setattr("fourbar_codegen.building.toolchain.get_include", lambda: str(headers))
        module = fb.build_model(slider(), tmp_path / "built", check=False)  # which would load it
    with pytest.raises(fb.ModelError, match=r"^The compiled model slider was built with another version"):
        fb.load(module)


@pytest.mark.slow
def test_batch_functions_of_another_layout_are_refused_when_attached(monkeypatch):
    model, found = fb.compile_model(slider()), []
    attach = type(model.kernel).attach_batch_functions
    with monkeypatch.context() as patched:
        patched.setattr(Kernel, "attach_batch_functions", lambda _, address: found.append(address))
        model.require_batch_functions()
    # The version, the sizes of eight structs, the width, and two functions.
    words = (ctypes.c_size_t * 12).from_address(found[0])
    for place in range(9):
        changed = (ctypes.c_size_t * 12)(*words)
        changed[place] += 8
        with pytest.raises(fb.ModelError, match="another version of this package"):
            attach(model.kernel, ctypes.addressof(changed))
    # As it was before it had sizes: the width, and two functions.
    with pytest.raises(fb.ModelError, match="another version of this package"):
        attach(model.kernel, ctypes.addressof(words) + ctypes.sizeof(ctypes.c_size_t * 9))
    assert model.lacks_batch_functions
    attach(model.kernel, found[0])
    assert not model.lacks_batch_functions


class Sleeper:
    """A compiler that starts another program, which lasts, and waits for it."""

    def __init__(self, folder):
        self.compiler, self.started = folder / "sleepcc", folder / "started"
        self.started.mkdir()
        self.compiler.write_text(f"#!/bin/sh\nsleep 1000 &\ntouch {self.started}/$!\nwait\n")
        self.compiler.chmod(0o755)

    def programs(self):
        """Those that have been started, of which there are some, sooner or later."""
        while not (found := [int(path.name) for path in self.started.iterdir()]):
            time.sleep(0.01)
        return found

    def end(self):
        """Wait until all have ended, but for what their parents make of it."""
        for number in self.programs():
            stat = Path(f"/proc/{number}/stat")
            with contextlib.suppress(FileNotFoundError):
                while stat.read_text().split()[2] != "Z":
                    time.sleep(0.01)


@pytest.mark.slow
def test_cache_over_its_limit_loses_the_least_recently_used_entries(monkeypatch, tmp_path):
    """What was not used for longest goes first; use is what counts, not age."""
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    known = set()
    for day, change in enumerate(("", "mass", "actuator")):
        fb.compile_model(slider(change))
        for entry in {entry.folder for entry in cache.entries()} - known:
            os.utime(entry / "checksum", (86400 * day, 86400 * day))
            known.add(entry)
    used_again = fb.compile_model(slider("")).path.parent
    before = cache.entries()
    assert before[0].folder == used_again
    limit = sum(entry.size for entry in before)
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE_SIZE", str(limit))
    made = fb.compile_model(slider("load")).path.parent
    after = [entry.folder for entry in cache.entries()]
    assert sum(entry.size for entry in cache.entries()) <= limit
    assert made in after
    kept = [entry.folder for entry in before if entry.folder in after]
    assert 0 < len(kept) < len(before)
    assert kept == [entry.folder for entry in before][: len(kept)]
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE_SIZE", "0")
    last = fb.compile_model(slider("inertia"))
    assert [entry.folder for entry in cache.entries()] == [last.path.parent]
    assert np.isfinite(last.rhs(0.0, [0.5, 0.1, 0.2, 0.3])).all()
    for wrong in ("much", "-1", "nan"):
        monkeypatch.setenv("FOURBAR_CODEGEN_CACHE_SIZE", wrong)
        with pytest.raises(fb.CacheError, match="a number of bytes"):
            fb.compile_model(slider("body"))


@pytest.mark.slow
def test_cache_that_cannot_be_written_still_serves_its_models(monkeypatch, tmp_path):
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    path = fb.compile_model(slider()).path

    def refused(*_, **__):
        raise PermissionError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(os, "utime", refused)
    monkeypatch.setattr(Path, "mkdir", refused)
    assert fb.compile_model(slider()).path == path


@pytest.fixture
def sleeper(tmp_path, monkeypatch):
    sleeper = Sleeper(tmp_path)
    monkeypatch.setenv("CC", str(sleeper.compiler))
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path / "cache"))
    return sleeper


@pytest.mark.slow
def test_compiler_beyond_its_time_limit_is_stopped_with_a_message(sleeper, monkeypatch, tmp_path):
    monkeypatch.setenv("FOURBAR_CODEGEN_TIME_LIMIT", "0.5")
    with pytest.raises(fb.BuildError, match=r"has not ended within 0.5 s .* FOURBAR_CODEGEN_TIME_LIMIT"):
        fb.compile_model(slider())
    sleeper.end()
    assert [path for path in (tmp_path / "cache").iterdir() if path.is_dir()] == []
    for wrong in ("soon", "0", "-1", "nan"):
        monkeypatch.setenv("FOURBAR_CODEGEN_TIME_LIMIT", wrong)
        with pytest.raises(fb.BuildError, match="a positive number of seconds"):
            fb.compile_model(slider())
    monkeypatch.delenv("CC")
    for none in ("", "inf"):
        monkeypatch.setenv("FOURBAR_CODEGEN_TIME_LIMIT", none)
        monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path / f"cache{none}"))
        assert fb.compile_model(slider()).name == "slider"


COMPILES = (
    "import sys; sys.path.insert(0, 'tests')\nimport fourbar_codegen as fb; from builders.systems import slider\n"
)


@pytest.mark.slow
@pytest.mark.parametrize("how", ["compile_model(slider())", "build_model(slider(), sys.argv[1])"])
def test_compilation_interrupted_from_the_keyboard_stops_its_tools(sleeper, tmp_path, how):
    code = (
        "import os, pathlib, signal, threading, time\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # what runs in the background ignores interrupts
        "def interrupt():\n"
        f"    while not any(pathlib.Path({str(sleeper.started)!r}).iterdir()): time.sleep(0.01)\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        f"{COMPILES}"
        "threading.Thread(target=interrupt).start()\n"
        f"fb.{how}\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "folder")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stderr.rstrip().endswith("KeyboardInterrupt")
    sleeper.end()
    assert not (tmp_path / "folder").exists()


@pytest.mark.slow
def test_process_that_waits_for_a_build_names_the_builder(sleeper, monkeypatch, capsys):
    monkeypatch.setattr(cache, "QUIET_SECONDS", 0.0)
    command = [sys.executable, "-c", f"{COMPILES}fb.compile_model(slider())"]
    first = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    programs = sleeper.programs()

    def wait():
        with contextlib.suppress(fb.BuildError):
            fb.compile_model(slider())

    second = threading.Thread(target=wait)
    second.start()
    said = ""
    while "waiting" not in said:
        time.sleep(0.01)
        said += capsys.readouterr().err
    assert f"waiting for process {first.pid} on " in said
    first.kill()
    while second.is_alive():  # now it is the second one's turn
        for number in {*sleeper.programs(), *programs}:
            with contextlib.suppress(ProcessLookupError):
                os.kill(number, signal.SIGKILL)
        time.sleep(0.01)
    first.wait()


def test_cache_folder_that_is_a_file_raises_an_error_that_names_the_variable(monkeypatch, tmp_path):
    # A file where the folder should be: no user may write there, root included.
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(blocked))
    with pytest.raises(fb.CacheError, match=r"FOURBAR_CODEGEN_CACHE"):
        fb.compile_model(slider())
    assert blocked.read_text() == ""


def run_of_slider(cache):
    """In a process of its own: the module must not be in memory already. The module's path, and what it gives."""
    code = (
        "import sys; sys.path.insert(0, 'tests')\n"
        "import fourbar_codegen as fb; from builders.systems import slider\n"
        "model = fb.compile_model(slider()); print(model.path, model.rhs(0.0, [0.5, 0.1, 0.2, 0.3]))"
    )
    environment = {**os.environ, "FOURBAR_CODEGEN_CACHE": str(cache)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    path, _, rates = done.stdout.partition(" ")
    return Path(path), rates


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    """A cache that has the slider; where its module is in it, and what that gives."""
    cache = tmp_path_factory.mktemp("filled")
    module, rates = run_of_slider(cache)
    return cache, module.relative_to(cache), rates


def truncate(module):
    with module.open("r+b") as file:
        file.truncate(20000)


def flip(source):
    source.write_text(source.read_text().replace("cos(", "sin("))


@pytest.mark.slow
@pytest.mark.parametrize(
    "damage",
    [
        truncate,
        lambda module: module.write_bytes(b""),
        lambda module: module.unlink(),
        lambda module: (module.parent / "checksum").unlink(),
        lambda module: (module.parent / "checksum").write_text("  slider_kernel.c\n"),
        lambda module: flip(module.with_name("slider_kernel.c")),
        lambda module: module.with_name("slider_batch.c").unlink(),
        lambda module: (shutil.rmtree(module.parent), module.parent.write_text("a file")),
        lambda module: module.parent.rename(
            f"{module.parent}.{os.geteuid()}.building"
        ),  # as of a process that was killed
    ],
    ids=["truncated", "empty", "missing", "no checksum", "no digest", "a source", "no source", "a file", "left behind"],
)
def test_damaged_entry_is_built_anew(tmp_path, filled, damage):
    cache, module, rates = filled
    shutil.copytree(cache, tmp_path / "cache")
    damage(tmp_path / "cache" / module)
    assert run_of_slider(tmp_path / "cache") == (tmp_path / "cache" / module, rates)


@pytest.mark.slow
def test_sources_damaged_in_the_cache_are_not_compiled_or_sent(tmp_path, monkeypatch):
    """They would be compiled for ensembles, and travel with a model."""
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    model = slider()
    model.name = "damaged"
    model = fb.compile_model(model)
    flip(model.path.with_name("damaged_kernel.c"))
    damaged = fb.load(model.path)
    with pytest.raises(fb.ModelError, match="damaged: compile the model again"):
        damaged.ensemble((0.0, 1.0), np.zeros(model.n_x), parameters={"m": [1.0, 2.0]})
    assert np.isfinite(model.rhs_batch(0.0, np.full((4, 3), 0.5))).all()  # was loaded before
    elsewhere = tmp_path / "elsewhere"
    sent = pickle.dumps(damaged)
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(elsewhere))
    with pytest.raises(fb.ModelError, match="its sources were not beside it"):
        pickle.loads(sent)


OTHER = 65534
"""A user without rights."""


@contextlib.contextmanager
def as_user(number):
    """As another user, where the tests run as root."""
    if os.geteuid() != 0:
        pytest.skip("only root can be two users: run the tests as root as well")
    os.setegid(number)
    codecs.lookup("ascii")  # which filelock needs, and another user may not be able to import
    os.seteuid(number)
    try:
        yield
    finally:
        os.seteuid(0)
        os.setegid(0)


@pytest.fixture
def shared(tmp_path, monkeypatch):
    """A folder where everybody can write, as /tmp; each user has a home."""
    for path in (tmp_path, *tmp_path.parents[:3]):
        path.chmod(path.stat().st_mode | 0o055)
    folder = tmp_path / "shared"
    folder.mkdir()
    folder.chmod(0o1777)
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(folder))
    for user in (0, OTHER):
        (tmp_path / str(user)).mkdir()
        os.chown(tmp_path / str(user), user, user) if os.geteuid() == 0 else None
    monkeypatch.setattr("platformdirs.user_cache_path", lambda *_, **__: tmp_path / str(os.geteuid()) / "cache")
    cache._own_folder.cache_clear()
    yield folder
    cache._own_folder.cache_clear()


def built_by(who):
    def build(folder):
        (folder / "model.so").write_text(who)
        return folder / "model.so"

    return build


KEY = "0123456789abcdef" * 4


def test_entry_of_another_user_in_a_shared_cache_is_not_loaded(shared):
    with as_user(OTHER):
        theirs = cache.cached("model", KEY, built_by("other"))
    assert theirs.parent.parent == shared
    assert cache.find_cached("model", KEY) is None
    with pytest.warns(UserWarning, match=f"{theirs.parent} belongs to another user, {OTHER}, and loading"):
        mine = cache.cached("model", KEY, built_by("me"))
    assert mine.read_text() == "me"
    assert mine.parent.parent == shared.parent / "0" / "cache"
    # What root has built, all may use.
    other_key = KEY[::-1]
    cache.cached("model", other_key, built_by("me"))
    with as_user(OTHER):
        assert cache.cached("model", other_key, built_by("other")).read_text() == "me"
        assert cache.find_cached("model", other_key).read_text() == "me"


def test_locks_of_another_user_in_a_shared_cache_block_nobody(shared):
    entry = cache._place(shared, "model", KEY).name
    with as_user(OTHER):
        for name in (f"{entry}.lock", f"{entry}.{OTHER}.lock"):
            (shared / name).write_text("")
            (shared / name).chmod(0o600)
        for name in (f"{entry}.building", f"{entry}.{OTHER}.building"):
            (shared / name).mkdir(0o700)
    with as_user(OTHER - 1):
        assert cache.cached("model", KEY, built_by("third")).parent.parent == shared


def linked(entry):
    target = entry.rename(entry.parent.parent / "elsewhere")
    entry.symlink_to(target)


TAMPERED = {
    "others can write to the folder": (lambda entry: entry.parent.chmod(0o777), "Others can write to"),
    "others can write to the entry": (lambda entry: entry.chmod(0o757), "Others can write to"),
    "others can write to the module": (lambda entry: (entry / "model.so").chmod(0o646), "Others can write to"),
    "a symbolic link": (linked, "is a symbolic link"),
}


@pytest.mark.parametrize("how", TAMPERED)
def test_entry_that_others_may_change_is_not_loaded_but_built_anew(shared, how):
    tamper, reason = TAMPERED[how]
    module = cache.cached("model", KEY, built_by("first"))
    tamper(module.parent)
    assert cache.find_cached("model", KEY) is None
    with pytest.warns(UserWarning, match=reason):
        again = cache.cached("model", KEY, built_by("again"))
    assert again.read_text() == "again"
    assert again.parent.parent == shared.parent / str(os.geteuid()) / "cache"


def test_checksum_that_names_a_file_outside_its_folder_is_refused(shared):
    module = cache.cached("model", KEY, built_by("first"))
    outside = shared.parent / "outside.so"
    outside.write_text("outside")
    for name in (str(outside), "../../outside.so"):
        (module.parent / "checksum").write_text(f"{stored_model.digest_of_file(outside)}  {name}\n")
        assert cache.find_cached("model", KEY) is None
        assert cache.cached("model", KEY, built_by("again")).read_text() == "again"


def test_entry_written_with_an_open_umask_is_closed_to_others(shared):
    before = os.umask(0)
    try:
        module = cache.cached("model", KEY, built_by("first"))
    finally:
        os.umask(before)
    assert cache.cached("model", KEY, built_by("again")) == module
    assert module.read_text() == "first"


def test_cache_without_a_usable_home_is_a_folder_of_the_process(shared, monkeypatch):
    """Then a folder for this process."""
    shared.chmod(0o777)
    monkeypatch.setattr("platformdirs.user_cache_path", lambda *_, **__: Path("/dev/null/cache"))
    with pytest.warns(UserWarning, match="Others can write to"):
        module = cache.cached("model", KEY, built_by("first"))
    assert module.read_text() == "first"


@contextlib.contextmanager
def mounted(folder, options):
    """A file system of its own on a folder."""
    mount = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("only who may mount has a file system of its own: run the tests as root as well")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.mark.slow
def test_a_full_disk_leaves_the_cache_as_it_was(monkeypatch, tmp_path):
    with mounted(tmp_path, "size=400k"):
        monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path / "cache"))
        first = fb.compile_model(slider())
        before = [entry.folder for entry in cache.entries()]
        file = os.open(tmp_path / "all", os.O_CREAT | os.O_WRONLY)
        with contextlib.suppress(OSError):  # when nothing is left
            while True:
                os.write(file, bytes(64))
        os.close(file)
        for call in (lambda: fb.compile_model(slider("mass")), lambda: first.jacobian(0.0, [0.3] * 4)):
            with pytest.raises(fb.CacheError, match="No space left on device"):
                call()
        assert [entry.folder for entry in cache.entries()] == before
        assert not list((tmp_path / "cache").glob("*.building"))
        assert fb.compile_model(slider()).path == first.path  # what is there can be had
        (tmp_path / "all").unlink()
        assert first.jacobian(0.0, [0.3] * 4).shape == (4, 4)


def test_module_on_a_noexec_file_system_is_refused_with_its_reason(four_bar, tmp_path):
    with mounted(tmp_path, "noexec"):
        shutil.copy(four_bar.path, tmp_path)
        with pytest.raises(fb.ModelError, match="mounted with noexec"):
            fb.load(tmp_path / four_bar.path.name)


def other_weight():
    """A model of the slider's name with another equation."""
    return slider("mass")


@pytest.mark.slow
def test_module_whose_folder_was_built_anew_is_not_sent_with_new_sources(monkeypatch, tmp_path):
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path / "cache"))
    loaded = fb.load(fb.build_model(slider(), tmp_path))
    expected = loaded.rhs(0.0, [0.5, 0.1, 0.2, 0.3])
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(loaded)).rhs(0.0, [0.5, 0.1, 0.2, 0.3]), expected)
    fb.build_model(other_weight(), tmp_path)
    with pytest.raises(fb.ModelError, match="those of a later build"):
        pickle.loads(pickle.dumps(loaded))


@pytest.mark.slow
def test_a_build_that_is_interrupted_leaves_the_folder_as_it_was(monkeypatch, tmp_path):
    module = fb.build_model(slider(), tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def full(self, content):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    original = toolchain.replacing

    @contextlib.contextmanager
    def replacing(path):
        with original(path) as file:
            # The disk is full when it comes to the module, which is written last.
            yield file if path.name != module.name else type("File", (), {"write": full})()

    with monkeypatch.context() as patch:
        patch.setattr(
            toolchain, "replacing", lambda path: replacing(path) if path.parent == tmp_path else original(path)
        )
        with pytest.raises(fb.BuildError, match="No space left"):
            fb.build_model(other_weight(), tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.slow
def test_models_of_one_name_with_shared_symbols_keep_their_own_rates(monkeypatch, tmp_path):
    """With RTLD_GLOBAL, the loader gives what was loaded first to all that ask for a name."""
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path / "cache"))
    module = fb.build_model(other_weight(), tmp_path / "built")
    fb.compile_model(slider())
    code = f"""
import os, sys
sys.path.insert(0, {str(PROJECT / "tests")!r})
sys.setdlopenflags(os.RTLD_NOW | os.RTLD_GLOBAL)
import ctypes, fourbar_codegen as fb
from builders.systems import slider
ctypes.CDLL({str(module)!r}, mode=ctypes.RTLD_GLOBAL)
for model in (fb.load({str(module)!r}), fb.compile_model(slider())):
    print(model.rhs(0.0, [0.5, 0.1, 0.2, 0.3]).tolist(), model.jacobian(0.0, [0.5, 0.1, 0.2, 0.3]).tolist())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    rates = [json.loads(line.partition("] [")[0] + "]") for line in done.stdout.splitlines()]
    x = [0.5, 0.1, 0.2, 0.3]
    np.testing.assert_allclose(rates[0], fb.compile_model(other_weight()).rhs(0.0, x), rtol=1e-13)
    np.testing.assert_allclose(rates[1], fb.compile_model(slider()).rhs(0.0, x), rtol=1e-13)
    assert rates[0] != rates[1]


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["numbers", "library"])
def test_library_or_numbers_damaged_in_the_cache_are_refused_by_path(monkeypatch, tmp_path, damage):
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    path = fb.compile_model(slider("parameter as an expression")).path
    damaged = path if damage == "library" else path.with_name("slider_numbers.json")
    content = damaged.read_bytes()
    damaged.write_bytes(content[: len(content) // 2] if damage == "library" else content.replace(b"1", b"2", 1))
    with pytest.raises(fb.ModelError, match="is damaged"):
        fb.load(path)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.05, 0.3, 0.95])
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="ELF")
def test_module_truncated_anywhere_is_refused_on_loading(tmp_path, share):
    """The loader of the system takes it, and ends the process."""
    module = fb.build_model(slider(), tmp_path)
    half = tmp_path / "half" / module.name
    half.parent.mkdir()
    half.write_bytes(module.read_bytes()[: int(share * module.stat().st_size)])
    with pytest.raises(fb.ModelError, match="is damaged"):
        fb.load(half)


@pytest.mark.slow
def test_cache_cleared_between_steps_is_built_again_up_to_five_times(monkeypatch, tmp_path):
    """Between any two steps another process may remove a folder; whoever looks for it builds it again."""
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    original, removed = cached_models.load_file, []

    def load_file(path):
        if len(removed) < 2:
            removed.append(path)
            shutil.rmtree(path.parent)
        return original(path)

    monkeypatch.setattr(cached_models, "load_file", load_file)
    assert np.isfinite(fb.compile_model(slider()).rhs(0.0, [0.5, 0.1, 0.2, 0.3])).all()
    assert len(removed) == 2
    with monkeypatch.context() as patch:
        patch.setattr(cached_models, "load_file", lambda path: shutil.rmtree(path.parent) or original(path))
        with pytest.raises(fb.CacheError, match="was removed 5 times"):
            fb.compile_model(slider())


def test_folders_that_a_killed_process_was_removing_are_listed_and_cleared(monkeypatch, tmp_path):
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    for name in (f"big-{32 * '0'}.0.26907.removed", f"bare-{32 * '1'}"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "file").write_bytes(bytes(1000))
    assert {(entry.name, entry.size) for entry in cache.entries()} == {("big", 1000), ("bare", 1000)}
    cache.clear()
    assert list(tmp_path.iterdir()) == []


def test_cache_that_is_a_file_cannot_be_listed_or_used(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path / "file"))
    with pytest.raises(fb.CacheError, match="cannot be read: Not a directory"):
        cache.entries()
    with pytest.raises(fb.CacheError) as caught:
        fb.compile_model(slider())
    assert str(caught.value).count("cannot be used") == 1
