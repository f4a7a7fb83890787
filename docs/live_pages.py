"""The live pages of the documentation, made when it is built: ready models, and linkages turned by a drive."""

import runpy
from functools import partial
from math import pi
from pathlib import Path

import sympy as sm
import sympy.physics.mechanics as me

import fourbar_codegen as fb

HERE = Path(__file__).parent
MECHANISMS = runpy.run_path(str(HERE.parent / "examples" / "11_mechanisms.py"))["MECHANISMS"]
PERIOD = 4.0
"""Of the drives, s."""
BLOCK = "R0"
"""The only driven point that slides; all other drives turn links."""


def four_bar():
    """The linkage of the SymBRiM tutorial, which the package contains."""
    return fb.load("four_bar").page(traces=["P2", "joint3_link3_joint"], watch=[("range", "q1"), ("greatest", "u1")])


def slider_crank():
    """Turned by a small torque."""
    model = fb.compile_model(fb.models.slider_crank())
    return model.page(t_span=(0.0, 2.0), inputs={"torque": 0.005})


def whipple_bicycle():
    """Pushed to the side at 5 m/s; the speed is that of the rear wheel, u6."""
    model = fb.compile_model(fb.models.whipple_bicycle())
    x0 = model.initial_state(speeds={"u4": 0.5, "u6": -5.0 / model.defaults["rr"]})
    ranges = {"u6": (-30.0, -5.0), "u4": (-1.0, 1.0)}
    watch = [("range", "q4"), ("range", "q7")]
    return model.page(t_span=(0.0, 3.0), x0=x0, ranges=ranges, watch=watch)


def chain():
    """Ten links that fall."""
    return fb.compile_model(fb.models.chain(10)).page(t_span=(0.0, 2.0))


def rolling_disc():
    """On a plane, without slip."""
    return fb.compile_model(fb.models.rolling_disc()).page()


def driven(make):
    """A linkage of the gallery whose drive turns, or goes to and fro."""
    drive, values, points = MECHANISMS[make]
    linkage, at = make(), drive.removeprefix("q_")
    low, high = float(values[0]), float(values[-1])
    if abs(high - low - 2.0 * pi) < 1e-9:
        linkage.drive(at, speed=2.0 * pi / PERIOD)
    else:
        middle, reach = (low + high) / 2.0, (high - low) / 2.0
        way = middle - reach * sm.cos(2.0 * sm.pi / PERIOD * me.dynamicsymbols._t)
        linkage.drive(at, **{"displacement" if at == BLOCK else "angle": way})
    return fb.compile_model(linkage.model()).page(t_span=(0.0, PERIOD), traces=points)


PAGES = {make.__name__: make for make in (four_bar, slider_crank, whipple_bicycle, chain, rolling_disc)}
PAGES |= {f"driven_{make.__name__}": partial(driven, make) for make in MECHANISMS if make.__name__ != "double_wishbone"}


def write(folder):
    """Write all pages to a folder, by their names."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, make in PAGES.items():
        (folder / f"{name}.html").write_text(make().text, encoding="utf-8")
