"""Assembly modes, against circles that are cut with circles and lines, and against SciPy's search in SymPy's terms."""

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor

import mpmath
import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.systems import masses_on_a_line, spatial_four_bar
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb
from fourbar_codegen.analysis.polynomials import Constraints
from fourbar_codegen.expressions.convert import Conversion
from fourbar_codegen.expressions.formulas import formulas
from fourbar_codegen.expressions.tape import Tape


def circles(center, radius, other, another):
    """The points at given distances from two others."""
    across = other - center
    distance = np.hypot(*across)
    along = (distance**2 + radius**2 - another**2) / (2 * distance)
    if abs(along) > radius:
        return []
    foot = center + along * across / distance
    normal = np.sqrt(radius**2 - along**2) * np.array([-across[1], across[0]]) / distance
    return [foot + normal, foot - normal]


def linkage(loops, absolute=False):
    """Four-bar linkages in a row: the rocker of each turns the crank of the next. All lengths are parameters."""
    frame, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(frame, 0)
    system = System(frame, origin)
    n = 1 + 2 * loops
    q, u = me.dynamicsymbols(f"q:{n}"), me.dynamicsymbols(f"u:{n}")
    lengths = sm.symbols(f"a:{4 * loops}")
    mass = sm.Symbol("m")

    def bar(base, angle, rate, length, name):
        turned = me.ReferenceFrame(name)
        turned.orient_axis(frame, frame.z, angle)
        turned.set_ang_vel(frame, rate * frame.z)
        end = base.locatenew(f"{name}_end", length * turned.x)
        end.v2pt_theory(base, frame, turned)
        system.add_bodies(me.Particle(name, end, mass))
        return end

    pivot, crank = origin, 0
    for k in range(loops):
        ground, l_crank, coupler, rocker = lengths[4 * k : 4 * k + 4]
        i, j = 1 + 2 * k, 2 + 2 * k
        top = bar(pivot, q[crank], u[crank], l_crank, f"crank{k}")
        angle, rate = (q[i], u[i]) if absolute else (q[crank] + q[i], u[crank] + u[i])
        top = bar(top, angle, rate, coupler, f"coupler{k}")
        next_pivot = pivot.locatenew(f"P{k}", ground * frame.x)
        next_pivot.set_vel(frame, 0)
        other = bar(next_pivot, q[j], u[j], rocker, f"rocker{k}")
        gap = top.pos_from(other)
        system.add_holonomic_constraints(gap.dot(frame.x), gap.dot(frame.y))
        pivot, crank = next_pivot, j
    system.q_ind, system.q_dep = q[:1], q[1:]
    system.u_ind, system.u_dep = u[:1], u[1:]
    system.add_kdes(*(rate - angle.diff() for angle, rate in zip(q, u, strict=True)))
    name = f"linkage{loops}{'_absolute' if absolute else ''}"
    return fb.compile_model(fb.Model(system, name=name, parameters={mass: 1.0}))


def rockers(lengths, angle):
    """The rockers' angles in all modes, by cutting circles, one loop after another."""
    if not len(lengths):
        return [()]
    ground, crank, coupler, rocker = lengths[:4]
    top = crank * np.array([np.cos(angle), np.sin(angle)])
    pivot = np.array([ground, 0.0])
    found = [np.arctan2(*(end - pivot)[::-1]) for end in circles(top, coupler, pivot, rocker)]
    return [(one, *others) for one in found for others in rockers(lengths[4:], one)]


