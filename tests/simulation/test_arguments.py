"""Arguments that cannot be: each gets one sentence that names it, at the call, before anything compiles."""

import jax
import numpy as np
import pytest

import pushjax as pj

BLOCK = pj.Polygon.rectangle(0.09, 0.06)
SURFACE = pj.Ellipsoid(np.eye(3), 0.03)
SLIDER, HAND, MODEL = pj.Slider(BLOCK, SURFACE), pj.Hand.finger(0.005), pj.FrictionModel(dof=20, friction=(0.1, 0.3))
PATH = pj.line((-0.06, 0.0), (-0.05, 0.0), 4)
GIVEN = {"slider": SLIDER, "hand": HAND, "path": PATH, "pose": np.zeros(3), "friction": 0.3}
RANDOM = {"n": 10, "slider": SLIDER, "hand": HAND, "path": PATH, "pose": np.zeros(3), "model": MODEL}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"solver": "exhaustive"}, "solver: expected a ContactSolver or StickingSolver; got a str"),
        ({"friction": "0.3"}, "friction: expected real numbers; got '0.3'"),
        ({"friction": None}, "friction: expected real numbers; got None"),
        ({"pose": [0, 0, 1j]}, "pose: expected real numbers; got"),
        ({"pose": [0, 0, [1, 2]]}, "pose: expected an array of numbers; got rows that differ"),
        ({"path": "path"}, "path: expected real numbers; got 'path'"),
        ({"slider": HAND, "hand": SLIDER}, "slider: expected a Slider; got a Hand"),
        ({"hand": [HAND]}, "hand: expected a Hand; got a list"),
        ({"table": 0.1}, "table: expected a Table; got a float"),
    ],
)
def test_rollout_names_the_argument(changed, message):
    with pytest.raises((TypeError, ValueError)) as caught:
        pj.rollout(**GIVEN | changed)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"model": None}, "model: expected a FrictionModel; got a NoneType"),
        ({"model": 0.3}, "model: expected a FrictionModel; got a float"),
        ({"n": jax.random.key(0)}, "n must be a whole number, at least 1; got "),
        ({"key": 3}, "key must be one key"),
    ],
)
def test_monte_carlo_names_the_argument(changed, message):
    with pytest.raises((TypeError, ValueError)) as caught:
        pj.monte_carlo(**{"key": jax.random.key(0)} | RANDOM | changed)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: pj.random_rollout(3, SLIDER, HAND, PATH, pose=np.zeros(3), model=MODEL), "key: expected a PRNG key"),
        (lambda: pj.solve_contacts(SURFACE, None), "contacts: expected a Contacts; got a NoneType"),
        (lambda: pj.solve_contacts(None, None), "surface: expected a LimitSurface; got a NoneType"),
        (lambda: pj.FrictionModel(dof="20", friction=(0.1, 0.3)), "dof: expected real numbers; got '20'"),
        (lambda: pj.Support.uniform(BLOCK, points=64.5), "points must be a whole number, at least 1; got 64.5"),
        (lambda: pj.Polygon([(0, 0), (1, 0), (0,)]), "vertices: expected an array of numbers; got rows that differ"),
        (lambda: pj.Hand.finger("5 mm"), "radius: expected real numbers; got '5 mm'"),
    ],
)
def test_others_name_the_argument(call, message):
    with pytest.raises((TypeError, ValueError)) as caught:
        call()
    assert str(caught.value).startswith(message)
