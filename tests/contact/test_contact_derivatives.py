"""Derivatives of the motion under several contacts, at ordinary problems, singular ones, and with padding."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contact_batches import first, flat_push, problems, square
from slopes import slopes

import pushjax as pj

DIFFERENCE = 1e-5  # against central differences
# One shape for all, so that each degree needs one program: the problems of a batch, and the contacts of each.
FEW, SLOTS = 240, 3
DEGREES = pytest.mark.parametrize(
    "degree", [pytest.param(2, marks=pytest.mark.slow, id="ellipsoid"), pytest.param(4, id="quartic")]
)


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


# Weights of twist, wrench, force and margin in the sum that is differentiated in reverse mode.
EVERYTHING = np.ones(3), np.ones(3), np.ones((SLOTS, 2)), np.ones(())


def spread(tree):
    """Repeat a tree for all problems."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(jnp.asarray(leaf, float), (FEW, *jnp.shape(leaf))), tree)


@jax.jit
@jax.vmap
def program(given: Given, surface, active, along: Given, weights):
    """Return (twist, wrench, force, margin), the motion, and derivatives in both modes."""

    def outcome(given):
        m = pj.solve_contacts(surface, pj.Contacts(*given, active))
        return (m.twist, m.wrench, m.force, jnp.where(jnp.isfinite(m.margin), m.margin, 0)), m

    return slopes(outcome, given, along, weights)


def derivatives(given, surface, active, along=None, weights=EVERYTHING):
    along = jax.tree.map(jnp.ones_like, given) if along is None else along
    weights = spread(weights) if weights is EVERYTHING else weights
    return jax.tree.map(np.asarray, program(given, surface, active, along, weights))


def inner(tree, other) -> np.ndarray:
    """Return the inner products of two trees, row by row."""
    products = jax.tree.map(lambda a, b: np.sum(a * b, axis=tuple(range(1, np.ndim(a)))), tree, other)
    return sum(jax.tree.leaves(products))


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


@pytest.mark.parametrize("count", [2, 3])
@DEGREES
def test_derivatives_are_those_of_the_solution(count, degree):
    """Forward against central differences: motions, forces where the motion is unique, and margins; and reverse."""
    surface, contacts = first(problems(count, degree, seed=11, slots=SLOTS, condition=30.0, gaps=0.3), FEW)
    given, active = Given.of(contacts), contacts.active
    along = pace(given)
    size = np.abs(contacts.displacement).max(axis=(1, 2))
    weights = tuple(np.asarray(w) for w in spread((np.array([100.0, 50.0, 1.0]), np.ones(3), np.ones((SLOTS, 2)), 1.0)))

    def sums(parts):
        """Return one number for the motion, the forces one by one, and the margin."""
        return inner(parts[:2], weights[:2])[:, None], parts[2].reshape(FEW, -1), (parts[3] / size)[:, None]

    value, motion, forward, reverse = derivatives(given, surface, active, along, weights)
    for leaf in jax.tree.leaves((forward, reverse)):
        assert np.all(np.isfinite(leaf))
    one, other = inner(forward, weights), inner(reverse, along)

    def central(h):
        (above, m, *_), (below, n, *_) = (derivatives(move(given, t), surface, active, along, weights) for t in (h, -h))
        same = [np.all(a.mode == motion.mode, axis=1) & (a.status == motion.status) for a in (m, n)]
        # the margin has a kink, or jumps, where two contacts are exactly opposite only here
        with np.errstate(invalid="ignore"):
            kinked = ~(np.abs(m.margin + n.margin - 2 * motion.margin) < 1e-4 * 2 * h * size)
        return [(a - b) / (2 * h) for a, b in zip(sums(above), sums(below), strict=True)], same[0] & same[1], ~kinked

    (wides, same, _), (narrows, _, smooth) = central(1e-5), central(2.5e-6)
    unique = same & motion.unique
    moves = unique & (motion.status == pj.Status.MOVING)
    kinds = unique, moves, smooth
    for now, mine, wide, narrow, judged in zip(sums(value), sums(forward), wides, narrows, kinds, strict=True):
        scale = np.abs(narrow).max(axis=1) + np.abs(now).max(axis=1) + 1.0
        if judged is unique:
            np.testing.assert_allclose(one / scale, other / scale, atol=1e-9)
        # near a jam the motion changes within a step of the central differences, which are then meaningless
        judged = judged & (np.abs(wide - narrow).max(axis=1) < 1e-4 * scale)
        assert judged.sum() > FEW / 4
        error = np.abs(mine - narrow).max(axis=1)[judged] / scale[judged]
        assert np.quantile(error, 0.9) < DIFFERENCE
        assert np.max(error) < 1e-4


