"""Bodies in space: wheels that touch the ground, rods, boxes of mass and inertia, given shapes, glTF, modes."""

import importlib
import io
import json
import pickle
import struct

import numpy as np
import PIL.Image
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.systems import pendulum, spatial_four_bar
from ecosystem.cases import LONG, QUICK
from harness.programs import complaints
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb
from fourbar_codegen.body_shapes import KINDS, BodyShape
from fourbar_codegen.kernel.kernel import parameter_array
from fourbar_codegen.views import meshes, shaded
from fourbar_codegen.views.found_shapes import parts_of
from fourbar_codegen.views.frames import frames_of
from fourbar_codegen.views.html_page import quaternions
from fourbar_codegen.views.moved_bodies import moved_bodies
from fourbar_codegen.views.solids import solids_of

M, G, L = sm.symbols("m g l")


def scene_of(run, times=100, **how):
    return frames_of(run, lambda start, end: np.linspace(start, end, times), **how).scene


def vertices_of(scene, solid):
    """All vertices of a solid at all instants, shape (n, 3, n_t)."""
    places, rotations = solid.placed(scene.positions, scene.rotations)
    return np.einsum("ijt,nj->nit", rotations, solid.mesh.vertices) + places


@pytest.fixture(scope="module")
def bicycle():
    return fb.compile_model(fb.models.whipple_bicycle())


@pytest.fixture(scope="module")
def disc():
    return fb.compile_model(fb.models.rolling_disc())


def box(size, mass=3.0, axes=None):
    """A free body with the inertia of a box: m (y^2 + z^2) / 12 and so on."""
    ground, frame, origin = me.ReferenceFrame("ground"), me.ReferenceFrame("frame"), me.Point("O")
    angles, turning = me.dynamicsymbols("a b c"), me.dynamicsymbols("u v w")
    frame.orient_body_fixed(ground, angles, "ZXY")
    rates = frame.ang_vel_in(ground)
    frame.set_ang_vel(ground, sum((w * axis for w, axis in zip(turning, frame, strict=True)), me.Vector(0)))
    origin.set_vel(ground, 0)
    x, y, z = size
    inertia = mass / 12 * np.diag([y**2 + z**2, x**2 + z**2, x**2 + y**2])
    if axes is not None:
        inertia = axes @ inertia @ axes.T
    entries = [sm.Float(inertia[i, j]) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))]
    body = me.RigidBody("satellite", origin, frame, sm.Float(mass), (me.inertia(frame, *entries), origin))
    system = System(ground, origin)
    system.add_bodies(body)
    system.q_ind, system.u_ind = angles, turning
    system.add_kdes(*(w - rates.dot(axis) for w, axis in zip(turning, frame, strict=True)))
    return system


@pytest.mark.parametrize(
    ("mesh", "volume", "tolerance"),
    # The volume of an inscribed prism with n sides is sin(2 pi / n) n / (2 pi) that of the cylinder.
    [
        (meshes.box(1.0, 2.0, 3.0), 6.0, 1e-15),
        (meshes.cylinder(1.0, 2.0), 2.0 * np.pi, 0.01),
        (meshes.cone(1.0, 3.0), np.pi, 0.01),
        (meshes.sphere(1.0), 4.0 / 3.0 * np.pi, 0.03),
        (meshes.ellipsoid(1.0, 2.0, 3.0), 8.0 * np.pi, 0.03),
        (meshes.capsule(1.0, 2.0), 2.0 * np.pi + 4.0 / 3.0 * np.pi, 0.05),  # with 20 sides, and 3 in a quarter
        (meshes.torus(2.0, 0.5), np.pi**2, 0.03),
    ],
    ids=["box", "cylinder", "cone", "sphere", "ellipsoid", "capsule", "torus"],
)
def test_meshes_have_the_volumes_of_their_shapes_and_outward_normals(mesh, volume, tolerance):
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    found = np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0
    assert volume * (1.0 - tolerance) <= found <= volume * (1.0 + 1e-14)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-12)
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), mesh.normals[mesh.faces[:, 0]]) > 0.0).all()


@pytest.mark.parametrize("lean", [0.0, 0.6])
def test_wheels_of_a_bicycle_touch_the_ground_where_they_roll(bicycle, lean):
    """The lowest vertex is at the contact point to a pixel: polygons of 64 sides are within 0.12 % of the radius."""
    run = bicycle.simulate((0.0, 1.5), bicycle.initial_state(speeds={"u4": lean, "u6": -16.0}))
    scene = scene_of(run)
    wheels = [solid for solid in scene.solids if "wheel" in solid.name]
    assert [solid.name for solid in wheels] == ["rear wheel", "front wheel"]
    pixel = scene.body_size / 420  # the bicycle fills a picture of 560 x 420
    for solid, contact, radius in zip(wheels, ("dn", "fn"), (0.3, 0.35), strict=True):
        corners, touching = vertices_of(scene, solid), scene.positions[scene.names.index(contact)]
        assert solid.mesh.vertices[:, :2].max() == pytest.approx(radius, rel=1e-12)
        lowest = corners[:, 2].min(axis=0)
        assert np.abs(lowest - touching[2]).max() < pixel
        assert np.abs(touching[2]).max() < 1e-9  # on the ground
    assert scene.contacts == (scene.names.index("dn"), scene.names.index("fn"))
    assert set(scene.traced().values()) == {"dn", "fn"}


def test_rolling_disc_touches_the_ground_and_turns_with_its_angle(disc):
    run = disc.simulate((0.0, 3.0))
    scene = scene_of(run)
    [solid] = scene.solids
    [contact] = scene.contacts
    corners = vertices_of(scene, solid)
    assert np.abs(corners[:, 2].min(axis=0) - scene.positions[contact, 2]).max() < 0.26 / 200
    distance = np.linalg.norm(corners - scene.positions[contact], axis=1).min(axis=0)
    assert distance.max() < np.pi / 64 * 0.26 + 0.26 / 200  # half a side of the polygon


