"""What is drawn: links by their own points, guides, pins, the ground, springs; the same in every picture."""

import warnings

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.linkages import inverted_slider_crank
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb
from fourbar_codegen.views.frames import frames_of
from fourbar_codegen.views.scene import scene


def scene_of(run, times=50):
    return frames_of(run, lambda start, end: np.linspace(start, end, times)).scene


def drawn(found, kind):
    """Lines of a kind, by names of points or numbers of rows."""
    names = dict(enumerate(found.names))
    return {tuple(names.get(row, row) for row in line.rows) for line in found.lines if line.kind == kind}


def places(found, kind):
    return {found.names[symbol.at] for symbol in found.symbols if symbol.kind == kind and symbol.at < len(found.names)}


def assert_rigid(found):
    """The ends of every line of a link keep their distance: to 1e-12 of the mechanism's size."""
    links = [line for line in found.lines if line.kind == "link"]
    assert links
    for line in links:
        for a, b in zip(line.rows, line.rows[1:], strict=False):
            distance = np.linalg.norm(found.positions[a] - found.positions[b], axis=0)
            assert np.ptp(distance) < 1e-12 * found.size


def test_scene_of_the_tutorials_linkage_has_its_links_pins_and_ground(four_bar):
    found = scene_of(four_bar.simulate((0.0, 3.0)))
    assert drawn(found, "link") == {("P1", "P2"), ("P2", "joint3_link3_joint"), ("joint3_link3_joint", "P44")}
    assert places(found, "ground") == {"P1", "P41"}
    assert places(found, "pin") == {"P1", "P2", "joint3_link3_joint", "P41"}
    assert places(found, "mass") == {"link2_masscenter", "link3_masscenter", "link4_masscenter"}
    assert_rigid(found)


def test_scene_of_a_slider_crank_has_a_guide_as_long_as_the_stroke():
    slider_crank = fb.compile_model(fb.models.slider_crank())
    found = scene_of(slider_crank.simulate((0.0, 1.0), dense_output=True), 1001)
    assert drawn(found, "link") == {("O", "P"), ("P", "E")}
    [guide] = [line for line in found.lines if line.kind == "guide"]
    ends = found.positions[list(guide.rows)]
    assert np.ptp(ends, axis=2).max() < 1e-14
    x = ends[:, 0, 0]
    # The slider goes from l - r = 0.2 to l + r = 0.4 m. The crank is shown every 0.01 rad, so the nearest position
    # shown is within (0.005 rad)^2 r / 2 (1 + r / (l - r)) of these.
    margin = 2 * found.unit
    np.testing.assert_allclose(x, [0.2 - margin, 0.4 + margin], rtol=0, atol=5e-6)
    assert places(found, "slider") == {"S"}
    assert places(found, "ground") == {"O"}
    assert_rigid(found)


@pytest.mark.slow(but=["lever-links0-P"])
@pytest.mark.parametrize(
    ("carrier", "links", "block"),
    [("lever", {("O", "E"), ("B", "T")}, "P"), ("rod", {("O", "E"), ("P", "T")}, "B")],
)
def test_scene_of_an_inverted_slider_crank_has_a_guide_that_turns(carrier, links, block):
    """The block slides on the lever, or the rod through the block at the ground: no other bar is there."""
    run = fb.compile_model(inverted_slider_crank(carrier)).simulate((0.0, 2.0))
    assert run.success
    found = scene_of(run)
    assert drawn(found, "link") == links
    assert places(found, "slider") == {block}
    [guide] = [line for line in found.lines if line.kind == "guide"]
    a, b = found.positions[list(guide.rows)]
    direction = (b - a) / np.linalg.norm(b - a, axis=0)
    np.testing.assert_allclose(direction[:2], [np.cos(run_at(run, "q2")), np.sin(run_at(run, "q2"))], atol=1e-9)
    assert_rigid(found)


def run_at(run, name):
    return run.resample(np.linspace(run.t[0], run.t[-1], 50))[name]


