"""The Whipple bicycle about its straight motion: eigenvalues and critical speeds.

Source: J. P. Meijaard, J. M. Papadopoulos, A. Ruina, A. L. Schwab, "Linearized dynamics equations for the balance and
steer of a bicycle: a benchmark and review", Proc. R. Soc. A 463 (2007), Tables 1 and 2.
"""

import numpy as np
import pytest

import fourbar_codegen as fb


@pytest.fixture(scope="module")
def bicycle():
    return fb.compile_model(fb.models.whipple_bicycle())


# Meijaard, Papadopoulos, Ruina, Schwab 2007, Table 2: forward speed, castering, capsize, weave.
EIGENVALUES = [
    (0, -5.53094371765393, -3.13164324790656, 3.13164324790656, 5.53094371765393),
    (1, -7.11008014637442, -3.13423125066578, 3.52696170990070 + 0.80774027519930j),
    (2, -8.67387984831735, -3.07158645641514, 2.68234517512745 + 1.68066296590675j),
    (3, -10.35101467245920, -2.63366137253667, 1.70675605663975 + 2.31582447384325j),
    (4, -12.15861426576447, -1.42944427361326, 0.41325331521125 + 3.07910818603206j),
    (5, -14.07838969279822, -0.32286642900409, -0.77534188219585 + 4.46486771378823j),
    (6, -16.08537123098030, -0.00406690076970, -1.52644486584142 + 5.87673060598709j),
    (7, -18.15788466125262, 0.10268170574766, -2.13875644258362 + 7.19525913329805j),
    (8, -20.27940894394569, 0.14327879765713, -2.69348683581097 + 8.46037971396931j),
    (9, -22.43788559040858, 0.15790184030917, -3.21675402252485 + 9.69377351531791j),
    (10, -24.62459635017404, 0.16105338653172, -3.72016840437287 + 10.90681139476287j),
]


def test_bicycle_parameters_from_meijaards_table_are_the_defaults(bicycle):
    # Meijaard's parameters in the geometry of Moore 2012, appendix: a steer axis tilted by lambda.
    w, c, tilt, rear, front = 1.02, 0.08, np.pi / 10, 0.3, 0.35
    d = bicycle.defaults
    d1 = np.cos(tilt) * (c + w - rear * np.tan(tilt))
    d3 = -np.cos(tilt) * (c - front * np.tan(tilt))
    d2 = (rear + d1 * np.sin(tilt) - front + d3 * np.sin(tilt)) / np.cos(tilt)
    np.testing.assert_allclose([d["d1"], d["d2"], d["d3"]], [d1, d2, d3], rtol=1e-14)
    turn = np.array([[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]])
    np.testing.assert_allclose([d["l1"], d["l2"]], turn @ [0.3, -0.9 + rear], rtol=1e-14)
    np.testing.assert_allclose([d["l3"], d["l4"]], turn @ [0.9 - w, -0.7 + front], rtol=1e-14)
    frame = turn @ [[9.2, 2.4], [2.4, 2.8]] @ turn.T
    np.testing.assert_allclose([d["ic11"], d["ic31"], d["ic33"]], [frame[0, 0], frame[0, 1], frame[1, 1]], rtol=1e-14)
    fork = turn @ [[0.05892, -0.00756], [-0.00756, 0.00708]] @ turn.T
    np.testing.assert_allclose([d["ie11"], d["ie31"], d["ie33"]], [fork[0, 0], fork[0, 1], fork[1, 1]], rtol=1e-13)


@pytest.mark.parametrize("row", EIGENVALUES, ids=lambda row: f"{row[0]} m/s")
def test_bicycle_at_each_speed_has_the_eigenvalues_of_meijaard(bicycle, row):
    speed, *expected = row
    expected += [value.conjugate() for value in expected if isinstance(value, complex)]
    x = bicycle.initial_state(speeds={"u6": -speed / 0.3})
    np.testing.assert_allclose(dict(zip(bicycle.states, x, strict=True))["u1"], speed, atol=1e-12)
    A, B = bicycle.linearize(0.0, x)
    assert B.shape == (10, 0)
    roll, steer = (bicycle.coordinates.index(name) for name in ("q4", "q7"))
    rates = [7 + bicycle.speeds.index(name) for name in ("u4", "u7")]
    # Roll and steer move apart from the six other states, which are cyclic or constant.
    moving = [roll, steer, *rates]
    np.testing.assert_allclose(np.delete(A[moving], moving, axis=1), 0.0, atol=1e-12)
    eigenvalues = np.linalg.eigvals(A[np.ix_(moving, moving)])
    # Printed to 14 decimals; the smallest of them comes from a matrix of entries around 100.
    np.testing.assert_allclose(np.sort_complex(eigenvalues), np.sort_complex(expected), rtol=0, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize(("speed", "number"), [(4.29238253634111, 2), (6.02426201538837, 1)], ids=["weave", "capsize"])
def test_an_eigenvalue_has_no_real_part_at_the_published_critical_speeds(bicycle, speed, number):
    """Table 2 and section 5: weave and capsize speed, to 14 decimals of m/s; real parts grow by about 1 per m/s."""
    A, _ = bicycle.linearize(0.0, bicycle.initial_state(speeds={"u6": -speed / 0.3}))
    roll, steer = (bicycle.coordinates.index(name) for name in ("q4", "q7"))
    moving = [roll, steer, *(7 + bicycle.speeds.index(name) for name in ("u4", "u7"))]
    real = np.linalg.eigvals(A[np.ix_(moving, moving)]).real
    assert np.count_nonzero(np.abs(real) < 1e-11) == number