DRAWN = {
    "rolling disc, three coordinates": [fb.Disc],  # whose contact point has no coordinates
    "rolling disc, thick": [fb.Torus],
    "Whipple bicycle, no wheel angles": [fb.Disc, fb.Disc],  # nor have the wheels and the contact points
    "Whipple bicycle, upside down": [fb.Wheel, fb.Wheel],
    "stationary bicycle": [],
}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Points of of_others that are not drawn")
@pytest.mark.parametrize("name", DRAWN)
def test_wheels_of_models_of_others_are_found(name):
    [case] = (case for case in (*QUICK, *LONG) if case.name == name)
    built = case.build()
    model = fb.Model(built.system, name="of_others", parameters=dict(built.values), inputs="auto", extra="ignore")
    compiled = fb.compile_model(model)
    values = {
        key: 1.0 if model.parameters[key].value is None else model.parameters[key].value for key in compiled.parameters
    }
    states = np.random.default_rng(1).uniform(-0.5, 0.5, (len(compiled.states), 2))
    run = compiled.trajectory([0.0, 1.0], states, parameters=values, inputs=dict.fromkeys(compiled.inputs, 0.0))
    found = [type(shape) for of_body in scene_of(run, 2).shapes.values() for shape in of_body]
    assert [kind for kind in found if kind in (fb.Wheel, fb.Disc, fb.Torus)] == DRAWN[name]


def test_disc_on_a_slope_touches_it_and_the_grid_lies_in_it():
    """The disc of the gallery, whose ground is turned about y."""
    given = fb.models.rolling_disc().system
    slope = me.ReferenceFrame("slope")
    slope.orient_axis(given.frame, given.frame.y, sm.Symbol("tilt"))
    q, (u1, u2, u3, u4, u5) = [*given.q_ind], me.dynamicsymbols("u1:6")
    leaning, frame = me.ReferenceFrame("L"), me.ReferenceFrame("D")
    leaning.orient_body_fixed(slope, (q[0], q[1], 0), "zxy")
    frame.orient_axis(leaning, leaning.y, q[2])
    rates, turning = frame.ang_vel_in(given.frame), u1 * frame.x + u2 * frame.y + u3 * frame.z
    frame.set_ang_vel(given.frame, turning)
    origin, contact, center = me.Point("O"), me.Point("P"), me.Point("C")
    origin.set_vel(given.frame, 0)
    contact.set_pos(origin, q[3] * slope.x + q[4] * slope.y)
    contact.set_vel(given.frame, u4 * slope.x + u5 * slope.y)
    center.set_pos(contact, sm.Symbol("r") * leaning.z)
    center.set_vel(given.frame, turning.cross(sm.Symbol("r") * leaning.z))
    slip = contact.vel(given.frame) + frame.ang_vel_in(leaning).cross(-sm.Symbol("r") * leaning.z)
    system = System(given.frame, origin)
    system.add_bodies(me.RigidBody("disc", center, frame, M, (me.inertia(frame, 1, 2, 1), center)))
    system.apply_uniform_gravity(-G * given.frame.z)
    system.q_ind, system.u_ind, system.u_dep = q, [u1, u2, u3], [u4, u5]
    system.add_kdes(*((rates - turning).dot(axis) for axis in frame))
    system.add_kdes(q[3].diff() - u4, q[4].diff() - u5)
    system.add_nonholonomic_constraints(slip.dot(slope.x), slip.dot(slope.y))
    values = {"g": 9.81, "r": 0.3, "m": 1.0, "tilt": 0.3}
    model = fb.compile_model(fb.Model(system, name="disc_on_a_slope", parameters=values))
    assert model.shapes["disc"][0].radius == "r"
    run = model.simulate((0.0, 0.3), model.initial_state([0.3, 0.2, 0.0, 0.0, 0.0], [0.1, -3.0, 0.1]))
    scene = scene_of(run, 10)
    normal = scene.view.turn @ [np.sin(0.3), 0.0, np.cos(0.3)]
    np.testing.assert_allclose(scene.ground_axes[2], normal, atol=1e-12)
    [solid] = scene.solids
    lowest = np.einsum("nit,i->nt", vertices_of(scene, solid), normal).min(axis=0)
    # The polygon with 64 sides is within 1 - cos(pi / 64) of the circle, 0.12 % of its radius.
    np.testing.assert_allclose(lowest, 0.0, atol=0.0013 * 0.3)


def test_disc_that_rolls_down_a_line_is_found():
    """A planar disc on a slope: the point moves along a line, and the disc rolls."""
    (x, u), ground = me.dynamicsymbols("x u"), me.ReferenceFrame("N")
    r, tilt = sm.symbols("r tilt")
    slope, frame, origin = me.ReferenceFrame("slope"), me.ReferenceFrame("D"), me.Point("O")
    slope.orient_axis(ground, ground.z, tilt)
    frame.orient_axis(ground, ground.z, -x / r)
    frame.set_ang_vel(ground, -u / r * ground.z)
    origin.set_vel(ground, 0)
    contact = origin.locatenew("P", x * slope.x)
    center = contact.locatenew("C", r * slope.y)
    for point in (contact, center):
        point.set_vel(ground, u * slope.x)
    system = System(ground, origin)
    system.add_bodies(me.RigidBody("disc", center, frame, M, (me.inertia(frame, 1, 1, 2), center)))
    system.q_ind, system.u_ind = [x], [u]
    system.add_kdes(u - x.diff())
    system.apply_uniform_gravity(-G * ground.y)
    values = {"m": 1.0, "g": 9.81, "r": 0.3, "tilt": -0.2}
    model = fb.compile_model(fb.Model(system, name="down", parameters=values, points=[contact]))
    [shape] = model.shapes["disc"]
    assert (type(shape), shape.radius, shape.at) == (fb.Disc, "r", "C")


