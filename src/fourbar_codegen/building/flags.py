"""The flags of C compilers that take gcc's options. setup.py runs this file, too."""

import os
import platform

__all__ = [
    "COMMON_FLAGS", "DERIVATIVES_FLAGS", "KERNEL_FLAGS", "STRICT_FLAGS", "STRICT_LINK_FLAGS", "UNITS", "VERSIONS",
    "WRAPPER_FLAGS",
]  # fmt: skip

# Without debugging information, which would double the file. On Windows, compilers refuse -fPIC, since all code is
# position-independent.
COMMON_FLAGS = ("-g0",) if os.name == "nt" else ("-fPIC", "-g0")
# Scalar straight-line code stores results that vectorized loops would reload two at a time, which stalls the
# processor: -fno-tree-vectorize saves 10 % of the four-bar's evaluation. Short loops of the solve, and those over
# batches of states, need to be unrolled, which -O2 does not do. The rest of -O3 takes a third of the compilation
# time, without a gain.
KERNEL_FLAGS = (*COMMON_FLAGS, "-O2", "-fpeel-loops", "-fno-tree-vectorize")
# Beyond -O1, compilation takes 50 % longer, and saves a few per cent in long straight-line code.
DERIVATIVES_FLAGS = (*COMMON_FLAGS, "-O1")
# After the user's flags, since kernels and integrators have to detect NaN.
STRICT_FLAGS = ("-fno-fast-math", "-fno-finite-math-only", "-fno-unsafe-math-optimizations")
# With fast-math flags, compilers also link code that flushes denormal numbers to zero in the whole process that loads
# it. -O2 overrides -Ofast, which is one of these flags.
STRICT_LINK_FLAGS = ("-O2", *STRICT_FLAGS)
# Versions of a kernel for instruction sets. When a module is loaded, the fastest that the processor can run is chosen.
# Other processor-specific flags made no measurable difference.
_X86 = platform.machine() in {"x86_64", "AMD64"}
_AVX2 = ("-mavx2", "-mfma") if _X86 else ()
_AVX512 = (*_AVX2, "-mavx512f", "-mavx512dq", "-mavx512vl") if _X86 else ()
VERSIONS = {"_avx2": _AVX2, "_avx512": _AVX512}
_IN_VERSIONS = {"_kernel": KERNEL_FLAGS, "_batch": KERNEL_FLAGS, "_products": DERIVATIVES_FLAGS}
UNITS = {
    **{f"{p}{v}.c": (*flags, *more) for p, flags in _IN_VERSIONS.items() for v, more in {"": (), **VERSIONS}.items()},
    "_derivatives.c": DERIVATIVES_FLAGS,
}
"""The sources of an extension module besides its wrapper, by the suffixes of their names, and their flags."""
# The wrapper only passes pointers on, so short compilation counts.
WRAPPER_FLAGS = (*COMMON_FLAGS, "-O1", "-DNPY_NO_DEPRECATED_API=NPY_1_7_API_VERSION")
