"""Thousands of random and recorded contact problems: no answer is wrong, and none is missing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import AS_USERS
from contact_batches import BATCH, MOST, problems

import pushjax as pj
from benchmarks import contacts as bench_contacts
from pushjax.testing import ProblemBatch, violations

# Relative errors of a clean answer: of the conditions, and of the twist against the recorded one
CONDITIONS, RECORDED = 1e-8, 1e-6
# The same problem in another order, frame or unit: roundoff times the condition of the selected set
EQUIVALENT = 1e-6
SLOW = pytest.mark.slow

solve = pj.solve_contacts
solve_all = jax.jit(jax.vmap(solve), compiler_options=AS_USERS)


def slots(count: int) -> int:
    """Return the slots for this number of contacts; sizes are shared, because compiling takes longer than running."""
    return 2 if count <= 2 else MOST


def with_padding(contacts: pj.Contacts) -> pj.Contacts:
    """Fill batches of contacts up with inactive ones, which have arbitrary numbers."""

    def fill(contacts):
        def grown(a, fill):
            return jnp.concatenate([a, jnp.broadcast_to(fill, (MOST - len(a), *a.shape[1:]))])

        arrays = (contacts.point, contacts.normal, contacts.displacement, contacts.friction, contacts.gap)
        fills = (0.01, jnp.array([0.0, 1.0]), 0.3, 0.5, -0.01)
        return pj.Contacts(*map(grown, arrays, fills), grown(contacts.active, False))

    return jax.vmap(fill)(contacts)


RECORDS = [(2, 1), *(pytest.param(count, kind, marks=SLOW) for count, kind in ((2, 0), (3, 0), (3, 1), (4, 0), (4, 1)))]


@pytest.mark.parametrize(("count", "kind"), RECORDS)
def test_recorded_problems(oracle, kind, count):
    record = np.load(oracle / "multi_contact.npz")
    rows = np.resize(np.flatnonzero((record["ls_type"] == kind) & (record["K"] == count)), BATCH)
    length, mu = jnp.asarray(record["rho"][rows]), jnp.asarray(record["mu"][rows])
    if kind:
        surface = jax.vmap(pj.Quartic)(jnp.asarray(record["coeffs"][rows]), length)
    else:
        surface = jax.vmap(pj.Ellipsoid)(jnp.asarray(record["A"][rows]), length)
    places = np.zeros((3, BATCH, slots(count), 2))
    for place, name in zip(places, ("points", "normals", "vels"), strict=True):
        place[:, :count] = record[name][rows][:, :count]
    active = np.broadcast_to(np.arange(places.shape[2]) < count, places.shape[1:3])
    contacts = jax.vmap(pj.Contacts)(places[0], -places[1], places[2], mu, jnp.zeros(BATCH), active)
    motion = solve_all(surface, contacts)

    expected = np.array([{"moving": 0, "receding": 1, "jam": 2}[s] for s in record["status_true"][rows]])
    clear = ~record["ambiguous"][rows]
    status = np.asarray(motion.status)
    np.testing.assert_array_equal(status[clear], expected[clear])
    twist = np.array(motion.twist)
    worst = violations(ProblemBatch.of(surface, contacts), twist, motion.force, motion.wrench).worst()
    assert worst[status == pj.Status.MOVING].max() < CONDITIONS
    twist[:, 2] *= record["rho"][rows]
    error = np.linalg.norm(twist - record["V_true"][rows], axis=1) / record["max_speed"][rows]
    other = error > RECORDED
    assert not np.any(other & (expected == 0) & clear & np.asarray(motion.unique))
    # the margin is the recorded certificate
    squeeze = -np.asarray(motion.margin) / record["max_speed"][rows]
    np.testing.assert_allclose(squeeze, record["squeeze_power"][rows], atol=1e-9)


# the programs of one degree see nearly all that those of the other see
DEGREES = pytest.mark.parametrize("degree", [pytest.param(2, marks=SLOW), 4])
NUMBERS = [
    *((count, 4) for count in (1, 2, 3)),
    *(pytest.param(count, 2, marks=SLOW) for count in (1, 2, 3)),
    *(pytest.param(count, degree, marks=SLOW) for count in (4, 5, 6, 7, 8) for degree in (2, 4)),
]


@pytest.mark.parametrize(("count", "degree"), NUMBERS)
def test_random_problems(count, degree):
    """No answer is wrong and no problem stays open.

    Every motion satisfies every condition. Every jam has squeeze power, and 50 starts of another solver (10 for many
    contacts; `python -m benchmarks contacts` has all) find no motion.
    """
    surface, contacts = problems(count, degree, seed=count, slots=slots(count))
    motion = solve_all(surface, contacts)
    starts = 50 if count <= 4 else 10
    counts, worst = bench_contacts.judge(ProblemBatch.of(surface, contacts), motion, "float64", starts)
    assert counts["wrong"] == counts["not_converged"] == 0, worst
    assert counts["solved"] + counts["jammed"] == BATCH
    assert (counts["jammed"] > 0) == (count > 1)
    status = np.asarray(motion.status)
    assert np.all(np.asarray(motion.margin)[status == pj.Status.JAMMED] < 0)
    still = status != pj.Status.MOVING
    assert not np.any(np.asarray(motion.force)[still])
    assert not np.any(np.asarray(motion.twist)[still])


@DEGREES
def test_closed_gripper_beside_a_fixture(rng, degree):
    """Two contacts that are exactly opposite and move together, and one that stays: every jam is one."""
    surface, contacts = problems(3, degree, slots=slots(3), gaps=0.0)
    point, normal, displacement = (np.array(a) for a in (contacts.point, contacts.normal, contacts.displacement))
    own, others, still = np.argsort(~np.asarray(contacts.active), axis=1, kind="stable")[:, :3].T
    row = np.arange(BATCH)
    inward = normal[row, own]
    point[row, others] = point[row, own] + rng.uniform(0.01, 0.1, (BATCH, 1)) * inward
    normal[row, others] = -inward
    slide = 1e-3 * rng.normal(size=(BATCH, 1)) * (row % 2)[:, None]  # of half of the pairs
    displacement[row, others] = displacement[row, own] + slide * np.stack([-inward[:, 1], inward[:, 0]], axis=1)
    displacement[row, still] = 0
    contacts = jax.vmap(pj.Contacts)(point, normal, displacement, contacts.friction, contacts.gap, contacts.active)
    counts, worst = bench_contacts.judge(
        ProblemBatch.of(surface, contacts), solve_all(surface, contacts), "float64", 50
    )
    assert counts["wrong"] == counts["not_converged"] == 0, worst
    assert counts["jammed"] > BATCH // 10


@DEGREES
def test_one_contact_has_the_same_answer(degree):
    surface, contacts = problems(1, degree)
    one = solve_all(surface, contacts)
    same = solve_all(*problems(1, degree, slots=2))  # as several contacts, of which one is active
    np.testing.assert_array_equal(one.status, same.status)
    scale = np.linalg.norm(contacts.displacement, axis=(1, 2))
    size = np.stack([np.ones(BATCH), np.ones(BATCH), surface.length], axis=1)
    # ill-conditioned forms: two algorithms differ by roundoff times condition
    assert np.max(np.linalg.norm((one.twist - same.twist) * size, axis=1) / scale) < RECORDED
    agree = np.mean(np.asarray(one.mode == same.mode[:, :1]))
    assert agree > 0.999, "modes differ beyond the edges of motion cones"
    np.testing.assert_allclose(one.wrench, same.wrench, rtol=1e-6, atol=1e-6)
    moving = np.asarray(same.status) == pj.Status.MOVING
    worst = violations(ProblemBatch.of(surface, contacts), same.twist, same.force[:, :1], same.wrench).worst()
    assert worst[moving].max() < CONDITIONS


@SLOW
def test_order_frame_mirror_and_padding_do_not_matter():
    surface, contacts = problems(3, seed=3, slots=slots(3))
    order = np.random.default_rng(0).permutation(MOST)
    swapped = solve_all(surface, jax.tree.map(lambda a: a[:, order], contacts))
    compare(solve_all(surface, contacts), swapped, order=order)

    surface, contacts = problems(2, seed=3)
    more = solve_all(surface, with_padding(contacts))
    first_two = jax.tree.map(lambda a: a[:, :2] if a.ndim > 1 and a.shape[1] == MOST else a, more)
    compare(solve_all(surface, contacts), first_two)

    # an ellipsoid, rotated and mirrored together with everything else
    surface, contacts = problems(3, 2, seed=4, slots=slots(3))
    base = solve_all(surface, contacts)
    c, s = np.cos(0.7), np.sin(0.7)
    for linear in (np.array([[c, -s], [s, c]]), np.array([[1.0, 0.0], [0.0, -1.0]])):
        full = np.eye(3)
        full[:2, :2], full[2, 2] = linear, np.linalg.det(linear)
        turned = jax.vmap(pj.Ellipsoid)(full @ surface.A @ full.T, surface.length)
        moved = jax.vmap(pj.Contacts)(
            *(a @ linear.T for a in (contacts.point, contacts.normal, contacts.displacement)),
            contacts.friction,
            contacts.gap,
            contacts.active,
        )
        other = solve_all(turned, moved)
        np.testing.assert_array_equal(base.status, other.status)
        keep = np.asarray(base.unique)
        close(base.twist @ full.T, other.twist, keep)
        assert np.array_equal(base.unique, other.unique)


def close(a, b, where):
    a, b = np.asarray(a)[where], np.asarray(b)[where]
    scale = np.abs(a).max(axis=tuple(range(1, a.ndim)), keepdims=True) + 1e-12
    assert np.max(np.abs(a - b) / scale) < EQUIVALENT


def compare(a, b, order=slice(None)):
    np.testing.assert_array_equal(a.status, b.status)
    np.testing.assert_array_equal(a.unique, b.unique)
    close(a.twist, b.twist, slice(None))
    close(a.force[:, order], b.force, slice(None))
    # friction below some 1e-7 counts as none, and cancellation leaves an error of this size
    np.testing.assert_allclose(a.margin, b.margin, rtol=1e-7, atol=1e-10)


@DEGREES
def test_a_receding_pusher_can_drag_the_slider_along(degree, rng):
    """Beyond 90 degrees of the motion cone, one contact pulls by friction and the others only just touch.

    This motion satisfies every condition, so the problem is never a jam. The motion that is returned has at least its
    power.
    """
    if degree == 2:
        surface = pj.Ellipsoid(np.eye(3), 1.0)
    else:
        surface = pj.Quartic([1.0, 1, 1, 0, 0, 0, 0, 0, 0, 2, 2, 2, 0, 0, 0], 1.0)  # its square: the same motion
    pulled, twist = np.array([3.0, 1.0]), 0.1 * np.array([1.0, 1.0, 2.0])

    def velocity(at):
        return twist[:2] + twist[2] * np.stack([-at[..., 1], at[..., 0]], axis=-1)

    at, angle = rng.uniform(-4, 4, (4 * BATCH, 2, 2)), rng.uniform(0, 2 * np.pi, (4 * BATCH, 2))
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    ahead = np.sum(velocity(at) * normal, axis=-1)
    keep = np.flatnonzero(np.all(ahead > 0.05, axis=1))[:BATCH]
    keep = np.resize(keep, BATCH)
    at, normal, ahead = at[keep], normal[keep], ahead[keep]
    aside = np.stack([-normal[..., 1], normal[..., 0]], axis=-1)
    push = rng.uniform(0.9, 1, (BATCH, 2, 1)) * ahead[..., None] * normal + rng.uniform(-3, 3, (BATCH, 2, 1)) * aside
    pull = velocity(pulled) + np.stack([np.zeros(BATCH), rng.uniform(0.02, 3, BATCH)], axis=1)
    assert np.all(pull[:, 0] < 0), "it recedes"

    def with_first(first, others):
        return np.concatenate([np.broadcast_to(first, (BATCH, 1, *others.shape[2:])), others], axis=1)

    contacts = jax.vmap(pj.Contacts)(
        with_first(pulled, at),
        with_first(np.array([1.0, 0.0]), normal),
        with_first(pull[:, None], push),
        with_first(1.0, rng.uniform(0, 2, (BATCH, 2))),
    )
    contacts = with_padding(contacts)
    surfaces = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (BATCH, *leaf.shape)), surface)
    motion = solve_all(surfaces, contacts)
    assert np.all(np.asarray(motion.status) == pj.Status.MOVING)
    batch = ProblemBatch.of(surfaces, contacts)
    assert violations(batch, motion.twist, motion.force, motion.wrench).worst().max() < CONDITIONS
    power = np.sum(np.asarray(motion.wrench) * np.asarray(motion.twist), axis=1)
    least = np.dot([1, 1, 2], twist) / np.sqrt(6)
    assert np.all(power > least * (1 - 1e-9))
    other = np.abs(np.asarray(motion.twist) - twist).max(axis=1) > 1e-6
    assert not np.any(other & np.asarray(motion.unique))


@SLOW
def test_float32():
    """In float32 no answer is wrong either.

    Frictionless wedges whose slider is a thousand times faster than its pushers stay without an answer, because float32
    has too few digits for such a twist.
    """
    surface, contacts = problems(3, seed=5)
    as32 = jax.tree.map(
        lambda a: a.astype(jnp.float32) if jnp.issubdtype(a.dtype, jnp.floating) else a, (surface, contacts)
    )
    exact, rough = solve_all(surface, with_padding(contacts)), solve_all(*as32)
    assert rough.twist.dtype == jnp.float32
    status = np.asarray(rough.status)
    counts, _ = bench_contacts.judge(ProblemBatch.of(*as32), rough, "float32", starts=50)
    assert counts["wrong"] == 0
    assert counts["not_converged"] < 0.005 * BATCH
    lost = (status == pj.Status.NOT_CONVERGED) & (np.asarray(exact.status) == pj.Status.MOVING)
    speed = np.linalg.norm(exact.twist, axis=1) / np.linalg.norm(contacts.displacement, axis=2).max(axis=1)
    assert np.median(speed[lost]) > 300
    settled = (status != pj.Status.NOT_CONVERGED) & (np.asarray(exact.margin / np.abs(exact.margin)) != 0)
    assert np.mean(status[settled] == np.asarray(exact.status)[settled]) > 0.999


@SLOW
@pytest.mark.parametrize("count", [2, 3])
def test_projected_is_right_where_it_answers(count):
    surface, contacts = problems(count, seed=9, condition=100.0)
    exact = solve_all(surface, contacts)
    found = jax.jit(jax.vmap(lambda s, c: solve(s, c, solver=pj.Projected())))(surface, contacts)
    status = np.asarray(found.status)
    assert set(np.unique(status)) <= {pj.Status.MOVING, pj.Status.FREE, pj.Status.NOT_CONVERGED}
    moving = status == pj.Status.MOVING
    worst = violations(ProblemBatch.of(surface, contacts), found.twist, found.force, found.wrench).worst()
    assert worst[moving].max() < CONDITIONS
    could = np.asarray(exact.status) == pj.Status.MOVING
    assert not np.any(moving & ~could)
    assert np.mean(moving[could]) > 0.85
    same = moving & np.asarray(exact.unique)
    close(found.twist, exact.twist, same)
