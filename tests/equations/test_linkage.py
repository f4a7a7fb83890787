"""Linkages by their points: the same motion as by hand, known mobilities, and what mistakes are told."""

import ast
import inspect
from itertools import pairwise
from math import sqrt

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders import by_hand
from builders.linkages import inverted_slider_crank
from formulations import natural_coordinates

import fourbar_codegen as fb

RHOMBUS = (25 / 6, sqrt(25 - (25 / 6) ** 2))
JANSEN = {
    "O": (0, 0),
    "G": (-38, -7.8),
    "A": (15, 0),
    "C": (-24.013535097127793, 31.272097454842683),
    "E": (-74.79436538093606, 8.143170205896139),
    "D": (-26.952107031572965, -45.51517017008116),
    "F": (-59.23151496141502, -28.052930230747776),
    "H": (-43.1601105241047, -91.75693292612323),
}
"""Theo Jansen's leg, crank at 0: https://www.strandbeest.com/explains."""

LINKAGES = {
    "four-bar": (
        {"A": (0, 0), "B": (0.1, 0.05), "C": (0.3, 0.3), "D": (0.4, 0)}, "AD", ["AB", "BC", "CD"]
    ),
    "coupler plate": (
        {"A": (0, 0), "B": (0.1, 0.05), "C": (0.3, 0.3), "D": (0.4, 0), "P": (0.15, 0.4)},
        "AD", ["AB", "BCP", "CD"],
    ),
    "five-bar": (
        {"A": (0, 0), "B": (-0.1, 0.3), "C": (0.2, 0.5), "D": (0.5, 0.25), "E": (0.4, 0)},
        "AE", ["AB", "BC", "CD", "DE"],
    ),
    "Peaucellier": (
        {"O": (0, 0), "Q": (1.5, 0), "B": (3, 0), "A": RHOMBUS, "C": (RHOMBUS[0], -RHOMBUS[1]), "D": (16 / 3, 0)},
        "OQ", ["QB", "OA", "OC", "AB", "BC", "CD", "DA"],
    ),
    "Jansen": (
        {name: (x / 100, y / 100) for name, (x, y) in JANSEN.items()},
        "OG", ["OA", "AC", "AD", "GCE", "GD", "EF", "FDH"],
    ),
    "parallelogram with a bar too many": (
        {"A": (0, 0), "B": (0, 1), "C": (1, 1), "D": (1, 0), "E": (0.5, 0), "F": (0.5, 1)},
        "AED", ["AB", "BFC", "CD", "EF"],
    ),
    "double pendulum": ({"A": (0, 0), "B": (0.4, 0.1), "C": (0.5, 0.5)}, "A", ["AB", "BC"]),
}  # fmt: skip
"""Points, ground, and links."""


def bars_of(links):
    """The bars of links with mass, and rods without: sides of plates; points on a line are on one bar, by rods."""
    on_line = [link for link in links if link == "BFC"]
    bars = [link for link in links if len(link) == 2] + [link[0] + link[-1] for link in on_line]
    plates = [link for link in links if len(link) > 2 and link not in on_line]
    bars += [a + b for link in plates for a, b in zip(link, link[1:] + link[0], strict=True)]
    return bars, [a + b for link in on_line for a, b in pairwise(link)]


@pytest.mark.slow
@pytest.mark.parametrize("name", LINKAGES)
def test_linkages_of_all_kinds_move_as_in_natural_coordinates(name):
    """All points, to 1e-10 of the linkage's size, by another formulation and another solver."""
    points, ground, links = LINKAGES[name]
    linkage = fb.Linkage("one", points=points, ground=ground, links=links, density=2.0, gravity=9.81)
    pushed = links[0][1]
    linkage.force(pushed, (3.0, -1.0))
    times = np.linspace(0.0, 0.5, 6)
    run = fb.compile_model(linkage.model()).simulate((0.0, 0.5), t_eval=times, rtol=1e-13, atol=1e-13)
    assert run.success
    load = np.array([[3.0, -1.0] if point == pushed else [0.0, 0.0] for point in points])
    bars, rods = bars_of(links)
    expected = natural_coordinates.simulate(
        points, bars, ground, times, density=2.0, gravity=9.81, force=lambda t, x, v: load, rods=rods
    )
    size = np.ptp(list(points.values()), axis=0).max()
    for point, path in zip(points, expected, strict=True):
        np.testing.assert_allclose(run[point][:2], path, rtol=0, atol=1e-10 * size)


def peaucellier():
    points, ground, links = LINKAGES["Peaucellier"]
    linkage = fb.Linkage("cell", points=points, ground=ground, links=links, density=by_hand.RHO, gravity=by_hand.G)
    linkage.force("B", (3, -1))
    return linkage


def jansen():
    points, ground, links = LINKAGES["Jansen"]
    linkage = fb.Linkage("leg", points=points, ground=ground, links=links, density=by_hand.RHO, gravity=by_hand.G)
    linkage.force("A", (3, -1))
    return linkage


