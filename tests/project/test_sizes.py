"""Functions and data are small enough to be read at once."""

import ast
import re
from pathlib import Path

import fourbar_codegen as fb

PACKAGE = Path(fb.__file__).parent
LONG = {"models.whipple_bicycle.whipple_bicycle"}
"""It is a page of a paper."""
MANY = {"simulation.batch.residual", "simulation.batch.residual_batch", "simulation.batch.residual_jacobian_batch"}
"""With more than six arguments by position, the kernel among them."""
WIDE = {"fb_kernel"}
"""It is an interface: typed functions for the innermost loops, and the sizes that they need."""


def definitions(kind):
    for path in sorted(PACKAGE.rglob("*.py")):
        module = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, kind):
                yield f"{module}.{node.name}", node


def lines_of_code(function):
    """Lines with a token that is neither in the docstring nor in a comment."""
    body = function.body[ast.get_docstring(function) is not None :]
    compound = (ast.stmt, ast.excepthandler, ast.match_case)
    found = set()
    for node in (each for statement in body for each in ast.walk(statement) if hasattr(each, "lineno")):
        is_compound = isinstance(node, compound) and hasattr(node, "body")
        found.update(range(node.lineno, (node.lineno if is_compound else node.end_lineno) + 1))
    return len(found)


def test_functions_have_80_lines_of_code_at_most():
    assert {name for name, node in definitions(ast.FunctionDef) if lines_of_code(node) > 80} == LONG


def test_functions_take_six_arguments_by_position_at_most():
    found = set()
    for name, node in definitions(ast.FunctionDef):
        names = [argument.arg for argument in (*node.args.posonlyargs, *node.args.args)]
        if len(names) - (names[:1] in (["self"], ["cls"])) > 6:
            found.add(name)
    assert found == MANY


def test_classes_of_data_have_24_fields_at_most():
    for name, node in definitions(ast.ClassDef):
        assert sum(isinstance(statement, ast.AnnAssign) for statement in node.body) <= 24, name


def headers():
    for path in sorted([*PACKAGE.glob("runtime/**/*.h"), *PACKAGE.glob("runtime/**/*.inc")]):
        yield path.name, re.sub(r"/\*.*?\*/", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)


def test_functions_in_c_have_80_lines_of_code_at_most():
    for file, text in headers():
        functions = r"^[\w ][^\n;]*?(\w+)\)?\([^;{}]*\)\n\{\n(.*?)^\}"
        for name, body in re.findall(functions, text, re.DOTALL | re.MULTILINE):
            assert sum(bool(line.strip()) for line in body.splitlines()) <= 80, f"{name} of {file}"


def test_structures_in_c_have_24_members_at_most():
    count = {}
    for _, text in headers():
        for name, body in re.findall(r"struct (\w+) \{\n(.*?)^\}", text, re.DOTALL | re.MULTILINE):
            declared = re.sub(r"\([^()]*\)|\{[^{}]*\}", "", re.sub(r"\(\*(\w+)\)\([^;]*\)", r"\1", body))
            count[name] = sum(statement.count(",") + 1 for statement in declared.split(";")[:-1])
    assert {name for name, n in count.items() if n > 24} == WIDE, count
