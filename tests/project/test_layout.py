"""The description of a compiled model has types: its JSON text is read in one file."""

import ast
import json
from pathlib import Path

import pytest

import fourbar_codegen as fb
from fourbar_codegen.layout import Layout

PACKAGE = Path(fb.__file__).parent


def test_descriptions_are_read_from_json_by_the_layout_alone():
    """No other file parses them, or takes an entry of one by its name."""
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            is_entry = isinstance(node, ast.Subscript) and ast.unparse(node.value).endswith("manifest")
            is_parsed = isinstance(node, ast.Attribute) and node.attr in ("from_json", "to_json")
            if is_entry or (is_parsed and path.name not in ("layout.py", "compiled_model.py", "cached_models.py")):
                found.append(f"{path.relative_to(PACKAGE)}, line {node.lineno}: {ast.unparse(node)}")
    assert found == []


def test_layout_read_from_its_own_text_is_the_same():
    layout = fb.load("four_bar").layout
    assert Layout.from_text(layout.to_text()) == layout
    assert Layout.from_parts(json.dumps(layout.structure), json.dumps(layout.numbers)) == layout


@pytest.mark.parametrize(
    ("key", "value"),
    [("speeds", "u1"), ("n_dependent_speeds", "2"), ("form", "fast"), ("parameters", [{}]), ("initial", {"q1": "0"})],
)
def test_layout_refuses_data_of_another_kind(key, value):
    data = fb.load("four_bar").manifest
    with pytest.raises((TypeError, ValueError, KeyError)):
        Layout.from_json({**data, key: value})


def test_layout_of_another_version_says_so():
    data = fb.load("four_bar").manifest
    with pytest.raises(fb.ModelError, match="four_bar was built with another version of this package"):
        Layout.from_json({**data, "format": 1})