SHAPER = {"O": (0, 2), "A": (1, 2), "L": (0, 0), "B": (4 / sqrt(5), 8 / sqrt(5)), "C": (3.228184126011713, 4)}


def quick_return():
    how = {"density": by_hand.RHO, "gravity": by_hand.G}
    linkage = fb.Linkage("shaper", points=SHAPER, ground="OL", links=["OA", "LB", "BC"], **how)
    linkage.slider("A", along="LB")
    linkage.slider("C", along=(1, 0))
    linkage.force("A", (3, -1))
    return linkage


SUSPENSION = {
    "A": (0.32, -0.08), "C": (0.737, -0.145), "D": (0.435, 0.196), "F": (0.68, 0.162), "W": (0.768, 0.0),
    "S": (0.4, 0.3), "K": (0.32 + 0.75 * 0.417, -0.08 - 0.75 * 0.065),
}  # fmt: skip


def double_wishbone():
    how = {"density": by_hand.RHO, "gravity": by_hand.G}
    linkage = fb.Linkage("suspension", points=SUSPENSION, ground="ADS", links=["AKC", "DF", "CFW"], **how)
    linkage.spring("S", "K", 400.0, length=0.4)
    linkage.damper("S", "K", 15.0)
    return linkage


BY_HAND = {
    peaucellier: lambda: (by_hand.peaucellier(), "BACD"),
    jansen: lambda: (by_hand.jansen(LINKAGES["Jansen"][0]), "ACDEFH"),
    quick_return: lambda: (by_hand.quick_return(SHAPER), "ABC"),
    double_wishbone: lambda: (by_hand.double_wishbone(SUSPENSION), "CFWK"),
}


@pytest.mark.slow
@pytest.mark.parametrize("make", BY_HAND)
def test_linkages_by_points_move_as_models_in_plain_sympy(make):
    """The motion of all points, from rest, is that of models in plain SymPy."""
    other, names = BY_HAND[make]()
    how = {"t_eval": np.linspace(0.0, 0.5, 11), "rtol": 1e-13, "atol": 1e-13}
    run, expected = (fb.compile_model(model).simulate((0.0, 0.5), **how) for model in (make().model(), other))
    assert run.success
    assert np.ptp(expected[names[0]]) > 0.1
    for name in names:
        np.testing.assert_allclose(run[name], expected[name], rtol=0, atol=1e-10)


def tutorials_linkage():
    k, c, F = *sm.symbols("k c"), me.dynamicsymbols("F")
    points = {"A": (0.4, 0), "B": (0.84, -0.24), "C": (-0.08, -0.62), "D": (-0.4, 0)}
    linkage = fb.Linkage("tutorial", points=points, ground="AD", links=["AB", "BC", "CD"], density=100.0, gravity=9.81)
    q, u = linkage.q, linkage.u
    linkage.torque("A", -k * (q["BC"] - q["AB"]) - c * (u["BC"] - u["AB"]))
    linkage.force("C", (F, 0))
    return linkage.model(
        parameters={k: 100.0, c: 10.0, "l_AB": 0.5, "l_BC": 1.0, "l_CD": 0.7},
        inputs={F: 100 * sm.sin(sm.pi * me.dynamicsymbols._t)},
        initial={"q_AB": -0.5, "u_AB": -0.1},
    )


@pytest.mark.slow
def test_tutorial_linkage_by_points_moves_as_the_ready_model(four_bar):
    """The flagship by its points: the same motion of all points as the model made by hand."""
    model = tutorials_linkage()
    run = fb.compile_model(model).simulate((0.0, 4.0), rtol=1e-13, atol=1e-13, t_eval=np.linspace(0.0, 4.0, 41))
    hand_made = four_bar.simulate((0.0, 4.0), rtol=1e-13, atol=1e-13, t_eval=run.t)
    for name, other in (("B", "P2"), ("C", "joint3_link3_joint"), ("D", "P44"), ("AB_masscenter", "link2_masscenter")):
        np.testing.assert_allclose(run[name], hand_made[other], rtol=0, atol=1e-10)
    np.testing.assert_allclose(run.kinetic_energy, hand_made.kinetic_energy, rtol=1e-9)


@pytest.mark.slow
def test_slider_crank_by_points_moves_as_the_ready_model():
    """As `models.slider_crank`, in its parameters' values; it is given a torque and a load."""
    hand_made = fb.compile_model(fb.models.slider_crank())
    r, length = 0.1, 0.3
    a, b = 0.5, -np.arcsin(r * np.sin(0.5) / length)
    points = {"O": (0, 0), "P": (r * np.cos(a), r * np.sin(a)), "S": (r * np.cos(a) + length * np.cos(b), 0)}
    model = fb.compile_model(slider_crank(points).model(initial={"u_OP": 10.0}))
    how = {"rtol": 1e-13, "atol": 1e-13, "t_eval": np.linspace(0.0, 1.0, 21)}
    inputs = {"torque": 0.3, "load": -2.0}
    run, other = (m.simulate((0.0, 1.0), inputs=inputs, **how) for m in (model, hand_made))
    np.testing.assert_allclose(run["P"], other["P"], rtol=0, atol=1e-10)
    np.testing.assert_allclose(run["S"], other["E"], rtol=0, atol=1e-10)


