"""Equations -> Program -> Schedule: what is evaluated, with how few operations, and in which order."""
