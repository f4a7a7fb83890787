"""Loaded models, their evaluation and its arguments."""
