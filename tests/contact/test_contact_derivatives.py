"""Derivatives of the motion under several contacts, at ordinary problems, singular ones, and with padding."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contact_batches import first, flat_push, problems, square

import pushjax as pj

DIFFERENCE = 1e-5  # against central differences
# One shape for all, so that each degree needs two programs only: the problems of a batch, and the contacts of each.
FEW, SLOTS = 240, 3


class Given(NamedTuple):
    """Inputs that a motion depends on; they may have leading axes."""

    point: Any
    normal: Any
    displacement: Any
    friction: Any
    gap: Any

    @staticmethod
    def of(contacts: pj.Contacts) -> "Given":
        return Given(*(getattr(contacts, name) for name in Given._fields))


class Weights(NamedTuple):
    """Weights of each part of the answer in the sum that is differentiated."""

    twist: Any = np.zeros(3)
    wrench: Any = np.zeros(3)
    force: Any = np.zeros((SLOTS, 2))
    margin: Any = 0.0


def spread(tree):
    """Repeat a tree for all problems."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(jnp.asarray(leaf, float), (FEW, *jnp.shape(leaf))), tree)


def outcome(given: Given, weights: Weights, surface, active):
    m = pj.solve_contacts(surface, pj.Contacts(*given, active))
    parts = m.twist, m.wrench, m.force, jnp.where(jnp.isfinite(m.margin), m.margin, 0)
    return sum(jnp.sum(weight * part) for weight, part in zip(weights, parts, strict=True)), m


reverse = jax.jit(jax.vmap(jax.value_and_grad(outcome, has_aux=True)))
forward = jax.jit(
    jax.vmap(
        lambda given, along, *others: jax.jvp(lambda g: outcome(g, *others), (given,), (along,), has_aux=True),
    )
)


def moved(given: Given, t) -> Given:
    """Move along a line through the inputs."""
    direction = jnp.arange(1.0, SLOTS + 1)
    angle = 0.3 * t * direction
    turn = jnp.stack([jnp.cos(angle), -jnp.sin(angle), jnp.sin(angle), jnp.cos(angle)], -1).reshape(-1, 2, 2)
    return Given(
        given.point + t * 1e-2 * direction[:, None],
        jnp.einsum("mij,mj->mi", turn, given.normal),
        given.displacement * (1 + t * direction[:, None]),
        given.friction * (1 + t * direction),
        given.gap + t * 1e-3,
    )


move = jax.jit(jax.vmap(moved, in_axes=(0, None)))
pace = jax.jit(jax.vmap(lambda given: jax.jvp(lambda t: moved(given, t), (0.0,), (1.0,))[1]))


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("degree", [pytest.param(2, marks=pytest.mark.long), 4])
def test_derivatives_are_those_of_the_solution(count, degree):
    surface, contacts = first(problems(count, degree, seed=11, slots=SLOTS, condition=30.0, gaps=0.3), FEW)
    given, active = Given.of(contacts), contacts.active
    others = spread(Weights(np.array([100.0, 50.0, 1.0]), np.ones(3))), surface, active
    along = pace(given)
    value, d1, motion = forward(given, along, *others)
    d2 = jax.tree.map(lambda g, v: np.sum(g * v, axis=tuple(range(1, g.ndim))), reverse(given, *others)[1], along)
    d2 = sum(d2)
    assert np.all(np.isfinite(d1))
    assert np.all(np.isfinite(d2))

    def central(h):
        (above, _, m), (below, _, n) = (forward(move(given, t), along, *others) for t in (h, -h))
        same = [np.all((a.mode == motion.mode), axis=1) & (a.status == motion.status) for a in (m, n)]
        return (above - below) / (2 * h), same[0] & same[1]

    (wide, same), (narrow, _) = central(1e-5), central(2.5e-6)
    scale = np.abs(narrow) + np.abs(value) + 1.0
    np.testing.assert_allclose(d1 / scale, d2 / scale, atol=1e-9)
    # near a jam the motion changes within a step of the central differences, which are then meaningless
    judged = same & np.asarray(motion.unique) & (np.abs(wide - narrow) < 1e-4 * scale)
    assert judged.sum() > FEW / 2
    assert np.quantile(np.abs(d1 - narrow)[judged] / scale[judged], 0.9) < DIFFERENCE
    assert np.max(np.abs(d1 - narrow)[judged] / scale[judged]) < 1e-4