def jointed():
    """SymPy's own joints: a ternary link on a pin, a slider on a wall, a spring and a damper between them."""
    wall, plate, cart = me.RigidBody("wall"), me.RigidBody("plate"), me.RigidBody("cart")
    q, u, x, v = me.dynamicsymbols("q u x v")
    system = System.from_newtonian(wall)
    pin = me.PinJoint("pin", wall, plate, q, u, wall.y, -plate.x, joint_axis=wall.z)
    slide = me.PrismaticJoint("slide", wall, cart, x, v, joint_axis=wall.x)
    system.add_joints(pin, slide)
    ears = [plate.masscenter.locatenew(name, at) for name, at in (("E", plate.x), ("F", 0.5 * plate.y))]
    pathway = me.LinearPathway(ears[0], cart.masscenter)
    k, c = sm.symbols("k c")
    system.add_actuators(me.LinearSpring(k, pathway, 1), me.LinearDamper(c, pathway))
    values = {k: 1.0, c: 1.0, plate.mass: 1.0, cart.mass: 1.0, "plate_izz": 1.0}
    return fb.Model(system, name="jointed", parameters=values, initial={q: 0.0, u: 0.0, x: 2.0, v: 0.0})


@pytest.mark.slow
def test_scene_of_a_system_with_sympys_joints_has_plate_pins_and_ground(tmp_path):
    run = fb.compile_model(jointed()).simulate((0.0, 1.0))
    found = scene_of(run)
    [plate] = [line for line in found.lines if line.kind == "link"]
    assert plate.is_closed
    assert {found.names[row] for row in plate.rows} == {"pin_wall_joint", "E", "F"}
    assert places(found, "ground") == places(found, "pin") == {"pin_wall_joint"}
    assert places(found, "slider") == {"cart_masscenter"}
    ends = {(found.names[s.at], found.names[s.toward]) for s in found.symbols if s.kind in ("spring", "damper")}
    assert ends == {("E", "cart_masscenter")}
    assert_rigid(found)
    # A spring's coil begins and ends where the spring does.
    [coil] = [symbol for symbol in found.symbols if symbol.kind == "spring"]
    lines = found.outline(coil)
    np.testing.assert_allclose(lines[:, 0], found.positions[coil.at], atol=1e-15)
    np.testing.assert_allclose(lines[:, -1], found.positions[coil.toward], atol=1e-15)
    for ending in ("html", "gif"):
        run.save(tmp_path / f"run.{ending}")
    run.plot_paths()


def pendulum_with_foot(*, is_known=False, **changes):
    q, u = me.dynamicsymbols("q u")
    length, reach = sm.symbols("l e")
    ground, bar, foot_frame = map(me.ReferenceFrame, "NBF")
    origin, bob, foot = map(me.Point, ("O", "P", "foot"))
    bar.orient_axis(ground, ground.z, q)
    foot_frame.orient_axis(bar, bar.z, sm.Symbol("a"))
    origin.set_vel(ground, 0)
    bob.set_pos(origin, length * bar.x)
    foot.set_pos(bob, reach * foot_frame.x)
    system = System(ground, origin)
    system.add_bodies(me.Particle("bob", bob, 1))
    system.apply_uniform_gravity(-9.81 * ground.y)
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_kdes(u - q.diff())
    values = {length: 2.0} | ({reach: 0.5, sm.Symbol("a"): 0.3} if is_known or "lines" in changes else {})
    given = {key: [foot if item == "foot" else item for item in value] for key, value in changes.items()}
    if "lines" in changes:
        given = {"lines": [(origin, foot), ("P", "O")]}
    return fb.compile_model(fb.Model(system, name="footed", parameters=values, initial={q: 0.1, u: 0.0}, **given))


@pytest.mark.slow
def test_point_with_an_unknown_parameter_is_not_drawn_with_a_warning():
    run = pendulum_with_foot().simulate((0.0, 1.0))
    assert "foot" not in run.points
    with pytest.warns(fb.ModelWarning, match=r"not drawn: foot\. .*points="):
        run.plot_paths()