def test_wheels_have_the_radius_that_is_a_parameter(bicycle, disc):
    assert bicycle.shapes["front wheel"] == (fb.Wheel("rf", at="fo", axis=(0.0, 1.0, 0.0)),)
    assert bicycle.shapes["rear wheel"] == (fb.Wheel("rr", at="do", axis=(0.0, 1.0, 0.0)),)
    [shape] = disc.shapes["disc"]
    assert isinstance(shape, fb.Disc)
    assert shape.radius == "r"
    longer = {"rf": 0.4}
    run = bicycle.simulate((0.0, 0.1), bicycle.initial_state(parameters=longer), parameters=longer)
    [wheel] = [solid for solid in scene_of(run, 3).solids if solid.name == "front wheel"]
    assert wheel.mesh.vertices[:, 0].max() == pytest.approx(0.4)


@pytest.mark.parametrize("make", [fb.models.four_bar, fb.models.slider_crank, lambda: fb.models.chain(3)])
def test_pins_are_no_wheels_and_planar_mechanisms_stay_drawings(make):
    """The end of a crank has a constant distance from its pin, but is not the lowest point of a wheel."""
    model = make()
    run = fb.compile_model(model).simulate((0.0, 0.1))
    scene = scene_of(run, 3)
    assert scene.is_planar
    assert not scene.solids
    scene = scene_of(run, 3, in_space=True)
    assert not scene.contacts
    assert not any(isinstance(shape, fb.Wheel | fb.Disc) for of_body in scene.shapes.values() for shape in of_body)


def test_coordinates_and_speeds_belong_to_the_bodies_that_they_move(bicycle):
    """As the coordinates of the benchmark bicycle are defined: of the rear frame, then spin, steer, and spin."""
    frame, wheels = "rear frame", {"6": "rear wheel", "7": "front frame", "8": "front wheel"}
    expected = {f"{kind}{n}": wheels.get(n, frame) for kind in "qu" for n in "12345678"}
    assert moved_bodies(bicycle.kernel, parameter_array(bicycle.kernel, None)) == expected


@pytest.mark.parametrize("mass_at", ["below", "pivot"])
def test_point_under_the_pivot_of_a_pole_is_no_contact_point(mass_at):
    """Neither the mass of a cart nor, without a mass, a point on its rail."""
    (x, angle, v, w), height = me.dynamicsymbols("x angle v w"), sm.Symbol("h")
    ground, frame, origin = me.ReferenceFrame("N"), me.ReferenceFrame("B"), me.Point("O")
    frame.orient_axis(ground, ground.y, angle)
    frame.set_ang_vel(ground, w * ground.y)
    origin.set_vel(ground, 0)
    cart = origin.locatenew("cart_point", x * ground.x)
    pivot = cart.locatenew("pivot", height * ground.z)
    center = pivot.locatenew("center", L * frame.x)
    for point in (cart, pivot):
        point.set_vel(ground, v * ground.x)
    center.v2pt_theory(pivot, ground, frame)
    system = System(ground, origin)
    pole = me.RigidBody("pole", center, frame, M, (me.inertia(frame, 0.1, 0.1, 0.1), center))
    system.add_bodies(me.Particle("cart", cart if mass_at == "below" else pivot, M), pole)
    system.q_ind, system.u_ind = [x, angle], [v, w]
    system.add_kdes(v - x.diff(), w - angle.diff())
    system.apply_uniform_gravity(-G * ground.z)
    values = {"m": 1.0, "g": 9.81, "l": 0.5, "h": 0.3}
    model = fb.compile_model(fb.Model(system, name="post", parameters=values, points=[cart]))
    assert [type(shape) for shape in model.shapes["pole"]] == [fb.Line]


def test_modes_and_branches_in_space_are_drawn_with_bodies():
    """And a pin on the ground is no contact of a wheel, though it is at a fixed place beside another one."""
    model = fb.compile_model(spatial_four_bar())
    modes = model.initial_states(speeds=[0.0])
    figure = modes.plot()
    for axes in figure.axes:
        [image] = axes.images
        assert 0.01 < (image.get_array()[..., 3] > 0.0).mean() < 0.5
    branches = model.kinematics({"q1": np.linspace(-0.6, 0.6, 5)})
    for figure in (branches.plot_paths(), branches[0].plot_paths(["P2"])):
        for axes in figure.axes:
            [bodies] = axes.collections
            assert len(bodies.get_facecolor()) > 100  # triangles
    assert all(isinstance(shape, fb.Line) for of_body in model.shapes.values() for shape in of_body)


@pytest.mark.parametrize("turned", [False, True])
def test_body_without_extent_is_the_box_of_its_mass_and_inertia(turned):
    angle = 0.4
    axes = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    model = fb.compile_model(fb.Model(box((0.3, 0.8, 1.5), axes=axes if turned else None), name=f"satellite{turned:d}"))
    [shape] = model.shapes["satellite"]
    assert isinstance(shape, fb.Box)
    assert sorted((shape.x, shape.y, shape.z)) == pytest.approx([0.3, 0.8, 1.5], rel=1e-9)
    run = model.simulate((0.0, 1.0), [0.0, 0.0, 0.0, 0.1, 3.0, 0.2])
    scene = scene_of(run, 2)
    [solid] = scene.solids
    corners = vertices_of(scene, solid)[..., 0]
    # The second moments of a box about its centre, from its corners: a third of those of its corners.
    moments = scene.view.turn.T @ (corners.T @ corners / len(corners) / 3.0) @ scene.view.turn
    inertia = 3.0 * (np.trace(moments) * np.eye(3) - moments)
    expected = 3.0 / 12 * np.diag([0.8**2 + 1.5**2, 0.3**2 + 1.5**2, 0.3**2 + 0.8**2])
    np.testing.assert_allclose(inertia, axes @ expected @ axes.T if turned else expected, rtol=1e-9, atol=1e-12)


