"""Positions along a drive: known curves, limits and velocities of mechanisms, and what cannot be driven."""

import json
from importlib import import_module
from itertools import product
from math import acos, pi, radians, sqrt

import numpy as np
import pytest
from builders.prescribed import driven_pendulum

import fourbar_codegen as fb
from fourbar_codegen.analysis.continuation import trace

mechanisms = import_module("11_mechanisms")


def found_of(make, values=None, **how):
    """The branches of a mechanism of the example, and the one that is drawn."""
    drive, own, _ = mechanisms.MECHANISMS[make]
    made = make()
    model = fb.compile_model(made if isinstance(made, fb.Model) else made.model())
    return model.kinematics({drive: own if values is None else values}, **how)


@pytest.mark.slow
def test_peaucelliers_pen_moves_on_the_exact_line_in_every_branch():
    """x = (l^2 - s^2) / (2 p) = 16/3, exactly; |OB| |OD| = l^2 - s^2 = 16, in every branch where the cell is open."""
    found = found_of(mechanisms.peaucellier)
    x, y, _ = found[0]["D"]
    np.testing.assert_allclose(x, 16 / 3, rtol=0, atol=1e-12)
    np.testing.assert_allclose(y, 16 / 3 * np.tan(found.drive["q_QB"] / 2), rtol=0, atol=1e-11)
    product = np.linalg.norm(found[0]["B"], axis=0) * np.linalg.norm(found[0]["D"], axis=0)
    np.testing.assert_allclose(product, 16.0, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_chebyshevs_point_stays_near_its_line_within_the_arms_limits():
    """Within sqrt(1029)/8 - 4 of y = 4 for 0 <= x <= 4, exact; the arm turns between acos(4/5) and acos(-1/5).

    Source of the limits: https://en.wikipedia.org/wiki/Chebyshev_linkage.
    """
    found = found_of(mechanisms.chebyshev, np.linspace(radians(30.0), radians(110.0), 1601))
    x, y, _ = found[0]["P"]
    inside = (x >= 0) & (x <= 4)
    assert np.nanmax(np.abs(y[inside] - 4.0)) <= sqrt(1029) / 8 - 4 + 1e-12
    assert np.nanmax(np.abs(y[inside] - 4.0)) > (sqrt(1029) / 8 - 4) * 0.999
    limits = sorted({round(point["q_OA"], 9) for point in found.dead_points})
    np.testing.assert_allclose(limits, [acos(4 / 5), acos(-1 / 5)], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_hoekens_point_moves_at_four_thirds_of_the_cranks_speed():
    """4/3 of the crank's speed in the middle of the line; P is at (4, 4), (2, 4), (0, 4) at quarter turns."""
    found = found_of(mechanisms.hoeken, np.array([pi / 2, pi, 3 * pi / 2]))
    branch = found[0]
    np.testing.assert_allclose(branch["P"][:2], [[4.0, 2.0, 0.0], [4.0, 4.0, 4.0]], rtol=0, atol=1e-12)
    assert branch.velocities["P"][0, 1] == pytest.approx(-4 / 3, abs=1e-12)


@pytest.mark.slow
def test_watts_point_leaves_its_line_with_the_fifth_power():
    """x = y^5 / (8 b^3 c) for small y: the first derivative that is not zero is the fifth."""
    found = found_of(mechanisms.watt, np.linspace(-0.06, 0.06, 13))
    x, y, _ = found[0]["P"]
    expected = y**5 / (8 * 2.5**3 * 0.5) * (1 + (y / 2.5) ** 2)
    np.testing.assert_allclose(x, expected, rtol=2e-3, atol=1e-13)


@pytest.mark.slow
def test_jansens_foot_at_quarter_turns_equals_intersections_of_circles():
    """The foot at quarters of a turn, by circles that intersect, with the published lengths."""
    found = found_of(mechanisms.jansen, np.radians([0.0, 90.0, 180.0, 270.0]))
    expected = [
        (-43.1601105241047, -91.75693292612323),
        (-7.689066230641682, -90.38935136740429),
        (-33.72972953816961, -73.5170974098195),
        (-70.67056317652096, -89.64283680091991),
    ]
    np.testing.assert_allclose(found[0]["H"][:2].T, expected, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_pantograph_along_its_drive_scales_by_its_ratio():
    branch = found_of(mechanisms.pantograph)[0]
    np.testing.assert_allclose(branch["Q"], 2.5 * branch["P"], rtol=0, atol=1e-11)


@pytest.mark.slow
def test_scissor_lift_along_its_drive_has_the_closed_form_height():
    """h = n l sin(theta), w = l cos(theta)."""
    branch = found_of(mechanisms.scissor_lift)[0]
    width = branch["R0"][0]
    np.testing.assert_allclose(branch["T"][1], 3 * np.sqrt(4 - width**2), rtol=0, atol=1e-11)


@pytest.mark.slow
def test_quick_return_along_its_drive_has_the_closed_form_stroke_and_speed():
    """The ram turns round where the crank is square to the lever, at 210 and 330 degrees: back in half of the time."""
    branch = found_of(mechanisms.quick_return, np.radians([90.0, 210.0, 330.0]))[0]
    assert branch["u_LB"][0] == pytest.approx(1 / 3, abs=1e-12)
    np.testing.assert_allclose(branch.velocities["C"][0, 1:], 0.0, atol=1e-12)
    assert abs(branch["C"][0, 1] - branch["C"][0, 2]) == pytest.approx(4.0, abs=1e-12)


@pytest.mark.slow
def test_transmission_angles_of_a_crank_rocker_have_the_closed_form_extremes():
    """Their extremes, by the law of cosines: 25.2 and 58.4 degrees, where crank and ground are in line."""
    branch = found_of(mechanisms.crank_rocker)[0]
    angle = branch.transmission_angle("A", "B", "R")
    expected = [acos((49 + 81 - (6 - sign * 2) ** 2) / (2 * 7 * 9)) for sign in (1, -1)]
    np.testing.assert_allclose([angle.min(), angle.max()], expected, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_velocities_and_accelerations_of_a_slider_equal_closed_forms():
    """In closed form, at 3 rad/s and with 2 rad/s^2."""
    angles = np.linspace(0.1, 6.0, 40)
    found = found_of(mechanisms.slider_crank, angles, rates={"q_OA": 3.0}, accelerations={"q_OA": 2.0})
    s = np.sqrt(9 - np.sin(angles) ** 2)
    first = -np.sin(angles) * (1 + np.cos(angles) / s)
    second = -np.cos(angles) - np.cos(2 * angles) / s - np.sin(2 * angles) ** 2 / (4 * s**3)
    np.testing.assert_allclose(found[0]["C"][0], np.cos(angles) + s, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found[0].velocities["C"][0], 3 * first, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found[0].accelerations["C"][0], 9 * second + 2 * first, rtol=0, atol=1e-11)
    assert len(found) == 2


@pytest.mark.slow
def test_branch_saved_to_files_holds_places_rates_and_accelerations(tmp_path):
    """The slider's place, rate and acceleration in closed form, as above; a value at which the loop does not close."""
    angles = np.linspace(0.1, 6.0, 40)
    found = found_of(mechanisms.slider_crank, angles, rates={"q_OA": 3.0}, accelerations={"q_OA": 2.0})
    s = np.sqrt(9 - np.sin(angles) ** 2)
    first = -np.sin(angles) * (1 + np.cos(angles) / s)
    second = -np.cos(angles) - np.cos(2 * angles) / s - np.sin(2 * angles) ** 2 / (4 * s**3)
    path = found[0].save(tmp_path / "folder" / "branch.csv")
    header = path.read_text().splitlines()[0].split(",")
    rows = dict(zip(header, np.loadtxt(path, delimiter=",", skiprows=1).T, strict=True))
    archive = np.load(found[0].save(tmp_path / "branch.npz"))
    for file in (rows, archive):
        np.testing.assert_array_equal(file["q_OA"], angles)
        np.testing.assert_allclose(file["q_OA''"], 2.0, rtol=0, atol=1e-12)
        np.testing.assert_allclose(file["C.x"], np.cos(angles) + s, rtol=0, atol=1e-12)
        np.testing.assert_allclose(file["C.x'"], 3 * first, rtol=0, atol=1e-12)
        np.testing.assert_allclose(file["C.x''"], 9 * second + 2 * first, rtol=0, atol=1e-11)
        np.testing.assert_allclose(file["u_OA"], 3.0, rtol=0, atol=1e-12)
    assert header == [name for name in archive.files if name != "run_attributes"]
    about = json.loads(str(archive["run_attributes"]))
    assert about["limits"]["q_OA"] == [0.1, 6.0]
    assert about["fingerprint"] == found.model.manifest["fingerprint"]
    with pytest.raises(fb.ModelError, match=r"A branch is saved as \.csv, \.npz"):
        found[0].save(tmp_path / "branch.xlsx")
    with pytest.raises(fb.ModelError, match="holds no trajectory"):
        fb.load_trajectory(tmp_path / "branch.npz", found.model)
    crank = fb.compile_model(fb.models.slider_crank())
    open_ends = crank.kinematics({"slide": [0.1, 0.3]})[0].save(tmp_path / "open.npz")
    np.testing.assert_array_equal(np.load(open_ends)["slide"], [0.1, 0.3])
    assert np.isnan(np.load(open_ends)["crank"]).tolist() == [True, False]


def test_dead_points_of_a_driven_slider_are_where_crank_and_rod_are_in_line():
    """At x = l + r and l - r, where crank and rod are in line; beyond, the loop does not close."""
    crank = fb.compile_model(fb.models.slider_crank())
    found = crank.kinematics({"slide": np.linspace(0.15, 0.45, 31)})
    assert sorted(point["slide"] for point in found.dead_points) == pytest.approx([0.2, 0.4], abs=1e-12)
    assert np.flatnonzero(found.closes).tolist() == list(range(5, 26))
    assert np.isnan(found[0].u[:, 5]).all()
    assert [branch.limits["slide"] for branch in found] == [pytest.approx((0.2, 0.4), abs=1e-12)] * 2


@pytest.mark.slow
def test_branches_that_close_in_a_small_part_of_the_drive_are_found():
    """The loop closes between 0.2 and 0.4 m, of 5: at given values alone, and the first of these is a dead point."""
    crank = fb.compile_model(fb.models.slider_crank())
    found = crank.kinematics({"slide": np.linspace(0.0, 5.0, 201)})
    assert len(found) == len(found.dead_points) == 2
    assert np.flatnonzero(found.closes).tolist() == list(range(8, 17))


def crossings(drawn, at, one, other, name):
    """The points at the drawn distances of a name from two pivots, which are elsewhere now."""
    near, far, apart = abs(drawn[name] - drawn[one]), abs(drawn[name] - drawn[other]), at[other] - at[one]
    along = (near**2 - far**2 + abs(apart) ** 2) / (2 * abs(apart))
    height = near**2 - along**2
    return [at[one] + apart / abs(apart) * (along + side * 1j * height**0.5) for side in (1, -1) if height > 0]


@pytest.mark.slow
def test_branches_that_close_at_few_values_beside_others_are_all_found():
    """Pivots on circles: C by B and D, F by E and G, H by C and J. Two of ten values with 8 modes stand apart."""
    points = {
        "O": (0, 0), "A": (0.5070579, 0.1521173), "B": (-0.4246983, 0.7039159), "E": (1.1521088, -0.3365495),
        "D": (-0.2997853, -0.5088148), "C": (0.2607650, -0.2600158), "G": (1.6721405, -1.0057842),
        "F": (2.2621141, -0.4655703), "J": (1.4915418, -1.4231630), "H": (0.1787367, -1.4181379),
    }  # fmt: skip
    links = ["OABE", "BC", "DC", "EF", "GF", "CH", "JH"]
    linkage = fb.Linkage("island", points=points, ground="ODGJ", links=links)
    angles = np.linspace(-pi, pi, 91) + 0.003
    found = fb.compile_model(linkage.model()).kinematics({"q_OABE": angles})
    z = {name: complex(*place) for name, place in points.items()}

    expected = []
    for angle in angles:
        turned = np.exp(1j * angle) / z["A"] * abs(z["A"])  # of the plate, whose angle is that of O to A
        at = {name: place * turned if name in "OABE" else place for name, place in z.items()}
        h = [point for c in crossings(z, at, "B", "D", "C") for point in crossings(z, {**at, "C": c}, "C", "J", "H")]
        expected.append(len(h) * len(crossings(z, at, "E", "G", "F")))
    assert np.isfinite([branch.q for branch in found]).all(axis=1).sum(axis=0).tolist() == expected
    assert [k for k, number in enumerate(expected) if number == 8] == [28, 29, *range(56, 64)]
    assert found.is_complete


@pytest.mark.slow(but=["1e-06"])
@pytest.mark.parametrize("inset", [0.0, 1e-12, 1e-8, 1e-6, 1e-5, 1e-4, -0.01])
def test_branches_of_a_slider_driven_over_its_stroke_end_at_dead_points(inset):
    """0.2 m for a crank of 0.1 m: two branches, whose ends are dead points if these are within the drive's ends."""
    points = {"O": (0, 0), "A": (0.1, 0), "C": (0.4, 0)}
    linkage = fb.Linkage("engine", points=points, ground="O", links=["OA", "AC"])
    linkage.slider("C", along=(1, 0))
    model = fb.compile_model(linkage.model())
    values = np.linspace(-0.2 + inset, -inset, 41)
    found = model.kinematics({"q_C": values})
    assert len(found) == 2
    assert len(found.dead_points) == (2 if inset < 1e-9 else 0)
    assert found.is_complete
    inside = (values >= -0.2 - 1e-15) & (values <= 1e-15)
    assert (found.closes == inside).all()
    for branch in found:
        x = 0.4 + values[inside]
        cosine = np.clip((x**2 + 0.1**2 - 0.3**2) / (2 * 0.1 * x), -1.0, 1.0)
        # Loops are closed to 1e-12, and the cosine changes by 15 per metre at the dead point.
        np.testing.assert_allclose(np.cos(branch["q_OA"][inside]), cosine, rtol=0, atol=2e-11)


@pytest.mark.slow
@pytest.mark.parametrize("offset", [0.0, 1e-6, 1e-4, 5e-3, 8e-3, 1e-2])
def test_branches_of_a_parallelogram_cross_at_change_points_with_their_limits(offset):
    """A parallelogram, and its antiparallel branch with -3 / (5 - 4 cos q) of the speed: limits where they cross.

    The interpolation errs by h^8 / 70 = 4e-16 times the eighth derivative, 2e6 there.
    """
    points = {"A": (0, 0), "B": (0, 1), "C": (2, 1), "D": (2, 0)}
    linkage = fb.Linkage("para", points=points, ground="AD", links=["AB", "BC", "CD"], density=1.0, gravity=9.81)
    linkage.torque("A", "M")
    model = fb.compile_model(linkage.model())
    angles = np.array([offset, 1.0, pi + offset, 4.0, 2 * pi - offset])
    along, across = model.kinematics({"q_AB": angles})
    np.testing.assert_allclose(along["u_CD"], 1.0, rtol=0, atol=1e-10)
    # Those at 0.008, the nearest that are evaluated directly, err most: by 4e-9, whether compiled with FMA or with -O0.
    np.testing.assert_allclose(along.qdd, 0.0, rtol=0, atol=1e-8)
    cosine = np.cos(angles)
    np.testing.assert_allclose(across["u_CD"], -3 / (5 - 4 * cosine), rtol=0, atol=1e-8)
    acceleration = 12 * np.sin(angles) / (5 - 4 * cosine) ** 2
    np.testing.assert_allclose(across.ud[model.speeds.index("u_CD")], acceleration, rtol=0, atol=1e-8)
    # Weights of cranks of 1 m, with coupler: M = (1 + 2) m g cos q. At the change point itself no torque holds them.
    torque = model.inverse_dynamics(along)["M"]
    assert np.isnan(torque[[0, 2, 4]]).all() == (offset == 0.0)
    known = np.isfinite(torque)
    # Accelerations err by 1e-10, and reactions by that over the distance from the change point, 1e-6 at least.
    np.testing.assert_allclose(torque[known], 3 * 9.81 * cosine[known], rtol=0, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("ground", [1.3, 1.1, 1.03, 1.01])
def test_branches_of_a_near_rhombus_have_closed_form_rates_at_the_change_point(ground):
    """Nearly a rhombus: the antiparallel branch turns within ground - 1 rad, (d^2 - 1) / (d - 1)^2 times as fast.

    Its position is an odd function of the distance, which any interpolation meets.
    """
    points = {"A": (0, 0), "B": (0, 1), "C": (ground, 1), "D": (ground, 0)}
    model = fb.compile_model(fb.Linkage("rhombus", points=points, ground="AD", links=["AB", "BC", "CD"]).model())
    angles = np.array([0.0, 1e-4, 4e-3, 1.0, pi, 2 * pi])
    along, across = model.kinematics({"q_AB": angles})
    np.testing.assert_allclose(along["u_CD"], 1.0, rtol=0, atol=1e-10)
    squares = ground**2 + 1.0 - 2.0 * ground * np.cos(angles)
    speed = -(ground**2 - 1.0) / squares
    # With nth derivatives of n! / R^n, six positions err by 36 (h / R)^6 <= 1e-6, and eight by 576 (h / R)^8 = 5e-8.
    np.testing.assert_allclose(across["u_CD"], speed, rtol=5e-8)
    acceleration = 2.0 * ground * np.sin(angles) * -speed / squares
    size = np.abs(speed).max() ** 2
    # The same of accelerations and squares of speeds, which are as large.
    np.testing.assert_allclose(across.ud[model.speeds.index("u_CD")], acceleration, rtol=0, atol=1e-7 * size)


@pytest.mark.slow
@pytest.mark.parametrize("longer", [1e-9, 1e-7, 5e-6, 1e-4])
def test_branches_beside_a_change_point_stay_on_their_side(longer):
    """A rod that is longer than the crank by little: the slider goes on on its side, by Pythagoras."""
    points = {"O": (0, 0), "A": (0.3, 0.4), "C": (0.6, 0)}
    linkage = fb.Linkage("isosceles", points=points, ground="O", links=["OA", "AC"])
    linkage.slider("C", along=(1, 0))
    model = fb.compile_model(linkage.model())
    angles = np.radians(np.arange(0.0, 361.0, 10.0))
    found = model.kinematics({"q_OA": angles}, parameters={"l_AC": 0.5 + longer})
    assert len(found) == 2
    side = np.sqrt((0.5 + longer) ** 2 - (0.5 * np.sin(angles)) ** 2)
    # Loops are closed to 1e-12, and the square root of what is added is taken.
    for branch, sign in zip(found, (1, -1), strict=True):
        expected = 0.5 * np.cos(angles) + sign * side
        np.testing.assert_allclose(branch["C"][0], expected, rtol=0, atol=1e-12 / side.min())


@pytest.mark.slow
def test_branches_of_a_folding_kite_go_through_its_folded_position():
    """Crank and ground of 1 m, coupler and rocker alike: folded, the rocker is free; two branches go on through it."""
    points = {"A": (0, 0), "B": (0.6, 0.8), "D": (1, 0), "C": (2.4, 1.2)}
    linkage = fb.Linkage("kite", points=points, ground="AD", links=["AB", "BC", "CD"])
    found = fb.compile_model(linkage.model()).kinematics({"q_AB": np.linspace(0.0, 2 * pi, 37)})
    assert len(found) == 2
    assert found.dead_points == ()
    assert found.closes.all()


@pytest.mark.slow
@pytest.mark.parametrize("wheels", [3, 4])
def test_branches_of_coupled_wheels_satisfy_their_closed_form(wheels):
    """Each coupling is a parallelogram or antiparallelogram: tan(q/2) of a wheel is k times that of the one before."""
    places = {f"G{i}": (2.0 * i, 0) for i in range(wheels)} | {f"K{i}": (2.0 * i + 0.6, 0.8) for i in range(wheels)}
    links = [(f"G{i}", f"K{i}") for i in range(wheels)] + [(f"K{i}", f"K{i + 1}") for i in range(wheels - 1)]
    linkage = fb.Linkage("wheels", points=places, ground=[f"G{i}" for i in range(wheels)], links=links, density=1.0)
    linkage.torque("G0", "M")
    with pytest.warns(fb.ModelWarning, match="move as one rigid part"):
        model = fb.compile_model(linkage.model())
    angles = np.linspace(0.0, 2 * pi, 181)
    found = model.kinematics({"q_G0_K0": angles})
    assert len(found) == 2 ** (wheels - 1)
    assert found.closes.all()
    for branch in found:
        tangents = np.tan([branch[f"q_G{i}_K{i}"][[5, 40, 130]] / 2 for i in range(wheels)])
        ratios = tangents[1:] / tangents[:-1]
        # The antiparallelogram of crank 1 and ground 2 multiplies tan(q/2) by -(2 + 1) / (2 - 1), or its inverse.
        known = np.array([1.0, -3.0, -1 / 3])
        assert np.abs(ratios[..., None] - known).min(axis=-1).max() < 1e-9
        for k in range(0, 181, 20):
            assert np.abs(model.position_constraints(0.0, branch.q[:, k])).max() < 1e-10
        torque = model.inverse_dynamics(branch)["M"]
        assert np.flatnonzero(np.isnan(torque)).tolist() == [0, 90, 180]


@pytest.mark.slow
def test_branches_of_two_drives_around_a_square_equal_intersections_of_circles():
    """Two drives of a five-bar around a square and back: each position by two circles that intersect."""
    points = {"A": (0, 0), "B": (-0.1, 0.3), "C": (0.2, 0.5), "D": (0.5, 0.25), "E": (0.4, 0)}
    linkage = fb.Linkage("five", points=points, ground="AE", links=["AB", "BC", "CD", "DE"])
    first, second = np.array([1.7, 1.9, 1.9, 1.7, 1.7, 1.9]), np.array([1.2, 1.2, 1.4, 1.4, 1.2, 1.4])
    found = fb.compile_model(linkage.model()).kinematics({"q_AB": first, "q_DE": second})
    assert found.is_complete
    assert found.closes.all()
    ab, bc, cd, de = (
        np.linalg.norm(np.subtract(points[a], points[b])) for a, b in (("A", "B"), ("B", "C"), ("C", "D"), ("D", "E"))
    )
    b = ab * np.exp(1j * first)
    # q_DE is the angle of the way from D to E.
    d = 0.4 - de * np.exp(1j * second)
    along = (d - b) / abs(d - b)
    middle = (bc**2 - cd**2 + abs(d - b) ** 2) / (2 * abs(d - b))
    expected = [b + along * (middle + side * 1j * np.sqrt(bc**2 - middle**2)) for side in (1, -1)]
    assert len(found) == 2
    places = [branch["C"][0] + 1j * branch["C"][1] for branch in found]
    for place in expected:
        assert min(np.abs(place - other).max() for other in places) < 1e-12


def test_open_chain_with_all_coordinates_driven_has_closed_form_accelerations():
    """All coordinates driven, with rates of their own: the end of a chain by differentiating its position."""
    model = fb.compile_model(fb.Linkage("arm", points=ARM, ground="A", links=["AB", "BC"]).model())
    t = np.linspace(0.0, 1.0, 11)
    one, two = np.sin(t), t**2
    found = model.kinematics(
        {"q_AB": one, "q_BC": two},
        rates={"q_AB": np.cos(t), "q_BC": 2 * t},
        accelerations={"q_AB": -np.sin(t), "q_BC": 2.0},
    )
    turn, other = 1j * np.cos(t), 2j * t
    a, b = 0.4 * np.exp(1j * one), 0.3 * np.exp(1j * two)
    acceleration = a * (turn**2 - 1j * np.sin(t)) + b * (other**2 + 2j)
    np.testing.assert_allclose(found[0].velocities["C"][0], (a * turn + b * other).real, rtol=0, atol=1e-14)
    np.testing.assert_allclose(found[0].accelerations["C"][1], acceleration.imag, rtol=0, atol=1e-14)
    with pytest.raises(fb.ModelError, match="The rate of q_AB is a finite number, or 11 of them"):
        model.kinematics({"q_AB": one, "q_BC": two}, rates={"q_AB": [1.0, 2.0]})


ARM = {"A": (0, 0), "B": (0.4, 0), "C": (0.7, 0)}


@pytest.mark.slow
def test_bob_on_a_pivot_that_is_moved_has_the_closed_form_velocity_and_acceleration():
    """s - i l exp(i q), which contains the prescribed motion s itself."""
    model = fb.compile_model(driven_pendulum(None))
    rates, second = {"s": 2.0, "q": 0.7}, {"s": 3.0, "q": -0.2}
    [branch] = model.kinematics({"s": [0.1], "q": [0.4]}, rates=rates, accelerations=second)
    arm = 0.5 * np.exp(0.4j)
    velocity, acceleration = 2.0 + 0.7 * arm, 3.0 + (-0.2 + 0.49j) * arm
    # Up to 3, to rounding.
    np.testing.assert_allclose(branch.velocities["Q"][:, 0], [velocity.real, velocity.imag, 0.0], atol=1e-14)
    np.testing.assert_allclose(branch.accelerations["Q"][:, 0], [acceleration.real, acceleration.imag, 0.0], atol=1e-14)


@pytest.mark.slow
def test_drive_by_a_prescribed_motion_gives_the_branches_of_the_coordinate():
    linkage = mechanisms.crank_rocker()
    linkage.drive("O", speed=1.0)
    model = fb.compile_model(linkage.model())
    wrt_input = model.kinematics({"drive_O": np.linspace(0.0, 2 * pi, 19)}, rates={"drive_O": 2.0})
    other = found_of(mechanisms.crank_rocker, np.linspace(0.0, 2 * pi, 19), rates={"q_OA": 2.0})
    assert len(wrt_input) == len(other) == 2
    np.testing.assert_allclose(wrt_input[0]["P"], other[0]["P"], rtol=0, atol=1e-12)
    np.testing.assert_allclose(wrt_input[0].accelerations["P"], other[0].accelerations["P"], rtol=0, atol=1e-10)
    # The crank of 2 m at 2 rad/s, and the coupler of 7 m and rocker of 9 m about (6, 0).
    angle, a, b = wrt_input.drive["drive_O"], wrt_input[0]["A"], wrt_input[0]["B"]
    np.testing.assert_allclose(a[:2], [2 * np.cos(angle), 2 * np.sin(angle)], rtol=0, atol=1e-12)
    np.testing.assert_allclose(wrt_input[0].accelerations["A"], -4.0 * a, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(b - a, axis=0), 7.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.hypot(b[0] - 6.0, b[1]), 9.0, rtol=0, atol=1e-12)


WISHBONE = {
    -10: (0.003566817762454773, 0.7473893050356877, -0.07019859573689735, 0.9989165703049724),
    -5: (0.0017895604993800537, 0.7600530510652271, -0.03555498092072579, -0.21233584854284443),
    5: (-0.0017879063591839973, 0.7716132059579246, 0.036150990285247014, -0.9290563990956462),
    10: (-0.003557648744409104, 0.7710587995809179, 0.07259176622997532, -0.6719691190300003),
}
"""Wheel centre, m, and camber, degrees, by the lower arm's angle in degrees: from two trigonometric equations in closed
form, and by Newton's method for 15 unknown coordinates of points; both agree to 1e-16 m."""


@pytest.mark.slow
def test_double_wishbone_in_space_has_the_known_places_and_camber():
    found = found_of(mechanisms.double_wishbone, np.radians([*WISHBONE]))
    branch = found[0]
    axle = branch["T"] - branch["W"]
    camber = np.degrees(np.arctan2(axle[2], axle[1]))
    for k, (x, y, z, expected) in enumerate(WISHBONE.values()):
        np.testing.assert_allclose(branch["W"][:, k], (x, y, z), rtol=0, atol=1e-12)
        assert camber[k] == pytest.approx(expected, abs=1e-9)


@pytest.mark.slow
def test_kinematics_without_masses_need_lengths_only():
    system = fb.models.four_bar().system
    lengths = {"l1": 0.8, "l2": 0.2, "l3": 0.7, "l4": 0.6}
    model = fb.compile_model(fb.Model(system, name="no_masses", parameters=lengths, inputs="auto"))
    assert len(model.kinematics({"q1": np.linspace(0.0, 6.0, 7)})) == 2
    incomplete = {name: value for name, value in lengths.items() if name != "l2"}
    bare = fb.compile_model(fb.Model(system, name="no_masses", parameters=incomplete, inputs="auto"))
    with pytest.raises(fb.ModelError, match="Positions depend on l2"):
        bare.kinematics({"q1": [0.0, 1.0]})


@pytest.mark.slow
def test_links_drawn_along_every_mechanisms_branch_keep_their_lengths():
    """The ends of each link's lines, along the whole motion, to 1e-12 of the size of the mechanism."""
    from fourbar_codegen.views.scene import scene

    for make, (_, values, _) in mechanisms.MECHANISMS.items():
        branch = found_of(make, values[::8])[0]
        found = scene(branch.kernel, branch.positions[:, :, np.isfinite(branch.q).all(axis=0)])
        links = [line for line in found.lines if line.kind == "link"]
        assert links, make
        for line in links:
            for a, b in zip(line.rows, line.rows[1:], strict=False):
                far = np.linalg.norm(found.positions[a] - found.positions[b], axis=0)
                assert np.ptp(far) < 1e-12 * found.size, (make, line)


@pytest.mark.slow
def test_five_bar_with_one_drive_is_refused_and_with_two_has_two_branches():
    """A five-bar has two degrees of freedom; both of them driven, it has two branches."""
    points = {"A": (0, 0), "B": (-0.1, 0.3), "C": (0.2, 0.5), "D": (0.5, 0.25), "E": (0.4, 0)}
    linkage = fb.Linkage("five", points=points, ground="AE", links=["AB", "BC", "CD", "DE"])
    model = fb.compile_model(linkage.model())
    with pytest.raises(fb.ModelError, match="degree of freedom is left"):
        model.kinematics({"q_AB": [1.5, 1.6]})
    angles = np.linspace(1.7, 1.9, 5)
    found = model.kinematics({"q_AB": angles, "q_DE": angles - 0.5})
    assert len(found) == 2
    lengths = [np.linalg.norm(branch["C"] - branch["B"], axis=0) for branch in found]
    np.testing.assert_allclose(lengths, sqrt(0.3**2 + 0.2**2), rtol=0, atol=1e-12)


def test_drives_that_close_nowhere_or_leave_freedom_are_refused(four_bar):
    with pytest.raises(fb.AssemblyError, match="close at none of the values"):
        four_bar.kinematics({"q1": [0.0, 1.0]}, parameters={"l1": 5.0})
    with pytest.raises(fb.ModelError, match="degree of freedom is left: with q1 held, 1 coord"):
        fb.compile_model(fb.models.chain(2)).kinematics({"q1": [0.0]})


@pytest.mark.slow
def test_point_of_a_trammel_moves_on_its_ellipse():
    """Two blocks on the ground and no pin there: the end of the rod moves on an ellipse (Archimedes)."""
    points = {"X": (0.75, 0), "Y": (0, -sqrt(27) / 4), "P": (1.5, sqrt(27) / 4)}
    linkage = fb.Linkage("trammel", points=points, links=["XYP"])
    linkage.slider("X", along=(1, 0))
    linkage.slider("Y", along=(0, 1))
    found = fb.compile_model(linkage.model()).kinematics({"q_XYP": np.linspace(-2.0, 2.0, 21)})
    x, y, _ = found[0]["P"]
    np.testing.assert_allclose((x / 3) ** 2 + (y / 1.5) ** 2, 1.0, rtol=0, atol=1e-12)


def test_plot_of_branches_that_close_at_no_given_value_is_refused():
    """The slider's dead points are at 0.2 and 0.4 m."""
    crank = fb.compile_model(fb.models.slider_crank())
    found = crank.kinematics({"slide": [0.1, 0.5]})
    assert not found.closes.any()
    with pytest.raises(fb.ModelError, match="close at none of the drive's values"):
        found.plot_paths()


@pytest.mark.slow
def test_plots_of_branches_have_a_panel_each_and_refuse_wrong_names(four_bar):
    found = four_bar.kinematics({"q1": np.linspace(-0.5, 0.5, 5)})
    assert len(found.plot().axes) == 2
    assert len(found.plot("q2", "P2").axes) == 2
    assert len(found.plot_paths(["P2"]).axes) == 2
    with pytest.raises(fb.ModelError, match="no point P9"):
        found.plot_paths(["P9"])
    with pytest.raises(fb.ModelError, match="There is no q9"):
        found.plot("q9")
    assert "2 branches" in repr(found)


@pytest.mark.slow(but=["0.0-0.1", "0.0-0.7", "0.3-0.1"])
@pytest.mark.parametrize("radius", [0.01, 0.1, 0.7, 3.0])
@pytest.mark.parametrize("angle", [0.0, 0.3, 1.2, pi / 2, 2.7, 4.4])
def test_circle_by_continuation_is_traced_once_with_two_folds(radius, angle):
    """A circle: its length, that of the chords of arcs of less than 0.11, with two folds."""

    def circle(z):
        x, s = z / radius
        return np.array([x * x + s * s - 1.0]), 2.0 * z[None, :] / radius**2

    begin = radius * np.array([np.cos(angle), np.sin(angle)])
    curve = trace(circle, begin, -5.0, 5.0, np.full(2, np.inf))
    assert curve.is_closed
    assert [abs(curve.points[k][1]) for k in curve.folds] == pytest.approx([radius] * 2)
    length = np.linalg.norm(np.diff(curve.points, axis=0), axis=1).sum()
    assert 2 * pi * radius * 0.9 < length <= 2 * pi * radius
    assert len(curve.branches()) == 2


@pytest.mark.slow
def test_branches_of_loops_with_paths_in_common_equal_intersections_of_circles():
    """By circles: C by A and G, D by A and G, F by D and E. The tree of links begins at G, and is driven at its end."""
    points = {
        "O": (0, 0), "G": (-38, -7.8), "A": (15, 0), "C": (-24, 31.3), "E": (-74.8, 8.1), "D": (-27, -45.5),
        "F": (-59.2, -28.1), "H": (-43.2, -91.8),
    }  # fmt: skip
    links = ["GCE", "EF", "FDH", "GD", "AD", "AC", "OA"]
    model = fb.compile_model(fb.Linkage("leg", points=points, ground="OG", links=links).model())
    angles = np.linspace(0.1, 6.3, 32)
    found = model.kinematics({"q_OA": angles})
    assert found.is_complete
    z = {name: complex(*place) for name, place in points.items()}
    expected = []
    for angle in angles:
        at = {"G": z["G"], "A": 15 * np.exp(1j * angle)}
        ends = [
            at["G"] + (c - at["G"]) * (z["E"] - z["G"]) / (z["C"] - z["G"]) for c in crossings(z, at, "A", "G", "C")
        ]
        pairs = product(crossings(z, at, "A", "G", "D"), ends)
        expected.append(sum(len(crossings(z, {"D": d, "E": e}, "D", "E", "F")) for d, e in pairs))
    assert np.isfinite([branch.q for branch in found]).all(axis=1).sum(axis=0).tolist() == expected
    assert set(expected) == {4, 6, 8}