@pytest.mark.slow
@pytest.mark.parametrize(("loops", "absolute"), [(1, True), (2, False), (3, False)])
def test_assembly_modes_of_four_bars_in_a_row_equal_intersections_of_circles(loops, absolute):
    """Each loop has two modes for each of those before it, or none: as many, and the same, as circles have points."""
    model = linkage(loops, absolute)
    generator = np.random.default_rng(loops)
    numbers = set()
    for _ in range(32 // loops**2):
        lengths = generator.uniform(0.3, 1.0, 4 * loops)
        angle = generator.uniform(-np.pi, np.pi)
        parameters = {f"a{number}": length for number, length in enumerate(lengths)}
        modes = model.initial_states([angle], [1.0], parameters=parameters)
        expected = sorted(rockers(lengths, angle))
        assert modes.is_complete
        assert len(modes) == len(expected)
        numbers.add(len(expected))
        got = sorted(tuple(mode[2 : model.n_q : 2]) for mode in modes)
        # The condition of a root is that of the dyad's own angle: a digit or three of 16 near a dead point.
        np.testing.assert_allclose(np.exp(1j * np.array(got)), np.exp(1j * np.array(expected)), atol=1e-9)
        for mode in modes:
            assert np.abs(model.velocity_constraints(0.0, mode, parameters)).max() < 1e-9
    assert {0, 2**loops} <= numbers  # some cannot be closed, some have all modes


@pytest.mark.slow
def test_assembly_modes_of_a_slider_crank_at_any_size_equal_pythagoras():
    """x = r cos a +- sqrt(l^2 - (r sin a)^2); none where the rod is too short."""
    model = fb.compile_model(fb.models.slider_crank())
    for scale in (1e-3, 1.0, 1e4):
        r, length = 0.2 * scale, 0.15 * scale
        for angle in np.linspace(-3.0, 3.0, 25):
            modes = model.initial_states([angle], [1.0], parameters={"r": r, "l": length})
            inside = length**2 - (r * np.sin(angle)) ** 2
            expected = r * np.cos(angle) + np.sqrt(inside) * np.array([-1.0, 1.0]) if inside > 0 else []
            assert modes.is_complete
            assert len(modes) == len(expected)
            np.testing.assert_allclose(sorted(x[2] for x in modes), expected, rtol=0, atol=1e-13 * scale)


def test_assembly_modes_at_a_dead_point_are_one_with_two_or_none_beside_it(four_bar):
    """Coupler and rocker in one line: one mode instead of two, and none beyond."""
    # cos q1 from the triangle of ground, crank, and coupler and rocker together: no such triangle is flatter.
    ground, crank, reach = 0.8, 1.0, 0.9 + 0.3
    angle = np.arccos((ground**2 + crank**2 - reach**2) / (2 * ground * crank))
    lengths = {"l1": ground, "l2": crank, "l3": 0.9, "l4": 0.3}
    # Link 2 leaves the ground's end, so that its angle is pi - that of the triangle.
    at = [len(four_bar.initial_states([np.pi - angle + d], [0.0], parameters=lengths)) for d in (-1e-3, 0.0, 1e-3)]
    assert at in ([0, 1, 2], [2, 1, 0])


def test_assembly_mode_at_a_dead_point_has_dependent_speeds_of_nan(four_bar):
    """At a dead point no speeds of the others follow from the crank's: the mode is there, its speeds are NaN."""
    angle = np.pi - np.arccos((0.8**2 + 1.0**2 - 1.2**2) / (2 * 0.8))
    lengths = {"l1": 0.8, "l2": 1.0, "l3": 0.9, "l4": 0.3}
    [mode] = four_bar.initial_states([angle], [1.0], parameters=lengths)
    assert np.isfinite(mode[:4]).all()
    assert np.isnan(mode[4:]).all()


def test_assembly_modes_of_the_tutorials_linkage_are_its_own_and_the_mirror_image(four_bar):
    """The first mode is the tutorial's; the second is its mirror image about the line between the outer joints."""
    modes = four_bar.initial_states({"q1": -0.5}, {"u1": -0.1})
    assert repr(modes) == "<AssemblyModes of four_bar: 2, and no others>"
    np.testing.assert_allclose(modes[0][:3], [-0.5, -2.24641553739307, -1.49782726919522], atol=1e-13)
    assert modes[1][2] == pytest.approx(-modes[0][2], abs=1e-13)
    assert four_bar.initial_states(parameters={"l1": 3.0}).x.shape == (0, 6)
    assert "cannot be closed" in repr(four_bar.initial_states(parameters={"l1": 3.0}))
    runs = [four_bar.simulate((0.0, 0.5), mode) for mode in modes]
    assert all(run.success for run in runs)
    assert np.sign(runs[0]["q3"]).max() < 0 < np.sign(runs[1]["q3"]).min()  # each stays in its mode


def test_assembly_modes_of_constraints_with_angle_sums_and_squares_are_all_found():
    """Two constraints that hold both unknowns in harmonics of sums and in squares: an angle and a displacement."""
    frame, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(frame, 0)
    q = a, b, s = me.dynamicsymbols("a b s")
    u = me.dynamicsymbols("u:3")
    c = sm.Symbol("c")
    point.set_pos(origin, s * frame.x)
    point.set_vel(frame, u[2] * frame.x)
    system = System(frame, origin)
    system.add_bodies(me.Particle("P", point, 1))
    for name, angle, rate in (("A", a, u[0]), ("B", b, u[1])):
        turned, center = me.ReferenceFrame(name), me.Point(name)
        turned.orient_axis(frame, frame.z, angle)
        turned.set_ang_vel(frame, rate * frame.z)
        center.set_pos(origin, 0)
        center.set_vel(frame, 0)
        system.add_bodies(me.RigidBody(name, center, turned, 1, (me.inertia(turned, 1, 1, 1), center)))
    first, second = sm.sin(2 * b + a) + s**2 - c, sm.cos(b) * s - sm.Rational(1, 5)
    system.add_holonomic_constraints(first, second)
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = [a], [b, s], [u[0]], [*u[1:]]
    system.add_kdes(*(rate - coordinate.diff() for coordinate, rate in zip(q, u, strict=True)))
    model = fb.compile_model(fb.Model(system, name="sums", parameters={c: 0.5}))
    modes = model.initial_states([0.3], [1.0])
    assert modes.is_complete
    # s = 0.2 / cos b leaves one equation in b, whose zeros are counted by its signs.
    angles = np.linspace(-np.pi, np.pi, 200_001)
    values = np.cos(angles) ** 2 * (np.sin(2 * angles + 0.3) - 0.5) + 0.04
    zeros = angles[:-1][np.diff(np.sign(values)) != 0]
    assert len(modes) == len(zeros) > 2
    np.testing.assert_allclose(modes.x[:, 1], zeros, atol=2 * np.pi / 200_000)
    np.testing.assert_allclose(modes.x[:, 2], 0.2 / np.cos(modes.x[:, 1]), rtol=1e-9)


def test_assembly_modes_of_a_folded_rhombus_name_the_coordinates_left_free():
    """The crank's end lies on the other pivot, and the other two bars turn freely about it."""
    model = linkage(1, absolute=True)
    assert len(model.initial_states([1.0], [0.0], parameters=[1.0] * 5)) == 2
    for turn in (0.0, 1e-15):  # less than rounding errors of the lengths
        folded = model.initial_states([turn], [0.0], parameters=[1.0] * 5)
        assert not folded.is_complete
        assert folded.free == ("q1", "q2")
        assert "of infinitely many; a degree of freedom is left: q1, q2 move while q0 is held" in repr(folded)
        np.testing.assert_allclose(np.cos(folded.x[:, 1]), np.cos(folded.x[:, 2]), atol=1e-13)
        assert np.isnan(folded.x[:, 4:6]).all()


@pytest.mark.slow
def test_assembly_modes_of_a_spatial_four_bar_equal_the_planar_ones():
    """Five spatial rows of which two are independent: the first pairs that do not determine the unknowns are left."""
    modes = fb.compile_model(spatial_four_bar()).initial_states(speeds=[0.0])
    assert modes.is_complete
    np.testing.assert_allclose(modes.x[:, 2], [-1.49782726919522, 1.49782726919522], atol=1e-9)  # the tutorial's


LEGS = (((0.0, 0.0), (0.0, 0.0)), ((1.9, 0.0), (1.1, 0.0)), ((2.8, 1.0), (0.9, 2.0)))
LENGTHS = (2.4, 1.4, 2.0)


def platform(legs=LEGS, lengths=LENGTHS):
    """A triangle on three legs whose lengths are given, in a plane: a triad, which is not made of dyads."""
    frame, origin, corner, body = me.ReferenceFrame("N"), me.Point("O"), me.Point("B1"), me.ReferenceFrame("B")
    origin.set_vel(frame, 0)
    q = leg, x, y, phi = me.dynamicsymbols("leg x y phi")
    u = me.dynamicsymbols("u:4")
    body.orient_axis(frame, frame.z, phi)
    body.set_ang_vel(frame, u[3] * frame.z)
    corner.set_pos(origin, x * frame.x + y * frame.y)
    corner.set_vel(frame, u[1] * frame.x + u[2] * frame.y)
    slider = origin.locatenew("S", leg * frame.z)
    slider.set_vel(frame, u[0] * frame.z)
    system = System(frame, origin)
    system.add_bodies(me.RigidBody("platform", corner, body, 1, (me.inertia(body, 1, 1, 1), corner)))
    system.add_bodies(me.Particle("leg", slider, 1))
    for (foot, place), length in zip(legs, (leg, *lengths[1:]), strict=True):
        gap = corner.pos_from(origin) + place[0] * body.x + place[1] * body.y - foot[0] * frame.x - foot[1] * frame.y
        system.add_holonomic_constraints(gap.dot(gap) - length**2)
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = [leg], q[1:], [u[0]], u[1:]
    system.add_kdes(*(rate - coordinate.diff() for coordinate, rate in zip(q, u, strict=True)))
    return fb.compile_model(fb.Model(system, name="platform"))


def test_assembly_modes_of_a_platform_equal_those_by_its_coupler_curve():
    """As many as the third leg's gap has zeros along the coupler curve of the first two; said to be a lower bound.

    These legs have six, the most there are: C. Gosselin and J.-P. Merlet, "The direct kinematics of planar parallel
    manipulators: special architectures and number of solutions", Mechanism and Machine Theory 29 (1994).
    """
    modes = platform().initial_states([LENGTHS[0]], [0.0])
    assert not modes.is_complete
    assert f"at least {len(modes)}" in repr(modes)
    (_, (foot_2, base)), (_, (foot_3, place)) = enumerate(LEGS[1:])
    turns = np.linspace(0.0, 2 * np.pi, 20_001)
    corners = LENGTHS[0] * np.array([np.cos(turns), np.sin(turns)])
    across = np.array(foot_2)[:, None] - corners
    distance = np.hypot(*across)
    along = (distance**2 + base[0] ** 2 - LENGTHS[1] ** 2) / (2 * distance)
    with np.errstate(invalid="ignore"):
        opening = np.arccos(along / base[0])
    number = 0
    for sign in (-1.0, 1.0):
        phi = np.arctan2(across[1], across[0]) + sign * opening
        turned = np.array([[np.cos(phi), -np.sin(phi)], [np.sin(phi), np.cos(phi)]])
        end = corners + np.tensordot(place, turned, axes=(0, 1))
        gap = np.hypot(*(end - np.array(foot_3)[:, None])) - LENGTHS[2]
        number += (gap[1:] * gap[:-1] < 0.0).sum()
    assert len(modes) == number == 6


def test_assembly_modes_with_redundant_constraints_satisfy_all_of_them():
    """What is left over when all coordinates are known has to hold as well."""
    for extra, number in ((0.0, 1), (0.1, 0)):
        frame, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
        origin.set_vel(frame, 0)
        x, y, ux, uy = me.dynamicsymbols("x y ux uy")
        point.set_pos(origin, x * frame.x + y * frame.y)
        point.set_vel(frame, ux * frame.x + uy * frame.y)
        system = System(frame, origin)
        system.add_bodies(me.Particle("P", point, 1))
        system.add_holonomic_constraints(y - 2 * x, 2 * y - 4 * x - extra)
        system.q_ind, system.q_dep, system.u_ind, system.u_dep = [x], [y], [ux], [uy]
        system.add_kdes(ux - x.diff(), uy - y.diff())
        model = fb.compile_model(fb.Model(system, name=f"redundant{number}"), check=False)
        modes = model.initial_states([0.7], [0.0])
        assert modes.is_complete
        assert len(modes) == number
        assert modes.x[:, 1] == pytest.approx([1.4] * number)


def on_a_line(constraints, coordinates, **how):
    """The modes of masses on a line, at a value of the first coordinate."""
    model = fb.Model(masses_on_a_line(constraints, coordinates), name="on_a_line", **how)

    def modes(value, **parameters):
        return fb.compile_model(model, check=False).initial_states([value], [0.0], parameters=parameters)

    return modes


W, S, A, Y = me.dynamicsymbols("w s a y")
LENGTH = sm.Symbol("l")


def test_assembly_modes_of_a_slider_crank_of_equal_lengths_include_the_root_zero():
    """A slider by the length of its rod, which is that of the crank: at 0 and 2 cos w, and both are regular."""
    modes = on_a_line([(S - sm.cos(W)) ** 2 + sm.sin(W) ** 2 - 1], [W, S])
    for angle in np.linspace(-3.0, 3.0, 13):
        found = modes(angle)
        assert found.is_complete
        np.testing.assert_allclose(np.sort(found.x[:, 1]), np.sort([0.0, 2 * np.cos(angle)]), rtol=0, atol=1e-12)


def test_speeds_beside_a_dead_point_equal_the_slope_and_at_it_are_refused():
    """Positions are found to half of all digits there, 1e-8 beside it, where the slope is 1e-8 and not 0."""
    model = fb.compile_model(fb.Model(masses_on_a_line([sm.cos(A) - W], [W, A]), name="dead_point"))
    assert model.initial_state([0.9], [0.5], guess=[1.0])[3] == pytest.approx(-0.5 / np.sqrt(1 - 0.9**2), rel=1e-12)
    near = 1.0 - 1e-8  # known to 1e-8 of the slope, which is 1.4e-4
    assert model.initial_state([near], [0.5], guess=[1.0])[3] == pytest.approx(-0.5 / np.sqrt(1 - near**2), rel=1e-6)
    for guess in (0.0, 1.0):
        with pytest.raises(fb.AssemblyError, match="do not follow from the independent ones"):
            model.initial_state([1.0], [0.5], guess=[guess])


def test_initial_state_of_a_constraint_by_half_an_angle_is_within_one_turn():
    """What changes with one turn and not with two comes within one of the guess, which is a dead point here."""
    model = fb.compile_model(fb.Model(masses_on_a_line([sm.cos(A / 2) - W], [W, A]), name="half_angle"))
    for value in (0.999, 0.5, 0.0, -0.5):
        angle = model.initial_state([value], [0.5])[1]
        assert abs(angle) == pytest.approx(2 * np.arccos(value), rel=1e-9)


@pytest.mark.slow
def test_assembly_modes_by_displacements_of_all_sizes_equal_closed_forms():
    """Roots in closed form, in whatever unit: 1e-6 to 1e5, also where the constraint is flat at zero."""
    modes = on_a_line(
        [(S**2 - LENGTH**2) ** 2 - (LENGTH / 2) ** 4, A**3 - W, LENGTH * Y**2 - Y + A], [W, S, A, Y],
        parameters={LENGTH: 1.0},
    )  # fmt: skip
    for length in (1e-6, 1e-3, 1.0, 1e3, 1e5):
        for value in (1e-30 / length**3, 1e-2 / length**3):  # so that the last has two roots, some far apart
            found = modes(value, l=length)
            assert found.is_complete
            squares = length * np.sqrt([1.25, 0.75]) * np.array([[-1.0], [1.0]])
            cube = value ** (1 / 3)
            larger = (1 + np.sqrt(1 - 4 * length * cube)) / (2 * length)
            assert len(found) == 8
            # In the order of the first, and then of the last.
            s, a, y = np.moveaxis(found.x[:, 1:4].reshape(4, 2, 3), 2, 0)
            np.testing.assert_allclose(s.T, [np.sort(squares.ravel())] * 2, rtol=1e-12)
            np.testing.assert_allclose(a, cube, rtol=1e-12)
            np.testing.assert_allclose(y, [[cube / (length * larger), larger]] * 4, rtol=1e-12)
    [quadruple] = on_a_line([(S - 1) ** 4 - W], [W, S])(0.0)
    assert quadruple[1] == pytest.approx(1.0, abs=1e-4)  # eps^(1/4)
    less = on_a_line([LENGTH * S**2 + S - W], [W, S], parameters={LENGTH: 0.0})
    assert less(2.0).x[:, 1].tolist() == [2.0]  # of a degree less than it could be


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1e-6, 1.0, 1e6, 1e10])
def test_assembly_modes_of_constraints_in_different_units_are_the_same(factor):
    modes = on_a_line([Y - S, factor * (S**2 - W)], [W, S, Y])(1.0)
    assert modes.is_complete
    np.testing.assert_allclose(modes.x[:, 1:3], [[-1.0, -1.0], [1.0, 1.0]], rtol=1e-12)


