"""Linear and angular momentum of a mechanism.

Source: T. R. Kane and D. A. Levinson, *Dynamics: Theory and Applications*, 1985, section 3.5 (angular momentum); H.
Goldstein, *Classical Mechanics*, 2nd ed. 1980, section 1.2 (about the mass centre).
"""

from __future__ import annotations

from fourbar_codegen.dynamics.drawn_positions import DrawnPositions
from fourbar_codegen.dynamics.equations import Variables, of_known, vector
from fourbar_codegen.dynamics.kane import Kane
from fourbar_codegen.dynamics.kinematics import INERTIAL, Components, add, cross, negative, scale
from fourbar_codegen.expressions.tape import Result

__all__ = ["form_momenta"]


def form_momenta(kane: Kane, picture: DrawnPositions, variables: Variables) -> tuple[Result, Result, Result]:
    """The momenta of the bodies that move, in the inertial frame.

    Parameters
    ----------
    kane : Kane
    picture : DrawnPositions
        With the positions of mass centres.
    variables : Variables

    Returns
    -------
    tuple of Result
        p = sum m v_C; L_O = sum (r_C x m v_C + I_C w) about the fixed point; L_C = L_O - r x p about the mass centre
        r = sum m r_C / sum m. L_O and L_C are NaN if the position of a mass centre is not known, L_O also if it is
        known relative to another point than the System's fixed one, or to one that moves, such as a wheel's contact
        point; and so are components that contain other parameters or inputs than `variables`: nobody has asked for
        values of these.
    """
    kinematics, tape = kane.kinematics, kane.tape
    places = {point.number: place for place, point in enumerate(picture.points) if point.number is not None}
    linear, angular, moments = kinematics.zero, kinematics.zero, kinematics.zero
    total, is_known = tape.zero, True
    for body, mass, of_body in kane.bodies():
        velocity = kinematics.express(kinematics.velocity(body.point), INERTIAL)
        own = kinematics.express(of_body, INERTIAL)
        if not any((*velocity, *own)):  # fixed to the ground
            continue
        momentum = scale(mass, velocity)
        linear, angular, total = add(linear, momentum), add(angular, own), total + mass
        if body.point in places:
            position = picture.positions[places[body.point]]
            angular, moments = add(angular, cross(position, momentum)), add(moments, scale(mass, position))
        elif mass:
            is_known = False
    nan: Components = (tape.number(float("nan")),) * 3
    about_centre = nan
    if is_known and total:
        about_centre = add(angular, negative(cross(scale(tape.one / total, moments), linear)))
    is_fixed = picture.is_at_rest and kinematics.mechanism.is_origin_fixed is not False
    about_origin = angular if is_known and is_fixed else nan
    vectors = {"momentum": linear, "angular_momentum": about_origin, "spin": about_centre}
    p, about_fixed_point, about_mass_centre = (
        vector(name, of_known(variables, entries)) for name, entries in vectors.items()
    )
    return p, about_fixed_point, about_mass_centre