def slider_crank(points):
    linkage = fb.Linkage("slider_crank", points=points, ground="O")
    linkage.bar("O", "P", mass=1.0)
    linkage.bar("P", "S", mass=0.5)
    linkage.slider("S", along=(1, 0), mass=0.8)
    linkage.torque("O", "torque")
    linkage.force("S", ("load", 0))
    return linkage


@pytest.mark.parametrize("make", [*BY_HAND, tutorials_linkage, slider_crank])
def test_linkages_of_the_tests_take_at_most_twelve_statements(make):
    """At most twelve, and one more for points that stand elsewhere."""
    [function] = ast.parse(inspect.getsource(make)).body
    statements = [node for node in ast.walk(function) if isinstance(node, ast.stmt) and node is not function]
    assert len(statements) < 12


@pytest.mark.slow
def test_block_on_a_lever_by_points_moves_as_the_model_by_hand():
    """A quick-return mechanism, as by hand in test_scene."""
    hand_made = fb.compile_model(inverted_slider_crank("lever"))
    closed = hand_made.simulate((0.0, 1.0), rtol=1e-13, atol=1e-13, t_eval=np.linspace(0.0, 1.0, 21))
    points = {name: closed[name][:2, 0] for name in "OEBT"}
    linkage = fb.Linkage("lever", points=points, ground="OB")
    linkage.bar("O", "E", mass=1, inertia=0.1)
    linkage.bar("B", "T", mass=1, inertia=0.1)
    linkage.slider("E", along="BT")
    run = fb.compile_model(linkage.model(initial={"u_OE": 5.0})).simulate(
        (0.0, 1.0), rtol=1e-13, atol=1e-13, t_eval=closed.t
    )
    for point in "ET":
        np.testing.assert_allclose(run[point], closed[point], rtol=0, atol=1e-10)
    np.testing.assert_allclose(run["q_E"], closed["s"], rtol=0, atol=1e-10)


def test_linkage_with_spring_and_damper_moves_as_in_natural_coordinates():
    """A bar on a spring and a damper to the ground, against SciPy with the forces written out."""
    points = {"A": (0, 0), "B": (1, 0), "C": (0.5, -0.8)}
    linkage = fb.Linkage("sprung", points=points, ground="AC", links=["AB"], density=2.0, gravity=9.81)
    linkage.spring("B", "C", 30.0, length=0.7)
    linkage.damper("B", "C", 1.5)
    times = np.linspace(0.0, 1.0, 11)
    run = fb.compile_model(linkage.model()).simulate((0.0, 1.0), t_eval=times, rtol=1e-12, atol=1e-12)

    def force(t, x, v):
        way = x[1] - x[2]
        far = np.linalg.norm(way)
        pull = -(30.0 * (far - 0.7) + 1.5 * (way @ (v[1] - v[2])) / far) * way / far
        return np.array([[0.0, 0.0], pull, [0.0, 0.0]])

    expected = natural_coordinates.simulate(points, ["AB"], "AC", times, density=2.0, gravity=9.81, force=force)
    np.testing.assert_allclose(run["B"][:2], expected[1], rtol=0, atol=1e-10)


def crank_rocker(**options):
    points = {"A": (0, 0), "B": (0.1, 0.05), "C": (0.3, 0.3), "D": (0.4, 0)}
    return fb.Linkage("rocker", points=points, ground="AD", links=["AB", "BC", "CD"], **options)


@pytest.mark.slow
def test_torque_of_a_drive_at_constant_speed_is_the_rate_of_energy():
    """At constant speed, the drive's power is the rate of the energy."""
    linkage = crank_rocker(density=1.0, gravity=9.81)
    linkage.drive("A", speed=20.0)
    model = fb.compile_model(linkage.model())
    assert model.outputs == ("torque_A",)
    run = model.simulate((0.0, 1.0), rtol=1e-12, atol=1e-12, t_eval=np.linspace(0.0, 1.0, 2001))
    np.testing.assert_allclose(run["q_AB"], run["q_AB"][0] + 20.0 * run.t, rtol=0, atol=1e-12)
    power = 20.0 * run["torque_A"]
    rate = (run.energy[2:] - run.energy[:-2]) / (run.t[2:] - run.t[:-2])
    # Central differences err by h^2 / 6 times the third derivative, some (20 rad/s)^3 of the energy's variation.
    np.testing.assert_allclose(power[1:-1], rate, rtol=0, atol=0.0005**2 / 6 * 30.0**3 * np.ptp(run.energy) * 5)


@pytest.mark.slow
def test_driven_block_follows_its_displacement_with_newtons_force():
    linkage = fb.Linkage("piston", points={"O": (0, 0), "A": (0.1, 0.1), "C": (0.4, 0)}, ground="O", links=["OA", "AC"])
    linkage.slider("C", along=(1, 0), mass=2.0)
    linkage.drive("C", displacement=0.05 * sm.sin(3 * me.dynamicsymbols._t))
    run = fb.compile_model(linkage.model()).simulate((0.0, 1.0))
    np.testing.assert_allclose(run["C"][0], 0.4 + 0.05 * np.sin(3 * run.t), rtol=0, atol=1e-12)
    # Only the block has mass: Newton's law.
    np.testing.assert_allclose(run["force_C"], -2.0 * 0.05 * 9.0 * np.sin(3 * run.t), rtol=0, atol=1e-9)


