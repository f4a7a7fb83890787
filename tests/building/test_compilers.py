"""C compilers: which one is taken, what they make, and on which processors and systems that runs."""

import json
import os
import platform
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from builders.systems import slider
from harness import PROJECT
from harness.programs import emulator, require, zig_cc

import fourbar_codegen as fb
import fourbar_codegen.export.module
from fourbar_codegen.building import compiler as compilers
from fourbar_codegen.building.loading import load_file
from fourbar_codegen.compiled_model import CompiledModel
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.runtime.batch import width
from fourbar_codegen.runtime.evaluator import versions

pytestmark = pytest.mark.slow

SOURCES = PROJECT / "generated" / "four_bar"
STATE = [-0.5, -1.5, -1.5, -0.1, 0.07, -0.03]
# Two implementations add in different orders; the condition of J_d is near 3 here, and rates are near 10.
ROUNDING = {"rtol": 1e-13, "atol": 1e-13}
# As many values as processors have lanes, and some more.
EVALUATE = f"""
import json, sys
import numpy as np
import fourbar_codegen as fb
four_bar = fb.load(sys.argv[1])
x = np.array({STATE})
batch = four_bar.rhs_batch(0.3, np.stack([x] * 19, axis=1)).T
print(json.dumps([four_bar.instructions, four_bar.rhs(0.3, x).tolist(), batch.tolist()]))
"""


def evaluated(model, *command):
    """Instructions, x' of one state, and of a batch, in another process."""
    # NumPy's OpenBLAS takes what this names for the processor, whichever is emulated.
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_CORETYPE"}
    process = [*command, sys.executable, "-c", EVALUATE, str(model)]
    done = subprocess.run(process, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def path_without(monkeypatch, tmp_path):
    """A PATH without any compiler, and a cache without any model."""
    (tmp_path / "bin").mkdir()
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.delenv("CC", raising=False)
    original = compilers.sysconfig.get_config_var
    monkeypatch.setattr(
        compilers.sysconfig, "get_config_var", lambda name: "no-gcc" if name in {"CC", "LDSHARED"} else original(name)
    )
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path / "cache"))


def test_compile_model_without_a_compiler_uses_ziglang(monkeypatch, tmp_path, tutorial):
    path_without(monkeypatch, tmp_path)
    assert compilers.find_compiler().origin == "the package ziglang"
    four_bar = fb.compile_model(fb.models.four_bar())
    np.testing.assert_allclose(four_bar.rhs(0.3, STATE), tutorial.rhs(0.3, np.array(STATE)), **ROUNDING)
    run = four_bar.simulate((0.0, 1.0), four_bar.initial_state(), rtol=1e-10, atol=1e-10)
    assert run.success
    assert np.abs(run.constraint_residual).max() < 1e-12
    # Derivatives and the functions for batches are built later, and compared then.
    assert four_bar.jacobian(0.3, STATE).shape == (6, 6)
    batch = four_bar.rhs_batch(0.3, np.stack([STATE] * 19, axis=1))
    np.testing.assert_allclose(batch.T, [tutorial.rhs(0.3, np.array(STATE))] * 19, **ROUNDING)
    # What zig keeps lies in our cache, and is cleared with it.
    from fourbar_codegen.building.cache import clear

    assert {entry.name for entry in clear()} >= {"ziglang", "four_bar"}


def test_module_built_by_ziglang_runs_on_older_processors(monkeypatch, tmp_path, tutorial):
    """zig compiles for the machine it runs on, unless it is told not to."""
    qemu = require("qemu-x86_64")
    path_without(monkeypatch, tmp_path)
    module = fb.build_model(fb.models.four_bar(), tmp_path / "built")
    instructions, rates, _ = evaluated(module, qemu, "-cpu", "Nehalem")
    assert instructions == "baseline"
    np.testing.assert_allclose(rates, tutorial.rhs(0.3, np.array(STATE)), **ROUNDING)


