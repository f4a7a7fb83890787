"""Equations -> Program -> Schedule: what is evaluated, with few operations, and in which order."""