@pytest.mark.slow
def test_lengths_of_a_linkage_changed_as_parameters_hold_in_its_positions():
    """A longer coupler, and a plate's point by its distances: the law of cosines."""
    points, ground, links = LINKAGES["coupler plate"]
    model = fb.compile_model(fb.Linkage("plate", points=points, ground=ground, links=links, density=1.0).model())
    assert {"l_AB", "l_BC", "l_BP", "l_CP", "l_CD", "x_D", "y_D"} <= {*model.parameters}
    changed = {"l_BC": 0.35, "l_BP": 0.3, "l_CP": 0.2}
    place = model.positions(0.0, model.initial_state(parameters=changed)[:3], {**model.defaults, **changed})
    for a, b, length in (("B", "C", 0.35), ("B", "P", 0.3), ("C", "P", 0.2)):
        assert np.linalg.norm(place[a] - place[b]) == pytest.approx(length, abs=1e-14)
    # On the side where it was drawn: left of the way from B to C.
    assert np.cross(place["C"] - place["B"], place["P"] - place["B"])[2] > 0


@pytest.mark.parametrize(
    ("name", "gruebler", "freedom", "redundant"),
    [
        ("four-bar", 1, 1, ()),
        ("five-bar", 2, 2, ()),
        ("Peaucellier", 1, 1, ()),
        ("Jansen", 1, 1, ()),
        ("double pendulum", 2, 2, ()),
        ("parallelogram with a bar too many", 0, 1, ("C", "F")),
    ],
)
def test_degrees_of_freedom_and_redundant_joints_of_known_linkages_are_found(name, gruebler, freedom, redundant):
    points, ground, links = LINKAGES[name]
    mobility = fb.Linkage("one", points=points, ground=ground, links=links).mobility
    assert (mobility.gruebler, mobility.degrees_of_freedom) == (gruebler, freedom)
    assert mobility.redundant == redundant
    assert len(mobility.independent) == freedom


@pytest.mark.slow
def test_linkage_drawn_at_a_dead_point_has_one_degree_of_freedom():
    """Crank and coupler in line: the rocker cannot be driven there, the crank can. A parallelogram drawn flat."""
    points = {"A": (0, 0), "B": (1, 0), "C": (3, 0), "D": (2.5, 2)}
    linkage = fb.Linkage("dead", points=points, ground="AD", links=["CD", "BC", "AB"], density=1.0)
    assert linkage.mobility.degrees_of_freedom == 1
    model = linkage.model()
    assert model.coordinates[0] in ("q_AB", "q_BC")
    assert fb.compile_model(model).simulate((0.0, 0.5), model_start(model, 1.0)).success
    flat = {"A": (0, 0), "B": (1, 0), "C": (3, 0), "D": (2, 0)}
    mobility = fb.Linkage("flat", points=flat, ground="AD", links=["AB", "BC", "CD"]).mobility
    assert mobility.degrees_of_freedom == 1
    assert mobility.is_singular


def model_start(model, rate):
    return fb.compile_model(model).initial_state(speeds=[rate])


def wrong(change):
    """The crank-rocker with one mistake."""
    points = {"A": (0, 0), "B": (0.1, 0.05), "C": (0.3, 0.3), "D": (0.4, 0)}
    if change == "a bar without length":
        points["B"] = points["A"]
    if change == "units mixed":
        points |= {"C": (300, 300), "D": (400, 0)}
    if change == "a point on no link":
        points["E"] = (1, 1)
    links = ["AB", "BC", "CD"]
    links = {"an open link": ["AB", "CD"], "a link of one point": ["AB", "B"], "an island": [*links, "EF"]}.get(
        change, links
    )
    if change == "an island":
        points |= {"E": (1, 0), "F": (1, 1)}
    if change == "a triangle":
        points, links = {"A": (0, 0), "B": (0.1, 0.05), "D": (0.4, 0)}, ["AB", "BD"]
    linkage = fb.Linkage("wrong", points=points, ground="" if change == "no ground" else "AD", links=links)
    if change == "a point twice":
        linkage.joint("B", (1, 1))
    if change == "a link twice":
        linkage.bar("A", "B")
    if change == "unknown point":
        linkage.bar("A", "Q")
    if change == "two drives":
        linkage.drive("A", speed=1.0)
        linkage.drive("D", speed=1.0)
    if change == "the ground as a link":
        linkage.bar("A", "D")
    if change == "a guide elsewhere":
        linkage.joint("S", (0.2, 0.3))
        linkage.bar("S", "D")
        linkage.slider("S", along="BC")
    if change == "a torque between three":
        linkage.bar("B", "D", name="other")
        linkage.torque("B", 1.0)
    return linkage.model()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("a point twice", "two points B"),
        ("a bar without length", "Link AB has no length from A to B: both are at .0, 0."),
        ("a point on no link", "Points E are on no link"),
        ("a link of one point", "two and more different points"),
        ("an island", "EF are not connected to the ground"),
        ("a triangle", "rigid: no link can move"),
        ("a link twice", "two links AB"),
        ("unknown point", "no point 'Q'"),
        ("no ground", "no ground"),
        ("two drives", "1 degrees of freedom, and the drives of AB, CD"),
        ("the ground as a link", "Link AD connects points of the ground only"),
        ("a guide elsewhere", "S is not on the guide from B to C"),
        ("a torque between three", "between two of AB, BC, other"),
    ],
)
def test_mistakes_in_a_linkages_points_and_links_are_refused_with_a_message(change, message):
    with pytest.raises(fb.ModelError, match=message):
        wrong(change)


