"""NumPy's archives."""

import numpy as np


def arrays_of(path):
    """The arrays of a file, which is closed."""
    with np.load(path) as file:
        return {**file}
