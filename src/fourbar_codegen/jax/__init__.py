"""Compiled models as functions of JAX."""
