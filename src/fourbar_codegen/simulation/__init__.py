"""Simulation: integration methods, events, discontinuities, singular positions, ensembles."""
