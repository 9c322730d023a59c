"""Derivatives of the final pose: forward, reverse and central differences; finite where they are singular."""

from typing import Any, NamedTuple, cast

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest

import pushjax as pj
import pushjax.simulation.rollout as rollout_module
from pushjax import ContactMode, Hand, Polygon, Quartic, Slider, Status, rollout
from pushjax.testing.problems import random_surface

STEPS = 24
RADIUS = 0.00475
LENGTH = 0.03
SQUARE = 0.045 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
SURFACE = np.asarray(cast(Quartic, random_surface(jax.random.key(5), condition=10.0, length=LENGTH)).coefficients)

# In units of order one; some 100 roundings, amplified by the surface's condition of 10.
FLOAT32 = 1e-3
# Between the two directions of differentiation: the same arithmetic in another order.
FORWARD_REVERSE = 1e-9
# Central differences, relative to the largest derivative of the push.
DIFFERENCE = 1e-5
STEP = 1e-6


class Inputs(NamedTuple):
    """All inputs of a push."""

    friction: Any
    surface: Any
    pose: Any
    path: Any
    radius: Any
    vertices: Any


# Units in which every input is of order one, and so are the derivatives of x, y and length x theta by it, over 30 mm.
UNITS = Inputs(*(np.asarray(u) for u in (1.0, SURFACE.max(), np.array([0.03, 0.03, 1.0]), 0.03, 0.03, 0.03)))


def push(inputs: Inputs):
    slider = Slider(Polygon(inputs.vertices, convex=True), Quartic(inputs.surface, LENGTH))
    return rollout(slider, Hand.finger(inputs.radius), inputs.path, pose=inputs.pose, friction=inputs.friction)


def end(inputs: Inputs) -> tuple[jax.Array, jax.Array]:
    """Return the final pose and all modes."""
    run = push(inputs)
    return run.pose[-1] / jnp.asarray([LENGTH, LENGTH, 1.0], inputs.pose.dtype), run.mode[:, 0]


def final(inputs: Inputs) -> jax.Array:
    return end(inputs)[0]


ends = jax.jit(jax.vmap(end))
forward = jax.jit(jax.vmap(lambda inputs, along: jax.jvp(final, (inputs,), (along,))[1]))
backward = jax.jit(jax.vmap(lambda inputs, weight: jax.vjp(final, inputs)[1](weight)[0]))


def reverse(inputs: Inputs) -> Inputs:
    """Return the Jacobians, with a push for each row: this compiles in half the time."""
    rows = jax.tree.map(lambda x: jnp.repeat(x, 3, axis=0), inputs)
    weights = jnp.tile(jnp.eye(3, dtype=inputs.pose.dtype), (len(inputs.pose), 1))
    return jax.tree.map(lambda g: g.reshape(-1, 3, *g.shape[1:]), backward(rows, weights))


def straight(start, direction: float, length: float, friction: float, **kwargs) -> Inputs:
    a = np.deg2rad(direction)
    path = np.asarray(start) + np.linspace(0, length, STEPS + 1)[:, None] * np.array([np.cos(a), np.sin(a)])
    values = {"pose": np.zeros(3), "surface": SURFACE, "radius": RADIUS, "vertices": SQUARE} | kwargs
    return Inputs(friction=np.asarray(friction), path=path, **{k: np.asarray(v, float) for k, v in values.items()})


AT = -0.045 - RADIUS

SMOOTH = {
    "sticking": straight((AT - 1e-3, 0.01), 5, 0.03, 1.0),
    "sticking, from a turned pose": straight((AT - 4e-3, -0.004), -8, 0.03, 0.8, pose=[1e-3, 2e-3, 0.05]),
    "sliding left": straight((AT - 1e-3, -0.01), 40, 0.03, 0.1),
    "sliding right": straight((AT - 1e-3, 0.012), -35, 0.03, 0.15),
    "little friction": straight((AT - 1e-3, 0.012), -35, 0.03, 1e-3),
    "overlapping at the start": straight((AT + 5e-4, 0.01), 10, 0.02, 0.5),
    "around a corner": straight((AT - 1e-3, 0.0462), 8, 0.02, 0.1),
    # The finger does not exactly touch at the start: the step has a kink there, between free motion and overlap.
    "sliding off": straight((AT - 1e-4, 0.035), 60, 0.04, 0.1),
}

