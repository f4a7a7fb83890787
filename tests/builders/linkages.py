"""Linkages that SymPy's joints do not make."""

import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb


def inverted_slider_crank(carrier):
    """A crank drives a block along a lever, or a rod through a block that turns about the ground's point B."""
    q1, q2, s, u1, u2, v = me.dynamicsymbols("q1 q2 s u1 u2 v")
    ground, crank, lever = map(me.ReferenceFrame, "NAB")
    origin, pivot, end, top, block = map(me.Point, ("O", "B", "E", "T", "P"))
    crank.orient_axis(ground, ground.z, q1)
    lever.orient_axis(ground, ground.z, q2)
    origin.set_vel(ground, 0)
    pivot.set_pos(origin, -0.5 * ground.y)
    end.set_pos(origin, 0.2 * crank.x)
    if carrier == "lever":
        top.set_pos(pivot, 1.2 * lever.x)
        block.set_pos(pivot, s * lever.x)
        centre = pivot.locatenew("C", 0.6 * lever.x)
    else:  # the rod's points follow from the one in the block
        block.set_pos(pivot, s * lever.x)
        top.set_pos(block, -1.2 * lever.x)
        centre = block.locatenew("C", -0.6 * lever.x)
    system = System(ground, origin)
    crank_centre = origin.locatenew("D", 0.1 * crank.x)
    system.add_bodies(
        me.RigidBody("crank", crank_centre, crank, 1, (me.inertia(crank, 0, 0, 0.1), crank_centre)),
        me.RigidBody("bar", centre, lever, 1, (me.inertia(lever, 0, 0, 0.1), centre)),
    )
    gap = end.pos_from(block)
    system.add_holonomic_constraints(gap.dot(ground.x), gap.dot(ground.y))
    system.q_ind, system.q_dep = [q1], [q2, s]
    system.u_ind, system.u_dep = [u1], [u2, v]
    system.add_kdes(u1 - q1.diff(), u2 - q2.diff(), v - s.diff())
    return fb.Model(system, name=f"sliding_{carrier}", initial={q1: 0.3, q2: 1.4, s: 0.6, u1: 5.0})
