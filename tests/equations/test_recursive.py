"""Trees by the articulated-body algorithm: against SymPy's own equations, closed forms, and differences.

Rounding errors of M^-1 f are bounded by the precision times the condition of M, here up to 1e4, relative to the largest
acceleration; 1e-10 is what equations at scale are to hold (test_scale.py).
"""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.forms import of_form
from sympy.physics.mechanics.models import n_link_pendulum_on_cart
from sympy.physics.mechanics.system import System
from trees import revolute_chain

import fourbar_codegen as fb
from fourbar_codegen.dynamics.formation import form_equations
from fourbar_codegen.lowering.lower import lower

STATES = 100
T = me.dynamicsymbols._t


class Tree:
    """A System under construction: frames and points that hang on others."""

    def __init__(self, name):
        self.name = name
        self.ground, self.origin = me.ReferenceFrame("N"), me.Point("O")
        self.origin.set_vel(self.ground, 0)
        self.system = System(self.ground, self.origin)
        self.q, self.u, self.parameters = [], [], {}

    def symbol(self, name, value):
        symbol = sm.Symbol(name)
        self.parameters[symbol] = value
        return symbol

    def coordinate(self, *, speed=None):
        n = len(self.q) + 1
        q, u = me.dynamicsymbols(f"q{n} u{n}")
        self.q.append(q)
        self.u.append(u)
        self.system.add_kdes((u if speed is None else speed(u)) - q.diff(T))
        return q, u

    def turned(self, parent, axis, name):
        """A frame that turns about an axis of another one."""
        q, u = self.coordinate()
        frame = me.ReferenceFrame(name)
        frame.orient_axis(parent, axis, q)
        frame.set_ang_vel(parent, u * axis)
        return frame

    def point(self, name, base, offset):
        """A point at an offset, with its velocity, which SymPy would derive from more than one other point."""
        point = base.locatenew(name, offset)
        rate = offset.dt(self.ground).subs(dict(zip((q.diff(T) for q in self.q), self.u, strict=True)))
        point.set_vel(self.ground, base.vel(self.ground) + rate)
        return point

    def body(self, name, point, frame, mass=1.3, moments=(0.11, 0.12, 0.03), products=(0.0, 0.0, 0.0)):
        m = self.symbol(f"m_{name}", mass)
        inertia = me.inertia(frame, *moments, *products)
        self.system.add_bodies(me.RigidBody(name, point, frame, m, (inertia, point)))

    def model(self, **options):
        g = self.symbol("g", 9.81)
        self.system.apply_uniform_gravity(-g * self.ground.z)
        self.system.add_coordinates(*self.q)
        self.system.add_speeds(*self.u)
        return self.system, {"name": self.name, "parameters": self.parameters, **options}


def chain(count=4):
    tree = Tree("chain_in_space")
    frame, joint = tree.ground, tree.origin
    for n in range(count):
        link = tree.turned(frame, (frame.x, frame.y, frame.z)[n % 3], f"B{n}")
        center = tree.point(f"C{n}", joint, 0.2 * link.x - 0.1 * link.z)
        tree.body(f"b{n}", center, link, products=(0.004, -0.006, 0.005))
        frame, joint = link, tree.point(f"P{n}", joint, 0.4 * link.x + 0.1 * link.y)
    return tree.model()


def branched():
    """A base that turns, with three arms of two links about different axes, with stops and dampers at the elbows."""
    tree = Tree("branched")
    base = tree.turned(tree.ground, tree.ground.z, "base")
    tree.body("base", tree.origin, base)
    k, c = tree.symbol("k", 3.0), tree.symbol("c", 0.4)
    for arm, axis in enumerate((base.x, base.y, base.x)):
        shoulder = tree.point(f"S{arm}", tree.origin, 0.3 * base.x * arm + 0.2 * base.y)
        upper = tree.turned(base, axis, f"U{arm}")
        tree.body(f"u{arm}", tree.point(f"CU{arm}", shoulder, -0.2 * upper.z), upper)
        elbow = tree.point(f"E{arm}", shoulder, -0.4 * upper.z)
        lower = tree.turned(upper, upper.y, f"L{arm}")
        tree.body(f"l{arm}", tree.point(f"CL{arm}", elbow, -0.2 * lower.z), lower)
        angle = tree.q[-1]
        stop = sm.Piecewise((-k * angle, angle < 0), (sm.sin(angle), angle > 0.5), (0, True))
        tree.system.add_actuators(me.TorqueActuator(stop - c * tree.u[-1] ** 3, upper.y, lower, upper))
    return tree.model()


