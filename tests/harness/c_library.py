"""A model's C library in this process, by ctypes."""

import ctypes
import re

import numpy as np

import fourbar_codegen as fb
from fourbar_codegen.runtime.enumerations import EXPLICIT, STIFF
from harness.programs import compile_c

STRICT = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror")

FUNCTION = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_void_p, ctypes.c_double, ctypes.POINTER(ctypes.c_double))


class Library:
    """Export, compile and load a model; `new` makes mechanisms, functions have the names of the header."""

    def __init__(self, model, folder, compiler="gcc"):
        self.name = model.name
        self.folder = fb.export_c(model, folder)
        shared = folder / f"lib{self.name}.so"
        sources = [folder / f"{self.name}{part}.c" for part in ("", "_derivatives", "_stiff")]
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

        class Event(ctypes.Structure):
            _fields_ = [
                ("quantity", ctypes.c_int),
                ("number", ctypes.c_int),
                ("direction", ctypes.c_int),
                ("ends_only", ctypes.c_int),
                ("at_start", ctypes.c_int),
                ("terminal", ctypes.c_long),
                ("function", FUNCTION),
                ("of", ctypes.c_void_p),
            ]

        class Found(ctypes.Structure):
            _fields_ = [("event", ctypes.c_int), ("t", double), ("x", double * n["x"])]

        class Events(ctypes.Structure):
            _fields_ = [
                ("n", ctypes.c_int),
                ("event", ctypes.POINTER(Event)),
                ("work", ctypes.POINTER(double)),
                ("found", ctypes.POINTER(Found)),
                ("room", ctypes.c_long),
                ("n_found", ctypes.c_long),
                ("ended_by", ctypes.c_int),
            ]

        self.Event, self.Found, self.Events = Event, Found, Events
        self.event_work = int(re.search(rf"{self.name}_event_work = (\d+)", header)[1])
        self.stiff_work = int(re.search(rf"{self.name}_stiff_work = (\d+)", header)[1])
        self.Mechanism, self.loaded = Mechanism, ctypes.CDLL(str(shared))
        self.function("message").restype = ctypes.c_char_p
        for name in ("violation", "relative_violation", "input", "next_breakpoint", "touched"):
            self.function(name).restype = double
        self.function("update").restype = ctypes.c_int

    def function(self, name):
        return getattr(self.loaded, f"{self.name}_{name}")

    def new(self):
        """A mechanism with its defaults."""
        mechanism = self.Mechanism()
        self.call("init", mechanism)
        return mechanism

    def events(self, *given, room=100):
        """Events for `simulate_events`, each a dictionary of members."""
        n = len(given)
        kept = (
            (self.Event * n)(*(self.Event(**members) for members in given)),
            (ctypes.c_double * (self.event_work * n))(),
            (self.Found * room)(),
        )
        return self.Events(n, *kept, room)

    def call(self, name, mechanism, *arguments):
        converted = []
        for argument in arguments:
            if isinstance(argument, np.ndarray):
                converted.append(argument.ctypes.data_as(ctypes.c_void_p))
            else:
                converted.append(ctypes.c_double(argument) if isinstance(argument, float) else argument)
        return self.function(name)(ctypes.byref(mechanism), *converted)

    def simulate(self, mechanism, method, end, tolerance, times, states, events=None):
        """A run by any method."""
        arguments = (end, tolerance, tolerance, times, len(times), states, events and ctypes.byref(events))
        if method == STIFF:
            return self.call("simulate_stiff", mechanism, *arguments, (ctypes.c_double * self.stiff_work)())
        mechanism.method = EXPLICIT.index(method)
        return self.call("simulate_events", mechanism, *arguments)

    def message(self, status):
        return self.function("message")(status).decode()