def test_orientations_and_masses_are_those_of_sympy(bicycle):
    model = fb.models.whipple_bicycle()
    q = np.linspace(-0.4, 0.5, bicycle.n_q)
    x = np.concatenate((q, np.zeros(bicycle.n_u)))
    rotations = bicycle.kernel.orientations_along([0.0], x[:, np.newaxis], np.zeros((0, 1)))[..., 0]
    masses, inertias = bicycle.kernel.mass_properties(0.0, x)
    values = dict(zip((*model.system.q_ind, *model.system.q_dep), q, strict=True))
    numbers = {symbol: parameter.value for symbol, parameter in model.parameter_symbols.items()}
    assert bicycle.layout.drawing.bodies == tuple(body.name for body in model.system.bodies)
    for body, rotation, mass, inertia in zip(model.system.bodies, rotations, masses, inertias, strict=True):
        expected = np.array(body.frame.dcm(model.system.frame).T.subs(values).evalf(), dtype=float)
        np.testing.assert_allclose(rotation, expected, atol=1e-14)
        assert mass == float(body.mass.subs(numbers))
        dyadic = body.central_inertia.to_matrix(body.frame).subs(values).subs(numbers).evalf()
        np.testing.assert_allclose(inertia, np.array(dyadic, dtype=float), atol=1e-13)


def test_quaternions_are_those_of_the_matrices():
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    matrices = np.stack((turn, np.full((3, 3), np.nan)), axis=2)[np.newaxis]
    found = quaternions(matrices)
    np.testing.assert_allclose(found[0, 0], [0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)], atol=1e-15)
    assert np.isnan(found[1]).all()


def test_pictures_need_no_derivatives(monkeypatch, tmp_path):
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path / "cache"))
    model = fb.compile_model(fb.Model(pendulum(), name="plain", parameters={M: 1.0, G: 9.81, L: 1.0}))
    assert model.lacks_drawing
    model.simulate((0.0, 1.0), [0.3, 0.0]).save(tmp_path / "run.html")
    assert model.lacks_derivatives
    assert not model.lacks_drawing
    model.jacobian(0.0, [0.3, 0.0])
    assert not model.lacks_derivatives


def test_shapes_compile_nothing_and_replace_those_that_are_found(monkeypatch, tmp_path):
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path / "cache"))
    plain = fb.compile_model(fb.Model(box((0.3, 0.8, 1.5)), name="shaped"))
    entries = sorted(path.name for path in (tmp_path / "cache").iterdir())
    system = box((0.3, 0.8, 1.5))
    [body] = system.bodies
    shapes = {body: [fb.Sphere(0.2, color="red"), fb.Cone(0.1, 0.3, axis=(1, 0, 0))], "ground": fb.Plane(2)}
    shaped = fb.compile_model(fb.Model(system, name="shaped", shapes=shapes))
    assert sorted(path.name for path in (tmp_path / "cache").iterdir()) == entries
    assert plain.layout.fingerprint == shaped.layout.fingerprint
    assert shaped.shapes["satellite"] == tuple(shapes[body])
    assert isinstance(plain.shapes["satellite"][0], fb.Box)
    again = pickle.loads(pickle.dumps(shaped))
    assert again.shapes == shaped.shapes
    run = shaped.simulate((0.0, 0.5), [0.0, 0.0, 0.0, 1.0, 2.0, 3.0])
    assert [solid.name for solid in scene_of(run, 2).solids] == ["satellite", "satellite", "ground"]
    assert [solid.name for solid in scene_of(run, 2, shapes={"satellite": []}).solids] == ["ground"]
    shaped.shapes = {"satellite": fb.Box(1, 1, 1)}
    assert shaped.shapes["satellite"] == (fb.Box(1, 1, 1),)
    module = fb.load(
        fb.build_model(
            fb.Model(box((0.3, 0.8, 1.5)), name="shipped", shapes={"satellite": fb.Sphere(0.5)}), tmp_path / "shipped"
        )
    )
    assert module.shapes["satellite"] == (fb.Sphere(0.5),)


def test_wheel_that_never_leans_is_found_with_its_radius():
    """A wheel on a cart: the steepest direction in its plane is always downwards."""
    ground, origin = me.ReferenceFrame("ground"), me.Point("O")
    q, u = me.dynamicsymbols("q u")
    m, r = sm.symbols("m r")
    origin.set_vel(ground, 0)
    spun = ground.orientnew("spun", "Axis", [q, ground.y])
    spun.set_ang_vel(ground, u * ground.y)
    contact = origin.locatenew("contact", r * q * ground.x)
    hub = contact.locatenew("hub", r * ground.z)
    hub.set_vel(ground, r * u * ground.x)
    wheel = me.RigidBody("wheel", hub, spun, m, (me.inertia(spun, m * r**2 / 4, m * r**2 / 2, m * r**2 / 4), hub))
    system = System(ground, origin)
    system.add_bodies(wheel)
    system.q_ind, system.u_ind = [q], [u]
    system.add_kdes(u - q.diff())
    system.add_loads(me.Force(hub, -m * 9.81 * ground.z))
    model = fb.compile_model(fb.Model(system, name="upright", parameters={m: 1.0, r: 0.3}, points=[contact]))
    [shape] = model.shapes["wheel"]
    assert isinstance(shape, fb.Disc)
    assert (shape.radius, shape.at, shape.axis) == ("r", "hub", (0.0, 1.0, 0.0))


