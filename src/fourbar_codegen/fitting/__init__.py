"""Parameters by least squares."""