def constraints_of(*expressions, w=0.3):
    """Expressions in s and w as `Constraints`."""
    tape = Tape()
    leaves = {function: tape.leaf("q", name) for function, name in ((S, "s"), (W, "w"))}
    convert = Conversion(tape, leaves)
    return Constraints(formulas(tape, [convert(expression) for expression in expressions]), {("q", "w"): w})


@pytest.mark.parametrize(
    "expression",
    [sm.sqrt(S**2 + 25), sm.Abs(S + 10), S + sm.sin(S) / 10, sm.sin(S / 2), 1 / S, 2**S, sm.sin(S**2), sm.sin(W * S)],
)
def test_expressions_that_are_no_polynomials_have_no_count_of_roots(expression):
    """Roots, kinks, an angle that is a displacement as well, half of an angle: their roots are not counted."""
    constraints = constraints_of(expression)
    assert constraints.polynomials([0], [("s", False)]) is None
    assert constraints.polynomials([0], [("s", True)]) is None
    assert not constraints.is_periodic(0, "s")


@pytest.mark.parametrize("expression", [sm.tan(S), sm.sqrt(2 + sm.cos(3 * S)), sm.sin(S + W) ** 2 / sm.cos(S)])
def test_periodic_expressions_that_are_no_polynomials_count_as_periodic(expression):
    constraints = constraints_of(expression)
    assert constraints.polynomials([0], [("s", True)]) is None
    assert constraints.is_periodic(0, "s")


