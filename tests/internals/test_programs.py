"""Programs are compiled once, and traced while Python's garbage collector is paused."""

import gc
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pushjax as pj
from pushjax._internal.jit import jit, outside_trace, quick_jit, without_gc


def test_the_collector_pauses_for_a_call_and_is_then_as_it_was():
    """Also after an error, and if it was off before: then a call within the call leaves it off, too."""

    def fails():
        assert not gc.isenabled()
        raise RuntimeError("no")

    before = gc.isenabled()
    try:
        for on in (True, False):
            (gc.enable if on else gc.disable)()
            assert without_gc(lambda x, *, y: (without_gc(lambda: None)(), gc.isenabled(), x + y))(1, y=2)[1:] == (
                False,
                3,
            )
            with pytest.raises(RuntimeError, match="no"):
                without_gc(fails)()
            assert gc.isenabled() == on
    finally:
        (gc.enable if before else gc.disable)()


def test_a_program_is_traced_once_for_all_values_of_arrays():
    traces = []

    @jit
    def power(x, exponent):
        traces.append(exponent)
        return x**exponent

    assert float(power(jnp.asarray(3.0), 2)) == 9
    assert float(power(jnp.asarray(4.0), 2)) == 16
    assert float(power(jnp.asarray(2.0), 3)) == 8
    assert traces == [2, 3]
    assert power.__name__ == "power"


@quick_jit
def squared(x, power=2):
    return {"value": x**power}


def test_what_compiles_quickly_works_within_everything():
    """By itself it has compiler options of its own, which JAX rejects inside `jit`; both work."""
    plain = squared(jnp.array(3.0))["value"]
    assert plain == 9
    assert jax.jit(lambda x: squared(x)["value"])(3.0) == 9
    assert jax.jit(lambda: squared(jnp.array(3.0))["value"])() == 9  # applied to a constant
    assert jax.grad(lambda x: squared(x)["value"])(3.0) == 6
    assert jax.jit(jax.hessian(lambda x: squared(x)["value"]))(3.0) == 2
    assert jax.grad(jax.checkpoint(lambda x: squared(x)["value"]))(3.0) == 6
    assert jax.vmap(lambda x: squared(x, power=3)["value"])(jnp.arange(3.0)).tolist() == [0, 1, 8]
    last, _ = jax.lax.scan(lambda x, _: (squared(x)["value"], None), 3.0, length=2)
    assert last == 81


def test_whether_anything_is_traced():
    seen = []

    def look(x):
        seen.append(outside_trace())
        return x

    look(1.0)
    jax.jit(look)(1.0)
    jax.grad(look)(1.0)
    jax.vmap(look)(jnp.ones(2))
    look(1.0)
    assert seen == [True, False, False, False, True]


def test_what_is_known_compiles_nothing(caplog):
    """Shapes, supports and paths compile nothing; op by op, each new shape of an array would compile programs."""
    with jax.log_compiles(), caplog.at_level("WARNING", logger="jax"):
        block = pj.Polygon.rectangle(0.0913, 0.0607)
        pj.Polygon([(0, 0), (0.05, 0.05), (0.0917, 0)])
        support = pj.Support.points(np.random.default_rng(0).uniform(size=(37, 2)), load=2.0)
        assert float(support.radius_of_gyration) > 0
        assert support.center.shape == (2,)
        assert float(block.area) > 0
        assert block.centroid.shape == (2,)
        assert pj.line((0.0, 0.1, 0.2), (0.1, 0.2, 0.3), 37).shape == (38, 3)
        known = list(caplog.records)
        jax.jit(lambda x: x + 37)(1.0)
    assert len(caplog.records) > len(known)
    assert [record.getMessage() for record in known if "ompil" in record.getMessage()] == []


FIRST = """
import sys, jax, jax.numpy as jnp, numpy as np, pushjax as pj

def call(x):
    pose = jnp.stack([0 * x, 0 * x, 0 * x])
    if sys.argv[1] == "solve_contacts":
        pushed = pj.Contacts([[-0.03, 0.0]], [[1.0, 0.0]], jnp.stack([1e-3 * x, 0 * x])[None], [0.3])
        return pj.solve_contacts(pj.Ellipsoid(np.eye(3), length=0.03), pushed).twist
    slider = pj.Slider(pj.Polygon.rectangle(0.09, 0.06), pj.Ellipsoid(np.eye(3), length=0.03))
    hand = pj.Hand.finger(0.005)
    if sys.argv[1] == "step":
        return pj.step(slider, hand, (-0.05, 0.01), (-0.04, 0.01), pose=pose, friction=0.3).pose
    if sys.argv[1] == "rollout":
        return pj.rollout(slider, hand, pj.line((-0.05, 0.01), (0.0, 0.01), 5), pose=pose, friction=0.3).pose
    env = pj.tasks.PushT()
    state = env.reset(jax.random.key(0), env.default_params)[1]
    return env.step(jax.random.key(0), state, jnp.array([0.1, 0.1]) * x, env.default_params)[0]

one = jnp.asarray(1.0)
ways = {
    "jit": lambda: jax.jit(call)(one),
    "vmap": lambda: jax.vmap(call)(one[None])[0],
    "jacfwd": lambda: (jax.jacfwd(call)(one), call(one))[1],
    "eval_shape": lambda: (jax.eval_shape(call, one), call(one))[1],
}
found, after = ways[sys.argv[2]](), jax.jit(call)(one)
np.testing.assert_allclose(found, after, atol=1e-6)
"""


SLOW = [
    pytest.param(name, way, marks=pytest.mark.slow)
    for name in ("solve_contacts", "step", "rollout", "env")
    for way in ("jit", "vmap", "jacfwd", "eval_shape")
    if (name, way) != ("rollout", "jit")
]


@pytest.mark.parametrize(("name", "way"), [("rollout", "jit"), *SLOW])
def test_first_use_inside_a_trace(name, way):
    """A module may be imported while the function that first uses it is traced."""
    done = subprocess.run([sys.executable, "-c", FIRST, name, way], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
