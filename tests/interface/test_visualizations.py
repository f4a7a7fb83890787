"""Shapes and lines that pydy.viz and symmeplot describe: where these packages themselves place them."""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from pydy.viz import shapes as pydy_shapes
from pydy.viz.scene import Scene
from pydy.viz.visualization_frame import VisualizationFrame
from symbrim.bicycle.rear_frames import RigidRearFrame
from symbrim.utilities.plotting import Plotter
from symmeplot.matplotlib import Scene3D

import fourbar_codegen as fb
from fourbar_codegen.modeling.visualizations import read_visualization
from fourbar_codegen.views.frames import frames_of
from fourbar_codegen.views.solids import solids_of

L, M, G = sm.symbols("l m g")
VALUES = {"l": 0.8, "m": 1.0, "g": 9.81}


class DoublePendulum:
    """That of PyDy's examples (examples/double_pendulum in github.com/pydy/pydy)."""

    def __init__(self):
        q1, q2, u1, u2 = me.dynamicsymbols("q1 q2 u1 u2")
        self.N, self.A, self.B = me.ReferenceFrame("N"), me.ReferenceFrame("A"), me.ReferenceFrame("B")
        self.A.orient_axis(self.N, self.N.z, q1)
        self.B.orient_axis(self.N, self.N.z, q2)
        self.A.set_ang_vel(self.N, u1 * self.N.z)
        self.B.set_ang_vel(self.N, u2 * self.N.z)
        self.O = me.Point("O")
        self.P = self.O.locatenew("P", L * self.A.x)
        self.R = self.P.locatenew("R", L * self.B.x)
        self.O.set_vel(self.N, 0)
        self.P.v2pt_theory(self.O, self.N, self.A)
        self.R.v2pt_theory(self.P, self.N, self.B)
        self.kane = me.KanesMethod(
            self.N,
            q_ind=[q1, q2],
            u_ind=[u1, u2],
            kd_eqs=[q1.diff() - u1, q2.diff() - u2],
            bodies=[me.Particle("upper", self.P, M), me.Particle("lower", self.R, M)],
            forcelist=[(self.P, M * G * self.N.x), (self.R, M * G * self.N.x)],
        )

    def visualization_frames(self):
        """As in the example: two points of one name, frames that nothing else has, particles in the inertial frame."""
        link = pydy_shapes.Cylinder(name="link", radius=0.1, length=L, color="red")
        ball = pydy_shapes.Sphere(name="sphere", radius=0.2)
        of_p, of_r = (
            frame.orientnew("frame" + frame.name, "Axis", [sm.pi / 2, self.N.z]) for frame in (self.A, self.B)
        )
        return [
            VisualizationFrame("linkP", of_p, self.O.locatenew("originP", L / 2 * self.A.x), link),
            VisualizationFrame("linkR", of_r, self.P.locatenew("originP", L / 2 * self.B.x), link),
            VisualizationFrame("sphereP", self.N, self.P, ball),
            VisualizationFrame("sphereR", self.N, self.R, ball),
        ]

    def model(self, shapes, **more):
        return fb.Model(self.kane, name="double_pendulum", parameters=VALUES, shapes=shapes, **more)


def test_shapes_of_pydy_are_where_pydy_places_them():
    pendulum = DoublePendulum()
    frames = pendulum.visualization_frames()
    model = pendulum.model(Scene(pendulum.N, pendulum.O, *frames))
    assert {name: [type(s).__name__ for s in of_body] for name, of_body in model.shapes.items()} == {
        "frameA": ["Cylinder"],
        "frameB": ["Cylinder"],
        "upper": ["Sphere"],
        "lower": ["Sphere"],
    }
    run = fb.compile_model(model).simulate((0.0, 1.0), [0.4, -1.1, 0.3, 0.2])
    drawn = frames_of(run, lambda start, end: np.linspace(start, end, 5))
    solids = {solid.name: solid for solid in drawn.scene.solids}
    for name, frame in zip(("frameA", "frameB", "upper", "lower"), frames, strict=True):
        pose = sm.lambdify((*pendulum.kane.q, L), frame.generate_transformation_matrix(pendulum.N, pendulum.O))
        places, rotations = solids[name].placed(drawn.scene.positions, drawn.scene.rotations)
        for k, (q1, q2) in enumerate(drawn.shown.q.T):
            expected = np.array(pose(q1, q2, VALUES["l"]), dtype=float).T  # PyDy's has translations in the last row
            np.testing.assert_allclose(drawn.scene.view.turn.T @ places[:, k], expected[:3, 3], atol=1e-14)
            axis = drawn.scene.view.turn.T @ rotations[:, 2, k]
            if name.startswith("frame"):
                np.testing.assert_allclose(axis, expected[:3, 1], atol=1e-14)  # cylinders along y


@pytest.mark.parametrize(
    ("shape", "sizes"),
    [
        (pydy_shapes.Box(1.0, 2.0, 3.0), (1.0, 2.0, 3.0)),
        (pydy_shapes.Cube(1.5), (1.5, 1.5, 1.5)),
        (pydy_shapes.Cylinder(3.0, 0.5), (1.0, 3.0, 1.0)),
        (pydy_shapes.Cone(L, 0.5), (1.0, 0.8, 1.0)),
        (pydy_shapes.Sphere(L), (1.6, 1.6, 1.6)),
        (pydy_shapes.Circle(0.5), (1.0, 1.0, 0.001)),
        (pydy_shapes.Plane(2.0, 1.0), (1.0, 2.0, 0.001)),
        (pydy_shapes.Torus(1.0, 0.25), (2.5, 2.5, 0.5)),
    ],
    ids=lambda value: type(value).__name__,
)
def test_shapes_of_pydy_have_its_sizes_along_x_y_and_z(shape, sizes):
    pendulum = DoublePendulum()
    model = fb.compile_model(pendulum.model({"upper": shape}))
    model.shapes = {"lower": [shape], "upper": shape}
    assert model.shapes["lower"] == model.shapes["upper"]
    assert model.shapes["upper"][0].color == "grey"
    values = np.array([VALUES[name] for name in model.parameters])
    [solid] = solids_of(model, {"upper": model.shapes["upper"]}, values, np.zeros((0, 3, 1)))
    np.testing.assert_allclose(np.ptp(solid.mesh.vertices @ solid.rotation.T, axis=0), sizes, rtol=1e-12)