def floating():
    """A body that moves freely, by velocities along its own axes, with a link on a ball joint."""
    tree = Tree("floating")
    body = me.ReferenceFrame("A")
    center = me.Point("C")
    place = [tree.coordinate(speed=lambda u: u) for _ in range(3)]
    angles = [me.dynamicsymbols(f"q{n}") for n in (4, 5, 6)]
    rates = me.dynamicsymbols("u4:7")
    body.orient_body_fixed(tree.ground, angles, "ZXY")
    given = body.ang_vel_in(tree.ground).to_matrix(body)
    solved = sm.solve(given - sm.Matrix(rates), [q.diff(T) for q in angles], dict=True)[0]
    tree.system.add_kdes(*(solved[q.diff(T)] - q.diff(T) for q in angles))
    body.set_ang_vel(tree.ground, sum((u * e for u, e in zip(rates, body, strict=True)), me.Vector(0)))
    tree.q += angles
    tree.u += rates
    center.set_pos(tree.origin, sum((q * e for (q, _), e in zip(place, tree.ground, strict=True)), me.Vector(0)))
    center.set_vel(tree.ground, sum((u * e for (_, u), e in zip(place, tree.ground, strict=True)), me.Vector(0)))
    tree.body("trunk", center, body, mass=4.0)
    first = tree.turned(body, body.x, "J1")
    second = tree.turned(first, first.y, "J2")
    leg = tree.turned(second, second.z, "J3")
    hip = tree.point("H", center, 0.1 * body.y - 0.3 * body.z)
    tree.body("leg", tree.point("CL", hip, -0.2 * leg.z + 0.02 * leg.x), leg)
    return tree.model()


def sliding():
    """Prismatic joints along axes that turn, and a motion that is prescribed at the root."""
    tree = Tree("sliding")
    drive = me.dynamicsymbols("s")
    root = tree.point("R", tree.origin, drive * tree.ground.x)
    frame, joint = tree.ground, root
    for n in range(3):
        link = tree.turned(frame, frame.y if n % 2 else frame.x, f"B{n}")
        q, _ = tree.coordinate()
        joint = tree.point(f"P{n}", joint, (0.3 + q) * link.z + 0.1 * link.x)
        tree.body(f"b{n}", joint, link)
        frame = link
    return tree.model(inputs={drive: sm.sin(3 * T) / 5})


def absolute():
    """SymPy's pendulum of links on a cart, in absolute angles."""
    kane = n_link_pendulum_on_cart(6, cart_force=False, joint_torques=True)
    symbols = sorted(kane.mass_matrix_full.free_symbols | kane.forcing_full.free_symbols, key=str)
    values = {symbol: 0.5 + 0.1 * i for i, symbol in enumerate(s for s in symbols if s != T)}
    torques = {
        f: sm.Rational(n + 1, 10) for n, f in enumerate(sorted(me.find_dynamicsymbols(kane.forcing_full), key=str))
    }
    torques = {f: value for f, value in torques.items() if f not in {*kane.q, *kane.u}}
    return kane, {"name": "absolute", "parameters": values, "inputs": torques}


def mixed_speeds():
    """Speeds that are combinations of the joints' rates: u_k = q_1' + ... + q_k' for all joints of a plane chain."""
    tree = Tree("mixed_speeds")
    t = T
    count = 7
    q, u = me.dynamicsymbols(f"q1:{count + 1}"), me.dynamicsymbols(f"u1:{count + 1}")
    frame, joint = tree.ground, tree.origin
    for n in range(count):
        before = u[n - 1] if n else 0
        link = me.ReferenceFrame(f"B{n}")
        link.orient_axis(frame, frame.y, q[n])
        link.set_ang_vel(frame, (u[n] - before) * frame.y)
        tree.body(f"b{n}", tree.point(f"C{n}", joint, 0.2 * link.x), link)
        tree.system.add_kdes(u[n] - before - q[n].diff(t))
        frame, joint = link, tree.point(f"P{n}", joint, 0.4 * link.x)
    tree.q, tree.u = [*q], [*u]
    return tree.model()


