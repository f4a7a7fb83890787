"""Mechanism -> Equations: kinematics, Kane's method, constraints and their derivatives."""
