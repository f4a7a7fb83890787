"""A model's extension module -> a wheel of its own."""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from fourbar_codegen.building.toolchain import copied, run_tool
from fourbar_codegen.errors import BuildError

__all__ = ["WHEEL_SUMMARY", "pack_wheel"]

WHEEL_SETUP = """\
from setuptools import Distribution, setup


class Binary(Distribution):
    def has_ext_modules(self):
        return True  # it is built already


setup(
    distclass=Binary,
    name={name!r},
    version={version!r},
    description={description!r},
    packages=[{name!r}],
    package_data={{{name!r}: ["*"]}},
    install_requires={requires!r},
    extras_require={extras!r},
)
"""

WHEEL_INIT = '''\
"""Compiled equations of motion of the model "{name}": ``fourbar_codegen.load({name!r})``, or `rhs` with NumPy alone."""

from {name}.{name} import kernel, manifest, rhs

__all__ = ["kernel", "manifest", "rhs"]
'''


BUILD_WHEEL = "from setuptools import build_meta; build_meta.build_wheel('dist')"
"""The call of packaging tools to setuptools, by PEP 517."""

WHEEL_SUMMARY = "Compiled equations of motion of the model"


def pack_wheel(
    module: Path, folder: Path, *, version: str, requires: Sequence[str], extras: Mapping[str, Sequence[str]]
) -> Path:
    """Pack an extension module, and the files beside it, into a wheel for Pythons and machines like this one.

    Parameters
    ----------
    module : Path
        As `build_extension` made it, in a folder of its own.
    folder : Path
        The folder for the wheel; created if it does not exist.
    version : str
        Of the wheel.
    requires : sequence of str
        Its dependencies.
    extras : mapping of str to sequence of str
        Further dependencies, by the names of extras.

    Returns
    -------
    Path
        The wheel.

    Raises
    ------
    BuildError
        If setuptools is missing or fails, or the folder cannot be written.
    """
    name = module.name.split(".")[0]
    with tempfile.TemporaryDirectory() as temporary:
        project = Path(temporary)
        shutil.copytree(module.parent, project / name)
        (project / name / "__init__.py").write_text(WHEEL_INIT.format(name=name), encoding="utf-8")
        setup = WHEEL_SETUP.format(
            name=name,
            version=version,
            description=f"{WHEEL_SUMMARY} {name}",
            requires=list(requires),
            extras=dict(extras),
        )
        (project / "setup.py").write_text(setup, encoding="utf-8")
        try:
            run_tool([sys.executable, "-c", BUILD_WHEEL], project / "dist", tool="setuptools", cwd=project)
        except BuildError as error:
            if "invalid command 'bdist_wheel'" in error.output:
                raise BuildError(
                    "This version of setuptools makes no wheels: pip install 'setuptools>=77'.", output=error.output
                ) from error
            raise
        (wheel,) = (project / "dist").glob("*.whl")
        return copied(wheel, folder)