def quaternion():
    """A body on a pin whose orientation is a quaternion, and a chain of three links on it."""
    tree = Tree("quaternion")
    body = me.ReferenceFrame("A")
    parts, rates = me.dynamicsymbols("e0:4"), me.dynamicsymbols("w1:4")
    e0, e1, e2, e3 = parts
    body.orient_quaternion(tree.ground, parts)
    body.set_ang_vel(tree.ground, sum((w * e for w, e in zip(rates, body, strict=True)), me.Vector(0)))
    w1, w2, w3 = rates
    slopes = (
        -e1 * w1 - e2 * w2 - e3 * w3,
        e0 * w1 - e3 * w2 + e2 * w3,
        e3 * w1 + e0 * w2 - e1 * w3,
        -e2 * w1 + e1 * w2 + e0 * w3,
    )
    tree.system.add_kdes(*(slope / 2 - e.diff(T) for slope, e in zip(slopes, parts, strict=True)))
    # Offsets are constant in frames whose angular velocity is known, so that SymPy derives all velocities.
    tree.q, tree.u = [*parts], [*rates]
    frame, joint = body, tree.origin
    for n in range(4):
        end, center = joint.locatenew(f"P{n}", 0.3 * frame.x), joint.locatenew(f"C{n}", 0.2 * frame.x - 0.1 * frame.y)
        for point in (center, end):
            point.v2pt_theory(joint, tree.ground, frame)
        tree.body(f"b{n}", center, frame)
        joint = end
        if n < 3:
            q, u = me.dynamicsymbols(f"q{n} u{n}")
            after = me.ReferenceFrame(f"B{n}")
            after.orient_axis(frame, (frame.x, frame.y, frame.z)[n], q)
            after.set_ang_vel(frame, u * (frame.x, frame.y, frame.z)[n])
            tree.system.add_kdes(u - q.diff(T))
            tree.q.append(q)
            tree.u.append(u)
            frame = after
    return tree.model()


def rotor_at_a_joint():
    """A link carries a rotor whose centre is on the axis of the link's own joint, so that it moves with the arm."""
    tree = Tree("rotor_at_a_joint")
    base = tree.turned(tree.ground, tree.ground.z, "A")
    arm = tree.turned(base, base.y, "B")
    tree.body("arm", tree.point("CB", tree.origin, 0.2 * arm.x), arm)
    joint = tree.point("P", tree.origin, 0.4 * arm.x)
    link = tree.turned(arm, arm.z, "C")
    tree.body("link", tree.point("CC", joint, 0.2 * link.x - 0.1 * link.z), link)
    tree.body("rotor", joint, tree.turned(link, link.x, "D"), products=(0.004, -0.006, 0.005))
    return tree.model()


MODELS = (chain, branched, floating, sliding, absolute, mixed_speeds, quaternion, rotor_at_a_joint)


def accelerations_by_sympy(system, parameters, inputs=(), t=0.3, **_):
    """u' of SymPy's own equations, as a function of the state."""
    kane = system
    if isinstance(system, System):
        system.form_eoms()
        kane = system.eom_method
    states = dict(zip((*kane.q, *kane.u), sm.symbols(f"x:{len(kane.q) + len(kane.u)}"), strict=True))
    numbers = {symbol: sm.sympify(value) for symbol, value in {**states, **parameters, T: t}.items()}
    rates = {f.diff(T, order): e.diff(T, order) for f, e in dict(inputs).items() for order in (2, 1)} | dict(inputs)
    expressions = [
        me.msubs(me.msubs(expression, kane.kindiffdict()), rates).xreplace(numbers)
        for expression in (kane.mass_matrix, kane.forcing)
    ]
    evaluate = sm.lambdify([[*states.values()]], expressions, cse=True)
    return lambda x: np.linalg.solve(*evaluate(x)).ravel()


def random_states(compiled, count=STATES):
    states = np.random.default_rng(7).uniform(-1.0, 1.0, (count, compiled.n_x))
    if compiled.coordinates[0] == "e0":
        states[:, :4] /= np.linalg.norm(states[:, :4], axis=1, keepdims=True)
    return states


