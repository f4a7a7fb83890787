"""Libraries of this folder's C sources, compiled once per session; no model goes through the compiler pipeline."""

from pathlib import Path

import pytest
from builders.hand_written_pendulum import loaded_pendulum
from harness.programs import compile_c, require
from harness.shims import Shims

import fourbar_codegen as fb

# -O1, since with -O2 gcc takes the constants of lanes/lane_equations.h for uninitialized: it cannot tell that the
# first batch fills them.
COMMAND = ("-std=gnu11", "-O1", "-Wall", "-Wextra", "-Werror", "-fPIC", "-shared")


@pytest.fixture(scope="session")
def shared(tmp_path_factory):
    """Compiles sources of this folder, with options, to a shared library; returns its path."""

    def compiled(name, *sources, options=()):
        path = tmp_path_factory.mktemp(name) / f"lib{name}.so"
        files = [Path(__file__).parent / source for source in sources]
        compile_c((require("gcc"), *COMMAND, *options), files, path, include=[fb.get_include()])
        return path

    return compiled


@pytest.fixture(scope="session")
def pendulum_path(shared):
    return shared("pendulum", "hand_written_pendulum.c", "hand_written_pendulum_batch.c")


@pytest.fixture(scope="session")
def pendulum(pendulum_path):
    return loaded_pendulum(pendulum_path)


@pytest.fixture(scope="session")
def redundant_pendulum(shared):
    """The pendulum with its constraint written twice."""
    sources = ("hand_written_pendulum.c", "hand_written_pendulum_batch.c")
    return loaded_pendulum(shared("redundant_pendulum", *sources, options=("-DTWICE",)), rows=2)


@pytest.fixture(params=["pendulum", "redundant_pendulum"])
def either_pendulum(request):
    """The pendulum with its constraint written once, and twice."""
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="session")
def shims(shared):
    """The runtime's functions that depend on no model."""
    return Shims(shared("shims", "shims.c"))


@pytest.fixture(scope="session")
def closing(shared):
    """Loop closure in C, for the pendulum."""
    return Shims(shared("closing", "shims_of_close.c"))
