"""Functions of a shared library of C, called with NumPy arrays and numbers."""

import ctypes

import numpy as np


class Shims:
    """Each function of the library as an attribute; arrays are passed as they are, and overwritten in place.

    Functions return an int, or with ``returns=`` another type of ctypes.
    """

    def __init__(self, path):
        self._library = ctypes.CDLL(str(path))

    def __getattr__(self, name):
        function = getattr(self._library, name)

        def call(*arguments, returns=ctypes.c_int):
            function.restype = returns
            return function(*map(_converted, arguments))

        return call


def _converted(argument):
    if isinstance(argument, np.ndarray):
        assert argument.flags.c_contiguous
        assert argument.dtype in (np.float64, np.intc)
        return argument.ctypes.data_as(ctypes.c_void_p)
    return ctypes.c_double(argument) if isinstance(argument, float) else argument