def test_compiler_from_cc_comes_before_that_of_the_system(monkeypatch, tmp_path):
    path_without(monkeypatch, tmp_path)
    clang = tmp_path / "bin" / "clang"
    clang.write_text("#!/bin/sh\nexit 3\n")
    clang.chmod(0o755)
    assert compilers.find_compiler().command == ("clang",)
    with pytest.raises(fb.BuildError, match=r"The C compiler clang \(the system\) failed"):
        fb.compile_model(slider())
    monkeypatch.setenv("CC", "false --version")
    with pytest.raises(fb.BuildError, match=r"false --version \(the environment variable CC\)"):
        fb.compile_model(slider())


def test_compile_model_without_any_compiler_says_what_to_install(monkeypatch, tmp_path):
    path_without(monkeypatch, tmp_path)
    monkeypatch.setattr(compilers, "find_spec", lambda name: None)
    with pytest.raises(fb.BuildError, match=r"pip install 'fourbar_codegen\[compiler\]'"):
        fb.compile_model(slider())
    assert fb.load("four_bar").rhs(0.0, STATE).shape == (6,)


@pytest.mark.skipif(platform.machine() != "x86_64", reason="versions are for x86-64")
@pytest.mark.parametrize(("processor", "expected"), [("Nehalem", "baseline"), ("Haswell", "avx2")])
def test_shipped_module_on_older_processors_selects_its_version(tutorial, processor, expected):
    instructions, rates, batch = evaluated("four_bar", require("qemu-x86_64"), "-cpu", processor)
    assert instructions == expected
    reference = tutorial.rhs(0.3, np.array(STATE))
    np.testing.assert_allclose(rates, reference, **ROUNDING)
    np.testing.assert_allclose(batch, [reference] * 19, **ROUNDING)


@pytest.mark.parametrize("built", ["installed", "by build_model"])
def test_versions_of_a_kernel_for_each_instruction_set_give_the_same_rates(four_bar, tutorial, tmp_path, built):
    path = four_bar.path if built == "installed" else fb.build_model(fb.models.four_bar(), tmp_path)
    loaded = load_file(path)
    models = [CompiledModel(Kernel(capsule, loaded.layout)) for capsule in versions(loaded.capsule)]
    assert [model.instructions for model in models] == ["baseline", "avx2", "avx512"][: len(models)]
    assert fb.load(path).instructions == models[-1].instructions
    if platform.machine() == "x86_64":
        flags = Path("/proc/cpuinfo").read_text().split()
        assert len(models) == 1 + ("avx2" in flags) + ("avx512dq" in flags)
        assert [width(model.kernel) for model in models] == [2, 4, 8][: len(models)]
    states = np.array(STATE)[:, None] + 1e-2 * np.sin(np.arange(6 * 19)).reshape(6, 19)
    expected = np.stack([tutorial.rhs(0.3, state) for state in states.T], axis=1)
    for model in models:
        np.testing.assert_allclose(model.rhs_batch(0.3, states), expected, **ROUNDING)
        np.testing.assert_allclose(model.rhs(0.3, states[:, 0]), expected[:, 0], **ROUNDING)


@pytest.mark.parametrize(
    ("part", "entry", "message"),
    [
        ("kernel", r"forcing\[1\] = ", "function dynamics, result forcing"),
        ("products", r"residual_tangent\[0\] = ", "product dx' along a direction"),
    ],
)
def test_a_version_that_differs_from_the_equations_is_not_built(
    monkeypatch, tmp_path, part, entry, message, unoptimized
):
    """Not only the version that this machine would take is compared."""
    if len(versions(load_file(fb.load("four_bar").path).capsule)) == 1:
        pytest.skip("this processor has no AVX2")
    original = fourbar_codegen.export.module.build_extension

    def damaged(name, sources, *arguments, **options):
        text, count = re.subn(f"({entry})", r"\g<1>1.001*", sources[f"slider_{part}.c"], count=1)
        assert count == 1
        version = sources[f"slider_{part}_avx2.c"].replace(f'#include "slider_{part}.c"', text)
        return original(name, {**sources, f"slider_{part}_avx2.c": version}, *arguments, **options)

    monkeypatch.setattr(fourbar_codegen.export.module, "build_extension", damaged)
    with pytest.raises(fb.BuildError, match=message):
        fb.build_model(slider(), tmp_path)


# Other systems, as far as they can be had here: what is built for them is linked, and run where it can be.

