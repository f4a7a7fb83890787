"""The tutorial's four-bar and open chains by this package and by multibody engines, side by side in one run.

Pinocchio, MuJoCo and Exudyn: how long a simulation of a closed loop takes for what error of the state at its end, and
how far the loop opens; how long one evaluation of the forward dynamics of an open chain takes. Engines that are not
installed are skipped with a line: ``pip install 'fourbar_codegen[bench]'``.
"""

from __future__ import annotations

import argparse
import ctypes
import functools
import json
import math
import os
import subprocess
import tempfile
import textwrap
import time
import timeit
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from measure import DOCS, circumstances, compare, replace_in_page
from peers import END, Case, aligned, at_error, by_scipy
from scipy.integrate import solve_ivp
from trees import LINK, revolute_chain
from tutorial import Floats

import fourbar_codegen as fb

ERRORS = (1e-4, 1e-6, 1e-8)
TOLERANCES = tuple(10.0**-k for k in range(3, 13))
LINKS = (2, 4, 8, 16, 32, 64)
BATCH = 1024
SAMPLES = 200
"""Number of intervals between the times at which a loop is looked at, where there are as many steps."""
OUR_FLAGS = ("-O2", "-fpeel-loops", "-fno-tree-vectorize", "-march=native")
"""Those of this package, and the instructions that it chooses when it loads a model."""
ENGINES = {"Pinocchio": ("pinocchio", "pin"), "MuJoCo": ("mujoco", "mujoco"), "Exudyn": ("exudyn", "exudyn")}
"""The module and the distribution of each."""
OURS = "fourbar_codegen, DOP853, loop kept closed"

OUR_SOURCE = r"""
#include <stdlib.h>

void evaluate(int n, const double *x, const double *p, double *accelerations)
{
    const fb_kernel *k = &KERNEL;
    const int n_x = k->n_x, n_u = k->n_u;
    double *constants = malloc((size_t)(k->n_constants + 1) * sizeof(double));
    double *rates = malloc((size_t)n_x * sizeof(double));
    void *work = malloc(k->work_size);
    k->prepare(p, constants);
    for (int i = 0; i < n; ++i, x += n_x, accelerations += n_u) {
        k->rhs(0.5, x, constants, 0, rates, work);
        for (int j = 0; j < n_u; ++j)
            accelerations[j] = rates[n_x - n_u + j];
    }
    free(constants);
    free(rates);
    free(work);
}

void differentiate(int n, const double *x, const double *p, double *jacobians)
{
    const fb_kernel *k = &KERNEL;
    const int n_x = k->n_x;
    double *constants = malloc((size_t)(k->n_constants + 1) * sizeof(double));
    void *work = malloc(k->work_size);
    k->prepare(p, constants);
    for (int i = 0; i < n; ++i, x += n_x, jacobians += n_x * n_x)
        fb_jacobian(k, 0.5, x, constants, 0, jacobians, work);
    free(constants);
    free(work);
}
"""

MUJOCO_SOURCE = r"""
#include <math.h>
#include <mujoco/mujoco.h>

double stiffness, damping;

/* What MuJoCo has no element for: a torque at one joint by the angle of another, and a force by the time. */
void passive(const mjModel *m, mjData *d)
{
    const mjtNum force[3] = {100 * sin(3.14159265358979323846 * d->time), 0, 0};
    d->qfrc_passive[0] -= stiffness * d->qpos[1] + damping * d->qvel[1];
    mj_applyFT(m, d, force, 0, d->xpos + 3 * 3, 3, d->qfrc_passive);
}

void forward(const mjModel *m, mjData *d, int n, const double *x, double *accelerations)
{
    for (int i = 0; i < n; ++i, x += 2 * m->nv, accelerations += m->nv) {
        mju_copy(d->qpos, x, m->nv);
        mju_copy(d->qvel, x + m->nv, m->nv);
        mj_forward(m, d);
        mju_copy(accelerations, d->qacc, m->nv);
    }
}
"""