SINGULAR = {
    "zero motion, touching": straight((AT, 0.01), 0, 0.0, 0.3),
    "zero motion, apart": straight((AT - 0.01, 0.01), 0, 0.0, 0.3),
    "no friction": straight((AT - 1e-3, 0.01), 10, 0.03, 0.0),
    "no friction, symmetric": straight((AT, 0.0), 0, 0.03, 0.0),
    "grazing along an edge": straight((AT, -0.06), 90, 0.12, 0.3),
    "just past a corner": straight((-0.1, 0.045 + RADIUS), 0, 0.2, 0.3),
    "at a corner": straight((AT, 0.045), 0, 0.02, 0.3),
    "diagonally at a corner": straight((-0.06, 0.06), -45, 0.03, 0.3),
    "a point at a corner": straight((-0.045, 0.045), -30, 0.02, 0.3, radius=0.0),
    "a point on an edge": straight((-0.045, 0.01), 10, 0.02, 0.3, radius=0.0),
    "free": straight((-0.2, 0.3), 10, 0.05, 0.3),
    "slipping off": straight((-0.05025, 0.025), 60, 0.05, 0.25),
    "slipping off in one step": straight((AT, 0.044), 60, 0.5, 0.05),
    "deep inside": straight((0.01, 0.0), 10, 0.02, 0.3),
    "at the center": straight((0.0, 0.0), 0, 0.02, 0.3),
}

CASES = SMOOTH | SINGULAR
PER_CASE = 24  # directions
ROWS = len(CASES) * PER_CASE


def stack(inputs: list[Inputs], dtype: Any = np.float64) -> Inputs:
    return Inputs(*(jnp.asarray(np.stack(column), dtype) for column in zip(*inputs, strict=True)))


def directions() -> list[Inputs]:
    """Return each input by itself, and random combinations of some of the long ones, in units of `UNITS`."""
    rng = np.random.default_rng(0)
    zero = Inputs(*(np.zeros_like(v) for v in next(iter(CASES.values()))))
    chosen = [zero._replace(friction=np.ones(())), zero._replace(radius=np.ones(()))]
    chosen += [zero._replace(pose=row) for row in np.eye(3)]
    chosen += [zero._replace(vertices=row.reshape(4, 2)) for row in np.eye(8)]
    chosen += [zero._replace(surface=rng.normal(size=15)) for _ in range(5)]
    chosen += [zero._replace(path=np.eye(STEPS + 1)[at][:, None] * rng.normal(size=2)) for at in (0, 1, 5, STEPS)]
    chosen += [zero._replace(path=rng.normal(size=(STEPS + 1, 2)) * 0.1) for _ in range(2)]
    assert len(chosen) == PER_CASE
    return [Inputs(*(v * u for v, u in zip(d, UNITS, strict=True))) for d in chosen]


def spread(dtype: Any = np.float64) -> tuple[Inputs, Inputs]:
    """Combine every case with every direction."""
    along = directions()
    cases = [case for case in CASES.values() for _ in along]
    return stack(cases, dtype), stack(along * len(CASES), dtype)


def by_case(values) -> np.ndarray:
    return np.asarray(values).reshape(len(CASES), PER_CASE, -1)


@pytest.fixture(scope="module")
def derivatives():
    """Return forward and reverse derivatives of all cases along all directions, (cases, directions, 3) each."""
    inputs, along = spread()
    one = by_case(forward(inputs, along))
    jacobian = reverse(stack(list(CASES.values())))
    units = directions()

    def contracted(j, v):
        return np.einsum("cok,dk->cdo", np.asarray(j).reshape(len(CASES), 3, -1), np.stack(v).reshape(PER_CASE, -1))

    other = sum(contracted(j, v) for j, v in zip(jacobian, zip(*units, strict=True), strict=True))
    return one, other, jacobian


@pytest.mark.long
def test_forward_equals_reverse(derivatives):
    one, other, _ = derivatives
    # roundoff decides there whether the finger touches, differently in each compiled program and with other derivatives
    clear = np.array([name != "grazing along an edge" for name in CASES])
    one, other = one[clear], other[clear]
    scale = 1 + np.abs(one).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(one / scale, other / scale, rtol=0, atol=FORWARD_REVERSE)


def test_derivatives_match_central_differences(derivatives):
    inputs, along = spread()

    def shifted(sign):
        pose, mode = ends(jax.tree.map(lambda a, d: a + sign * STEP * d, inputs, along))
        return by_case(pose), by_case(mode)

    (plus, modes_plus), (minus, modes_minus) = shifted(1), shifted(-1)
    numeric = (plus - minus) / (2 * STEP)
    seen = set()
    for i, name in enumerate(CASES):
        if name not in SMOOTH:
            continue
        same = (modes_plus[i] == modes_minus[i]).all(axis=1) & (modes_plus[i] == modes_plus[i, 0]).all(axis=1)
        assert same.all(), name  # the same sequence of modes on both sides of every difference
        seen |= set(modes_plus[i].ravel().tolist())
        scale = np.abs(numeric[i]).max()
        assert scale > 0.1, name  # the derivative is not just zero
        error = np.abs(derivatives[0][i] - numeric[i]).max() / scale
        assert error < DIFFERENCE, name
    assert seen == set(ContactMode)