FOUR_BAR = {"A": (0, 0), "B": (0.1, 0.05), "C": (0.3, 0.3), "D": (0.4, 0)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda linkage: linkage.torque("A", "my torque"), "torque on AB at A is a number, .* not 'my torque'"),
        (lambda linkage: linkage.torque("A", "2*x"), "not '2[*]x'"),
        (lambda linkage: linkage.torque("A", [1.0]), "torque on AB"),
        (lambda linkage: linkage.torque("AB", 1.0, link="BC"), "between it and the ground"),
        (lambda linkage: linkage.joint("_E", (1, 1)), "a letter, then letters"),
        (lambda linkage: linkage.joint("AB", (1, 1)), "AB is a link"),
        (lambda linkage: linkage.bar("A", "C", name="1st", density=1.0), "a letter, then letters"),
        (lambda linkage: linkage.bar("A", "C", density=-1.0), "mass of AC by length is -1 kg/m"),
        (lambda linkage: linkage.slider("C", along=1), "along= of C is a direction .x, y., or two points, not 1"),
        (lambda linkage: linkage.slider("A", along=(1, 0)), "A is a point of ground itself"),
        (lambda linkage: linkage.slider("C", along="BC"), "C is a point of BC itself"),
    ],
)
def test_mistakes_in_a_linkages_loads_and_drives_are_refused_with_a_message(change, message):
    linkage = fb.Linkage("one", points=FOUR_BAR, ground="AD", links=["AB", "BC", "CD"], density=1.0)

    def model():
        change(linkage)
        linkage.model()

    with pytest.raises(fb.ModelError, match=message):
        model()


@pytest.mark.parametrize("given", [{"links": None}, {"links": "AB"}, {"ground": 5}, {"ground": None}, {"links": [3]}])
def test_links_or_ground_that_are_no_sequences_are_refused(given):
    with pytest.raises(fb.ModelError, match=r"is a sequence of (names of points|links)"):
        fb.Linkage("one", points=FOUR_BAR, **{"ground": "AD", "links": ["AB", "BC", "CD"], **given})


def test_linkage_takes_arrays_and_names_for_links():
    links = {"crank": "AB", "coupler": ["B", "C"], "rocker": "CD"}
    linkage = fb.Linkage("one", points=FOUR_BAR, ground=np.array(["A", "D"]), links=links, density=np.float64(2.0))
    linkage.force("B", np.array([1.0, 2.0]))
    linkage.force("C", (sm.Integer(0), sm.Rational(1, 2)))
    model = linkage.model()
    assert model.coordinates == ("q_crank", "q_coupler", "q_rocker")
    assert {s.name: p.value for s, p in model.parameter_symbols.items()}["F_C_y"] == 0.5


@pytest.mark.slow
def test_masses_of_a_point_and_its_block_are_added():
    """A point mass and a block of the same point; F = (3 + 2) m x''."""
    m = sm.Symbol("m1")
    linkage = fb.Linkage("one", points={"O": (0, 0), "A": (0, 0.1)}, ground="O", links=["OA"])
    linkage.joint("C", (0.3, 0), mass=3 * m)
    linkage.bar("A", "C")
    linkage.slider("C", along=(1, 0), mass=2 * m)
    linkage.force("C", ("F", 0))
    model = fb.compile_model(linkage.model(parameters={m: 1.0}))
    found = model.kinematics({"q_C": [0.0]}, rates={"q_C": 0.0}, accelerations={"q_C": 1.0})[0]
    assert model.inverse_dynamics(found)["F"] == pytest.approx(5.0)


def test_density_of_a_linkage_gives_the_mass_of_a_bar_with_an_inertia():
    linkage = fb.Linkage("one", points={"A": (0, 0), "B": (0.5, 0)}, ground="A", density=2.0, gravity=10.0)
    linkage.bar("A", "B", inertia=0.1)
    model = fb.compile_model(linkage.model())
    # m g l / 2 over I + m l^2 / 4, with m = 1 kg.
    assert model.rhs(0.0, [0.0, 0.0])[1] == pytest.approx(-2.5 / (0.1 + 0.0625))