@pytest.fixture(scope="module", params=MODELS, ids=[model.__name__ for model in MODELS])
def case(request):
    system, options = request.param()
    return system, options, fb.compile_model(fb.Model(system, **options))


@pytest.mark.slow
def test_trees_of_all_kinds_have_the_recursive_form(case):
    assert case[2].manifest["form"] == "recursive"


@pytest.mark.slow
@pytest.mark.parametrize("links", [8, 32])
def test_long_spatial_chains_have_the_recursive_form(links):
    """M is found regular by random numbers, which need not be the inertia of a body."""
    model = revolute_chain(links)
    assert lower(model.name, form_equations(model)).form == "recursive"


@pytest.mark.slow
def test_accelerations_of_the_recursive_form_equal_sympys(case):
    system, options, compiled = case
    expected = accelerations_by_sympy(system, **options)
    for x in random_states(compiled):
        wanted = expected(x)
        found = compiled.rhs(0.3, x)[compiled.n_q :]
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-10 * np.abs(wanted).max())
        matrix, forcing = compiled.tree_mass_matrix(0.3, x), compiled.tree_forcing(0.3, x)
        np.testing.assert_allclose(matrix @ wanted, forcing, rtol=0, atol=1e-10 * np.abs(matrix @ wanted).max())


@pytest.mark.slow
def test_batch_in_the_recursive_form_equals_single_states(case):
    *_, compiled = case
    states = random_states(compiled, 21)
    together = compiled.rhs_batch(0.3, states.T.copy())
    for x, column in zip(states, together.T, strict=True):
        alone = compiled.rhs(0.3, x)
        np.testing.assert_allclose(column, alone, rtol=0, atol=1e-12 * np.abs(alone).max())


@pytest.mark.slow
def test_jacobians_of_the_recursive_form_equal_differences(case):
    """Central differences of order 6, whose errors are near 1e-9 of the largest entry."""
    *_, compiled = case
    p = np.array([*compiled.defaults.values()])

    def differences(function, at):
        h = 1e-3
        weights = ((1, 45.0), (2, -9.0), (3, 1.0))
        columns = []
        for unit in np.eye(len(at)):
            terms = [w * (function(at + k * h * unit) - function(at - k * h * unit)) for k, w in weights]
            columns.append(np.sum(terms, axis=0) / (60.0 * h))
        return np.array(columns).T

    for x in random_states(compiled, 3):
        wrt_state = differences(lambda y: compiled.rhs(0.3, y), x)
        wrt_parameters = differences(lambda values, x=x: compiled.rhs(0.3, x, values), p)
        for found, wanted in (
            (compiled.jacobian(0.3, x), wrt_state),
            (compiled.parameter_jacobian(0.3, x), wrt_parameters),
        ):
            np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-7 * np.abs(wanted).max())


@pytest.mark.slow
def test_singular_mass_matrix_in_the_recursive_form_raises_an_error():
    """Six joints that only a particle at the tip resists: M has rank 3, and rounding errors for pivots."""
    tree = Tree("massless_arm")
    frame, joint = tree.ground, tree.origin
    for n in range(6):
        link = tree.turned(frame, (frame.x, frame.y, frame.z)[n % 3], f"B{n}")
        share = tree.symbol("share", 1.0)
        inertia = me.inertia(link, *(share * moment for moment in (0.02, 0.03, 0.04)))
        center = tree.point(f"C{n}", joint, 0.2 * link.x + 0.05 * link.y)
        tree.system.add_bodies(me.RigidBody(f"b{n}", center, link, share, (inertia, center)))
        frame, joint = link, tree.point(f"P{n}", joint, 0.4 * link.x)
    tree.system.add_bodies(me.Particle("tip", joint, tree.symbol("m", 0.5)))
    system, options = tree.model()
    compiled = fb.compile_model(fb.Model(system, **options))
    assert compiled.manifest["form"] == "recursive"
    states = random_states(compiled, 40)
    for x in states:
        with pytest.raises(fb.SimulationError, match="not positive definite"):
            compiled.rhs(0.0, x, {"share": 0.0})
    assert np.isnan(compiled.rhs_batch(0.0, states.T.copy(), {"share": 0.0})).all(axis=0).all()
    for x in states[:5]:  # light, but regular: M is as ill-conditioned as the links are light
        found = compiled.rhs(0.0, x, {"share": 1e-6})[6:]
        matrix = compiled.tree_mass_matrix(0.0, x, {"share": 1e-6})
        wanted = np.linalg.solve(matrix, compiled.tree_forcing(0.0, x, {"share": 1e-6}))
        rounding = 1e-14 * np.linalg.cond(matrix)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=rounding * np.abs(wanted).max())