def test_assembly_modes_of_a_rack_and_crank_are_a_lower_bound():
    """An angle that is a displacement as well: a lower bound, of seven by a plot of s + sin(100 s) / 10."""
    modes = on_a_line([S - A / 100, S + sm.sin(A) / 10 - W], [W, A, S])(0.05)
    assert not modes.is_complete
    assert 2 <= len(modes) <= 7


@pytest.mark.slow
def test_assembly_modes_near_a_dead_point_are_counted_to_rounding(four_bar):
    """None outside, two inside, and one where rounding errors leave no more: 1e-13 of the position, 1e-11 at most."""
    angle = np.pi - np.arccos((0.8**2 + 1.0**2 - 1.2**2) / (2 * 0.8))
    lengths = {"l1": 0.8, "l2": 1.0, "l3": 0.9, "l4": 0.3}
    for change in 10.0 ** np.arange(-10, -2):
        assert len(four_bar.initial_states([angle - change], [1.0], parameters=lengths)) == 0
        assert len(four_bar.initial_states([angle + change], [1.0], parameters=lengths)) == 2
    for change in 10.0 ** np.arange(-16, -10):
        assert len(four_bar.initial_states([angle - change], [1.0], parameters=lengths)) <= 1
        assert 1 <= len(four_bar.initial_states([angle + change], [1.0], parameters=lengths)) <= 2


