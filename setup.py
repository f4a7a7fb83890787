"""Extension modules; all metadata is in pyproject.toml.

The runtime, and every model whose generated sources are in generated/. It generates no models itself.
"""

import os
import platform
import runpy
import sys
from pathlib import Path
from threading import Lock

import numpy as np
from Cython.Build import cythonize
from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

RUNTIME = "src/fourbar_codegen/runtime"
MACROS = [("NPY_NO_DEPRECATED_API", "NPY_1_7_API_VERSION")]
FLAGS = runpy.run_path("src/fourbar_codegen/building/flags.py")
STRICT = FLAGS["STRICT_FLAGS"]
LINK = [*FLAGS["STRICT_LINK_FLAGS"], *(["-Wl,-Bsymbolic"] if sys.platform.startswith(("linux", "freebsd")) else [])]
# What -O3 has more takes a third of the compilation time, without a gain for the README's rows.
WRAPPED = ["-O2", "-fvect-cost-model=dynamic", "-fpeel-loops", "-funswitch-loops", "-fsplit-paths", "-g0", *STRICT]
KERNEL = [*FLAGS["KERNEL_FLAGS"], *STRICT]
# Microsoft's: versions for more instructions are empty there.
MICROSOFT = ["/O2", "/fp:precise", "/std:c11"]


def extension(name: str, sources: list[Path | str], folder: Path | str) -> Extension:
    return Extension(
        f"fourbar_codegen.{name}",
        [str(source) for source in sources],
        include_dirs=[str(folder), RUNTIME, np.get_include()],
        depends=[str(path) for kind in ("h", "inc", "pxd") for path in sorted(Path(RUNTIME).rglob(f"*.{kind}"))],
        define_macros=MACROS,
    )


def is_model(ext: Extension) -> bool:
    return ext.name.startswith("fourbar_codegen.prebuilt.")


class BuildExtension(build_ext):
    """Flags by the kind of compiler and source, which an Extension alone cannot have."""

    # One Extension is translated while C compilers work on others; Cython is not made for threads.
    translating = Lock()

    def finalize_options(self) -> None:
        """Compile on all cores, which an option of `setup` would not reach in editable installations."""
        super().finalize_options()
        self.parallel = self.parallel or os.cpu_count()

    def build_extension(self, ext: Extension) -> None:
        """Build one, by setuptools."""
        with self.translating:
            [translated] = cythonize([ext], build_dir="build/cython", include_path=["src"], force=self.force)
        ext.sources = translated.sources
        if self.compiler.compiler_type == "msvc":
            ext.extra_compile_args = MICROSOFT
        else:
            ext.extra_compile_args, ext.extra_link_args = KERNEL if is_model(ext) else WRAPPED, LINK
            # macOS builds may be for two kinds of processors at once.
            if platform.machine() in {"x86_64", "AMD64"} and sys.platform != "darwin":
                for version, flags in FLAGS["VERSIONS"].items():
                    self.compile_version(ext, f"{version}.c", list(flags))
        super().build_extension(ext)
        if is_model(ext):
            self.copy_sources(Path(self.get_ext_fullpath(ext.name)).parent)

    def copy_extensions_to_source(self) -> None:
        """For editable installations, by setuptools."""
        super().copy_extensions_to_source()
        self.copy_sources(Path(self.get_finalized_command("build_py").get_package_dir("fourbar_codegen.prebuilt")))

    def copy_sources(self, folder: Path) -> None:
        """Copy what live pages are compiled from, when they are made."""
        # Those of the part "derivatives" and the kernel in building/kernel_library.py.
        for wrapper in Path("generated").glob("*/*.pyx"):
            place = folder / f"{wrapper.stem}_sources"
            self.mkpath(str(place))
            for suffix in ("_kernel.c", "_kernel.h", "_derivatives.c"):
                self.copy_file(str(wrapper.with_name(f"{wrapper.stem}{suffix}")), str(place))

    def compile_version(self, ext: Extension, suffix: str, flags: list[str]) -> None:
        """Compile the sources of a version apart from the others."""
        sources = [source for source in ext.sources if source.endswith(suffix)]
        ext.sources = [source for source in ext.sources if source not in sources]
        ext.extra_objects += self.compiler.compile(
            sources,
            output_dir=self.build_temp,
            macros=ext.define_macros,
            include_dirs=ext.include_dirs,
            extra_postargs=[*ext.extra_compile_args, *flags],
            depends=[*ext.depends, *ext.sources],
        )


# A header that changes only with its text, so that nothing is compiled anew without need.
enums, text = (
    Path(RUNTIME, "fourbar_enums.h"),
    runpy.run_path("src/fourbar_codegen/runtime/enumerations.py")["enums_text"](),
)
if not enums.exists() or enums.read_text(encoding="utf-8") != text:
    enums.write_text(text, encoding="utf-8")

runtime = [extension(f"runtime.{wrapper.stem}", [wrapper], RUNTIME) for wrapper in sorted(Path(RUNTIME).glob("*.pyx"))]
models = [
    extension(f"prebuilt.{wrapper.stem}", [wrapper, *sorted(wrapper.parent.glob("*.c"))], wrapper.parent)
    for wrapper in sorted(Path("generated").glob("*/*.pyx"))
]


def size(ext: Extension) -> int:
    return sum(Path(source).stat().st_size for source in ext.sources)


setup(
    ext_modules=sorted([*runtime, *models], key=size, reverse=True),  # what takes longest comes first
    cmdclass={"build_ext": BuildExtension},
)