def test_hidden_bodies_leave_an_empty_picture(tmp_path):
    model = fb.compile_model(fb.Model(box((0.3, 0.8, 1.5)), name="hidden", shapes={"satellite": []}))
    run = model.simulate((0.0, 0.5), [0.0, 0.0, 0.0, 1.0, 2.0, 3.0])
    for figure in (run.plot_frames([0.0]), run.plot_frames([0.0, 0.5])):
        figure.savefig(tmp_path / "frames.png")
    assert run.save(tmp_path / "run.gif").stat().st_size > 100
    assert run.save(tmp_path / "run.html").stat().st_size > 100


def test_frames_are_in_space_whatever_times_are_chosen():
    model = fb.compile_model(fb.Model(box((0.3, 0.8, 1.5)), name="spinning"))
    run = model.simulate((0.0, 0.5), [0.0, 0.0, 0.0, 1.0, 2.0, 3.0])
    assert all(len(run.plot_frames(times).axes[0].images) == 1 for times in ([0.0], [0.0, 0.5]))


def test_names_of_bodies_that_contain_and_are_whole():
    system = pendulum()
    model = fb.compile_model(fb.Model(system, name="salted", parameters={M: 1.0, G: 9.81, L: 1.0}))
    run = model.simulate((0.0, 0.2), [0.3, 0.0])
    assert parts_of("salt and pepper", ["salt and pepper"]) == ["salt and pepper"]
    assert parts_of("a and b", ["a", "b"]) == ["a", "b"]
    assert scene_of(run, 2, in_space=True).solids


def test_frames_and_parameters_give_shapes_their_place_and_size():
    """A flywheel in a frame that no body has, as large as a parameter."""
    system = box((0.3, 0.8, 1.5))
    [body] = system.bodies
    spun = body.frame.orientnew("spun", "Axis", (sm.Symbol("tilt"), body.frame.x))
    nose = body.masscenter.locatenew("nose", sm.Symbol("arm") * spun.z)
    model = fb.Model(
        system,
        name="flywheel",
        points=[nose],
        parameters={"tilt": 0.5, "arm": 2.0},
        shapes={"satellite": fb.Sphere("arm"), "spun": fb.Disc(0.4, 0.1, at="nose")},
    )
    compiled = fb.compile_model(model)
    run = compiled.simulate((0.0, 0.1), [0.0, 0.0, 0.0, 1.0, 0.0, 0.0], parameters={"arm": 3.0})
    scene = scene_of(run, 2)
    ball, wheel = scene.solids
    assert np.linalg.norm(ball.mesh.vertices, axis=1).max() == pytest.approx(3.0)
    _, rotations = wheel.placed(scene.positions, scene.rotations)
    normal = scene.view.turn.T @ rotations[:, 2, 0]
    np.testing.assert_allclose(normal, [0.0, -np.sin(0.5), np.cos(0.5)], atol=1e-14)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: fb.Sphere(-1.0), "The radius of a Sphere is a positive number"),
        (lambda: fb.Sphere(float("nan")), "radius of a Sphere"),
        (lambda: fb.Box(1, 2, 3, at=(0, 0)), "at of a Box is a point or three coordinates"),
        (lambda: fb.Cylinder(1, 2, axis=(0, 0, 0)), "axis of a Cylinder is a direction"),
        (lambda: fb.Cylinder(1, 2, axis=(float("nan"), 0, 0)), "axis of a Cylinder"),
        (
            lambda: fb.Box(1, 2, 3, axis=(1, 0, 0), x_axis=(-2, 0, 0)),
            "x_axis of a Box is a direction that is not that of",
        ),
        (lambda: fb.Box(1, 2, 3, at=(0, 0, float("inf"))), "at of a Box"),
        (lambda: fb.Sphere(0.0), "The radius of a Sphere is a positive number"),
        (lambda: fb.Cone(1, 2, color="reddish"), "A colour is #rrggbb or one of black, white"),
        (lambda: fb.Line(points=("A",), radius=0.1), "points of a Line are two names or more"),
    ],
)
def test_shapes_that_are_none_are_refused(make, message):
    with pytest.raises(fb.ModelError, match=message):
        make()


def test_shapes_of_unknown_bodies_points_and_parameters_are_refused(bicycle, tmp_path):
    run = bicycle.simulate((0.0, 0.1))
    for shapes, message in (
        ({"saddle": fb.Sphere(1)}, "There is no body or frame 'saddle'. There are rear frame"),
        ({"rear frame": 3}, "The shape of rear frame is one of Arrow, Box"),
        (
            {"rear frame": fb.Sphere("radius")},
            "The shape of rear frame has the size radius, which is no parameter; there are rr, rf",
        ),
        (
            {"rear frame": fb.Sphere(1, at="hub")},
            "The shape of rear frame names a point hub, which is not drawn; there are O, dn",
        ),
        ({"rear frame": fb.Mesh(str(tmp_path / "no.stl"))}, "no.stl cannot be read"),
        ([fb.Sphere(1)], "shapes= is a mapping of bodies to shapes"),
    ):
        with pytest.raises(fb.ModelError, match=message):
            run.report(shapes=shapes)
    with pytest.raises(fb.ModelError, match="There is no body or frame 'saddle'"):
        bicycle.shapes = {"saddle": fb.Sphere(1)}
    with pytest.raises(fb.ModelError, match="has the size radius, which is no parameter"):
        bicycle.shapes = {"rear frame": fb.Sphere("radius")}
    for shapes, message in (
        ({"x": fb.Sphere(1)}, "There is no body or frame 'x'"),
        ({"bob": fb.Sphere("radius")}, "has the size radius, which is no parameter"),
    ):
        with pytest.raises(fb.ModelError, match=message):
            fb.Model(pendulum(), shapes=shapes)
    with pytest.raises(fb.ModelError, match=r"The size l1 of a shape is -2: it must be positive"):
        bicycle.simulate((0.0, 0.1), bicycle.initial_state(), parameters={"l1": -2.0}).report(
            shapes={"rear frame": fb.Sphere("l1")}
        )