RUNTIME = """
#include <float.h>
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#define static static __attribute__((used)) /* so that all of it is compiled */
#include "steppers/ali3p.h"
#include "lanes/batch.h"
#include "derivatives/implicit_residual.h"
#include "run/driver.h"
#include "kernel/problem.h"
#include "steppers/tableaus.h"
"""
MAIN = """
#include "four_bar_kernel.h"
#include <stdio.h>
#include <stdlib.h>
int main(int argc, char **argv)
{
    const fb_kernel *const k = fb_fastest(&four_bar_kernel);
    double p[16], constants[64], x[8], r[1], rates[8];
    void *const work = calloc(1, k->work_size);
    for (int i = 0; i < k->n_p; ++i)
        p[i] = atof(argv[1 + i]);
    for (int i = 0; i < k->n_q + k->n_u; ++i)
        x[i] = atof(argv[1 + k->n_p + i]);
    k->prepare(p, constants);
    k->default_inputs(0.3, constants, r);
    const int status = k->rhs(0.3, x, constants, r, rates, work);
    for (int i = 0; i < k->n_q + k->n_u; ++i)
        printf("%.17g\\n", rates[i]);
    (void)argc;
    return status;
}
"""


@pytest.mark.parametrize(
    ("target", "magic"),
    [("x86_64-windows-gnu", b"MZ"), ("aarch64-macos", b"\xcf\xfa\xed\xfe"), ("aarch64-linux-gnu.2.17", b"\x7fELF")],
)
def test_kernel_and_runtime_compile_for_windows_macos_and_arm(tmp_path, target, magic):
    (tmp_path / "runtime.c").write_text(RUNTIME)
    built = zig_cc(tmp_path, target, [*sorted(SOURCES.glob("*.c")), tmp_path / "runtime.c"], "-shared")
    assert built.read_bytes().startswith(magic)


def test_kernel_on_emulated_aarch64_gives_sympys_rates(four_bar, tutorial, tmp_path):
    (tmp_path / "main.c").write_text(MAIN)
    built = zig_cc(tmp_path, "aarch64-linux-gnu.2.17", [*sorted(SOURCES.glob("*.c")), tmp_path / "main.c"], "-lm")
    numbers = [repr(float(value)) for value in (*four_bar.defaults.values(), *STATE)]
    command = [*emulator("aarch64", "aarch64-linux-gnu"), built, *numbers]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    rates = [float(line) for line in done.stdout.splitlines()]
    np.testing.assert_allclose(rates, tutorial.rhs(0.3, np.array(STATE)), **ROUNDING)


def test_generated_sources_without_gnu_extensions_are_strict_c99(tmp_path):
    """None of gcc's extensions stands where a compiler does not say that it has them, as Microsoft's does not."""
    for source in sorted(SOURCES.glob("*.c")):  # musl's INFINITY is 1e5000f there
        zig_cc(tmp_path, "x86_64-linux-musl", [source], "-c", "-U__GNUC__", "-pedantic-errors", "-Wno-literal-range")


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize(
    "flags", [["-ffast-math"], ["-Ofast"], ["-fassociative-math", "-fno-signed-zeros", "-fno-trapping-math"]]
)
def test_fast_math_is_refused_or_does_nothing_to_generated_sources(four_bar, tutorial, tmp_path, compiler, flags):
    """With reassociation, angles would be rounded to wrong quadrants without a word."""
    (tmp_path / "main.c").write_text(MAIN)
    command = [require(compiler), "-O2", *flags, "-I", str(SOURCES), "-I", fb.get_include(), str(tmp_path / "main.c")]
    command += [*map(str, sorted(SOURCES.glob("*.c"))), "-o", str(tmp_path / "main"), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        assert "Results would be wrong with -ffast-math" in done.stderr
        return
    assert compiler == "clang"
    numbers = [repr(float(value)) for value in (*four_bar.defaults.values(), *STATE)]
    done = subprocess.run([tmp_path / "main", *numbers], capture_output=True, text=True, check=True)
    rates = [float(line) for line in done.stdout.splitlines()]
    np.testing.assert_allclose(rates, tutorial.rhs(0.3, np.array(STATE)), **ROUNDING)
