"""Positions: closed loops, initial states, assembly modes, linearization, equilibrium."""
