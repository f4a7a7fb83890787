"""Live pages: a model in a browser."""