@pytest.mark.slow
def test_assembly_modes_in_threads_keep_their_precision_beside_mpmaths(four_bar):
    """Each thread computes with as many digits as alone, while mpmath's own precision is changed beside it."""
    angles = np.linspace(-0.6, 0.6, 12)
    alone = [four_bar.initial_states([angle], [0.0]).x for angle in angles]
    with ThreadPoolExecutor(4) as pool, mpmath.workdps(3):
        beside = list(pool.map(lambda angle: four_bar.initial_states([angle], [0.0]).x, angles))
        assert mpmath.mp.dps == 3
    for found, expected in zip(beside, alone, strict=True):
        np.testing.assert_array_equal(found, expected)


def test_assembly_modes_of_an_open_chain_are_its_one_state():
    chain = fb.compile_model(fb.models.chain(2))
    [mode] = chain.initial_states([0.1, 0.2], [0.0, 0.0])
    assert mode.tolist() == [0.1, 0.2, 0.0, 0.0]


def test_assembly_modes_after_many_turns_of_the_crank_are_the_same(four_bar):
    """After 1e5 turns, angles are right to 1e5 eps 2 pi = 1e-10."""
    once = four_bar.initial_states([-0.5], [0.0])
    often = four_bar.initial_states([-0.5 + 2e5 * np.pi], [0.0])
    assert often.is_complete
    np.testing.assert_allclose(often.x[:, 1:3], once.x[:, 1:3], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(often.x[:, 0], -0.5 + 2e5 * np.pi)


@pytest.mark.slow
def test_plots_of_assembly_modes_draw_each_mode_in_its_panel(four_bar, monkeypatch):
    figure = four_bar.initial_states().plot()
    assert len(figure.axes) == 2
    for axes, mode in zip(figure.axes, four_bar.initial_states(), strict=True):
        ends = np.array([line.get_xydata()[-1] for line in axes.lines])
        points = four_bar.positions(0.0, mode[:3])
        assert np.abs(ends - points["joint3_link3_joint"][:2]).max(axis=1).min() == 0.0
    with pytest.raises(fb.ModelError, match="nothing to draw"):
        four_bar.initial_states(parameters={"l1": 3.0}).plot()
    monkeypatch.setattr("fourbar_codegen.views.figures.MAX_PANELS", 1)
    assert len(four_bar.initial_states().plot().axes) == 1


def inverted_slider_crank():
    """A crank whose end slides along a bar about (G, 0): A cos a - G + x cos b = 0, A sin a + x sin b = 0."""
    a, b, x = me.dynamicsymbols("a b x")
    crank, ground = sm.symbols("A G")
    rows = crank * sm.cos(a) - ground + x * sm.cos(b), crank * sm.sin(a) + x * sm.sin(b)
    return on_a_line(rows, [a, b, x], parameters={crank: 1.0, ground: 3.0})


@pytest.mark.slow
def test_assembly_modes_of_an_inverted_slider_crank_at_round_angles_are_two():
    """Two modes always, x = +- the distance of the crank's end from the pivot; one number of a root may be rounding."""
    modes = inverted_slider_crank()
    for crank, ground in ((1.0, 3.0), (2.0, 1.0), (3.0, 1.0)):
        for twelfth in range(-12, 13):
            angle = twelfth * np.pi / 12
            found = modes(angle, A=crank, G=ground)
            distance = np.hypot(crank * np.cos(angle) - ground, crank * np.sin(angle))
            assert found.is_complete
            np.testing.assert_allclose(np.sort(found.x[:, 2]), [-distance, distance], rtol=1e-14)


def test_assembly_modes_with_the_cranks_end_on_the_pivot_leave_the_bar_free():
    """Where that is the pivot, x = 0 at any angle of the bar: infinitely many ways."""
    modes = inverted_slider_crank()
    for length in (1.0, 15.0):
        found = modes(0.0, A=length, G=length)
        assert found.free == ("b",)
        assert not found.is_complete
        np.testing.assert_allclose(found.x[:, 2], 0.0, atol=1e-12)


@pytest.mark.slow
def test_assembly_modes_with_crank_and_rod_of_equal_length_equal_closed_forms():
    """x = 2 r cos a, and x = 0 with the rod folded onto the crank."""
    model = fb.compile_model(fb.models.slider_crank())
    for twelfth in range(-12, 13):
        angle = twelfth * np.pi / 12
        modes = model.initial_states([angle], [0.0], parameters={"r": 0.3, "l": 0.3})
        assert modes.is_complete
        expected = {0.0, 0.6 * np.cos(angle)} if twelfth % 12 != 6 else {0.0}
        # Where the two meet, x is known to the root of rounding errors.
        np.testing.assert_allclose(
            np.sort(modes.x[:, 2]), sorted(expected), rtol=0, atol=1e-15 if len(expected) > 1 else 1e-8
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    "roots",
    [
        [1000.0 * k for k in range(1, 7)], [100.0 * k for k in range(1, 9)], [1e-3, 1e-2, 0.5, 3.0, 20.0, 5e2],
        [-1e-6, 1e-6, 1.0, 1e6], [k / 7 for k in range(-10, 10)],
    ],
)  # fmt: skip
@pytest.mark.parametrize("expanded", [False, True])
def test_assembly_modes_by_a_polynomial_of_high_degree_are_all_its_roots(roots, expanded):
    product = sm.prod([S - sm.Rational(root) for root in roots])
    modes = on_a_line([(sm.expand(product) if expanded else product) + W], [W, S])(0.0)
    assert modes.is_complete
    np.testing.assert_allclose(modes.x[:, 1], sorted(roots), rtol=1e-12)


@pytest.mark.slow
def test_assembly_modes_of_two_cubics_equal_numpys_real_roots():
    """Of two cubics, each in one unknown of the other: as many as NumPy finds real roots of the nonic."""
    generator = np.random.default_rng(3)
    a = me.dynamicsymbols("a")
    k0, k1, k3, m0, m1, m3 = sm.symbols("k0 k1 k3 m0 m1 m3")
    rows = k0 + k1 * S + k3 * S**3 + a - Y, m0 + m1 * Y + m3 * Y**3 - S
    modes = on_a_line(rows, [a, S, Y])
    numbers = set()
    for _ in range(8):
        values = 0.2 * generator.normal(size=6) + [0.0, 2.5, -1.0, 0.0, 2.5, -1.0]
        found = modes(0.0, **dict(zip(("k0", "k1", "k3", "m0", "m1", "m3"), values, strict=True)))
        y = np.polynomial.Polynomial([values[0], values[1], 0.0, values[2]])
        nonic = values[3] + values[4] * y + values[5] * y**3 - np.polynomial.Polynomial([0.0, 1.0])
        expected = sorted(root.real for root in nonic.roots() if abs(root.imag) < 1e-9)
        assert found.is_complete
        np.testing.assert_allclose(np.sort(found.x[:, 1]), expected, rtol=1e-8)
        numbers.add(len(expected))
    assert max(numbers) > 3


@pytest.mark.slow
def test_assembly_modes_of_a_gear_of_ratio_two_equal_closed_forms():
    """P cos 2b + Q sin b = cos a is a quadratic in sin b; the ratio may be a parameter as well."""
    a, b = me.dynamicsymbols("a b")
    ratio = sm.Symbol("n")
    for harmonic in (2, ratio):
        parameters = {} if harmonic == 2 else {ratio: 2.0}
        modes = on_a_line([sm.cos(harmonic * b) + sm.sin(b) / 2 - sm.cos(a)], [a, b], parameters=parameters)
        for angle in (0.3, 1.2, 2.9):
            found = modes(angle)
            sines = np.roots([-2.0, 0.5, 1.0 - np.cos(angle)])
            sines = sines[np.abs(sines) <= 1.0]
            expected = np.concatenate((np.arcsin(sines), np.pi - np.arcsin(sines)))
            assert found.is_complete
            np.testing.assert_allclose(
                np.sort(found.x[:, 1]), np.sort(np.remainder(expected + np.pi, 2 * np.pi) - np.pi), rtol=1e-12
            )


def chained(constraints, start):
    """Coordinates s0, s1, ... of masses on a line, of which s0 alone is independent."""
    coordinates = me.dynamicsymbols(f"s0:{len(constraints) + 1}")
    system = masses_on_a_line([row(*coordinates) for row in constraints], coordinates)
    return fb.compile_model(fb.Model(system, name="chained", initial=dict.fromkeys(coordinates, start)))


def test_initial_state_of_a_rhombus_closes_within_one_turn(four_bar):
    # A rhombus that can fold: from here, steps along its singular directions end at angles of 1e16, whose sines are
    # anything.
    equal = dict.fromkeys(four_bar.parameters, 1.0)
    for q1 in np.linspace(0.05, 3.0, 60):
        q = four_bar.initial_state({"q1": q1}, {"u1": 0.1}, guess=[0.0, 0.0], parameters=equal)[:3]
        assert np.abs(q).max() < 2 * np.pi
        # The sides as complex numbers; in a folded position to half of all digits.
        assert abs(np.exp(1j * np.cumsum(q)).sum() + 1.0) < 1e-10


@pytest.mark.slow
def test_initial_state_of_chained_cubics_is_found_loop_by_loop():
    """Cubics with one real root, near -2.1, and a minimum between it and the guess, where a search ends: all of six are
    hardly met at once. Each has the one before it in it, in no order."""
    order = [3, 0, 5, 1, 4, 2]
    rows = [lambda *s, i=i: s[i + 1] ** 3 - 3 * s[i + 1] + 3 + s[i] / 50 for i in order]
    model = chained(rows, 1.2)
    state = model.initial_state({"s0": 0.5}, dict.fromkeys(model.speeds[:1], 0.0))
    value = 0.5
    for found in state[1:7]:
        [value] = [root.real for root in np.roots([1.0, 0.0, -3.0, 3.0 + value / 50.0]) if abs(root.imag) < 1e-12]
        assert found == pytest.approx(value, rel=1e-12)
    # A guess that is given is kept to, and what closes elsewhere is said.
    with pytest.raises(fb.AssemblyError, match=r"close from other guesses, for instance guess=\[-2\.1"):
        model.initial_state({"s0": 0.5}, [0.0], guess=[1.2] * 6)


@pytest.mark.slow
def test_initial_state_with_one_loop_open_names_that_loop_alone():
    rows = [lambda *s: sm.sin(s[1]) - s[0] / 2, lambda *s: sm.cos(s[2]) - 2 - s[1] / 10, lambda *s: sm.sin(s[3]) - s[1]]
    model = chained(rows, 0.3)
    with pytest.raises(fb.AssemblyError, match=r"constraints 2, to be closed by s2, stay open by 1\.0") as caught:
        model.initial_state({"s0": 0.5}, [0.0])
    assert "constraints 1," not in str(caught.value)
    assert "constraints 3," not in str(caught.value)


@pytest.mark.slow
def test_initial_state_with_bounds_is_within_them_or_refused():
    model = chained([lambda *s: sm.cos(s[1]) - s[0], lambda *s: sm.sin(s[2]) - sm.sin(s[1])], 2.0)
    for low, high, expected in ((0.0, np.pi, np.pi / 3), (-np.pi, 0.0, -np.pi / 3), (6.0, 8.0, 2 * np.pi + np.pi / 3)):
        state = model.initial_state({"s0": 0.5}, [0.0], bounds={"s1": (low, high)})
        assert state[1] == pytest.approx(expected, rel=1e-12)
    s1 = me.dynamicsymbols("s1")
    with pytest.raises(fb.AssemblyError, match="within the bounds"):
        model.initial_state({"s0": 0.5}, [0.0], bounds={s1: (1.1, 1.2)})
    for bounds, words in (
        ({"s0": (0.0, 1.0)}, "no dependent coordinate 's0'"),
        ({"s1": (1.0, 0.0)}, "smaller and a larger"),
        ({"s1": 3.0}, "smaller and a larger"),
        ([(0.0, 1.0)], "mapping"),
    ):
        with pytest.raises(fb.ModelError, match=words):
            model.initial_state({"s0": 0.5}, [0.0], bounds=bounds)


@pytest.mark.slow
def test_assembly_modes_behind_a_free_bar_are_at_the_rockers_angles():
    """A folded rhombus, whose rocker drives a loop that does not close where the rocker is at 0."""
    model = linkage(2, absolute=True)
    ground, crank, coupler, rocker = 1.0, 0.8, 1.2, 0.3
    assert abs(ground - crank) < coupler - rocker < coupler + rocker < ground + crank
    lengths = (1.0, 1.0, 1.0, 1.0, ground, crank, coupler, rocker)
    modes = model.initial_states([0.0], [0.0], parameters={f"a{i}": length for i, length in enumerate(lengths)})
    assert modes.free == ("q1", "q2", "q3", "q4")
    assert not modes.is_complete
    for mode in modes:
        assert min(abs(np.exp(1j * mode[4]) - np.exp(1j * angle)) for (angle,) in rockers(lengths[4:], mode[2])) < 1e-9


def test_assembly_modes_of_a_slider_crank_without_lengths_leave_the_rod_free():
    """The slider is held at the crank's pivot by a rod of length zero, which turns freely."""
    model = fb.compile_model(fb.models.slider_crank())
    for angle in (0.0, 0.5):
        modes = model.initial_states([angle], [1.0], parameters={"r": 0.0, "l": 0.0})
        assert modes.free == ("rod",)
        assert not modes.is_complete
        np.testing.assert_allclose(modes.x[:, 2], 0.0, atol=1e-13)
    sentence = "a degree of freedom is left: rod moves while crank is held"
    assert repr(modes) == f"<AssemblyModes of slider_crank: 1 of infinitely many; {sentence}>"
    assert sentence in modes._repr_html_()
    assert sentence in modes.plot().get_suptitle()
    again = pickle.loads(pickle.dumps(modes))
    assert (again.free, repr(again)) == (modes.free, repr(modes))
    earlier = copy.copy(modes)  # from a version that did not know
    del vars(earlier)["free"]
    assert (earlier.free, repr(earlier)) == ((), "<AssemblyModes of slider_crank: at least 1>")


ARM, SIDE, CRANK = 3.0, 1.5, 1.2


def peaucellier(independent):
    """Peaucellier's linkage: seven bars with absolute angles, and the place (x, y) of its pen.

    Its mobility is 3 * 7 - 2 * 10 = 1, and the pen draws the line x = (ARM^2 - SIDE^2) / (2 CRANK).

    A. B. Kempe, *How to Draw a Straight Line*, 1877.
    """
    arm, side, crank = sm.symbols("arm side crank")
    *angles, x, y = coordinates = me.dynamicsymbols("q:7 x y")

    def bar(length, angle):
        return length * sm.Matrix([sm.cos(angle), sm.sin(angle)])

    pin = sm.Matrix([crank, 0]) + bar(crank, angles[0])
    one, other = bar(arm, angles[1]), bar(arm, angles[2])
    pen = sm.Matrix([x, y])
    sides = [bar(side, angle) for angle in angles[3:]]
    top = one + sides[2]
    gaps = one + sides[0] - pin, other + sides[1] - pin, other + sides[3] - top, pen - top
    order = sorted(coordinates, key=lambda q: q.func.__name__ != independent)
    return on_a_line([row for gap in gaps for row in gap], order, parameters={arm: ARM, side: SIDE, crank: CRANK})


@pytest.mark.slow(but=["1.0", "1000.0"])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_assembly_modes_of_peaucelliers_cell_are_the_open_and_the_folded_ones(unit):
    """Both elbows are on one side or the other. Where they coincide, the pen turns about them with two bars; otherwise
    it is on the line or on the crank's pin."""
    lengths = {"arm": ARM * unit, "side": SIDE * unit, "crank": CRANK * unit}
    modes = peaucellier("q0")(0.3, **lengths)
    assert modes.free == ("q5", "q6", "x", "y")
    assert not modes.is_complete
    pin = CRANK * np.array([1 + np.cos(0.3), np.sin(0.3)])
    elbows = circles(np.zeros(2), ARM, pin, SIDE)
    line = (ARM**2 - SIDE**2) / (2 * CRANK)
    isolated = 0
    for mode in modes:
        one, other = (ARM * np.array([np.cos(angle), np.sin(angle)]) for angle in mode[1:3])
        assert min(np.abs(one - elbow).max() for elbow in elbows) < 1e-12
        pen = mode[7:9] / unit
        assert np.hypot(*(pen - one)) == pytest.approx(SIDE, rel=1e-12)
        if np.abs(one - other).max() > 1e-3:
            assert min(abs(pen[0] - line), np.abs(pen - pin).max()) < 1e-12
            isolated += 1
        assert np.isnan(mode[10:18]).any() == (np.abs(one - other).max() < 1e-3)
    assert isolated == 4
    assert len(modes) == 6


@pytest.mark.slow(but=["1.0", "1000.0"])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_assembly_modes_with_peaucelliers_constant_x_held_leave_all_else_free(unit):
    """The pen's x is the line's wherever the linkage is, so holding it leaves the mobility of 1."""
    lengths = {"arm": ARM * unit, "side": SIDE * unit, "crank": CRANK * unit}
    modes = peaucellier("x")((ARM**2 - SIDE**2) / (2 * CRANK) * unit, **lengths)
    assert modes.free == ("q0", "q1", "q2", "q3", "q4", "q5", "q6", "y")
    assert not modes.is_complete


def test_assembly_modes_of_a_five_bar_held_by_one_angle_leave_three_free():
    """Of mobility 3 * 4 - 2 * 5 = 2; a third constraint is redundant, so one too many is declared dependent."""
    angles = me.dynamicsymbols("q:4")
    x, y = (sum(turn(angle) for angle in angles) for turn in (sm.cos, sm.sin))
    modes = on_a_line([x - 2, y, x - 2 + y / 3], angles)(0.5)
    assert modes.free == ("q1", "q2", "q3")
    assert not modes.is_complete


@pytest.mark.slow
def test_assembly_modes_of_a_redundant_parallelogram_are_isolated():
    """Three parallel cranks and a coupler: 3 * 4 - 2 * 6 = 0 by Gruebler, yet it moves.

    One crank holds it, also in line, where four constraints have rank 2 in three angles and two modes meet.
    """
    crank, coupler, one, other = angles = me.dynamicsymbols("q:4")
    rows = [
        row
        for angle, length in ((one, 2), (other, 1))
        for row in (
            sm.cos(crank) + length * sm.cos(coupler) - sm.cos(angle) - length,
            sm.sin(crank) + length * sm.sin(coupler) - sm.sin(angle),
        )
    ]
    modes = on_a_line(rows, angles)
    for angle in (-2.0, 0.0, 0.7, np.pi / 2):
        found = modes(angle)
        assert found.is_complete
        assert found.free == ()
        np.testing.assert_allclose(found.x[:, 1:4], [[0.0, angle, angle]], atol=1e-7 if angle == 0.0 else 1e-13)


@pytest.mark.slow
def test_assembly_modes_of_bennetts_linkage_satisfy_its_closed_form():
    """Four hinges in space: 6 * 3 - 5 * 4 = -2 by Kutzbach, yet it moves, with tan(q0 / 2) tan(q1 / 2) constant.

    G. T. Bennett, "A new mechanism", Engineering 76 (1903). Six constraints have rank 3 in three angles.
    """
    one, other, length = 1.0, 1.9, 1.0
    angles = me.dynamicsymbols("q:4")

    def hinge(angle, twist, length):
        c, s, ct, st = sm.cos(angle), sm.sin(angle), np.cos(twist), np.sin(twist)
        return sm.Matrix([[c, -s * ct, s * st], [s, c * ct, -c * st], [0, st, ct]]), length * sm.Matrix([c, s, 0])

    another = length * np.sin(other) / np.sin(one)
    (r0, p0), (r1, p1), (r2, p2), (r3, p3) = (
        hinge(angle, *link) for angle, link in zip(angles, [(one, length), (other, another)] * 2, strict=True)
    )
    turned = r0 * r1 - (r2 * r3).T
    gap = p0 + r0 * p1 + (r2 * r3).T * (p2 + r2 * p3)
    modes = on_a_line([*gap, turned[0, 1], turned[0, 2], turned[1, 2]], angles)
    for angle in (0.4, 1.3, -2.0):
        found = modes(angle)
        assert found.free == ()
        ratio = np.sin((one + other) / 2) / np.sin((other - one) / 2)
        expected = 2 * np.arctan(ratio / np.tan(angle / 2))
        assert np.abs(found.x[:, 1:4] - [expected, -angle, -expected]).max(axis=1).min() < 1e-9


@pytest.mark.slow
def test_assembly_modes_of_a_platform_on_parallel_legs_leave_x_and_y_free():
    """As wide as its base, on legs of one length: it moves along a circle and does not turn, like a parallelogram."""
    modes = platform([(foot, foot) for foot, _ in LEGS], [2.4] * 3).initial_states([2.4], [0.0])
    assert modes.free == ("x", "y")
    assert not modes.is_complete


@pytest.mark.slow
def test_assembly_modes_of_a_taut_chain_are_the_straight_one_with_nothing_free():
    """As far as it reaches: all bars in line, where the Jacobian has rank 1 in three angles, and nothing moves."""
    angles = me.dynamicsymbols("q:4")
    x, y = (sum(turn(angle) for angle in angles) for turn in (sm.cos, sm.sin))
    modes = on_a_line([x - 4, y, x - 4 + y / 3], angles)(0.0)
    assert modes.free == ()
    assert len(modes) > 0
    np.testing.assert_allclose(modes.x[:, :4], 0.0, atol=1e-4)  # half of all digits, and the search's 1e-10 for them


@pytest.mark.slow
def test_assembly_modes_of_a_circle_are_free_and_those_of_a_point_are_not():
    """s^2 + y^2 = w twice: at 0 the Jacobian is zero, and the only solution is a point, known to half of all digits."""
    modes = on_a_line([S**2 + Y**2 - W, 2 * (S**2 + Y**2 - W)], [W, S, Y])
    assert modes(1.0).free == ("s", "y")
    point = modes(0.0)
    assert point.free == ()
    np.testing.assert_allclose(point.x[:, 1:3], 0.0, atol=1e-4)
