"""Extension modules; all metadata is in pyproject.toml.

The runtime, and every model whose generated sources are in generated/. It generates nothing itself.
"""

import os
from pathlib import Path

import numpy as np
from Cython.Build import cythonize
from setuptools import Extension, setup

RUNTIME = "src/fourbar_codegen/runtime"
# Behind the user's flags, as in toolchain.py: what is not a number has to be noticed, and roundings are part of the
# method.
STRICT_FLAGS = ["-fno-fast-math", "-fno-finite-math-only", "-fno-unsafe-math-optimizations"]
MACROS = [("NPY_NO_DEPRECATED_API", "NPY_1_7_API_VERSION")]


def extension(name: str, sources: list[Path | str], folder: Path | str, *flags: str) -> Extension:
    return Extension(
        f"fourbar_codegen.{name}",
        [str(source) for source in sources],
        include_dirs=[str(folder), RUNTIME, np.get_include()],
        depends=[str(path) for path in sorted(Path(RUNTIME).glob("*.h")) + sorted(Path(RUNTIME).glob("*.pxd"))],
        define_macros=MACROS,
        extra_compile_args=["-O3", *flags, "-g0", *STRICT_FLAGS],
        extra_link_args=["-O2", *STRICT_FLAGS],
    )


runtime = [extension(f"runtime.{wrapper.stem}", [wrapper], RUNTIME) for wrapper in sorted(Path(RUNTIME).glob("*.pyx"))]
models = [
    # The flags of toolchain.py.
    extension(
        f"prebuilt.{wrapper.stem}",
        [wrapper, *sorted(wrapper.parent.glob("*.c"))],
        wrapper.parent,
        "-O2",
        "-fpeel-loops",
        "-fno-tree-vectorize",
    )
    for wrapper in sorted(Path("generated").glob("*/*.pyx"))
]

setup(
    ext_modules=cythonize(
        [*runtime, *models],
        build_dir="build/cython",
        include_path=["src"],
    ),
    options={"build_ext": {"parallel": os.cpu_count()}},
)
