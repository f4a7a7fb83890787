"""A model as a wheel, in an environment without SymPy and without a compiler."""

import importlib.util
import os
import re
import subprocess
import sys
import venv
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from builders.systems import slider

import fourbar_codegen as fb
from fourbar_codegen.export.wheel import pack_wheel

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("unoptimized")]

USE = """
import sys
for name in ("sympy", "Cython", "click", "platformdirs", "filelock"):
    try:
        __import__(name)
    except ImportError:
        continue
    raise SystemExit(f"{name} is here")
import pickle
import slider
import fourbar_codegen as fb
model = fb.load("slider")
x = [0.3, 0.2, 0.0, 1.0]
print(slider.rhs(0.5, x, [1.0, 0.5, 2.0, 0.1, 9.81], [0.3]).tolist())
print(model.rhs(0.5, x, r=[0.3]).tolist())
print(pickle.loads(pickle.dumps(model)).rhs(0.5, x, r=[0.3]).tolist())
print(model.simulate((0.0, 0.1), x, constraints="none").success)
"""


def test_wheel_in_a_fresh_environment_gives_the_models_rates(tmp_path):
    wheel = fb.build_wheel(slider(), tmp_path / "dist", version="1.2")
    assert wheel.name.startswith("slider-1.2-cp")
    with zipfile.ZipFile(wheel) as archive:
        (metadata,) = (name for name in archive.namelist() if name.endswith("METADATA"))
        text = archive.read(metadata).decode()
    assert re.findall("Requires-Dist: (.*)", text) == ["numpy>=2.0", 'fourbar_codegen~=0.1.0; extra == "simulate"']
    venv.create(tmp_path / "fresh", with_pip=True)
    python = tmp_path / "fresh" / "bin" / "python"
    subprocess.run([python, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", wheel], check=True)
    # What the wheel depends on, as it is installed here; nothing else is seen from there.
    known = tmp_path / "known"
    known.mkdir()
    for name in ("numpy", "numpy.libs", "scipy", "scipy.libs", "fourbar_codegen"):
        spec = importlib.util.find_spec(name.split(".")[0])
        folder = Path(spec.submodule_search_locations[0])
        if name.endswith(".libs"):
            folder = folder.with_name(name)
        if folder.exists():
            (known / name).symlink_to(folder)
    environment = {"PATH": "", "PYTHONPATH": str(known), "HOME": os.environ.get("HOME", "/")}
    (known / "fourbar_codegen").rename(tmp_path / "apart")
    use = "import slider; print(slider.rhs(0.5, [0.3, 0.2, 0.0, 1.0], [1.0, 0.5, 2.0, 0.1, 9.81], [0.3]).shape)"
    alone = [python, "-W", "error", "-c", use]
    done = subprocess.run(alone, capture_output=True, text=True, env=environment, cwd=tmp_path, check=False)
    assert done.stdout == "(4,)\n", done.stderr
    (tmp_path / "apart").rename(known / "fourbar_codegen")
    done = subprocess.run(
        [python, "-W", "error", "-c", USE], capture_output=True, text=True, env=environment, cwd=tmp_path, check=False
    )
    assert done.returncode == 0, done.stderr + done.stdout
    *rates, success = done.stdout.splitlines()
    expected = fb.compile_model(slider()).rhs(0.5, [0.3, 0.2, 0.0, 1.0], r=[0.3])
    for line in rates:
        # The wheel is built without the instructions of this machine.
        np.testing.assert_allclose(eval(line), expected, rtol=1e-12)
    assert success == "True"


def named(name):
    model = slider()
    model.name = name
    return model


def test_wheel_with_a_taken_name_is_refused(tmp_path, monkeypatch):
    for taken in ("sympy", "scipy", "numpy", "pip", "test", "setup", "setuptools", "four_bar", "json"):
        with pytest.raises(fb.ModelError, match="a module of that name exists"):
            fb.build_wheel(named(taken), tmp_path)
    for alike in ("Arm_One", "arm__one"):
        with pytest.raises(fb.ModelError, match="the same project as 'arm_one'"):
            fb.build_wheel(named(alike), tmp_path)
    for refused in ("arm_", "_arm"):
        with pytest.raises(fb.ModelError, match="underscores at either end"):
            fb.build_wheel(named(refused), tmp_path)
    module = fb.build_model(slider(), tmp_path / "built")
    pack = partial(pack_wheel, module, version="1.0", requires=[], extras={})
    with pytest.raises(fb.BuildError, match="cannot be written"):
        pack(Path("/dev/null/dist"))
    old = tmp_path / "old"
    old.write_text("#!/bin/sh\necho \"error: invalid command 'bdist_wheel'\" >&2\nexit 1\n")
    old.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(old))
    with pytest.raises(fb.BuildError, match="pip install 'setuptools>=77'"):
        pack(tmp_path / "dist")
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(fb.BuildError, match="Setuptools failed"):
        pack(tmp_path / "dist")
    assert not (tmp_path / "dist").exists()