def test_pinned_plate_of_bars_turns_with_the_closed_forms_inertia():
    """The inertia of a triangle of bars about its corner."""
    places = {"A": 0j, "B": 1 + 0j, "C": 0.3 + 0.8j}
    points = {name: (z.real, z.imag) for name, z in places.items()}
    linkage = fb.Linkage("one", points=points, ground="A", links=["ABC"], density=1.0)
    linkage.torque("A", "M")
    inertia = sum(
        abs(b - a) * (abs(b - a) ** 2 / 12 + abs(a + b) ** 2 / 4)
        for a, b in ((places[i], places[j]) for i, j in ("AB", "BC", "CA"))
    )
    model = fb.compile_model(linkage.model())
    assert model.rhs(0.0, [0.3, 0.0], r={"M": 1.0})[1] == pytest.approx(1 / inertia, rel=1e-14)


def test_symbols_of_a_linkage_whose_names_coincide_are_numbered():
    """Two lengths l_A_B_C; a spring's stiffness beside a symbol of the user's; a link with the name of two points."""
    points = {"A": (0, 0), "B_C": (0.2, 0.1), "T": (0.1, 0.2), "A_B": (0.5, 0.4), "C": (0.7, 0)}
    linkage = fb.Linkage("one", points=points, ground=["A", "C"])
    linkage.plate("A", "B_C", "T")
    linkage.bar("B_C", "A_B")
    linkage.bar("A_B", "C")
    values = {s.name: p.value for s, p in linkage.model().parameter_symbols.items()}
    assert values["l_A_B_C"] == pytest.approx(sqrt(0.05))
    assert values["l_A_B_C_2"] == pytest.approx(sqrt(0.2))
    k = sm.Symbol("k_BC")
    linkage = fb.Linkage("one", points={"A": (0, 0), "B": (0.5, 0), "C": (0.2, 0.7)}, ground="AC", links=["AB"])
    linkage.torque("A", -k * linkage.q["AB"])
    linkage.spring("B", "C", 40.0)
    values = {s.name: p.value for s, p in linkage.model(parameters={k: 0.5}).parameter_symbols.items()}
    assert (values["k_BC"], values["k_BC_2"]) == (0.5, 40.0)


@pytest.mark.slow
def test_drive_with_a_name_is_an_input_of_that_name_or_refused():
    """The motion is an input of that name: held as drawn, or given; the crank's angle is what is given."""
    points = {"A": (0, 0), "B": (0, 0.1), "C": (0.3, 0.3), "D": (0.4, 0)}
    found = []
    for angle in ("s", me.dynamicsymbols("s")):
        linkage = fb.Linkage("named", points=points, ground="AD", links=["AB", "BC", "CD"], density=1.0)
        linkage.drive("A", angle=angle)
        found.append(linkage.model())
    assert found[1].input_expressions == found[0].input_expressions
    model = fb.compile_model(found[0])
    assert (model.inputs, model.outputs) == (("s", "s'", "s''"), ("torque_A",))
    np.testing.assert_allclose(model.simulate((0.0, 1.0))["q_AB"], np.pi / 2, rtol=1e-14)
    t = np.linspace(0.0, 1.0, 11)
    run = model.simulate((0.0, 1.0), inputs={"s": (t, np.pi / 2 + t**3)}, t_eval=t)
    np.testing.assert_allclose(run["q_AB"], np.pi / 2 + t**3, rtol=1e-12)  # a spline is exact for cubics
    with pytest.raises(fb.AssemblyError, match=r"with s = 1.5708, and .*too short\) and the prescribed motions[.]$"):
        model.initial_state(parameters={"l_BC": 2.0})
    for wrong in ("w", 2 * me.dynamicsymbols._t):
        with pytest.raises(fb.ModelError, match="speed of the drive at A is a number or an expression of parameters"):
            fb.Linkage("fast", points=points, ground="AD", links=["AB", "BC", "CD"]).drive("A", speed=wrong)