PINOCCHIO_SOURCE = r"""
#include <array>
#include <cmath>
#include <boost/numeric/odeint.hpp>
#include <pinocchio/algorithm/aba-derivatives.hpp>
#include <pinocchio/algorithm/aba.hpp>
#include <pinocchio/algorithm/constrained-dynamics.hpp>
#include <pinocchio/algorithm/proximal.hpp>
#include <pinocchio/constraints.hpp>
#include <pinocchio/multibody.hpp>

namespace pin = pinocchio;
namespace odeint = boost::numeric::odeint;
using Eigen::Map;
using Eigen::Matrix3d;
using Eigen::Vector3d;
using Eigen::VectorXd;
using Loop = pin::RigidConstraintModel;
using LoopData = pin::RigidConstraintData;
using State = std::array<double, 6>;

static pin::SE3 at(double x, double y, double z)
{
    return pin::SE3(Matrix3d::Identity(), Vector3d(x, y, z));
}

struct FourBar {
    std::array<double, 3> l;
    double k, c;
    pin::Model model;
    pin::Data data;
    std::vector<Loop, Eigen::aligned_allocator<Loop>> loops;
    std::vector<LoopData, Eigen::aligned_allocator<LoopData>> loop_data;
    pin::ProximalSettings proximal;
    VectorXd q, u, tau;

    void operator()(const State &x, State &rates, double t)
    {
        const double force = 100 * std::sin(M_PI * t), y2 = l[0] * std::sin(x[0]), y23 = l[1] * std::sin(x[0] + x[1]);
        tau[0] = -k * x[1] - c * x[4] - force * (y2 + y23);
        tau[1] = -force * y23;
        q = Map<const VectorXd>(x.data(), 3);
        u = Map<const VectorXd>(x.data() + 3, 3);
        Map<VectorXd>(rates.data(), 3) = u;
        Map<VectorXd>(rates.data() + 3, 3) =
            pin::constraintDynamics(model, data, q, u, tau, loops, loop_data, proximal);
    }
};

/* p: rho, l1 to l4, g, k, c; proximal: accuracy, mu */
extern "C" FourBar *four_bar(const double *p, const double *proximal, int iterations)
{
    auto *bar = new FourBar{{p[2], p[3], p[4]}, p[6], p[7]};
    bar->model.gravity.linear(Vector3d(0, -p[5], 0));
    pin::JointIndex parent = 0;
    for (int i = 0; i < 3; ++i) {
        const double l = bar->l[i], m = p[0] * l, inertia = m * l * l / 12, from = i ? bar->l[i - 1] : p[1] / 2;
        parent = bar->model.addJoint(parent, pin::JointModelRZ(), at(from, 0, 0), "joint" + std::to_string(i));
        const Matrix3d central = Vector3d(0, inertia, inertia).asDiagonal().toDenseMatrix();
        bar->model.appendBodyToJoint(parent, pin::Inertia(m, Vector3d(l / 2, 0, 0), central), pin::SE3::Identity());
    }
    bar->data = pin::Data(bar->model);
    const pin::SE3 end = at(bar->l[2], 0, 0), start = at(-p[1] / 2, 0, 0);
    bar->loops.emplace_back(pin::CONTACT_3D, bar->model, parent, end, 0, start, pin::LOCAL);
    bar->loop_data.emplace_back(bar->loops[0]);
    bar->proximal = pin::ProximalSettings(proximal[0], proximal[1], iterations);
    bar->tau = VectorXd::Zero(3);
    pin::initConstraintDynamics(bar->model, bar->data, bar->loops, bar->loop_data);
    return bar;
}

/* Steps of RK4, or those of a controlled method if steps is 0; writes the states to path, at most room of them. */
extern "C" int run(FourBar *bar, double end, int steps, double tolerance, double *x, double *path, int room)
{
    State state;
    std::copy(x, x + 6, state.begin());
    int written = 0;
    auto record = [&](const State &now, double) {
        if (written < room)
            std::copy(now.begin(), now.end(), path + 6 * written++);
    };
    auto rates = std::ref(*bar);
    if (steps)
        odeint::integrate_n_steps(odeint::runge_kutta4<State>(), rates, state, 0.0, end / steps, steps, record);
    else
        odeint::integrate_adaptive(
            odeint::make_controlled(tolerance, tolerance, odeint::runge_kutta_fehlberg78<State>()), rates, state, 0.0,
            end, 1e-3, record);
    std::copy(state.begin(), state.end(), x);
    return written;
}

struct Chain {
    pin::Model model;
    pin::Data data;
};

extern "C" Chain *chain(int n, double m, double l, double g, const double *inertia)
{
    auto *made = new Chain;
    made->model.gravity.linear(Vector3d(0, 0, -g));
    const pin::Inertia body(m, Vector3d(0, 0, -l / 2), Map<const Matrix3d>(inertia));
    const pin::JointModel axes[] = {pin::JointModelRX(), pin::JointModelRY()};
    pin::JointIndex parent = 0;
    for (int i = 0; i < n; ++i) {
        parent = made->model.addJoint(parent, axes[i % 2], at(0, 0, i ? -l : 0), "joint" + std::to_string(i));
        made->model.appendBodyToJoint(parent, body, pin::SE3::Identity());
    }
    made->data = pin::Data(made->model);
    return made;
}

extern "C" void aba(Chain *made, int n, const double *x, double *accelerations)
{
    const int k = made->model.nv;
    const VectorXd tau = VectorXd::Zero(k);
    VectorXd q(k), u(k);
    for (int i = 0; i < n; ++i, x += 2 * k, accelerations += k) {
        q = Map<const VectorXd>(x, k);
        u = Map<const VectorXd>(x + k, k);
        Map<VectorXd>(accelerations, k) = pin::aba(made->model, made->data, q, u, tau);
    }
}

/* d(accelerations)/dq and d(accelerations)/du, one after the other, column by column. */
extern "C" void aba_derivatives(Chain *made, int n, const double *x, double *jacobians)
{
    const int k = made->model.nv;
    const VectorXd tau = VectorXd::Zero(k);
    VectorXd q(k), u(k);
    for (int i = 0; i < n; ++i, x += 2 * k, jacobians += 2 * k * k) {
        q = Map<const VectorXd>(x, k);
        u = Map<const VectorXd>(x + k, k);
        pin::computeABADerivatives(made->model, made->data, q, u, tau);
        Map<Eigen::MatrixXd>(jacobians, k, k) = made->data.ddq_dq;
        Map<Eigen::MatrixXd>(jacobians + k * k, k, k) = made->data.ddq_dv;
    }
}
"""


@dataclass(frozen=True)
class Way:
    """A way to simulate the four-bar.

    Parameters
    ----------
    settings : sequence of float
        Numbers of steps, or tolerances.
    prepare : callable
        Makes of a setting what is timed, which returns the state at the end.
    path : callable
        The states of a run in columns, by a setting.
    """

    settings: Sequence[float]
    prepare: Callable[[Any], Callable[[], Floats]]
    path: Callable[[Any], Floats]


def cpu_time(statement: str, names: Mapping[str, Any], share: float = 1.0) -> Callable[[], float]:
    """A measure of CPU time, which other processes lengthen less than the time of a clock; 10 ms or one call."""
    timer = timeit.Timer(statement, timer=time.process_time, globals=dict(names))
    timer.timeit(1)  # the first call may compile
    number = max(1, int(0.01 / max(timer.timeit(3) / 3, 1e-8)))
    return lambda: timer.timeit(number) / number * share


