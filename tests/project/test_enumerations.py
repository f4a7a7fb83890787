"""Enumerations that Python and C share have one definition."""

from pathlib import Path

import fourbar_codegen as fb
from fourbar_codegen.runtime.enumerations import enums_text


def test_header_of_enumerations_is_that_of_roles():
    """The package was built after the last change of enumerations.py."""
    assert Path(fb.get_include(), "fourbar_enums.h").read_text(encoding="utf-8") == enums_text()
