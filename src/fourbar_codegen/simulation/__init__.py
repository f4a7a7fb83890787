"""Motions: runs of all methods, events, jumps, singular positions, ensembles."""