def test_several_shapes_of_a_frame_and_frames_that_nothing_else_needs():
    pendulum = DoublePendulum()
    tilted = pendulum.A.orientnew("tilted", "Axis", [0.3, pendulum.A.x])
    model = pendulum.model({tilted: [pydy_shapes.Sphere(0.1), fb.Box(1, 1, 1, at="P")], "upper": []})
    assert [type(shape).__name__ for shape in model.shapes["tilted"]] == ["Sphere", "Box"]
    frames = [VisualizationFrame(tilted, pendulum.P, pydy_shapes.Cube(length)) for length in (0.1, 0.2)]
    assert [shape.x for shape in pendulum.model(frames).shapes["tilted"]] == [0.1, 0.2]


def test_bodies_with_one_frame_have_their_own_shapes():
    """Two sliders in the inertial frame, and a floor, which is neither's."""
    frame, origin = me.ReferenceFrame("N"), me.Point("O")
    (x, y, u, v) = me.dynamicsymbols("x y u v")
    origin.set_vel(frame, 0)
    centers = [origin.locatenew(name, way * frame.x + frame.z) for name, way in (("G1", x), ("G2", y))]
    for point, speed in zip(centers, (u, v), strict=True):
        point.set_vel(frame, speed * frame.x)
    inertia = me.inertia(frame, 1, 1, 1)
    first, second = (
        me.RigidBody(f"slider{n}", center, frame, M, (inertia, center)) for n, center in enumerate(centers, 1)
    )
    system = me.System(frame, origin)
    system.add_bodies(first, second)
    system.q_ind, system.u_ind = [x, y], [u, v]
    system.add_kdes(u - x.diff(), v - y.diff())
    cubes = [VisualizationFrame(body, pydy_shapes.Cube(0.1 * n)) for n, body in enumerate((first, second), 1)]
    floor = VisualizationFrame(frame, origin, pydy_shapes.Plane(3.0, 3.0))
    model = fb.compile_model(fb.Model(system, name="sliders", parameters={"m": 1.0}, shapes=[*cubes, floor]))
    run = model.simulate((0.0, 1.0), [0.2, 0.5, 1.0, -1.0])
    scene = frames_of(run, lambda start, end: np.array([start, end])).scene
    places = {
        solid.name: (scene.view.turn.T @ solid.placed(scene.positions, scene.rotations)[0]).round(9).T.tolist()
        for solid in scene.solids
    }
    assert places == {
        "slider1": [[0.2, 0, 1], [1.2, 0, 1]],
        "slider2": [[0.5, 0, 1], [-0.5, 0, 1]],
        "N": [[0, 0, 0], [0, 0, 0]],
    }


def test_frames_of_one_name_are_refused():
    pendulum = DoublePendulum()
    frames = [frame.orientnew("turned", "Axis", [0.3, pendulum.N.z]) for frame in (pendulum.A, pendulum.B)]
    shapes = [VisualizationFrame(frame, pendulum.P, pydy_shapes.Cube(0.1)) for frame in frames]
    with pytest.raises(fb.ModelError, match="A frame with a shape is called turned, as another frame or body is"):
        pendulum.model(shapes)


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        ({"upper": pydy_shapes.TorusKnot(1.0, 0.1)}, "no shape like the TorusKnot of pydy.viz; there are Box, Circle"),
        ({"upper": pydy_shapes.Sphere(L / 2)}, "radius of a Sphere"),
        ([pydy_shapes.Sphere(1.0)], "a list of pydy's visualization frames"),
        ("red", "shapes= is a mapping of bodies to shapes"),
        ({me.ReferenceFrame("lost"): fb.Sphere(0.1)}, "Frame lost, used by shapes, is not oriented"),
    ],
)
def test_what_is_no_shape_is_refused(shapes, message):
    with pytest.raises(fb.ModelError, match=message):
        DoublePendulum().model(shapes)


def test_lines_of_symmeplot_are_drawn_between_their_points():
    pendulum = DoublePendulum()
    scene = Scene3D(pendulum.N, pendulum.O)
    elbow = pendulum.P.locatenew("P", L / 4 * pendulum.B.y)
    scene.add_line([pendulum.O, pendulum.P, elbow, pendulum.R], "line")
    run = fb.compile_model(pendulum.model(scene)).simulate((0.0, 0.1), [0.4, -1.1, 0.3, 0.2])
    drawn = frames_of(run, lambda start, _: np.array([start]))
    [line] = [line for line in drawn.scene.lines if line.kind == "line"]
    scene.lambdify_system((pendulum.kane.q[:], [L]))
    scene.evaluate_system(run.q[:, 0], [VALUES["l"]])
    seen = drawn.scene.view.turn.T @ drawn.scene.positions[[*line.rows], :, 0].T
    np.testing.assert_allclose(seen, np.array(scene.children[1].line_coords).reshape(3, -1), atol=1e-14)


def test_plotter_of_symbrim_has_the_lines_of_its_models():
    frame = RigidRearFrame("rear")
    frame.define_all()
    [line] = read_visualization(Plotter.from_model(frame)).lines
    assert line[0] is frame.bottom_bracket
    assert frame.saddle.point in line
