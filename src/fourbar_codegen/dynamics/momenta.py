"""Linear and angular momentum of a mechanism.

Source: T. R. Kane and D. A. Levinson, *Dynamics: Theory and Applications*, 1985, section 3.5 (angular momentum); H.
Goldstein, *Classical Mechanics*, 2nd ed. 1980, section 1.2 (about the mass centre).
"""

from __future__ import annotations

from fourbar_codegen.dynamics.equations import vector
from fourbar_codegen.dynamics.kane import Kane
from fourbar_codegen.dynamics.kinematics import INERTIAL, Components, add, cross, negative, scale
from fourbar_codegen.dynamics.picture import Picture
from fourbar_codegen.expressions.tape import Result

__all__ = ["form_momenta"]


def form_momenta(kane: Kane, picture: Picture) -> tuple[Result, Result, Result]:
    """The momenta of the bodies that move, in the inertial frame.

    Parameters
    ----------
    kane : Kane
    picture : Picture
        With the positions of mass centres.

    Returns
    -------
    tuple of Result
        p = sum m v_C; L_O = sum (r_C x m v_C + I_C w) about the fixed point; L_C = L_O - r x p about the mass centre
        r = sum m r_C / sum m. L_O and L_C are NaN if the position of a mass centre is not known.
    """
    kinematics, tape = kane.kinematics, kane.tape
    places = {point.number: place for place, point in enumerate(picture.points) if point.number is not None}
    linear, angular, moments = kinematics.zero, kinematics.zero, kinematics.zero
    total, is_known = tape.zero, True
    for body, mass, spin in kane.bodies():
        velocity = kinematics.express(kinematics.velocity(body.point), INERTIAL)
        own = kinematics.express(spin, INERTIAL)
        if not any((*velocity, *own)):  # fixed to the ground
            continue
        momentum = scale(mass, velocity)
        linear, angular, total = add(linear, momentum), add(angular, own), total + mass
        if body.point in places:
            position = picture.positions[places[body.point]]
            angular, moments = add(angular, cross(position, momentum)), add(moments, scale(mass, position))
        else:
            is_known = False
    nan: Components = (tape.number(float("nan")),) * 3
    about_centre = nan
    if is_known and total:
        about_centre = add(angular, negative(cross(scale(tape.one / total, moments), linear)))
    about_origin = angular if is_known else nan
    return vector("momentum", linear), vector("angular_momentum", about_origin), vector("spin", about_centre)