def library(
    source: str, suffix: str, command: Sequence[str], end: Sequence[str], files: Mapping[str, str] | None = None
) -> ctypes.CDLL:
    """Compile and load a few functions."""
    folder = Path(tempfile.mkdtemp())
    for name, text in (files or {}).items():
        (folder / name).write_text(text)
    file = folder / f"functions{suffix}"
    file.write_text(source)
    made = folder / "functions.so"
    written = [str(folder / name) for name in files or () if name.endswith(".c")]
    command = [*command, f"-I{folder}", "-fPIC", "-shared", str(file), *written, "-o", str(made), *end]
    subprocess.run(command, check=True)
    return ctypes.CDLL(str(made))


def address(array: Floats) -> ctypes.c_void_p:
    """Where an array's numbers are."""
    return ctypes.c_void_p(array.ctypes.data)


def steps(fewest: int, factor: int, number: int) -> tuple[int, ...]:
    """Numbers of steps, each a multiple of the one before."""
    return tuple(fewest * factor**k for k in range(number))


class Numbers:
    """The four-bar's parameters by name, and what all engines need of them."""

    def __init__(self, case: Case) -> None:
        values = dict(zip(case.four_bar.parameters, case.p, strict=True))
        self.rho, self.g, self.k, self.c = (float(values[name]) for name in ("rho", "g", "k", "c"))
        self.ground, *self.lengths = (float(values[f"l{i}"]) for i in range(1, 5))

    @property
    def links(self) -> Iterator[tuple[float, float, float]]:
        """Length, mass, and central moment of inertia of each moving link."""
        for length in self.lengths:
            yield length, self.rho * length, self.rho * length**3 / 12


# ---- this package


def four_bar_by_ourselves(case: Case) -> dict[str, Way]:
    four_bar = case.four_bar

    def run(method: str, tolerance: float, times: Any) -> Floats:
        return four_bar.simulate(
            (0.0, END), case.x0, method=method, rtol=tolerance, atol=tolerance, t_eval=times
        ).y  # fmt: skip

    def way(method: str) -> Way:
        return Way(
            TOLERANCES,
            lambda tolerance: lambda: run(method, tolerance, [END])[:, -1],
            lambda tolerance: run(method, tolerance, np.linspace(0.0, END, SAMPLES + 1)),
        )

    return {f"fourbar_codegen, {method}, loop kept closed": way(method) for method in ("DOP853", "RK45")}


# ---- Pinocchio

PROXIMAL = (1e-12, 1e-10, 10)
"""Accuracy, mu, and iterations, of which 3 are done; accelerations agree with ours to 1e-13."""


@functools.cache
def pinocchio_functions() -> ctypes.CDLL | None:
    """Pinocchio's loops in C++; None where they cannot be compiled."""
    import pinocchio

    prefix = next(folder for folder in Path(pinocchio.__file__).parents if folder.name == "cmeel.prefix")
    if not (prefix / "include" / "eigen3").exists():
        print("Eigen's headers are not installed, so Pinocchio is called from Python alone: pip install cmeel-eigen")
        return None
    # As its CMake files say.
    flags = [
        "PINOCCHIO_ENABLE_TEMPLATE_INSTANTIATION",
        "BOOST_MPL_LIMIT_LIST_SIZE=30",
        "BOOST_MPL_LIMIT_VECTOR_SIZE=30",
    ]
    flags += ["BOOST_MPL_CFG_NO_PREPROCESSED_HEADERS", "BOOST_FUSION_INVOKE_MAX_ARITY=12"]
    command = [os.environ.get("CXX", "c++"), "-std=c++17", "-O3", "-DNDEBUG", "-w", *(f"-D{flag}" for flag in flags)]
    command += ["-isystem", str(prefix / "include"), "-isystem", str(prefix / "include" / "eigen3")]
    lib = prefix / "lib"
    end = [f"-L{lib}", "-lpinocchio_default", f"-Wl,-rpath,{lib}"]
    print("Compiling Pinocchio's loops, which takes a minute.", flush=True)
    try:
        found = library(PINOCCHIO_SOURCE, ".cpp", command, end)
    except (OSError, subprocess.CalledProcessError) as error:
        print(f"Pinocchio is called from Python alone: its loops in C++ cannot be compiled ({error}).")
        return None
    found.four_bar.restype = found.chain.restype = ctypes.c_void_p
    return found


