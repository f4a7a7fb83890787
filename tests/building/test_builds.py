"""Builds that fail say why and leave things as they were; modules that were built again or with odd flags."""

import os
import subprocess
import sys

import numpy as np
import pytest
import sympy as sm
from builders.systems import pendulum

import fourbar_codegen as fb

pytestmark = pytest.mark.usefixtures("unoptimized")

M = sm.Symbol("m")


@pytest.mark.parametrize("command", ["no-such-compiler-here", "false"])
def test_compile_model_with_a_missing_or_failing_compiler_names_it(monkeypatch, tmp_path, command):
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    monkeypatch.setenv("CC", command)
    with pytest.raises(fb.BuildError) as caught:
        fb.compile_model(fb.models.four_bar())
    assert command in str(caught.value)
    assert caught.value.command[0] == command
    assert [path for path in tmp_path.iterdir() if path.is_dir()] == []
    assert fb.load("four_bar").simulate((0.0, 0.1)).success


def test_build_error_of_a_wrong_flag_shows_the_compilers_message(monkeypatch, tmp_path):
    monkeypatch.setenv("CFLAGS", "--no-such-flag")
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    with pytest.raises(fb.BuildError, match="no-such-flag") as caught:
        fb.compile_model(fb.models.four_bar())
    assert caught.value.exit_code == 1
    assert "unrecognized" in caught.value.output


@pytest.mark.slow
def test_failed_build_leaves_the_users_folder_alone(monkeypatch, tmp_path):
    monkeypatch.setenv("CC", "false")
    with pytest.raises(fb.BuildError):
        fb.build_model(fb.models.four_bar(), tmp_path / "built")
    assert not (tmp_path / "built").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variable", "text", "words"),
    [
        ("CC", 'gcc "', "environment variable CC cannot be read"),
        ("CFLAGS", '-O"', "environment variable CFLAGS cannot be read"),
        ("CC", "true", "made no"),
    ],
)
def test_build_with_unreadable_compiler_settings_is_refused_with_their_name(
    monkeypatch, tmp_path, variable, text, words
):
    monkeypatch.setenv(variable, text)
    with pytest.raises(fb.BuildError, match=words):
        fb.build_model(fb.models.four_bar(), tmp_path)


@pytest.mark.slow
def test_module_built_with_fast_math_keeps_nan_and_denormal_numbers(monkeypatch, tmp_path):
    monkeypatch.setenv("CC", f"{os.environ.get('CC', 'cc')} -Ofast")
    monkeypatch.setenv("CFLAGS", "-ffast-math")
    monkeypatch.setenv("LDFLAGS", "-ffast-math -funsafe-math-optimizations")
    path = fb.build_model(fb.models.four_bar(), tmp_path)
    # The least number of double is one still: with code that compilers link for these flags, it would be zero.
    script = f"import fourbar_codegen as fb\nfb.load({str(path)!r})\nprint(float('5e-324') * 1.0)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "5e-324\n"
    four_bar = fb.load(path)
    ode = four_bar.ode()
    assert np.isnan(ode(0.0, [np.nan] * 6)).all()
    assert "not finite" in ode.failure


@pytest.mark.slow
def test_module_built_again_after_loading_is_refused_in_the_same_process(tmp_path):
    fb.load(fb.build_model(fb.Model(pendulum(), name="again", parameters={M: 1.0}), tmp_path))
    path = fb.build_model(fb.Model(pendulum(), name="again", parameters={M: 2.0}), tmp_path)
    with pytest.raises(fb.ModelError, match="built again"):
        fb.load(path)


@pytest.mark.slow
def test_module_built_after_a_failed_load_is_loaded(tmp_path):
    model = fb.Model(pendulum(), name="mended", parameters={M: 1.0})
    path = fb.build_model(model, tmp_path)
    path.unlink()
    path.write_text("Not a library.")
    with pytest.raises(fb.ModelError, match="cannot be loaded"):
        fb.load(path)
    path.unlink()
    assert fb.load(fb.build_model(model, tmp_path)).name == "mended"
