"""Small models of each form of the equations: a dense one, a sparse one, and recursions with and without a loop."""

from trees import revolute_chain

import fourbar_codegen as fb

FORMS = {
    "dense": (fb.models.four_bar, "dense"),
    "sparse": (lambda: fb.models.n_four_bar(5), "sparse"),
    "recursive": (lambda: revolute_chain(5), "recursive"),
    "recursive in the plane": (lambda: fb.models.chain(5), "recursive"),
    "recursive with a loop": (lambda: fb.models.chain(9, closed=True), "recursive"),
}
"""Makers, and the form that is chosen for each."""


def of_form(name):
    return FORMS[name][0]()