@pytest.mark.parametrize("degree", [2, 4])
def test_nothing_is_nan_in_degenerate_problems(degree):
    point = np.array([[-0.045, 0.0], [0.045, 0.0], [0.0, 0.045]])
    normal = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, -1.0]])
    still, push = np.zeros((3, 2)), 1e-3 * normal
    cases = {
        "zero motion": (point, normal, still, 0.3),
        "no friction": (point, normal, push, 0.0),
        "jam": (point, normal, push, 0.5),
        "one point three times": (point[:1].repeat(3, 0), normal[:1].repeat(3, 0), push[:1].repeat(3, 0), 0.3),
        "grazing": (point, normal, np.flip(push, axis=1) * np.array([[1.0, -1.0]]), 0.3),
        "all at the center": (0 * point, normal, push, 0.3),
        "tiny": (point, normal, 1e-12 * push, 0.3),
        "two of three": (point, normal, push * np.array([[1.0], [0.0], [1.0]]), 0.3),
    }
    rows = [Given(p, n, d, np.full(3, mu), np.zeros(3)) for p, n, d, mu in cases.values()]
    given = Given(
        *(jnp.asarray(np.resize(np.stack(column), (FEW, *column[0].shape))) for column in zip(*rows, strict=True))
    )
    weights = spread(Weights(np.ones(3), np.ones(3), np.ones((SLOTS, 2)), 1.0))
    (_, motion), gradient = reverse(given, weights, spread(square(degree)), jnp.ones((FEW, SLOTS), bool))
    for k, name in enumerate(cases):
        assert motion.status[k] != pj.Status.NOT_CONVERGED, name
        for leaf in jax.tree.leaves((motion.twist, motion.wrench, motion.force, gradient)):
            assert np.all(np.isfinite(leaf[k])), name
    status = dict(zip(cases, np.asarray(motion.status), strict=False))
    assert status["zero motion"] == pj.Status.FREE
    assert status["jam"] == pj.Status.JAMMED


@pytest.mark.slow
def test_equal_contacts_share_equally():
    """A contact given twice has half the force each, and half the derivatives, when sticking and when sliding."""
    cases = [(slide, mu) for slide in (2e-4, -6e-4) for mu in (1e-7, 1e-6, 1e-4, 1e-2, 0.2, 0.5)]
    base = Given(np.array([-0.04, 0.005]), np.array([1.0, 0.0]), None, None, np.array(0.0))
    inputs = np.eye(5)  # point, displacement, friction
    rows, alongs, weights = [], [], []
    for slide, mu in cases:
        for one in inputs:
            for entry in range(4):
                rows.append(base._replace(displacement=np.array([1e-3, slide]), friction=np.array(mu)))
                alongs.append(Given(one[:2], np.zeros(2), one[2:4], one[4], np.array(0.0)))
                weights.append(Weights(force=np.eye(2 * SLOTS)[entry].reshape(SLOTS, 2)))
    assert len(rows) == FEW

    def stacked(values, times):
        return jax.tree.map(lambda *leaves: jnp.asarray(np.repeat(np.stack(leaves)[:, None], times, axis=1)), *values)

    given, along = (stacked(values, SLOTS) for values in (rows, alongs))
    counted = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *weights)

    def of(times):
        active = jnp.broadcast_to(jnp.arange(SLOTS) < times, (FEW, SLOTS))
        value, slope, _ = forward(given, along, counted, spread(square(4)), active)
        return (np.asarray(a).reshape(len(cases), 5, 4) for a in (value, slope))

    (one, slope), (two, slopes) = of(1), of(2)
    half, half_slope = one[..., :2] / 2, slope[..., :2] / 2
    np.testing.assert_allclose(two, np.concatenate([half, half], axis=-1), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(slopes, np.concatenate([half_slope, half_slope], axis=-1), rtol=1e-8, atol=1e-8)


def test_padding_may_be_no_number():
    flat = flat_push()
    arrays = [jnp.concatenate([a, jnp.full((1, 2), jnp.nan)]) for a in (flat.point, flat.normal, flat.displacement)]
    friction, active = jnp.array([0.5, 0.5, jnp.nan]), jnp.array([True, True, False])
    with pytest.raises(ValueError, match="point must be finite"):
        pj.Contacts(*arrays, friction)
    contacts = pj.Contacts(*arrays, friction, active=active)
    given = Given(*arrays, friction, contacts.gap)
    everything = spread(Weights(np.ones(3), np.ones(3), np.ones((SLOTS, 2)), 1.0))
    others = everything, spread(square(4)), jnp.broadcast_to(active, (FEW, SLOTS))
    (_, motion), slope = reverse(spread(given), *others)
    np.testing.assert_allclose(motion.twist[0], pj.solve_contacts(square(4), flat).twist, atol=1e-15)
    with_numbers = reverse(spread(jax.tree.map(jnp.nan_to_num, given)), *others)
    jax.tree.map(np.testing.assert_array_equal, (motion, slope), (with_numbers[0][1], with_numbers[1]))
    for leaf in jax.tree.leaves(slope):
        assert np.all(np.isfinite(leaf))