@pytest.mark.slow
def test_independent_coordinate_of_a_linkage_may_be_chosen_with_the_same_motion():
    """Of the four-bar each link may be the independent one; the motion is the same."""
    points = {"A": (0, 0), "B": (0, 0.1), "C": (0.3, 0.3), "D": (0.4, 0)}
    how = {"points": points, "ground": "AD", "links": ["AB", "BC", "CD"], "density": 1.0, "gravity": 9.81}
    runs = {}
    for name in ("AB", "CD"):
        linkage = fb.Linkage("chosen", independent=name, **how)
        assert linkage.mobility.independent == (name,)
        model = fb.compile_model(linkage.model())
        assert model.coordinates[0] == f"q_{name}"
        runs[name] = model.simulate((0.0, 0.3), rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(runs["AB"]["q_CD"][-1], runs["CD"]["q_CD"][-1], rtol=1e-9)
    assert fb.Linkage("chosen", independent=["BC"], **how).mobility.independent == ("BC",)
    with pytest.raises(fb.ModelError, match=r"'XY', which is no link or block.* There are AB, BC, CD"):
        fb.Linkage("chosen", independent="XY", **how).model()
    with pytest.raises(fb.ModelError, match="AB, CD cannot be independent as chosen is drawn: 1 coordinates determine"):
        fb.Linkage("chosen", independent=["AB", "CD"], **how).model()
    how["points"] = {**points, "B": (0.1, 0.1)}  # at a dead point of the rocker
    with pytest.raises(fb.ModelError, match="CD cannot be independent as chosen is drawn: 1 coordinates determine"):
        fb.Linkage("chosen", independent="CD", **how).model()
    driven = fb.Linkage("chosen", independent="CD", **how)
    driven.drive("A", angle="s")
    with pytest.raises(fb.ModelError, match=r"CD cannot be independent .* while AB is driven: the drives determine"):
        driven.model()
    for wrong in (None, 5):
        with pytest.raises(fb.ModelError, match=f"independent= is the name of a link or block, .* not {wrong}"):
            fb.Linkage("chosen", independent=wrong, **how)


@pytest.mark.parametrize(
    ("motion", "kind"),
    [
        ("q_BC", "a coordinate or speed"), ("u_AB", "a coordinate or speed"), ("l_AB", "a parameter"),
        ("torque_A", "an output"), (me.dynamicsymbols("q_CD"), "a coordinate or speed"),
        (me.dynamicsymbols("q_AB"), "a coordinate or speed"),
    ],
)  # fmt: skip
def test_drive_with_a_name_that_is_taken_is_refused(motion, kind):
    points = {"A": (0, 0), "B": (0, 0.1), "C": (0.3, 0.3), "D": (0.4, 0)}
    linkage = fb.Linkage("driven", points=points, ground="AD", links=["AB", "BC", "CD"], density=1.0)
    linkage.drive("A", angle=motion)
    name = motion if isinstance(motion, str) else motion.name
    with pytest.raises(fb.ModelError, match=f"The input {name} has the name of {kind} of .* follow functions of time"):
        linkage.model()


@pytest.mark.slow
def test_drive_starts_at_the_drawn_angle_also_at_a_dead_point():
    """Although the link is stated before those that place it; and a drive at its dead point is no drive too many."""
    linkage = fb.Linkage("one", points={"A": (0, 0), "B": (0.5, 1), "C": (0.9, 1.25), "D": (1.2, 0)}, ground="AD")
    linkage.bar("B", "C")
    linkage.drive("BC", speed=1.0)
    linkage.bar("A", "B")
    linkage.bar("C", "D")
    parameters = {s.name: p.value for s, p in linkage.model().parameter_symbols.items()}
    assert parameters["start_BC"] == pytest.approx(np.arctan2(0.25, 0.4))
    dead = {"O": (0, 0), "A": (0.1, 0), "C": (0.4, 0)}
    linkage = fb.Linkage("dead", points=dead, ground="O", links=["OA", "AC"], density=1.0)
    linkage.slider("C", along=(1, 0))
    linkage.drive("C", speed=-0.1)
    assert linkage.mobility.free == ()
    with pytest.raises(fb.SimulationError, match="singular"):
        fb.compile_model(linkage.model()).simulate((0.0, 0.1))


@pytest.mark.slow
def test_linkage_in_nanometres_has_torques_in_proportion():
    """With gravity in proportion, torques go with the third power of the size."""
    torques = []
    for size in (1.0, 1e-9):
        points = {name: (size * x, size * y) for name, (x, y) in FOUR_BAR.items()}
        linkage = fb.Linkage(
            "small", points=points, ground="AD", links=["AB", "BC", "CD"], density=1.3, gravity=9.81 * size
        )
        linkage.torque("A", "M")
        model = fb.compile_model(linkage.model())
        found = model.kinematics({"q_AB": np.linspace(0.0, 6.0, 7)}, rates={"q_AB": 2.0})
        assert len(found) == 2
        torques.append(model.inverse_dynamics(found[0])["M"] / size**3)
    np.testing.assert_allclose(torques[1], torques[0], rtol=1e-9)


@pytest.mark.slow
def test_lengths_of_a_plate_that_make_no_triangle_are_refused():
    points, ground, links = LINKAGES["coupler plate"]
    model = fb.compile_model(fb.Linkage("plate", points=points, ground=ground, links=links).model())
    with pytest.raises(fb.ModelError, match="P have no positions with these parameters"):
        model.kinematics({"q_AB": [0.0, 1.0]}, parameters={"l_BP": 0.01, "l_CP": 0.01})


def test_linkage_with_mixed_units_gives_a_warning():
    with pytest.warns(fb.ModelWarning, match="are units mixed"):
        wrong("units mixed")


def test_linkage_with_a_forgotten_bar_has_two_degrees_of_freedom():
    """Two pendulums, where a bar between them was forgotten: said in numbers, by both coordinates."""
    points = {"A": (0, 0), "B": (0.1, 0.05), "C": (0.3, 0.3), "D": (0.4, 0)}
    linkage = fb.Linkage("open", points=points, ground="AD", links=["AB", "CD"])
    assert linkage.mobility.degrees_of_freedom == 2
    assert linkage.mobility.parts == ((("AB",), 1), (("CD",), 1))
    assert len(linkage.model().system.q_ind) == 2


def test_rigid_groups_of_bars_are_named_in_a_warning():
    """A triangle of bars as coupler, and one on the ground beside a four-bar; a crossbar that makes a frame."""
    points = {"A": (0, 0), "B": (0.1, 0.05), "C": (0.3, 0.3), "D": (0.4, 0), "P": (0.15, 0.4), "E": (0.2, -0.3)}

    def made(links, names):
        return fb.Linkage("one", points={name: points[name] for name in names}, ground="AD", links=links)

    coupler = made(["AB", "BC", "CP", "PB", "CD"], "ABCDP")
    with pytest.warns(fb.ModelWarning, match="BC, CP, PB of one move as one rigid part.* points B, C, P"):
        assert coupler.mobility.rigid == (("BC", "CP", "PB"),)
    with pytest.warns(fb.ModelWarning, match="Links AE, ED of one cannot move") as told:
        assert made(["AB", "BC", "CD", "AE", "ED"], "ABCDE").model().coordinates
    assert told[0].filename == __file__
    framed = made(["AB", "BC", "CD", "DB", "CP"], "ABCDP")
    with pytest.warns(fb.ModelWarning, match="Links AB, BC, CD, DB of one cannot move"):
        assert framed.mobility.parts == ((("CP",), 1),)
    framed.drive("A", speed=1.0)
    with pytest.raises(fb.ModelError, match="AB is rigidly connected to the ground"):
        framed.mobility  # noqa: B018


def test_links_that_drives_leave_free_are_named_in_the_mobility():
    points, ground, links = LINKAGES["five-bar"]
    linkage = fb.Linkage("one", points=points, ground=ground, links=links)
    linkage.drive("A", speed=1.0)
    assert linkage.mobility.free == ("BC", "CD", "DE")
    linkage.drive("E", speed=1.0)
    assert linkage.mobility.free == ()


def test_linkage_from_csv_reads_points_and_links_and_refuses_bad_tables(tmp_path):
    path = tmp_path / "crank rocker.csv"
    rows = ["point,x,y,links", "A,0,0,ground crank", "B,0.1,0.05,crank coupler", "C,0.3,0.3,coupler rocker"]
    path.write_text("\n".join([*rows, "D,0.4,0,rocker ground"]))
    linkage = fb.Linkage.from_csv(path, density=1.0)
    assert linkage.model().coordinates == ("q_crank", "q_coupler", "q_rocker")
    assert linkage.name == "crank_rocker"
    other = tmp_path / "4bar.csv"
    marked = ["# from a drawing", " Point; X ;Y; Links", "", *(row.replace(",", "; ") for row in rows[1:]), ";;;"]
    other.write_text("\n".join([*marked, "D; 0.4; 0; rocker Ground"]))
    assert fb.Linkage.from_csv(other).mobility == linkage.mobility
    assert fb.Linkage.from_csv(other).name == "linkage_4bar"
    path.write_text("point,x,y,links\n")
    with pytest.raises(fb.ModelError, match="has no points"):
        fb.Linkage.from_csv(path)
    path.write_text("point,x,y,links\nA,zero,0,ground")
    with pytest.raises(fb.ModelError, match="Row 2 of"):
        fb.Linkage.from_csv(path)
    with pytest.raises(fb.ModelError, match="cannot be read"):
        fb.Linkage.from_csv(tmp_path / "none.csv")


@pytest.mark.slow
def test_system_of_a_linkage_has_sympys_rates_and_is_formed_anew_after_changes():
    """SymPy's own equations of the System, at a state, are the compiled ones."""
    linkage = crank_rocker(density=1.0, gravity=9.81)
    system = linkage.system
    assert linkage.system is system
    model = linkage.model()
    compiled = fb.compile_model(model)
    state = compiled.initial_state(speeds=[1.3])
    system.form_eoms(constraint_solver="CRAMER")
    values = dict(zip((*system.q_ind, *system.q_dep, *system.u_ind, *system.u_dep), state, strict=True))
    values |= {symbol: parameter.value for symbol, parameter in model.parameter_symbols.items()}
    mass, forcing = (np.array(m.subs(values).evalf(), dtype=float) for m in (system.mass_matrix, system.forcing))
    np.testing.assert_allclose(np.linalg.solve(mass, forcing).ravel(), compiled.rhs(0.0, state)[3:], rtol=1e-9)
    linkage.force("C", (1.0, 0.0))
    assert linkage.system is not system


def test_names_of_points_in_a_links_text_are_split_only_if_unique():
    points = {"A1": (0, 0), "A": (1, 0), "B": (1, 1)}
    linkage = fb.Linkage("names", points=points, ground=["A1"], links=["A1B", ("B", "A")])
    assert [*linkage.q] == ["A1_B", "BA"]
    with pytest.raises(fb.ModelError, match="not made of names"):
        fb.Linkage("names", points=points, links=["A1C"])
    with pytest.raises(fb.ModelError, match="ambiguous"):
        fb.Linkage("names", points={"A": (0, 0), "B": (1, 0), "AB": (1, 1)}, links=["ABA"])