@pytest.mark.slow
def test_point_that_nothing_needs_is_drawn_if_its_parameters_have_values():
    run = pendulum_with_foot(is_known=True).simulate((0.0, 1.0))
    assert run.model.parameters == ("l", "e", "a")
    angle = run["q"]
    np.testing.assert_allclose(run["foot"][0], 2.0 * np.cos(angle) + 0.5 * np.cos(angle + 0.3), rtol=0, atol=1e-14)


def test_point_named_in_points_keeps_its_parameters_in_the_model():
    model = pendulum_with_foot(points=["foot"])
    assert model.parameters == ("l", "a", "e")
    run = model.simulate((0.0, 1.0), parameters={"e": 0.7, "a": 0.2})
    angle = run["q"]
    expected = 2.0 * np.exp(1j * angle) + 0.7 * np.exp(1j * (angle + 0.2))
    np.testing.assert_allclose(run["foot"][:2], [expected.real, expected.imag], rtol=0, atol=1e-14)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = scene_of(run)
    # The bar and the foot are rigidly connected.
    assert drawn(found, "link") == {("O", "P", "foot")}


def test_lines_given_by_points_are_drawn_and_wrong_ones_refused():
    run = pendulum_with_foot(lines=[]).simulate((0.0, 1.0))
    assert drawn(scene_of(run), "line") == {("O", "foot"), ("P", "O")}
    system = fb.models.cartesian_pendulum().system
    for wrong, message in (
        ([("O", "Q")], "a point Q, which is not drawn"),
        ([("O",)], "two and more points"),
        ("OP", "two and more points"),
        (3, "two and more points"),
    ):
        with pytest.raises(fb.ModelError, match=message):
            fb.Model(system, lines=wrong)
    with pytest.raises(fb.ModelError, match="takes Points"):
        fb.Model(system, points=["O"])
    with pytest.raises(fb.ModelError, match="Point lost cannot be drawn"):
        fb.Model(system, points=[me.Point("lost")])


def test_scene_of_a_run_with_an_open_loop_has_no_pin_there(four_bar):
    """What is open is drawn open."""
    x0 = four_bar.initial_state()
    x0[1] += 0.1
    found = scene_of(four_bar.simulate((0.0, 0.2), x0, constraints="none"))
    assert places(found, "ground") == {"P1"}


def test_scene_of_assembly_modes_has_the_links_of_a_run(four_bar):
    """Two modes, each with the links of the other pictures."""
    modes = four_bar.initial_states()
    positions = np.stack([modes.model.kernel.drawing(0.0, x)[0] for x in modes.x], axis=2)
    found = scene(modes.kernel, positions)
    assert len(drawn(found, "link")) == 3
    assert places(found, "ground") == {"P1", "P41"}
    assert len(modes.plot().axes) == len(modes)


@pytest.mark.slow
def test_scene_of_a_spatial_link_has_the_edges_of_its_hull():
    """A tetrahedron with a mass centre inside it has six edges; its base point is that of a ball joint."""
    q, u = me.dynamicsymbols("q u")
    ground, body = me.ReferenceFrame("N"), me.ReferenceFrame("B")
    body.orient_axis(ground, ground.x, q)
    origin = me.Point("O")
    origin.set_vel(ground, 0)
    corners = [body.x, body.y, body.z]
    named = [origin.locatenew(name, at) for name, at in zip("abc", corners, strict=True)]
    centre = origin.locatenew("G", (body.x + body.y + body.z) / 4)
    system = System(ground, origin)
    system.add_bodies(me.RigidBody("solid", centre, body, 1, (me.inertia(body, 1, 1, 1), centre)))
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_kdes(u - q.diff())
    run = fb.compile_model(fb.Model(system, name="solid", points=named, initial={q: 0.0, u: 1.0})).simulate((0.0, 1.0))
    found = scene_of(run)
    assert {frozenset(edge) for edge in drawn(found, "link")} == {
        frozenset(edge) for edge in ("Oa", "Ob", "Oc", "ab", "bc", "ac")
    }
    assert_rigid(found)


