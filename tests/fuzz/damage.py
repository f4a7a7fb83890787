"""Damage to saved trajectories: it is told by a ModelError, or what is read is what was saved."""

from __future__ import annotations

import io
import tempfile
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

import fourbar_codegen as fb


@cache
def runs() -> dict[str, tuple[fb.Trajectory, bytes]]:
    """Two runs, each in files of both kinds, and with the numbers compressed."""
    four_bar = fb.load("four_bar")
    times = np.linspace(0.0, 0.5, 11)
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, how in (("one", {"parameters": {"l2": 0.45}}), ("other", {"inputs": {"F": 3.0}, "method": "RK45"})):
            run = four_bar.simulate((0.0, 0.5), t_eval=times, **how)
            for suffix in ("npz", "nc"):
                found[f"{name}.{suffix}"] = run, run.save(Path(folder) / f"{name}.{suffix}").read_bytes()
            for method in (zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
                found[f"{name} {method}.npz"] = run, _compressed(found[f"{name}.npz"][1], method)
            path = Path(folder) / "compressed.nc"
            dataset = run.to_xarray()
            smaller = {key: {"zlib": True} for key, array in dataset.variables.items() if array.dtype == float}
            dataset.to_netcdf(path, engine="h5netcdf", encoding=smaller)
            found[f"{name} compressed.nc"] = run, path.read_bytes()
    return found


def _compressed(content: bytes, method: int) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as source, zipfile.ZipFile(file, "w", method) as target:
        for name in source.namelist():
            target.writestr(name, source.read(name))
    return file.getvalue()


def flip(generator: np.random.Generator, content: bytes, _: bytes) -> bytes:
    """Some bits are others."""
    changed = bytearray(content)
    for place in generator.integers(len(content), size=generator.choice([1, 1, 2, 8])):
        changed[place] ^= 1 << int(generator.integers(8))
    return bytes(changed)


def overwrite(generator: np.random.Generator, content: bytes, _: bytes) -> bytes:
    """Some bytes in a row are zeros, or anything."""
    begin, length = _section(generator, content)
    return (
        content[:begin]
        + (bytes(length) if generator.random() < 0.5 else generator.bytes(length))
        + content[begin + length :]
    )


def truncate(generator: np.random.Generator, content: bytes, _: bytes) -> bytes:
    """The end is missing, or the beginning."""
    place = int(generator.integers(len(content)))
    return content[:place] if generator.random() < 0.8 else content[place:]


def splice(generator: np.random.Generator, content: bytes, other: bytes) -> bytes:
    """A section is missing, is there twice, comes from another file, or the file goes on as another."""
    begin, length = _section(generator, content)
    section = (b"", 2 * content[begin : begin + length], other[begin : begin + length])[generator.integers(3)]
    if generator.random() < 0.2:
        return content[:begin] + other[begin:]
    return content[:begin] + section + content[begin + length :]


def _section(generator: np.random.Generator, content: bytes) -> tuple[int, int]:
    return int(generator.integers(len(content))), int(2 ** generator.uniform(0.0, 12.0))


DAMAGE = (flip, overwrite, truncate, splice)


def case(generator: np.random.Generator, say: Callable[[str], None]) -> None:
    """One file, damaged in one way."""
    name = str(generator.choice(list(runs())))
    run, content = runs()[name]
    other = runs()[name.replace("one", "other") if name.startswith("one") else name.replace("other", "one")]
    damage = DAMAGE[generator.integers(len(DAMAGE))]
    damaged = damage(generator, content, other[1])
    first = next((i for i, (a, b) in enumerate(zip(content, damaged, strict=False)) if a != b), len(damaged))
    say(f"{damage.__name__} {name}, from byte {first} of {len(content)} on, {len(damaged)} bytes left")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"damaged.{name.rpartition('.')[2]}"
        path.write_bytes(damaged)
        try:
            back = fb.load_trajectory(path)
        except fb.ModelError:
            return
    # A splice of files of one kind may be a whole file: the other one.
    saved = other[0] if damage is splice and np.array_equal(back.y, other[0].y) else run
    for attribute in ("t", "y", "r", "energy", "nfev", "njev", "nlu", "status", "success", "message"):
        np.testing.assert_array_equal(getattr(back, attribute), getattr(saved, attribute), err_msg=attribute)
    expected = list(back.model.defaults.values()) if saved.parameters is None else saved.parameters
    np.testing.assert_array_equal(back.parameters, expected, err_msg="parameters")
    assert back.settings == dict(saved.settings)
