"""SymPy's own time for a chain of pin joints whose velocities are asked for, by the size of SymPy's cache."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable

from measure import circumstances, compare, options_of, publish

SIZES = (8, 16, 24)
CACHES = ("1000", "None")
"""The first is SymPy's default."""

PINS = """
import sys, time
import sympy.physics.mechanics as me
wall = parent = me.RigidBody("wall")
system = me.System.from_newtonian(wall)
begin = time.perf_counter()
for i in range(int(sys.argv[1])):
    body = me.RigidBody(f"link{i}")
    points = {"parent_point": parent.frame.z if i else None, "child_point": -body.frame.z}
    axis = parent.frame.y if i % 2 else parent.frame.x
    system.add_joints(me.PinJoint(f"pin{i}", parent, body, joint_axis=axis, **points))
    body.masscenter.vel(wall.frame)
    parent = body
print(time.perf_counter() - begin)
"""


def modelling(pins: int, cache: str) -> Callable[[], float]:
    """A measure of the modelling in a fresh process."""

    def seconds() -> float:
        command = [sys.executable, "-c", PINS, str(pins)]
        done = subprocess.run(
            command, check=True, capture_output=True, text=True, env={**os.environ, "SYMPY_CACHE_SIZE": cache}
        )
        return float(done.stdout)

    return seconds


def main() -> None:
    options = options_of(__doc__)
    rows = {
        pins: compare(*(modelling(pins, cache) for cache in CACHES), rounds=min(options.rounds, 3)) for pins in SIZES
    }
    lines = [
        "| pins | `SYMPY_CACHE_SIZE=1000`, the default | `SYMPY_CACHE_SIZE=None` |",
        "|---|---|---|",
        *(f"| {pins} | {small:.3g} s | {unlimited:.3g} s |" for pins, (small, unlimited) in rows.items()),
    ]
    publish(options, "pins", "\n".join(lines), {**circumstances(), "seconds": {str(n): row for n, row in rows.items()}})


if __name__ == "__main__":
    main()