def test_friction_does_not_matter_while_sticking(derivatives):
    *_, jacobian = derivatives
    names = list(CASES)
    assert not np.asarray(jacobian.friction)[names.index("sticking")].any()
    assert np.abs(np.asarray(jacobian.friction)[names.index("sliding left")]).max() > 1e-2


def test_derivatives_are_finite_where_they_are_singular(derivatives):
    one, other, jacobian = derivatives
    for i, name in enumerate(CASES):
        assert np.isfinite(one[i]).all(), name
        assert all(np.isfinite(np.asarray(leaf)[i]).all() for leaf in jax.tree.leaves(jacobian)), name
    assert np.isfinite(other).all()
    free = list(CASES).index("free")
    assert not np.asarray(jacobian.friction)[free].any()
    np.testing.assert_array_equal(np.asarray(jacobian.pose)[free], np.diag([1 / LENGTH, 1 / LENGTH, 1.0]))


@pytest.mark.slow
def test_derivatives_in_float32(derivatives):
    """In float32 derivatives are finite everywhere, and close to float64's where the push is smooth."""
    *_, exact = derivatives
    jacobian = reverse(stack(list(CASES.values()), np.float32))
    for field, unit in enumerate(UNITS):
        rough, fine = np.asarray(jacobian[field]), np.asarray(exact[field])
        assert rough.dtype == np.float32
        for i, name in enumerate(CASES):
            assert np.isfinite(rough[i]).all(), name
            if name in SMOOTH:
                np.testing.assert_allclose(unit * rough[i], unit * fine[i], rtol=0, atol=FLOAT32, err_msg=name)


def test_singular_cases_are_what_they_are_called():
    pose, mode = ends(stack(list(CASES.values()) * PER_CASE))
    mode = dict(zip(CASES, np.asarray(mode), strict=False))
    assert (mode["free"] == ContactMode.SEPARATED).all()
    grazing = list(CASES).index("grazing along an edge")
    np.testing.assert_allclose(np.asarray(pose)[grazing], 0, rtol=0, atol=1e-13)
    assert (mode["sticking"][4:] == ContactMode.STICKING).all()
    assert mode["slipping off"][-1] == ContactMode.SEPARATED
    assert mode["slipping off"][5] == ContactMode.SLIDING_LEFT
    assert np.isfinite(pose).all()
    status = jax.jit(lambda i: push(i).status)(jax.tree.map(jnp.asarray, CASES["deep inside"]))
    assert (status[:5] == Status.OVERLAPPING).all()


def test_gradients_and_batches_along_paths_of_many_lengths_share_a_program(monkeypatch):
    """As in a single push, whose path is filled up; a program that the user compiles has the path as it is."""
    traced = []
    simulate = rollout_module.simulate
    monkeypatch.setattr(rollout_module, "simulate", lambda *args: traced.append(len(args[2])) or simulate(*args))
    slider, hand = Slider(Polygon.rectangle(0.091, 0.06), pj.Ellipsoid(np.eye(3), LENGTH)), Hand.finger(RADIUS)

    def turn(mu, path):
        return rollout(slider, hand, path, pose=np.zeros(3), friction=mu).pose[-1, 2]

    for steps in (5, 9, 31):
        path = jnp.asarray(pj.line((-0.06, 0.01), (-0.02, 0.01), steps))
        change, slope = jax.value_and_grad(turn)(0.1, path)
        along = jax.grad(turn, argnums=1)(0.1, path)
        batch = jax.vmap(turn, in_axes=(0, None))(jnp.array([0.1, 0.2]), path)
        assert along.shape == path.shape
        if steps == 5:
            once = len(traced)
            compiled = jax.jit(jax.value_and_grad(turn, argnums=(0, 1)))(0.1, path)
            np.testing.assert_allclose([change, slope], [compiled[0], compiled[1][0]], rtol=1e-5)
            np.testing.assert_allclose(along, compiled[1][1], rtol=1e-4, atol=1e-4)
            np.testing.assert_allclose(batch[0], change, rtol=1e-6)
            del traced[once:]
    assert len(traced) == once
    assert set(traced) == {33}
