"""Programs that some tests need and that pip does not install."""

import shutil

import pytest

PACKAGES = {
    "gcc": "gcc",
    "clang": "clang",
    "chromium": "chromium",
    "ffmpeg": "ffmpeg",
    "ffprobe": "ffmpeg",
    "qemu-aarch64": "qemu-user",
    "qemu-x86_64": "qemu-user",
}
"""By whose name Debian installs them."""


def require(program):
    """The program's path; without it the test is skipped, which on CI fails the run (see conftest.py)."""
    path = shutil.which(program)
    if path is None:
        pytest.skip(f"{program} is not installed: apt install {PACKAGES[program]}")
    return path