@pytest.mark.slow
def test_unknown_force_at_the_root_of_a_chain_equals_sympys():
    """The force that holds the first joint of a chain, against SymPy's equation of its auxiliary speed."""
    tree = Tree("held_chain")
    slip, force = me.dynamicsymbols("w F")
    root = tree.origin.locatenew("R", 0)
    root.set_vel(tree.ground, slip * tree.ground.z)
    tree.system.add_auxiliary_speeds(slip)
    tree.system.add_loads(me.Force(root, force * tree.ground.z))
    frame, joint = tree.ground, root
    for n in range(5):
        link = tree.turned(frame, frame.y if n % 2 else frame.x, f"B{n}")
        tree.body(f"b{n}", tree.point(f"C{n}", joint, -0.2 * link.z), link)
        frame, joint = link, tree.point(f"P{n}", joint, -0.4 * link.z)
    system, options = tree.model()
    compiled = fb.compile_model(fb.Model(system, **options))
    assert compiled.manifest["form"] == "recursive"
    system.form_eoms()
    (equation,) = system.eom_method.auxiliary_eqs
    given = {q.diff(T): u for q, u in zip(tree.q, tree.u, strict=True)} | tree.parameters | {slip: 0}
    leaves = [*tree.q, *tree.u, *(u.diff(T) for u in tree.u), force]
    left = sm.lambdify([leaves], me.msubs(equation, given), cse=True)  # linear in the force
    for x in random_states(compiled, 20):
        motion = [*x, *compiled.rhs(0.0, x)[5:]]
        none, one = left([*motion, 0.0]), left([*motion, 1.0])
        np.testing.assert_allclose(compiled.output(0.0, x), [none / (none - one)], rtol=1e-10)


@pytest.fixture(scope="module")
def closed():
    return fb.compile_model(of_form("recursive with a loop"))


@pytest.mark.slow
def test_members_of_a_closed_recursive_chain_equal_runs(closed):
    x0 = closed.initial_state()
    how = {"t_eval": [0.1, 0.2, 0.3], "rtol": 1e-9, "atol": 1e-9}
    values = np.linspace(0.9, 1.1, 9)
    ensemble = closed.ensemble((0.0, 0.3), np.tile(x0, (9, 1)), parameters={"m": values}, **how)
    assert ensemble.success.all()
    for i in (0, 4, 8):
        run = closed.simulate((0.0, 0.3), x0, parameters={"m": values[i]}, **how)
        np.testing.assert_allclose(ensemble.y[i], run.y, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_nearly_dependent_constraints_in_the_recursive_form_still_hold(closed):
    """Near a stretched chain J loses rank, so that the dense solution is used; J u' + gamma = 0 holds on both sides."""
    for bend in (0.3, 1e-2, 1e-4, 1e-6):
        q = np.zeros(closed.n_q)
        q[0::2], q[1::2] = bend, -bend
        x = np.concatenate((q, np.linspace(-1.0, 1.0, closed.n_u)))
        accelerations, multipliers = closed.kernel.accelerations(0.0, x)
        _, matrix, forcing, jacobian, bias = closed.kernel.dynamics(0.0, x)
        # Rounding errors grow with the condition of J, which is 1 / bend.
        tolerance = 1e-13 / bend * np.abs(accelerations).max()
        np.testing.assert_allclose(jacobian @ accelerations, -bias, rtol=0, atol=tolerance * np.abs(jacobian).max())
        balance = matrix @ accelerations - forcing - jacobian.T @ multipliers
        np.testing.assert_allclose(balance, 0.0, rtol=0, atol=tolerance * np.abs(matrix).max())