def test_shapes_are_data_of_json():
    for kind in KINDS.values():
        needed = {"Line": {"points": ("A", "B")}, "Mesh": {"path": "a.stl"}}.get(kind.__name__, {})
        shape = kind(**dict.fromkeys(kind.sizes, 1.0), **needed, at=(1, "l", 2.5), color="#102030")
        assert BodyShape.from_data(json.loads(json.dumps(shape.as_data()))) == shape
        assert eval(repr(shape), vars(importlib.import_module("fourbar_codegen.body_shapes"))) == shape


def test_mesh_of_a_file_is_drawn_in_its_scale(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box((100.0, 200.0, 300.0)).export(tmp_path / "part.stl")
    model = fb.compile_model(fb.Model(box((0.3, 0.8, 1.5)), name="meshed"))
    run = model.simulate((0.0, 0.1), [0.0, 0.0, 0.0, 1.0, 2.0, 3.0])
    [solid] = scene_of(run, 2, shapes={"satellite": fb.Mesh(str(tmp_path / "part.stl"), 0.001)}).solids
    np.testing.assert_allclose(
        np.ptp(solid.mesh.vertices, axis=0), [0.1, 0.2, 0.3], rtol=1e-6
    )  # STL has single precision


def animated(gltf, blob, node, path):
    """The values of an animation of a node."""
    for animation in gltf.get("animations", ()):
        for channel in animation["channels"]:
            if channel["target"] == {"node": node, "path": path}:
                accessor = gltf["accessors"][animation["samplers"][channel["sampler"]]["output"]]
                view = gltf["bufferViews"][accessor["bufferView"]]
                start, n = view.get("byteOffset", 0), {"VEC3": 3, "VEC4": 4, "SCALAR": 1}[accessor["type"]]
                values = np.frombuffer(blob, "<f4", accessor["count"] * n, start)
                return values.reshape(-1, n)
    return None


@pytest.mark.parametrize("make", [fb.models.whipple_bicycle, fb.models.four_bar])
def test_gltf_has_the_points_and_bodies_where_they_are(make, tmp_path):
    """Positions equal `positions` to 1e-6 of the mechanism, in single precision; read by hand and by trimesh."""
    trimesh = pytest.importorskip("trimesh")
    model = fb.compile_model(make())
    run = model.simulate((0.0, 1.0), dense_output=True)
    content = run.save(tmp_path / "run.glb").read_bytes()
    magic, version, length = struct.unpack("<4sII", content[:12])
    assert (magic, version, length) == (b"glTF", 2, len(content))
    size = struct.unpack("<I", content[12:16])[0]
    gltf, blob = json.loads(content[20 : 20 + size]), content[28 + size :]
    times = np.linspace(0.0, 1.0, 61)
    for number, node in enumerate(gltf["nodes"]):
        if node["name"] in model.points and "mesh" not in node:
            path = animated(gltf, blob, number, "translation")
            path = np.repeat([node["translation"]], 61, axis=0) if path is None else path
            expected = [model.positions(t, run.sol(t)[: model.n_q])[node["name"]] for t in times]
            np.testing.assert_allclose(path, expected, atol=1e-6 * max(1.0, np.abs(expected).max()))
    scene = trimesh.load(io.BytesIO(content), file_type="glb")
    assert len(scene.geometry) == len(frames_of(run, lambda a, b: np.array([a, b]), in_space=True).scene.solids)
    if model.name == "whipple_bicycle":  # y points upwards there, and the lowest points are on the ground
        assert scene.bounds[0][1] == pytest.approx(0.0, abs=1e-3)
    text = json.loads(run.save(tmp_path / "run.gltf").read_text())
    assert text["buffers"][0]["uri"].startswith("data:")


def test_rods_between_points_that_part_reach_them(tmp_path):
    """A mass on a turning rod, along which it slides: x'' = w^2 x."""
    (x, angle, v, w), ground = me.dynamicsymbols("x angle v w"), me.ReferenceFrame("N")
    rod, origin = me.ReferenceFrame("B"), me.Point("O")
    rod.orient_axis(ground, ground.z, angle)
    rod.set_ang_vel(ground, w * ground.z)
    origin.set_vel(ground, 0)
    mass = origin.locatenew("mass_point", x * rod.x)
    mass.set_vel(ground, v * rod.x + x * w * rod.y)
    system = System(ground, origin)
    system.add_bodies(me.Particle("mass", mass, 1))
    system.q_ind, system.u_ind = [x, angle], [v, w]
    system.add_kdes(v - x.diff(), w - angle.diff())
    shapes = {"mass": fb.Line(points=("O", "mass_point"), radius=0.02)}
    run = fb.compile_model(fb.Model(system, name="parting", shapes=shapes)).simulate((0.0, 1.0), [0.3, 0.0, 0.5, 1.0])
    drawn = frames_of(run, lambda start, end: np.linspace(start, end, 61)).scene
    ends = [drawn.positions[drawn.names.index(name)] for name in ("O", "mass_point")]
    distance = np.linalg.norm(ends[1] - ends[0], axis=0)
    assert np.ptp(distance) > 0.2
    [solid] = drawn.solids
    np.testing.assert_allclose(solid.stretch(drawn.positions) * solid.length, distance, rtol=1e-14)
    content = run.save(tmp_path / "parting.glb").read_bytes()
    size = struct.unpack("<I", content[12:16])[0]
    gltf = json.loads(content[20 : 20 + size])
    [number] = (number for number, node in enumerate(gltf["nodes"]) if "mesh" in node)
    scales = animated(gltf, content[28 + size :], number, "scale")
    np.testing.assert_allclose(scales[:, 2] * solid.length, distance, rtol=1e-6)  # single precision


def test_gltf_without_its_package_is_refused(bicycle, monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "pygltflib", None)
    with pytest.raises(fb.ModelError, match=r"glTF files need pygltflib: pip install 'fourbar_codegen\[meshes\]'"):
        bicycle.simulate((0.0, 0.1)).save(tmp_path / "run.glb")
    assert not list(tmp_path.iterdir())


def test_modes_of_a_bicycle_are_weave_capsize_and_castering(bicycle):
    """The eigenvalues at 5 m/s of Meijaard, Papadopoulos, Ruina and Schwab 2007, table 2."""
    linear = bicycle.linearize(0.0, bicycle.initial_state())
    weave, weave_too, capsize, castering = (
        linear.eigenvalues[np.argmin(np.abs(linear.eigenvalues - value))]
        for value in (-0.775 + 4.465j, -0.775 - 4.465j, -0.322, -14.08)
    )
    assert weave == pytest.approx(-0.77534188219585 + 4.46486771378823j, abs=1e-11)
    assert weave_too == pytest.approx(weave.conjugate(), abs=1e-12)
    assert capsize == pytest.approx(-0.32286642900409, abs=1e-11)
    assert castering == pytest.approx(-14.07838969279822, abs=1e-11)
    assert (np.diff(linear.eigenvalues.real) <= 1e-9).all()


def test_motion_along_a_mode_is_that_of_the_nonlinear_equations_to_second_order(bicycle):
    """From the same state, the difference to a run falls at least with the square of the amplitude."""
    linear = bicycle.linearize(0.0, bicycle.initial_state())
    number = int(np.argmax(linear.eigenvalues.imag))
    errors = []
    for amplitude in (0.02, 0.01):
        mode = linear.mode(number, amplitude=amplitude, duration=0.5)
        leaning = mode["q4"]
        assert np.abs(mode.q - mode.q[:, :1])[[3, 5]].max() > 0.0
        start = bicycle.initial_state(
            {name: mode[name][0] for name in bicycle.coordinates[:7]},
            {name: mode[name][0] for name in ("u4", "u6", "u7")},
        )
        run = bicycle.simulate((0.0, 0.5), start, t_eval=mode.t, rtol=1e-11, atol=1e-13)
        errors.append(np.abs(run["q4"] - leaning).max())
    assert errors[0] < 0.02 * 0.02
    assert errors[0] / errors[1] > 3.9
    four_bar = fb.load("four_bar")
    x0 = four_bar.initial_state()
    modes = [four_bar.linearize(0.0, x0, None, inputs).mode(0, duration=0.1) for inputs in ({"F": 1.0}, [1.0])]
    np.testing.assert_array_equal(modes[0].y, modes[1].y)
    np.testing.assert_array_equal(modes[0].r, 1.0)
    with pytest.raises(fb.ModelError, match="There are modes 0 to 9, not 10"):
        linear.mode(10)
    with pytest.raises(fb.ModelError, match="amplitude"):
        linear.mode(0, amplitude=0.0)


def test_nearer_triangles_hide_others_also_where_they_intersect():
    """Two squares that cross along the middle: each is in front on one side."""
    tilted = np.array([[0.0, 0.0, -4.0], [8.0, 0.0, 4.0], [8.0, 8.0, 4.0], [0.0, 8.0, -4.0]])
    corners = np.concatenate([[square[[0, 1, 2]], square[[0, 2, 3]]] for square in (tilted, tilted * (1, 1, -1))])
    red, blue = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    image = shaded._filled(corners, np.array([red, red, blue, blue]), 10, 8)
    assert image.shape == (8, 10, 4)
    np.testing.assert_array_equal(image[:, 4:8, :3], np.broadcast_to(red, (8, 4, 3)))
    np.testing.assert_array_equal(image[:, :4, :3], np.broadcast_to(blue, (8, 4, 3)))
    np.testing.assert_array_equal(image[:, :8, 3], 1.0)
    np.testing.assert_array_equal(image[:, 8:], 0.0)


def test_lines_among_bodies_have_their_width():
    [*quads] = shaded._quads(np.array([[0.0, 100.0, np.nan, 5.0], [3.0, 3.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0]]), 2.0)
    image = shaded._filled(np.array(quads), np.ones((len(quads), 3)), 100, 10)
    np.testing.assert_array_equal(image[:, :, 3].sum(axis=0), 4.0)


def test_animations_and_frames_in_space_are_drawn(bicycle, tmp_path):
    run = bicycle.simulate((0.0, 0.2))
    linear = bicycle.linearize(0.0, bicycle.initial_state())
    for animation in (run.animate(), linear.animate(0, duration=0.2, fps=10)):
        animation._init_draw()
        animation._draw_frame(1)
        [image] = animation._fig.axes[0].images
        pixels = np.asarray(image.get_array()).reshape(-1, 4)
        assert 0.01 < (pixels[:, 3] == 1.0).mean() < 0.6
        assert len({tuple(color) for color in pixels.tolist()}) > 50  # shaded
    figure = run.plot_frames([0.0, 0.1])
    assert [axes.get_title() for axes in figure.axes] == ["t = 0 s", "t = 0.1 s"]
    figure.savefig(tmp_path / "frames.svg")
    assert (tmp_path / "frames.svg").read_text().count("<image") == 2
    for times in ([0.3], [], [[0.0]]):
        with pytest.raises(fb.ModelError, match="times are"):
            run.plot_frames(times)


SIZED = [
    fb.Sphere("rf"),
    fb.Ellipsoid("rf", 0.3, 0.2),
    fb.Box("rf", "rr", 0.1, at=(0.0, "rr", "rf")),
    fb.Cylinder(0.1, "rf"),
    fb.Capsule("rf", "rr"),
    fb.Cone("rr", "rf"),
    fb.Disc("rf", "rr"),
    fb.Wheel("rf"),
    fb.Torus("rf", 0.05),
    fb.Torus(0.5, "rr"),
    fb.Plane("rf"),
    fb.Arrow("rf"),
    fb.CoordinateFrame("rf"),
]


@pytest.mark.parametrize("shape", SIZED, ids=repr)
def test_changes_by_parameters_are_those_between_two_sizes(bicycle, shape):
    """Vertices and places are linear in sizes: to rounding errors of the difference quotient, 1e-16 / 1e-3."""
    before, after = parameter_array(bicycle, None), parameter_array(bicycle, None)
    after[bicycle.parameters.index("rf")] = 0.7
    after[bicycle.parameters.index("rr")] = 0.25
    other = dict(zip(bicycle.parameters, after, strict=True))
    first, second = ([*solids_of(bicycle, {"rear wheel": [shape]}, p, np.zeros((0, 3, 1)))] for p in (before, after))
    for now, then in zip(first, second, strict=True):
        more = [(change, other[change.parameter] - change.value) for change in now.changes]
        vertices = now.mesh.vertices + sum(step * change.vertices for change, step in more)
        np.testing.assert_allclose(vertices, then.mesh.vertices, rtol=0, atol=1e-12)
        offset = now.offset + sum(step * change.offset for change, step in more)
        np.testing.assert_allclose(offset, then.offset, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_traces_of_many_points_are_grouped_by_body(browser, tmp_path):
    chain, page = fb.compile_model(fb.models.chain(9)), browser.new_page()
    page.goto(chain.simulate((0.0, 1.0)).save(tmp_path / "run.html").as_uri())
    traced = page.locator("#traces input:checked").count()
    page.locator("details.few summary").click()
    of_frame = page.locator("#traces div", has_text="bar3").locator("input")
    assert of_frame.count() > 1
    assert page.locator("#traces input").count() == len(chain.points)
    for on in (True, False):
        page.get_by_role("button", name="Traces of bar3").click()
        assert of_frame.evaluate_all("boxes => boxes.map(box => box.checked)") == [on] * of_frame.count()
    assert 0 < page.locator("#traces input:checked").count() < traced
    page.close()


@pytest.mark.slow
def test_shapes_of_a_live_page_follow_parameters(browser, tmp_path):
    """After a slider has moved, the picture is that of a page that begins with its value."""
    shapes = {"disc": [fb.Torus("r", 0.1), fb.Box("r", 0.4, "r", at=("r", 0.0, 0.0), color="red")]}
    model = fb.compile_model(fb.models.rolling_disc())
    model.shapes = shapes
    images = []
    for begin, end in ((0.3, 0.3), (0.3, 0.45), (0.45, 0.45)):
        path = tmp_path / "page.html"
        model.page(path, t_span=(0.0, 1.0), parameters={"r": begin}, ranges={"r": (0.1, 1.0)})
        page = browser.new_page()
        page.goto(path.as_uri())
        page.evaluate("async value => { settings.parameters.r = value; await update(); released(); }", end)
        page.wait_for_timeout(300)
        png = page.locator("canvas#mechanism").screenshot()
        images.append(np.asarray(PIL.Image.open(io.BytesIO(png)).convert("RGB"), dtype=float))
        page.close()
    before, moved, expected = images
    assert np.abs(before - expected).max(axis=2).mean() > 5.0
    assert np.abs(moved - expected).max(axis=2).mean() < 0.05  # some pixels at edges: the same run, but for 1e-11


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_report_in_space_is_drawn_by_webgl_and_turned_by_pointer_and_keys(bicycle, browser, tmp_path, scheme):
    path = bicycle.simulate((0.0, 1.0)).save(tmp_path / "run.html")
    page = browser.new_page(color_scheme=scheme)
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: errors.extend(complaints(message.text)))
    page.goto(path.as_uri())
    canvas = page.locator("canvas#mechanism")
    canvas.wait_for()
    page.wait_for_timeout(200)
    seen = [canvas.screenshot()]
    for act in (
        lambda: page.get_by_role("button", name="Top").click(),
        lambda: page.get_by_role("button", name="Home").click(),
        lambda: (canvas.focus(), page.keyboard.press("ArrowLeft")),
        lambda: page.keyboard.press("+"),
        lambda: page.keyboard.press("Shift+ArrowUp"),
        lambda: page.keyboard.press("2"),
        lambda: (canvas.hover(), page.mouse.down(), page.mouse.move(300, 300), page.mouse.up()),
        lambda: page.mouse.wheel(0, -200),
        lambda: page.evaluate("controls.show(60)"),
    ):
        act()
        page.wait_for_timeout(150)
        seen.append(canvas.screenshot())
    assert seen[2] == seen[0]  # at home again
    assert len({*seen}) == len(seen) - 1
    assert errors == []
    page.close()
