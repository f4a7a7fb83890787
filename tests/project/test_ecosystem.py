"""Models of others, unmodified, with default settings; `make ecosystem` runs the long ones as well."""

import pytest
from ecosystem.cases import QUICK
from ecosystem.conformance import run

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("case", QUICK, ids=lambda case: f"{case.source}: {case.name}")
def test_models_of_others_compile_agree_with_sympy_and_stay_closed(case):
    assert run(case).disagreement(case) == ""
