"""The same physics and mathematics by other methods, in plain NumPy and SciPy."""
