"""Several contacts: single cases and bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contact_batches import flat_push, square

import pushjax as pj
from pushjax.contact.cubic import Roots
from pushjax.contact.jam_certificate import search_squeeze
from pushjax.contact.scaled_problem import ContactArrays, nondimensionalize
from pushjax.friction.polynomial import Polynomial

solve = pj.solve_contacts


@pytest.mark.parametrize("degree", [2, 4])
def test_flat_push_sticks_without_slip_and_shares_the_force(degree):
    contacts = flat_push()
    motion = solve(square(degree), contacts)
    assert motion.status == pj.Status.MOVING
    np.testing.assert_array_equal(motion.mode, [pj.ContactMode.STICKING] * 2)
    v = np.asarray(motion.twist)
    point = np.asarray(contacts.point)
    slip = v[:2] + v[2] * np.stack([-point[:, 1], point[:, 0]], axis=1) - np.asarray(contacts.displacement)
    np.testing.assert_allclose(slip, 0, atol=1e-18)
    f = np.asarray(motion.force)
    # the load is shared as evenly as its moment allows, and no contact pulls
    assert np.all(f[:, 0] > 0)
    np.testing.assert_allclose(f.sum(axis=0), np.asarray(motion.wrench)[:2], rtol=1e-12, atol=1e-12)


def test_pinched_disc_moves_to_the_middle():
    """With two opposite fingers, one faster, the slider moves with the difference; at equal speed it is jammed."""
    disk = pj.Ellipsoid(np.eye(3), 0.02)
    point, normal = jnp.array([[-0.03, 0.0], [0.03, 0.0]]), jnp.array([[1.0, 0.0], [-1.0, 0.0]])
    jam = solve(disk, pj.Contacts(point, normal, jnp.array([[0.001, 0.0], [-0.001, 0.0]]), 0.3))
    assert jam.status == pj.Status.JAMMED
    np.testing.assert_allclose(jam.margin, -0.001, rtol=1e-6)
    gap = solve(disk, pj.Contacts(point, normal, jnp.array([[0.001, 0.0], [-0.001, 0.0]]), 0.3, jnp.array([0, 0.003])))
    assert gap.status == pj.Status.MOVING
    np.testing.assert_allclose(gap.twist, [0.001, 0, 0], atol=1e-15)
    assert gap.mode[1] == pj.ContactMode.SEPARATED


def test_a_squeeze_does_not_depend_on_the_order_of_the_contacts(rng):
    """In float32, whether two opposite forces can cancel does not depend on the order of the contacts.

    One finger has no friction and the other hardly any. The answer depends on the product of the two cone edges of the
    latter, which is exact for either order.
    """
    n = 2000
    angle, mu = rng.uniform(-np.pi, np.pi, n), 10.0 ** rng.uniform(-6, -2, n)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    point = np.stack([-0.03 * normal, 0.03 * normal], axis=1)
    arrays = point, np.stack([normal, -normal], axis=1), rng.normal(size=(n, 2, 2)), np.stack([0 * mu, mu], axis=1)
    surface = Polynomial.of(pj.Ellipsoid(np.eye(3, dtype=np.float32), np.float32(0.02)).form().table()[..., None])

    @jax.jit
    def tight(point, normal, displacement, mu):
        vectors = (jnp.moveaxis(array, 0, -1).swapaxes(0, 1) for array in (point, normal, displacement))
        length, active = jnp.full(n, 0.02, jnp.float32), jnp.ones((2, n), bool)
        return search_squeeze(nondimensionalize(ContactArrays(surface, length, *vectors, 0 * mu.T, mu.T, active)))

    found, other = (tight(*(jnp.asarray(a[:, order], jnp.float32) for a in arrays)) for order in ([0, 1], [1, 0]))
    exists = np.isfinite(found.power)
    assert np.mean(exists) > 0.95
    np.testing.assert_array_equal(exists, np.isfinite(other.power))
    np.testing.assert_array_equal(found.presses, other.presses)


def test_roots_of_very_different_sizes_are_found(rng):
    """Find the roots of cubics on an interval of length one that contains zero.

    The cubics have three real roots, or one, of sizes from 1e-6 to 1. The single root may be near the complex pair,
    where the cubic is nearly flat.
    """
    n = 20_000
    root = 10 ** rng.uniform(-6, 0, (3, n)) * rng.choice([-1, 1], (3, n))
    single = rng.random(n) < 0.4  # then the first two entries are the two parts of a complex pair
    beside = single & (rng.random(n) < 0.5)
    pair = root[0], np.abs(root[0]) * 10 ** rng.uniform(-1, 0.3, n)
    root[1] = np.where(beside, pair[1], root[1])
    root[2] = np.where(beside, pair[0] + pair[1] * rng.uniform(-4, 4, n), root[2])
    a, b = np.where(single, -2 * root[0], -root[0] - root[1]), root[0] * root[1]
    b = np.where(single, root[0] ** 2 + root[1] ** 2, b)
    cubic = [-b * root[2], b - a * root[2], a - root[2], np.ones(n)]
    low = -rng.uniform(0, 1, n)

    @jax.jit
    def roots(c, low):
        found = Roots.of(c, low, low + 1)
        return jnp.where(found.exist(), found.find(), jnp.inf)

    found = np.asarray(roots(jnp.stack([jnp.asarray(c) for c in cubic]), jnp.asarray(low)))
    for k in range(3):
        apart = np.min([np.abs(root[k] - root[j]) for j in range(3) if j != k], axis=0)
        wanted = (root[k] > low) & (root[k] < low + 1) & ((apart > 1e-2 * np.abs(root[k])) | (single & (k == 2)))
        wanted &= ~single | (k == 2)
        assert wanted.sum() > 3000
        off = np.abs(found - root[k]).min(axis=0) / np.abs(root[k])
        assert np.mean(off[wanted] < 1e-8) > 0.999  # except near a larger pair, which roundoff may separate
        assert np.max(off[wanted]) < 1e-3


def test_free_is_not_unique_where_a_pusher_could_drag():
    surface, pad = pj.Ellipsoid(np.eye(3), 1.0), [[0.0, 0.0]]
    one = [[3.0, 1.0]], [[1.0, 0.0]], [[-0.1, 2.0]]
    two = pj.Contacts(*(a + b for a, b in zip(one, (pad, [[1.0, 0.0]], pad), strict=True)), 1.0, active=[True, False])
    for motion in (solve(surface, pj.Contacts(*one, 1.0)), solve(surface, two)):
        assert motion.status == pj.Status.FREE
        assert not motion.unique


@pytest.mark.slow
def test_light_and_small_pushes_in_float32():
    """Solve a contact with almost no pressure beside a fast one, and a hand that hardly moves."""
    as32 = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), square(4))

    def status(displacement, gap):
        contacts = flat_push(displacement=displacement)
        given = (a.astype(jnp.float32) for a in (contacts.point, contacts.normal, contacts.displacement))
        return solve(as32, pj.Contacts(*given, jnp.float32(0.3), gap)).status

    push, zero = jnp.array([[1.0, 0.2], [1.0, 0.2]], jnp.float32), jnp.zeros(4, jnp.float32)
    aside = jnp.broadcast_to(jnp.array([0.0, 1e-2], jnp.float32), (4, 2, 2))
    small = jnp.array([1e-3, 1e-12, 1e-19, 1e-24], jnp.float32)[:, None, None] * push[None]
    light = jnp.array([1e-9, 1e-12, 1e-14, 1e-20], jnp.float32)
    found = jax.jit(jax.vmap(status))(jnp.concatenate([aside, small]), jnp.concatenate([-light, zero]))
    assert np.all(found == pj.Status.MOVING)


def test_traced_values_that_are_no_numbers_are_invalid():
    contacts = flat_push()
    unchecked = jax.jit(lambda d, mu: pj.Contacts(contacts.point, contacts.normal, d, mu))
    bad = solve(square(4), unchecked(contacts.displacement.at[1, 0].set(jnp.nan), jnp.array(0.3)))
    assert bad.status == pj.Status.INVALID
    assert np.all(np.isfinite(bad.twist))
    assert np.all(np.isfinite(bad.force))
    assert solve(square(4), unchecked(contacts.displacement, jnp.array(-0.3))).status == pj.Status.INVALID


@pytest.mark.parametrize("count", [0, 9])
def test_number_of_contacts(count):
    with pytest.raises(ValueError, match=f"from one to 8 are supported; got {count}"):
        solve(
            square(4),
            pj.Contacts(jnp.zeros((count, 2)), jnp.tile(jnp.array([1.0, 0.0]), (count, 1)), jnp.zeros((count, 2)), 0.3),
        )


def test_a_solver_of_one_contact_refuses_two():
    with pytest.raises(ValueError, match="ScalarRoot solves one contact; got 2"):
        solve(square(4), flat_push(), solver=pj.ScalarRoot())


ANGLES = np.linspace(0.1, 6.2, 40)


def frictionless(leaning: float, count: int, angle: float) -> pj.Contacts:
    """Return two opposite fingers, or three around a disk of 30 mm, that close; the normal of the first is tilted.

    The third of two is inactive, so that both cases share a program.
    """
    around = angle + 2 * np.pi / count * np.arange(3)
    point = 0.03 * np.stack([np.cos(around), np.sin(around)], axis=1)
    lean = around + np.where(np.arange(3) == 0, leaning, 0.0)
    normal = -np.stack([np.cos(lean), np.sin(lean)], axis=1)
    active = np.arange(3) < count
    return pj.Contacts(jnp.asarray(point), jnp.asarray(normal), jnp.asarray(1e-3 * normal), 0.0, active=active)


@pytest.mark.parametrize("dtype", [jnp.float64, pytest.param(jnp.float32, marks=pytest.mark.slow)])
@pytest.mark.parametrize("count", [2, 3])
def test_frictionless_fingers_jam_where_their_forces_balance_to_rounding(dtype, count):
    """At any angle they jam; tilted a little more than roundoff, they squeeze the slider out."""
    surface = jax.tree.map(lambda leaf: leaf.astype(dtype), square(4))

    def solved(leaning):
        each = [frictionless(leaning, count, angle) for angle in ANGLES]
        batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
        batch = jax.tree.map(lambda leaf: leaf.astype(dtype) if leaf.dtype != bool else leaf, batch)
        return jax.vmap(lambda c: pj.solve_contacts(surface, c))(batch)

    straight = solved(0.0)
    assert (straight.status == pj.Status.JAMMED).all()
    np.testing.assert_allclose(straight.margin, -1e-3, rtol=1e-4)
    leaning = solved(1e-6 if dtype == jnp.float64 else 1e-3)
    assert (leaning.status != pj.Status.JAMMED).all()
    if dtype == jnp.float64:
        assert (leaning.status == pj.Status.MOVING).all()
