"""One member of a batch with numbers that cannot be computed with: the others, and derivatives, are as without it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from slopes import slopes

import pushjax as pj

STEPS, SIDE = 6, np.array([[-0.03, -0.02], [0.03, -0.02], [0.03, 0.02], [-0.03, 0.02]])
BAD = {"NaN": np.nan, "infinite": np.inf, "huge": -1e30, "negative": -1.0, "zero": 0.0}
# The numbers that are in their domain wherever they stand, so that the push need not be INVALID.
ALLOWED = {
    "huge": {"wall"},  # a normal of any length is a direction
    "negative": {"pose", "path", "vertices", "wall"},
    "zero": {"pose", "path", "vertices", "wall", "friction", "radius"},
}
GOOD = {
    "pose": np.array([0.0, 0.001, 0.05]),
    "A": np.diag([1.0, 1.2, 0.9]),
    "length": np.array(0.03),
    "friction": np.array(0.3),
    "vertices": SIDE,
    "radius": np.array(0.005),
    "path": np.array(pj.line((-0.036, 0.004), (-0.024, 0.008), STEPS)),
    "wall": np.array([0.1, 0.0, -1.0, 0.0, 0.2]),
}


def push(given) -> pj.Trajectory:
    slider = pj.Slider(pj.Polygon(given["vertices"], convex=True), pj.Ellipsoid(given["A"], length=given["length"]))
    walls = (pj.Wall(given["wall"][:2], given["wall"][2:4], given["wall"][4]),) if "wall" in given else ()
    hand = pj.Hand.finger(given["radius"])
    return pj.rollout(slider, hand, given["path"], pose=given["pose"], friction=given["friction"], fixtures=walls)


def ends(batch, shift):
    """Return ends and twists of a batch, of which all members share `shift`; and what the pushes gave."""

    def of_one(given):
        found = push(jax.tree.map(jnp.add, given, shift))
        return (jnp.where(jnp.isfinite(found.pose[-1]), found.pose[-1], 0.0), found.twist), (found.pose, found.status)

    return jax.vmap(of_one)(batch)


@jax.jit
def program(batch, shift):
    """Return poses and statuses, forward derivatives by everything, and reverse derivatives of a weighted sum."""
    along = jax.tree.map(jnp.ones_like, (batch, shift))
    weights = jnp.tile(jnp.array([1.0, 2.0, 0.3]), (2, 1)), jnp.ones((2, STEPS, 3))
    _, found, forward, reverse = slopes(lambda both: ends(*both), (batch, shift), along, weights)
    return found, forward, reverse


def broken():
    """Members of a batch that are wrong in one place each, and whether they must be INVALID."""
    for name, good in GOOD.items():
        for kind, number in BAD.items():
            for index in np.ndindex(good.shape) if good.size <= 5 else [(1, 1)]:
                wrong = good.copy()
                wrong[index] = number
                yield f"{name}{list(index)} {kind}", {**GOOD, name: wrong}, name not in ALLOWED.get(kind, ())
    for name, vertices in {"clockwise": SIDE[::-1], "collapsed": SIDE * [1, 0], "twice": SIDE[[0, 0, 2, 3]]}.items():
        yield f"vertices {name}", {**GOOD, "vertices": vertices}, True


@pytest.mark.parametrize("walls", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["plain", "wall"])
def test_a_bad_member_of_a_batch_changes_nothing_for_the_others(walls):
    def stacked(members):
        return {k: jnp.asarray(np.stack([m[k] for m in members])) for k in GOOD if walls or k != "wall"}

    none = {k: jnp.zeros(v.shape) for k, v in GOOD.items() if walls or k != "wall"}
    (poses, status), ahead, (slope, _) = program(stacked([GOOD, GOOD]), none)
    assert (status[0] == pj.Status.MOVING).all()
    assert np.all(slope["pose"][0] != 0)
    for name, member, must_be_invalid in broken():
        if name.startswith("wall") and not walls:
            continue
        # no number on the way is NaN where it could reach a derivative
        batch = stacked([GOOD, member])
        with jax.debug_nans(name == "path[1, 1] NaN"):
            found, forward, (own, shared) = program(batch, none)
        once = (poses, status, ahead, slope)
        for new, old in zip(jax.tree.leaves((*found, forward, own)), jax.tree.leaves(once), strict=True):
            np.testing.assert_array_equal(new[0], old[0], err_msg=name)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((forward, own))), name
        for k in own:
            np.testing.assert_allclose(shared[k], slope[k][0] + own[k][1], rtol=1e-5, atol=1e-7, err_msg=name)
        if name == "path[1, 1] NaN":
            assert not own["path"][1, 1].any()
            assert own["path"][1, 3].any()
        invalid = np.asarray(found[1][1]) == pj.Status.INVALID
        if must_be_invalid:
            rows = np.isin(np.arange(STEPS), [0, 1]) if name.startswith("path") else np.ones(STEPS, bool)
            assert invalid[rows].all(), (name, found[1][1])


def test_friction_that_is_not_valid_counts_also_without_a_contact():
    """A pad that is far from the slider, or beside it, has no contact that could carry its friction."""
    pad = pj.Hand((pj.Polygon.rectangle(0.02, 0.05),), lambda q: q[None], 3)
    slider = pj.Slider(pj.Polygon(SIDE, convex=True), pj.Ellipsoid(GOOD["A"], length=0.03))
    path = jnp.array([[-0.3, 0.4, 0.7], [-0.29, 0.4, 0.7]])
    status = jax.vmap(lambda mu: pj.rollout(slider, pad, path, pose=jnp.zeros(3), friction=mu).status[0])
    found = status(jnp.array([0.3, -1.0, jnp.nan]))
    np.testing.assert_array_equal(found, [pj.Status.FREE, pj.Status.INVALID, pj.Status.INVALID])
