"""Arguments that cannot be: each gets one sentence that names it, at the call, before anything compiles."""

import warnings

import jax
import numpy as np
import pytest

import pushjax as pj
from pushjax.simulation.hand import Pad

BLOCK = pj.Polygon.rectangle(0.09, 0.06)
SURFACE = pj.Ellipsoid(np.eye(3), 0.03)
SLIDER, HAND, MODEL = pj.Slider(BLOCK, SURFACE), pj.Hand.finger(0.005), pj.FrictionModel(dof=20, friction=(0.1, 0.3))
PATH = pj.line((-0.06, 0.0), (-0.05, 0.0), 4)
GIVEN = {"slider": SLIDER, "hand": HAND, "path": PATH, "pose": np.zeros(3), "friction": 0.3}
TURNTABLE = pj.Hand((0.005,), lambda q: jax.numpy.stack([jax.numpy.cos(q[0]), jax.numpy.sin(q[0])])[None], 1)
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
        (
            {"hand": pj.Hand.parallel_jaw(0.02, 0.01), "path": np.zeros((5, 3))},
            "path has 3 columns; a configuration of this hand has 4: x, y, theta, d",
        ),
        ({"path": np.zeros((5, 3))}, "path has 3 columns; a configuration of this hand has 2: x, y"),
        ({"hand": TURNTABLE}, "path has 2 columns; a configuration of this hand has 1"),
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
        (
            lambda: pj.FrictionModel((0.15, 0.35), 20),
            "dof has shape (2,); expected a scalar: are dof and friction swapped",
        ),
        (lambda: pj.FrictionModel(0.25, 20), "dof must be at least 3, the size of an ellipsoid's matrix; got 0.25"),
        (lambda: pj.Support.uniform(BLOCK, points=64.5), "points must be a whole number, at least 1; got 64.5"),
        (lambda: pj.Polygon([(0, 0), (1, 0), (0,)]), "vertices: expected an array of numbers; got rows that differ"),
        (lambda: pj.Hand.finger("5 mm"), "radius: expected real numbers; got '5 mm'"),
        (lambda: Pad("square"), "shape: expected a Polygon; got a str"),
        (lambda: pj.Hand((0.005,), lambda q: q[None], 2.0), "dof must be a whole number, at least 1; got 2.0"),
        (lambda: pj.motion_cone(None, (0.0, 0.0), (0.0, 1.0), 0.3), "surface: expected a LimitSurface; got a NoneType"),
    ],
)
def test_others_name_the_argument(call, message):
    with pytest.raises((TypeError, ValueError)) as caught:
        call()
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), np.zeros(3), jax.numpy.zeros(3)])
def test_known_arguments_inside_jit(pose):
    """Constants of a traced program are checked as elsewhere, or not at all, but are no error."""
    jax.make_jaxpr(lambda x: x + pj.rollout(SLIDER, HAND, PATH, pose=pose, friction=0.3).pose[-1])(0.0)
    jax.make_jaxpr(lambda key: pj.random_rollout(key, SLIDER, HAND, PATH, pose=pose, model=MODEL).push.pose)(
        jax.random.key(0)
    )


@pytest.mark.parametrize(
    "call",
    [
        lambda: pj.FrictionModel(20, (10.0, 30.0)),
        lambda: pj.step(SLIDER, HAND, *PATH[:2], pose=np.zeros(3), friction=30),
    ],
)
def test_friction_in_percent_is_named(call):
    """One warning at the caller's line; under `jit`, where the value is not known, there is none."""
    with pytest.warns(
        UserWarning, match=r"friction: mu is up to 30, and rarely more than 1: is it in percent\?"
    ) as seen:
        call()
    assert [each.filename for each in seen] == [__file__]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.make_jaxpr(lambda mu: pj.step(SLIDER, HAND, *PATH[:2], pose=np.zeros(3), friction=mu).pose)(30.0)
