"""Operation counts, held by a committed baseline: ``python tests/building/test_operations.py`` writes it anew."""

import json
from pathlib import Path

import pytest

import fourbar_codegen as fb

BASELINE = Path(__file__).with_name("operations.json")
MODELS = {
    "four_bar": fb.models.four_bar,
    "slider_crank": fb.models.slider_crank,
    "rolling_disc": fb.models.rolling_disc,
    "chain(8)": lambda: fb.models.chain(8),
    "chain(8, closed=True)": lambda: fb.models.chain(8, closed=True),
    "n_four_bar(2)": lambda: fb.models.n_four_bar(2),
    "whipple_bicycle": fb.models.whipple_bicycle,
}


def operations(name):
    return json.loads(fb.generate_sources(MODELS[name]())["manifest.json"])["operations"]


@pytest.mark.parametrize("name", MODELS)
def test_no_more_operations_than_before(name):
    baseline = json.loads(BASELINE.read_text())[name]
    counted = operations(name)
    assert counted.keys() == baseline.keys()
    more = {function: count for function, count in counted.items() if count > baseline[function]}
    assert not more, f"more than {baseline}: write the baseline anew if it is worth it"


def test_bicycle_against_sympys_joint_cse():
    # SymPy's own test bicycle has 2312 operations in M, f, J and gamma after one joint cse of what form_eoms makes.
    assert json.loads(BASELINE.read_text())["whipple_bicycle"]["dynamics"] <= 2312


if __name__ == "__main__":
    BASELINE.write_text(json.dumps({name: operations(name) for name in MODELS}, indent=2) + "\n")