def four_bar_by_pinocchio(case: Case) -> dict[str, Way]:
    import pinocchio as pin

    n = Numbers(case)

    def at(x: float) -> Any:
        return pin.SE3(np.eye(3), np.array([x, 0.0, 0.0]))

    def rates_by(kp: float, kd: float) -> Callable[[float, Floats], Floats]:
        model = pin.Model()
        model.gravity.linear = np.array([0.0, -n.g, 0.0])
        parent, joint = 0, n.ground / 2
        for i, (length, mass, inertia) in enumerate(n.links):
            parent = model.addJoint(parent, pin.JointModelRZ(), at(joint), f"joint{i}")
            body = pin.Inertia(mass, np.array([length / 2, 0.0, 0.0]), np.diag([0.0, inertia, inertia]))
            model.appendBodyToJoint(parent, body, pin.SE3.Identity())
            joint = length
        kind, frame = pin.ContactType.CONTACT_3D, pin.ReferenceFrame.LOCAL
        loop = pin.RigidConstraintModel(kind, model, parent, at(joint), 0, at(-n.ground / 2), frame)
        corrector = loop.m_baumgarte_parameters
        corrector.Kp, corrector.Kd = kp, kd
        loop.setBaumgarteCorrectorParameters(corrector)
        loops, loop_data = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
        loops.append(loop)
        loop_data.append(loop.createData())
        data = model.createData()
        pin.initConstraintDynamics(model, data, loops, loop_data)
        proximal, tau = pin.ProximalSettings(*PROXIMAL), np.zeros(3)
        l2, l3, _ = n.lengths

        def rates(t: float, x: Floats) -> Floats:
            q1, q2, force = x[0], x[1], 100.0 * math.sin(math.pi * t)
            y2, y23 = l2 * math.sin(q1), l3 * math.sin(q1 + q2)
            tau[0] = -n.k * q2 - n.c * x[4] - force * (y2 + y23)
            tau[1] = -force * y23
            found = np.empty(6)
            found[:3] = x[3:]
            found[3:] = pin.constraintDynamics(model, data, x[:3], x[3:], tau, loops, loop_data, proximal)
            return found

        expected = case.four_bar.rhs(0.0, case.x0)
        np.testing.assert_allclose(rates(0.0, case.x0), expected, rtol=0, atol=1e-9 * np.abs(expected).max())
        return rates

    def stepped(rates: Callable[[float, Floats], Floats], steps: int) -> Iterator[Floats]:
        h, x = END / steps, case.x0
        for i in range(steps):
            t = i * h
            k1 = rates(t, x)
            k2 = rates(t + h / 2, x + h / 2 * k1)
            k3 = rates(t + h / 2, x + h / 2 * k2)
            k4 = rates(t + h, x + h * k3)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            yield x

    free, corrected = rates_by(0.0, 0.0), rates_by(100.0, 20.0)

    def last(states: Iterator[Floats]) -> Floats:
        for state in states:
            x = state
        return x

    def adaptive(rates: Any) -> Way:
        return Way(
            TOLERANCES,
            lambda tolerance: functools.partial(by_scipy(rates, case), tolerance),
            lambda tolerance: (
                solve_ivp(rates, (0.0, END), case.x0, method="DOP853", rtol=max(tolerance, 1e-13), atol=tolerance).y
            ),
        )

    ways = {
        "Pinocchio, constraintDynamics, RK4, loop in Python": Way(
            steps(50, 2, 8),
            lambda steps: lambda: last(stepped(free, steps)),
            lambda steps: np.array(list(stepped(free, steps))).T,
        ),
        "Pinocchio, constraintDynamics, solve_ivp DOP853": adaptive(free),
        "Pinocchio, solve_ivp DOP853, Baumgarte's correction (Kp = 100, Kd = 20)": adaptive(corrected),
    }
    functions = pinocchio_functions()
    if functions is None:
        return ways
    p = np.array([n.rho, n.ground, *n.lengths, n.g, n.k, n.c])
    bar = ctypes.c_void_p(functions.four_bar(address(p), address(np.array(PROXIMAL[:2])), PROXIMAL[2]))
    room = 100_000

    def run(steps: int, tolerance: float, path: Floats | None) -> Floats:
        x = case.x0.copy()
        length = functions.run(
            bar, ctypes.c_double(END), steps, ctypes.c_double(tolerance), address(x),
            None if path is None else address(path), 0 if path is None else room,
        )  # fmt: skip
        return x if path is None else path[:length].T

    def inside(name: str, settings: Sequence[float], arguments: Callable[[Any], tuple[int, float]]) -> None:
        ways[f"Pinocchio, constraintDynamics, {name}, loop in C++"] = Way(
            settings,
            lambda setting: lambda: run(*arguments(setting), None),
            lambda setting: run(*arguments(setting), np.empty((room, 6))),
        )

    inside("RK4", steps(50, 2, 9), lambda steps: (steps, 0.0))
    inside("Fehlberg 7(8)", TOLERANCES, lambda tolerance: (0, tolerance))
    return ways


# ---- MuJoCo


@functools.cache
def mujoco_functions() -> ctypes.CDLL:
    import mujoco

    folder = Path(mujoco.__file__).parent
    command = [os.environ.get("CC", "cc"), "-O2", f"-I{folder / 'include'}"]
    return library(MUJOCO_SOURCE, ".c", command, [str(next(folder.glob("libmujoco.so*"))), f"-Wl,-rpath,{folder}"])