def hanging(turn_about, down, offset):
    """A pendulum that hangs in the direction in which gravity acts."""
    q, u = me.dynamicsymbols("q u")
    m, g, length = sm.symbols("m g l")
    frame, origin, rod = me.ReferenceFrame("N"), me.Point("O"), me.ReferenceFrame("R")
    origin.set_vel(frame, 0)

    def vector(components, of=frame):
        return sum((c * axis for c, axis in zip(components, of, strict=True)), me.Vector(0))

    rod.orient_axis(frame, vector(turn_about), q)
    rod.set_ang_vel(frame, u * vector(turn_about))
    end = origin.locatenew("end", length * vector(down, rod) + offset * vector(turn_about, rod))
    end.v2pt_theory(origin, frame, rod)
    system = System(frame, origin)
    system.add_bodies(me.Particle("bob", end, m))
    system.add_loads(me.Force(end, m * g * vector(down)))
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_kdes(u - q.diff())
    values = {m: 2.0, g: 9.81, length: 0.5}
    return fb.compile_model(fb.Model(system, name="hanging", parameters=values, initial={q: 0.3, u: 0.0}))


AXES = np.vstack((np.eye(3, dtype=int), -np.eye(3, dtype=int)))


@pytest.mark.slow
@pytest.mark.parametrize("down", AXES.tolist(), ids=["x", "y", "z", "-x", "-y", "-z"])
@pytest.mark.parametrize("offset", [0.0, 0.2])
def test_scene_of_a_hanging_body_shows_gravity_downwards_along_every_axis(down, offset):
    """Whatever axis it acts along; what is shown is turned, not mirrored, and in the plane if there is one."""
    about = np.roll(np.abs(down), 1)
    model = hanging(about.tolist(), down, offset)
    assert model.manifest["gravity"] == down
    run = model.simulate((0.0, 1.0))
    drawn = scene(model.kernel, model.kernel.drawing_along(run.t, run.y, run.r, None)[0])
    assert drawn.is_planar is (offset == 0.0)
    assert np.linalg.det(drawn.view.turn) == 1.0
    vertical = 1 if drawn.is_planar else 2
    end, origin = (drawn.positions[drawn.names.index(name)] for name in ("end", "O"))
    assert (end[vertical] < origin[vertical] - 0.4).all()
    assert drawn.view.labels[vertical] == ("-" if sum(down) > 0 else "") + "xyz"[int(np.abs(down).argmax())]


def block(*forces, mass=None, others=(), **options):
    """A particle on the x axis with forces, beside other points."""
    q, u = me.dynamicsymbols("q u")
    frame, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(frame, 0)
    point = origin.locatenew("block", q * frame.x)
    point.set_vel(frame, u * frame.x)
    system = System(frame, origin)
    system.add_bodies(me.Particle("block", point, sm.Symbol("m") if mass is None else mass))
    system.add_loads(
        *(me.Force(point, sum((f * axis for axis, f in given(frame).items()), me.Vector(0))) for given in forces)
    )
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_kdes(u - q.diff())
    for add in others:
        add(frame, point, q, u)
    return fb.compile_model(fb.Model(system, name="block", **options))


t = me.dynamicsymbols._t
M, PUSH, RHO = sm.symbols("m push rho")


@pytest.mark.slow(but=["<lambda>-None-gravity2"])
@pytest.mark.parametrize(
    ("force", "mass", "gravity"),
    [
        (lambda n: {n.x: PUSH}, None, None),
        (lambda n: {n.x: 9.81 * M}, None, [1, 0, 0]),
        (lambda n: {n.x: 9.81 * M, n.y: 0 * M}, None, [1, 0, 0]),
        (lambda n: {n.x: 9.81 * M, n.y: M}, None, None),
        (lambda n: {n.y: -sm.Symbol("g") * M + me.dynamicsymbols("F")}, None, [0, -1, 0]),
        (lambda n: {n.x: M * sm.sin(5 * t)}, None, None),
        (lambda n: {n.x: 19.62}, 2, [1, 0, 0]),
        (lambda n: {n.x: 3.0}, 2, None),
        (lambda n: {n.x: sm.sqrt(sm.Symbol("a") - 2 * sm.Symbol("b"))}, None, None),
        (lambda n: {n.x: sm.Symbol("k") / (sm.Symbol("a") - sm.Symbol("b"))}, None, None),
        (lambda n: {n.x: sm.Symbol("k") * sm.Symbol("l")}, sm.Symbol("rho") * sm.Symbol("l"), None),
        (
            lambda n: {n.z: sm.Symbol("g") * sm.Symbol("rho") * sm.Symbol("l")},
            sm.Symbol("rho") * sm.Symbol("l"),
            [0, 0, 1],
        ),
    ],
)
def test_constant_force_counts_as_gravity_only_if_proportional_to_the_mass(force, mass, gravity):
    """The constant force that is proportional to the mass; of masses in numbers, as on the earth."""
    model = block(force, mass=mass, inputs="auto", parameters={} if mass else {M: 1.0})
    assert model.manifest["gravity"] == gravity


