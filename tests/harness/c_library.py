"""A model's C library in this process, by ctypes."""

import ctypes
import re

import numpy as np

import fourbar_codegen as fb
from harness.programs import compile_c

STRICT = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror")


class Library:
    """Export, compile and load a model; `new` makes mechanisms, functions have the names of the header."""

    def __init__(self, model, folder, compiler="gcc"):
        self.name = model.name
        self.folder = fb.export_c(model, folder)
        shared = folder / f"lib{self.name}.so"
        sources = [folder / f"{self.name}.c", folder / f"{self.name}_derivatives.c"]
        compile_c((compiler, *STRICT, "-fPIC", "-shared", "-lm"), sources, shared, include=[folder / "runtime"])
        header = (folder / f"{self.name}.h").read_text()
        self.sizes = {name: int(n) for name, n in re.findall(rf"    {self.name}_n_(\w+) = (\d+)", header)}
        n, double = self.sizes, ctypes.c_double

        class Mechanism(ctypes.Structure):
            _fields_ = [
                ("t", double),
                ("x", double * n["x"]),
                ("p", double * max(n["p"], 1)),
                ("r", double * max(n["r"], 1)),
                ("slope", double * max(n["r"], 1)),
                ("since", double),
                ("held", ctypes.c_int * max(n["r"], 1)),
                ("method", ctypes.c_int),
                ("memory", double * (int(re.search(r"bytes\[(\d+)\]", header)[1]) // 8)),
            ]

        self.Mechanism, self.loaded = Mechanism, ctypes.CDLL(str(shared))
        self.function("message").restype = ctypes.c_char_p
        for name in ("violation", "relative_violation", "input", "next_breakpoint"):
            self.function(name).restype = double
        self.function("update").restype = ctypes.c_int

    def function(self, name):
        return getattr(self.loaded, f"{self.name}_{name}")

    def new(self):
        """A mechanism with its defaults."""
        mechanism = self.Mechanism()
        self.call("init", mechanism)
        return mechanism

    def call(self, name, mechanism, *arguments):
        converted = []
        for argument in arguments:
            if isinstance(argument, np.ndarray):
                converted.append(argument.ctypes.data_as(ctypes.c_void_p))
            else:
                converted.append(ctypes.c_double(argument) if isinstance(argument, float) else argument)
        return self.function(name)(ctypes.byref(mechanism), *converted)

    def message(self, status):
        return self.function("message")(status).decode()