def four_bar_by_mujoco(case: Case) -> dict[str, Way]:
    import mujoco

    n, functions = Numbers(case), mujoco_functions()
    for name in ("stiffness", "damping"):
        ctypes.c_double.in_dll(functions, name).value = {"stiffness": n.k, "damping": n.c}[name]
    bodies, joint = "", n.ground / 2
    for length, mass, inertia in n.links:  # a motion in the plane does not need the first moment of inertia
        bodies += (
            f'<body name="to {length}" pos="{joint!r} 0 0"><joint axis="0 0 1"/>'
            f'<inertial pos="{length / 2!r} 0 0" mass="{mass!r}" '
            f'diaginertia="{1e-6 * inertia!r} {inertia!r} {inertia!r}"/>'
        )
        joint = length
    name = f"to {joint}"

    def model(integrator: str, steps: int, constant: float, ratio: float) -> Any:
        h = END / steps
        made = mujoco.MjModel.from_xml_string(
            f'<mujoco><option timestep="{h!r}" integrator="{integrator}" gravity="0 {-n.g!r} 0" jacobian="dense">'
            f'<flag contact="disable" island="disable"/></option><worldbody>{bodies}{"</body>" * 3}</worldbody>'
            f'<equality><connect body1="{name}" body2="world" anchor="{joint!r} 0 0" '
            f'solref="{constant * h!r} {ratio!r}" solimp="0.9999 0.9999 0.001 0.5 2"/></equality></mujoco>'
        )
        made.eq_data[0, 3:6] = [-n.ground / 2, 0.0, 0.0]
        return made

    def started(model: Any, data: Any) -> None:
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = case.x0[:3], case.x0[3:]
        mujoco.set_mjcb_passive(functions.passive)

    def way(integrator: str, settings: Sequence[float], constant: float, ratio: float) -> Way:
        def prepare(steps: int) -> Callable[[], Floats]:
            made = model(integrator, steps, constant, ratio)
            data = mujoco.MjData(made)

            def run() -> Floats:
                started(made, data)
                mujoco.mj_step(made, data, steps)
                mujoco.set_mjcb_passive(None)
                return np.concatenate((data.qpos, data.qvel))

            return run

        def path(steps: int) -> Floats:
            made = model(integrator, steps, constant, ratio)
            data = mujoco.MjData(made)
            started(made, data)
            states = []
            for _ in range(min(steps, SAMPLES)):
                mujoco.mj_step(made, data, steps // min(steps, SAMPLES))
                states.append(np.concatenate((data.qpos, data.qvel)))
            mujoco.set_mjcb_passive(None)
            return np.array(states).T

        return Way(settings, prepare, path)

    return {
        "MuJoCo, Euler, time constant of 2 steps": way("Euler", steps(1600, 4, 5), 2.0, 1.0),
        "MuJoCo, implicitfast, time constant of 2 steps": way("implicitfast", steps(1600, 4, 5), 2.0, 1.0),
        "MuJoCo, RK4, time constant of 2 steps": way("RK4", steps(50, 2, 12), 2.0, 1.0),
        "MuJoCo, RK4, time constant of 20 steps, damping ratio 0.1": way("RK4", steps(50, 2, 11), 20.0, 0.1),
    }


# ---- Exudyn


def four_bar_by_exudyn(case: Case) -> dict[str, Way]:
    import exudyn
    import exudyn.itemInterface
    from exudyn.advancedUtilities import CreateSymbolicUserFunction

    n, kept, items = Numbers(case), [], exudyn.itemInterface

    def force(mbs: Any, t: Any, loadVector: Any) -> list[Any]:  # noqa: ARG001
        return [loadVector[0] * exudyn.symbolic.sin(math.pi * t), 0, 0]

    def linkage() -> tuple[Any, list[Any]]:
        """The bodies' positions and angles as coordinates, four joints as constraints."""
        container = exudyn.SystemContainer()
        mbs = container.AddSystem()
        ground = mbs.AddObject(items.ObjectGround())

        def marker(body: Any, x: float) -> Any:
            return mbs.AddMarker(items.MarkerBodyPosition(bodyNumber=body, localPosition=[x, 0.0, 0.0]))

        start, velocity, before = np.array([n.ground / 2, 0.0]), np.zeros(2), marker(ground, n.ground / 2)
        nodes, ends = [], []
        angles, rates = np.cumsum(case.x0[:3]), np.cumsum(case.x0[3:])
        for (length, mass, inertia), angle, rate in zip(n.links, angles, rates, strict=True):
            half = length / 2 * np.array([np.cos(angle), np.sin(angle)])
            turn = rate * np.array([-half[1], half[0]])
            node = mbs.AddNode(
                items.NodeRigidBody2D(
                    initialCoordinates=[*(start + half), angle], initialVelocities=[*(velocity + turn), rate]
                )
            )
            body = mbs.AddObject(items.ObjectRigidBody2D(mass=mass, inertia=inertia, nodeNumber=node))
            whole = mbs.AddMarker(items.MarkerBodyMass(bodyNumber=body))
            mbs.AddLoad(items.LoadMassProportional(markerNumber=whole, loadVector=[0.0, -n.g, 0.0]))
            mbs.AddObject(items.ObjectJointRevolute2D(markerNumbers=[before, marker(body, -length / 2)]))
            before = marker(body, length / 2)
            start, velocity = start + 2 * half, velocity + 2 * turn
            nodes.append(node)
            ends.append(before)
        mbs.AddObject(items.ObjectJointRevolute2D(markerNumbers=[before, marker(ground, -n.ground / 2)]))
        # The torque on the first link by the angle between the first and the second.
        matrix = np.zeros((6, 6))
        matrix[2, 2], matrix[2, 5] = -1.0, 1.0
        mbs.AddObject(
            items.ObjectGenericODE2(
                nodeNumbers=nodes[:2],
                massMatrix=np.zeros((6, 6)),
                stiffnessMatrix=n.k * matrix,
                dampingMatrix=n.c * matrix,
            )
        )
        function = CreateSymbolicUserFunction(mbs, force, "loadVectorUserFunction", itemTypeName="LoadForceVector")
        mbs.AddLoad(
            items.LoadForceVector(markerNumber=ends[1], loadVector=[100.0, 0.0, 0.0], loadVectorUserFunction=function)
        )
        kept.append((container, function))  # which have to live as long
        return mbs, nodes

    def settings_of(steps: int, *, watched: bool) -> Any:
        settings = exudyn.SimulationSettings()
        settings.solution.file.write = False
        settings.solution.sensors.active = watched
        settings.solution.sensors.writePeriod = END / SAMPLES
        integration = settings.timeIntegration
        integration.endTime, integration.numberOfSteps = END, steps
        integration.verboseMode = integration.stepInformation = 0
        newton = integration.newton
        newton.modifiedNewtonJacUpdatePerStep = True
        newton.relativeTolerance, newton.absoluteTolerance = 1e-10, 1e-12
        return settings

    def state(coordinates: Any, velocities: Any) -> Floats:
        """Our coordinates and speeds: angles of links relative to the ones before."""
        q, u = (np.diff([row[2] for row in rows], prepend=0.0) for rows in (coordinates, velocities))
        return np.concatenate((q, u))

    def way(solver: Any) -> Way:
        def prepare(steps: int) -> Callable[[], Floats]:
            mbs, nodes = linkage()
            mbs.Assemble()
            settings = settings_of(steps, watched=False)
            kinds = exudyn.OutputVariableType.Coordinates, exudyn.OutputVariableType.Coordinates_t

            def run() -> Floats:
                mbs.SolveDynamic(settings, solverType=solver)
                return state(*([mbs.GetNodeOutput(node, kind) for node in nodes] for kind in kinds))

            return run

        def path(steps: int) -> Floats:
            mbs, nodes = linkage()
            kind = exudyn.OutputVariableType.Coordinates
            sensors = [
                mbs.AddSensor(items.SensorNode(nodeNumber=node, storeInternal=True, outputVariableType=kind))
                for node in nodes
            ]
            mbs.Assemble()
            mbs.SolveDynamic(settings_of(steps, watched=True), solverType=solver)
            angles = np.array([np.asarray(mbs.GetSensorStoredData(sensor))[:, 3] for sensor in sensors])
            return np.diff(angles, axis=0, prepend=0.0)

        return Way(steps(400, 4, 6), prepare, path)

    kinds = exudyn.DynamicSolverType
    return {
        "Exudyn, generalized-alpha, index 3": way(kinds.GeneralizedAlpha),
        "Exudyn, trapezoidal rule, index 2": way(kinds.TrapezoidalIndex2),
    }


FOUR_BARS = {
    "fourbar_codegen": four_bar_by_ourselves, "Pinocchio": four_bar_by_pinocchio, "MuJoCo": four_bar_by_mujoco,
    "Exudyn": four_bar_by_exudyn,
}  # fmt: skip


def reference(case: Case) -> tuple[Floats, float]:
    """The state at the end, and how far another implementation is from it: the tutorial's code by SciPy."""
    ours = case.four_bar.simulate((0.0, END), case.x0, rtol=1e-13, atol=1e-13, t_eval=[END]).y[:, -1]
    difference = float(np.abs(ours - by_scipy(case.tutorial.rhs, case)(1e-13)).max())
    assert difference < 1e-10, difference
    return ours, difference


def precision(case: Case, expected: Floats, ways: Mapping[str, Way], rounds: int) -> list[dict[str, Any]]:
    """For each way and setting the error at the end, how far the loop opens, and the time."""
    rows, measures = [], []
    for name, way in ways.items():
        for setting in way.settings:
            run = way.prepare(setting)
            error = float(np.abs(run() - expected).max())
            gap = max(
                float(np.linalg.norm(case.four_bar.position_constraints(0.0, x[:3]))) for x in way.path(setting).T
            )
            rows.append({"integrator": name, "setting": setting, "error": error, "open m": gap})
            measures.append(cpu_time("run()", {"run": run}))
    for row, seconds in zip(rows, compare(*measures, rounds=rounds), strict=True):
        row["seconds"] = seconds
        print(json.dumps(row), flush=True)
    return rows


# ---- open chains


@dataclass(frozen=True)
class Evaluation:
    """A way to evaluate a chain's forward dynamics.

    Parameters
    ----------
    accelerations : callable
        Those at states in rows, for comparison.
    measure : callable
        Makes a measure of seconds a state.
    """

    accelerations: Callable[[Floats], Floats]
    measure: Callable[[Floats], Callable[[], float]]


def one_by_one(function: Callable[[float, Floats], Floats]) -> Evaluation:
    """A function of one state, called from Python; what it returns ends with the accelerations."""
    return Evaluation(
        lambda states: np.array([np.array(function(0.5, x))[-len(x) // 2 :] for x in states]),
        lambda states: cpu_time("function(0.5, x)", {"function": function, "x": states[0].copy()}),
    )


def many(function: Callable[[Floats, Floats], object]) -> Evaluation:
    """A loop in C over states in rows, which writes accelerations into rows."""

    def accelerations(states: Floats) -> Floats:
        found = np.empty((len(states), states.shape[1] // 2))
        function(states, found)
        return found

    def measure(states: Floats) -> Callable[[], float]:
        found = np.empty((len(states), states.shape[1] // 2))
        names = {"function": function, "states": states, "found": found}
        return cpu_time("function(states, found)", names, 1 / len(states))

    return Evaluation(accelerations, measure)


def our_functions(model: fb.Model) -> ctypes.CDLL:
    """Loops in C over a model's kernel."""
    name = f"{model.name}_kernel"
    command = [
        os.environ.get("CC", "cc"),
        *OUR_FLAGS,
        f"-I{fb.get_include()}",
        f"-DKERNEL={name}",
        "-include",
        f"{name}.h",
    ]
    return library(OUR_SOURCE, ".c", command, ["-lm"], fb.generate_sources(model))


def chain_by_ourselves(links: int) -> dict[str, Evaluation]:
    model = revolute_chain(links)
    compiled, functions, p = fb.compile_model(model), our_functions(model), np.array(LINK)

    def batch(states: Floats) -> Callable[[], float]:
        names = {
            "function": functools.partial(
                compiled.rhs_batch, out=aligned(np.empty((2 * links, len(states)))), workers=1
            ),
            "columns": aligned(states.T),
        }
        return cpu_time("function(0.5, columns)", names, 1 / len(states))

    return {
        "from Python: fourbar_codegen, a model's `ode()`": one_by_one(compiled.ode()),
        "in C: fourbar_codegen": many(
            lambda states, out: functions.evaluate(len(states), address(states), address(p), address(out))
        ),
        f"batch: fourbar_codegen, `rhs_batch` of {BATCH}, one thread": Evaluation(
            lambda states: compiled.rhs_batch(0.5, states.T.copy(), workers=1)[links:].T, batch
        ),
    }


def chain_in_pinocchio(functions: ctypes.CDLL, links: int) -> ctypes.c_void_p:
    """The chain in C++."""
    m, length, g, xx, yy, zz, xy, yz, zx = LINK
    inertia = np.array([[xx, xy, zx], [xy, yy, yz], [zx, yz, zz]])
    numbers = (ctypes.c_double(value) for value in (m, length, g))
    return ctypes.c_void_p(functions.chain(links, *numbers, address(inertia)))


def chain_by_pinocchio(links: int) -> dict[str, Evaluation]:
    import pinocchio as pin

    m, length, g, xx, yy, zz, xy, yz, zx = LINK
    inertia = np.array([[xx, xy, zx], [xy, yy, yz], [zx, yz, zz]])
    model = pin.Model()
    model.gravity.linear = np.array([0.0, 0.0, -g])
    body, parent = pin.Inertia(m, np.array([0.0, 0.0, -length / 2]), inertia), 0
    for i in range(links):
        kind = pin.JointModelRY() if i % 2 else pin.JointModelRX()
        place = pin.SE3(np.eye(3), np.array([0.0, 0.0, -length if i else 0.0]))
        parent = model.addJoint(parent, kind, place, f"joint{i}")
        model.appendBodyToJoint(parent, body, pin.SE3.Identity())
    data, tau, aba = model.createData(), np.zeros(links), pin.aba
    found = {
        "from Python: Pinocchio, `aba`": one_by_one(lambda _, x: aba(model, data, x[:links], x[links:], tau)),
    }
    functions = pinocchio_functions()
    if functions is not None:
        chain = chain_in_pinocchio(functions, links)
        found["in C: Pinocchio, `aba`"] = many(
            lambda states, out: functions.aba(chain, len(states), address(states), address(out))
        )
    return found


def chain_by_mujoco(links: int) -> dict[str, Evaluation]:
    import mujoco

    m, length, g, xx, yy, zz, xy, yz, zx = LINK
    bodies = ""
    for i in range(links):
        bodies += (
            f'<body pos="0 0 {-length if i else 0.0!r}"><joint axis="{"0 1 0" if i % 2 else "1 0 0"}"/>'
            f'<inertial pos="0 0 {-length / 2!r}" mass="{m!r}" '
            f'fullinertia="{xx!r} {yy!r} {zz!r} {xy!r} {zx!r} {yz!r}"/>'
        )
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option gravity="0 0 {-g!r}"><flag contact="disable"/></option>'
        f"<worldbody>{bodies}{'</body>' * links}</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    q, u, accelerations = data.qpos, data.qvel, data.qacc

    def rates(_: float, x: Floats) -> Floats:
        q[:], u[:] = x[:links], x[links:]
        mujoco.mj_forward(model, data)
        return accelerations

    functions = mujoco_functions()

    def all_of_them(states: Floats, out: Floats) -> None:
        where = ctypes.c_void_p(model._address), ctypes.c_void_p(data._address)
        functions.forward(*where, len(states), address(states), address(out))

    return {
        "from Python: MuJoCo, `mj_forward`": one_by_one(rates),
        "in C: MuJoCo, `mj_forward`": many(all_of_them),
    }


CHAINS = {"fourbar_codegen": chain_by_ourselves, "Pinocchio": chain_by_pinocchio, "MuJoCo": chain_by_mujoco}


def evaluations(links: int, engines: Sequence[str], rounds: int) -> list[dict[str, Any]]:
    """For each way the time of one evaluation, and how far its accelerations are from ours, relative to the largest."""
    ways = {name: way for engine in engines if engine in CHAINS for name, way in CHAINS[engine](links).items()}
    states = np.ascontiguousarray(np.random.default_rng(links).uniform(-1.0, 1.0, (BATCH, 2 * links)))
    expected, rows = next(iter(ways.values())).accelerations(states[:64]), []
    for name, way in ways.items():
        found = way.accelerations(states[:64])
        difference = float((np.abs(found - expected).max(axis=1) / np.abs(expected).max(axis=1)).max())
        assert difference < 1e-9, (name, links, difference)
        rows.append({"way": name, "links": links, "difference": difference})
    medians = compare(*(way.measure(states) for way in ways.values()), rounds=rounds)
    for row, seconds in zip(rows, medians, strict=True):
        row["seconds"] = seconds
        print(json.dumps(row), flush=True)
    return rows


# ---- the tables


def frontier(rows: Sequence[dict[str, Any]], name: str) -> list[dict[str, Any]]:
    """A way's settings without those that take longer and err more than another one."""
    own = [row for row in rows if row["integrator"] == name]
    return [
        row
        for row in own
        if not any(other["error"] <= row["error"] and other["seconds"] < row["seconds"] for other in own)
    ]


def listed(words: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(words[:-1]), *words[-1:])))


def grouped(pairs: Sequence[tuple[str, str]]) -> str:
    """What holds for what, each said once."""
    groups: dict[str, list[str]] = {}
    for what, where in pairs:
        groups.setdefault(what, []).append(where)
    return "; ".join(f"{what} ({listed(where)})" for what, where in groups.items())


def paragraph(text: str, indent: str = "") -> str:
    return textwrap.fill(text, 120, subsequent_indent=indent, break_on_hyphens=False, break_long_words=False)


UNEQUAL = {
    "fourbar_codegen": (
        "This package's C is made for this one linkage. It closes the loop after each step. Settings are tolerances, "
        "relative and absolute."
    ),
    "Pinocchio": (
        "Pinocchio's `constraintDynamics` closes the accelerations, so the loop drifts with the error of the "
        "integration. The rows say where the loop over the steps runs: in Python, which takes more than half of the "
        "time (`solve_ivp` as well), or in C++, compiled with `-O3 -DNDEBUG`, with the steps of Boost's odeint. "
        "Baumgarte's correction slows the drift."
    ),
    "MuJoCo": (
        "MuJoCo's constraints are soft: their impedance is at most 0.9999, and their time constant is not shorter than "
        "2 steps. The row with 20 steps and a damping ratio of 0.1 is the best one that we found for this linkage. "
        "`mj_step` does all steps in C. The torque and the force, for which MuJoCo has no element, are a callback in C."
    ),
    "Exudyn": (
        "Exudyn has nine coordinates and eight constraints for this linkage, and implicit methods of second order, "
        "with one Jacobian a step and Newton tolerances of 1e-10 and 1e-12. The force is a symbolic function, which "
        "does not call Python."
    ),
}


def four_bar_table(rows: list[dict[str, Any]], difference: float, engines: Sequence[str]) -> list[str]:
    names = list(dict.fromkeys(row["integrator"] for row in rows))
    best = {name: frontier(rows, name) for name in names}
    times = {name: [at_error(best[name], name, error) for error in ERRORS] for name in names}
    lines, won, nearest = [], [], []
    for name in names:
        cells = [
            f"{1e3 * cell:.3g} ms, {cell / own:.3g}" if cell and own else ""
            for cell, own in zip(times[name], times[OURS], strict=True)
        ]
        own = sorted(best[name], key=lambda row: -row["error"])
        shown = next((row for row in own if row["error"] <= 1e-6), own[-1])
        lines.append(f"| {name} | {' | '.join(cells)} | {shown['open m']:.0e} m, {shown['error']:.0e} |")
    for i, error in enumerate(ERRORS):
        reached = [(seconds[i], name) for name, seconds in times.items() if seconds[i]]
        others = [entry for entry in reached if not entry[1].startswith("fourbar_codegen")]
        ours = times[OURS][i]
        won.append((min(reached)[1], f"{error:.0e}"))
        if others and ours:
            nearest.append((min(others)[1], f"{min(others)[0] / ours:.3g} times our time at {error:.0e}"))
    return [
        paragraph(
            "How long does a simulation of a closed loop take for a given error? The tutorial's four-bar, 4 s. Held "
            "equal: the model with its numbers, its force and its initial state, and the error of the state at 4 s "
            "(the largest of six, in rad and rad/s). The reference is our DOP853 at 1e-13; the tutorial's code with "
            f"SciPy's DOP853 at 1e-13 differs from it by {difference:.0e}. All times are CPU times, medians of "
            "interleaved measurements in one run, on one thread; models are built before. Not held equal:"
        ),
        "",
        *(paragraph(f"- {UNEQUAL[engine]}", "  ") for engine in engines),
        "",
        paragraph(
            f"The fastest: {grouped(won)}. The fastest of the engines: {grouped(nearest) or 'none'}. Times are "
            "interpolated between settings; an empty cell was not reached with the settings tried. Each time is "
            "followed by its ratio to the first row. The last column has the largest constraint violation (the gap "
            "of the loop, computed from the joint angles) and the error, at the first setting whose error is below "
            "1e-6, or at the smallest error otherwise."
        ),
        "",
        "| | " + " | ".join(f"{error:.0e}" for error in ERRORS) + " | constraint violation, at the error |",
        "|---|" + "---|" * (len(ERRORS) + 1),
        *lines,
    ]


def chain_table(rows: list[dict[str, Any]]) -> list[str]:
    names = list(dict.fromkeys(row["way"] for row in rows))
    seconds = {(row["way"], row["links"]): row["seconds"] for row in rows}
    sizes = sorted({row["links"] for row in rows})
    difference = max(row["difference"] for row in rows)
    sentences = []
    for kind in ("from Python", "in C", "batch"):
        own = [name for name in names if name.startswith(f"{kind}: ") or (kind == "batch" and "in C: " in name)]
        first = [min(own, key=lambda name, n=n: seconds[name, n]) for n in sizes]
        pairs = [(name.partition(": ")[2].partition(",")[0], str(n)) for name, n in zip(first, sizes, strict=True)]
        words = {"batch": "many states, in a batch or one after another in C"}.get(kind, f"one state, {kind}")
        sentences.append(f"{words}, by n: {grouped(pairs)}")
    growths = [
        f"{name.partition(': ')[2].partition(',')[0]} {seconds[name, sizes[-1]] / seconds[name, sizes[-2]]:.2g}"
        for name in names
        if name.startswith("in C: ")
    ]
    return [
        "",
        paragraph(
            "How long does one evaluation of the forward dynamics take? Open chains of n links in space; revolute "
            "joints about x, y, x, y, ...; all moments and products of inertia; gravity. Held equal: the model, one "
            "thread, and the accelerations: before anything is timed they are compared at 64 random states, and "
            f"differ by {difference:.0e} at most, relative to the largest of a state. Not held equal: this package "
            "compiles C for each chain, with all instructions that the processor has; the engines take any chain and "
            "need no compiler (MuJoCo as in its wheel; Pinocchio's headers with `-O3`). A call from Python has its "
            "overhead in it, with MuJoCo also the writing of the state. `mj_forward` forms the mass matrix as well."
        ),
        "",
        paragraph(
            f"The fastest, {'. The fastest, '.join(sentences)}. From {sizes[-2]} to {sizes[-1]} links, the time in C "
            f"is multiplied by: {', '.join(growths)}. The engines need no compilation."
        ),
        "",
        "| | " + " | ".join(f"n = {n}" for n in sizes) + " |",
        "|---|" + "---|" * len(sizes),
        *(f"| {name} | " + " | ".join(f"{1e6 * seconds[name, n]:.3g} us" for n in sizes) + " |" for name in names),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("results/engines.json"), help="where to write JSON")
    parser.add_argument("--docs", action="store_true", help="write the tables into docs/benchmarks.md as well")
    parser.add_argument("--rounds", type=int, default=7, help="samples of each measure")
    options = parser.parse_args()
    missing = [name for name, (module, _) in ENGINES.items() if not find_spec(module)]
    for name in missing:
        print(f"{name} is not installed: pip install 'fourbar_codegen[bench]'", flush=True)
    engines = ["fourbar_codegen", *(name for name in ENGINES if name not in missing)]
    chains = [row for links in LINKS for row in evaluations(links, engines, options.rounds)]
    case = Case()
    case.x0 = case.four_bar.initial_state()  # the same, but closed to rounding errors
    expected, difference = reference(case)
    ways = {name: way for engine in engines for name, way in FOUR_BARS[engine](case).items()}
    rows = precision(case, expected, ways, options.rounds)
    report = {**circumstances(), "reference": difference, "precision": rows, "chains": chains}
    packages = (distribution for name, (_, distribution) in ENGINES.items() if name in engines)
    report["versions"] |= {name: version(name) for name in packages}
    lines = [*four_bar_table(rows, difference, engines), *chain_table(chains)]
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(report, indent=2) + "\n")
    print("\n".join([*lines, f"Written: {options.output}"]))
    if options.docs:
        command = "python benchmarks/engines.py --docs"
        replace_in_page(DOCS / "benchmarks.md", "engines", "\n".join(lines), command, report)


if __name__ == "__main__":
    main()