def test_gravity_beside_a_constant_push_is_still_found():
    """A constant force on one of the mass centres does not hide the weight."""
    model = block(lambda n: {n.x: 9.81 * M}, lambda n: {n.y: PUSH}, parameters={M: 1.0, PUSH: 0.1})
    assert model.manifest["gravity"] == [1, 0, 0]


def frame_with(orient, position):
    """Adds a point in a frame of its own."""

    def add(ground, point, q, u):
        frame = me.ReferenceFrame("F")
        orient(frame, ground, q, u)
        point.locatenew("foot", position(frame, q, u))

    return add


@pytest.mark.slow(
    but=["<lambda>-<lambda>-False1", "<lambda>-<lambda>-False2", "<lambda>-<lambda>-False3", "<lambda>-<lambda>-False4"]
)
@pytest.mark.parametrize(
    ("orient", "position", "is_drawn"),
    [
        (lambda f, n, q, u: f.orient_axis(n, n.z, q), lambda f, q, u: sm.Symbol("b") * f.x, True),
        (lambda f, n, q, u: f.orient_axis(n, n.z, sm.Symbol("a")), lambda f, q, u: sm.Symbol("b") * f.x, True),
        (lambda f, n, q, u: f.orient_axis(n, n.z, sm.Symbol("c")), lambda f, q, u: sm.Symbol("b") * f.x, False),
        (lambda f, n, q, u: f.orient_axis(n, n.z, q), lambda f, q, u: u * f.x, False),
        (lambda f, n, q, u: f.orient_axis(n, n.z, q), lambda f, q, u: q.diff() * f.x, False),
        (lambda f, n, q, u: f.orient_axis(n, n.z, me.dynamicsymbols("x")), lambda f, q, u: f.x, False),
        (lambda f, n, q, u: f.orient_axis(n, n.z, q), lambda f, q, u: sm.besselj(0, q) * f.x, False),
        (lambda f, n, q, u: f.orient_axis(n, n.z, q), lambda f, q, u: sm.I * sm.Symbol("b") * f.x, False),
        (lambda f, n, q, u: f.orient_axis(n, n.z, q), lambda f, q, u: sm.Symbol("b", positive=True) * f.x, False),
    ],
)
def test_point_without_a_name_is_drawn_only_in_a_simple_and_known_place(orient, position, is_drawn):
    """Those in simple and known places; no others are asked for, and none makes a model that is refused."""
    model = block(others=[frame_with(orient, position)], parameters={"m": 1.0, "a": 0.3, "b": 0.5}, extra="ignore")
    assert ("foot" in model.points) is is_drawn
    assert model.simulate((0.0, 0.1), [0.0, 1.0]).success


def test_point_in_a_frame_of_unknown_angular_velocity_is_left_out():
    """Of a frame that only a point needs: the point is left out."""

    def add(ground, point, q, u):
        frame = me.ReferenceFrame("F")
        frame.orient_axis(ground, ground.z, q)
        frame.set_ang_vel(ground, me.dynamicsymbols("x") * ground.z)
        point.locatenew("foot", sm.Symbol("b") * frame.x)

    model = block(others=[add], parameters={"m": 1.0, "b": 0.5}, extra="ignore")
    assert "foot" not in model.points