@DEGREES
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
    _, motion, *gradients = derivatives(given, spread(square(degree)), jnp.ones((FEW, SLOTS), bool))
    for k, name in enumerate(cases):
        assert motion.status[k] != pj.Status.NOT_CONVERGED, name
        for leaf in jax.tree.leaves((motion.twist, motion.wrench, motion.force, gradients)):
            assert np.all(np.isfinite(leaf[k])), name
    status = dict(zip(cases, motion.status, strict=False))
    assert status["zero motion"] == pj.Status.FREE
    assert status["jam"] == pj.Status.JAMMED


def test_equal_contacts_share_equally():
    """A contact given twice has half the force each, and half the derivatives, when sticking and when sliding."""
    cases = [(slide, mu) for slide in (2e-4, -6e-4) for mu in (1e-7, 1e-6, 1e-4, 1e-2, 0.2, 0.5)]
    base = Given(np.array([-0.04, 0.005]), np.array([1.0, 0.0]), None, None, np.array(0.0))
    rows = [
        (
            base._replace(displacement=np.array([1e-3, slide]), friction=np.array(mu)),
            Given(one[:2], np.zeros(2), one[2:4], one[4], np.array(0.0)),
        )
        for slide, mu in cases
        for one in np.eye(5)  # of point, displacement and friction
    ]
    given, along = jax.tree.map(
        lambda *leaves: jnp.asarray(
            np.resize(np.repeat(np.stack(leaves)[:, None], SLOTS, 1), (FEW, SLOTS, *leaves[0].shape))
        ),
        *rows,
    )

    def of(times):
        active = jnp.broadcast_to(jnp.arange(SLOTS) < times, (FEW, SLOTS))
        value, _, slope, _ = derivatives(given, spread(square(4)), active, along)
        return value[2][: len(rows), :2], slope[2][: len(rows), :2]

    (one, slope), (two, slopes_of_two) = of(1), of(2)
    np.testing.assert_allclose(two, np.repeat(one[:, :1] / 2, 2, axis=1), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(slopes_of_two, np.repeat(slope[:, :1] / 2, 2, axis=1), rtol=1e-8, atol=1e-8)


def test_padding_may_be_no_number():
    flat = flat_push()
    arrays = [jnp.concatenate([a, jnp.full((1, 2), jnp.nan)]) for a in (flat.point, flat.normal, flat.displacement)]
    friction, active = jnp.array([0.5, 0.5, jnp.nan]), jnp.array([True, True, False])
    with pytest.raises(ValueError, match="point must be finite"):
        pj.Contacts(*arrays, friction)
    contacts = pj.Contacts(*arrays, friction, active=active)
    given = Given(*arrays, friction, contacts.gap)
    others = spread(square(4)), jnp.broadcast_to(active, (FEW, SLOTS))
    found = derivatives(spread(given), *others)
    np.testing.assert_allclose(found[1].twist[0], pj.solve_contacts(square(4), flat).twist, atol=1e-15)
    with_numbers = derivatives(spread(jax.tree.map(jnp.nan_to_num, given)), *others)
    jax.tree.map(np.testing.assert_array_equal, found, with_numbers)
    for leaf in jax.tree.leaves(found[2:]):
        assert np.all(np.isfinite(leaf))
