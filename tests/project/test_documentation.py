"""The examples in docstrings that pytest does not collect, because they stand in compiled code."""

import doctest

import pytest

from fourbar_codegen.runtime import evaluator


@pytest.mark.parametrize("name", ["rhs", "jacobian"])
def test_docstring_examples_of_compiled_functions_give_what_they_show(name):
    text = getattr(evaluator.Evaluator, name).__doc__
    example = doctest.DocTestParser().get_doctest(text, {}, name, None, None)
    assert example.examples
    assert doctest.DocTestRunner().run(example).failed == 0
