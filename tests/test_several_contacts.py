"""Several contacts: single cases, degenerate sets, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contact_batches import BATCH, first, problems

import pushjax as pj
from pushjax.solve._edge_line import roots
from pushjax.verify import ProblemBatch, violations

CONDITIONS = 1e-8  # of a clean answer, relative
DIFFERENCE = 1e-5  # gradient against central differences

solve = pj.solve_contacts


def flat_push(mu=0.5, displacement=((0.001, 0.0), (0.001, 0.0)), tilt=0.0):
    """Two points flat against the left side of a square, 40 mm apart."""
    c, s = np.cos(tilt), np.sin(tilt)
    d = jnp.asarray(displacement) @ jnp.array([[c, s], [-s, c]])
    point = jnp.array([[-0.045, 0.02], [-0.045, -0.02]])
    return pj.Contacts(point, jnp.array([[1.0, 0.0], [1.0, 0.0]]), d, mu)


@pytest.fixture(scope="module")
def squares():
    support = pj.Support.uniform(pj.Polygon.rectangle(0.09, 0.09), points=64)
    pairs = support.wrench_twist_pairs(jax.random.key(1), 300)
    return {degree: pj.fit_limit_surface(*pairs, degree=degree) for degree in (2, 4)}


@pytest.fixture
def square(squares):
    """Of uniform pressure, as a quartic."""
    return squares[4]


@pytest.fixture(params=[2, 4], ids=["ellipsoid", "quartic"])
def either_square(squares, request):
    return squares[request.param]


def test_flat_push_sticks_without_slip_and_shares_the_force(either_square):
    contacts = flat_push()
    motion = solve(either_square, contacts)
    assert motion.status == pj.Status.MOVING
    np.testing.assert_array_equal(motion.mode, [pj.ContactMode.STICKING] * 2)
    v = np.asarray(motion.twist)
    point = np.asarray(contacts.point)
    slip = v[:2] + v[2] * np.stack([-point[:, 1], point[:, 0]], axis=1) - np.asarray(contacts.displacement)
    np.testing.assert_allclose(slip, 0, atol=1e-18)
    f = np.asarray(motion.force)
    # the load is shared as evenly as its moment allows, and nobody pulls
    assert np.all(f[:, 0] > 0)
    np.testing.assert_allclose(f.sum(axis=0), np.asarray(motion.wrench)[:2], rtol=1e-12, atol=1e-12)


def test_pinched_disc_moves_to_the_middle():
    """Two opposite fingers, one faster: the slider goes with the difference; at equal speed it is jammed."""
    disc = pj.Ellipsoid(np.eye(3), 0.02)
    point, normal = jnp.array([[-0.03, 0.0], [0.03, 0.0]]), jnp.array([[1.0, 0.0], [-1.0, 0.0]])
    jam = solve(disc, pj.Contacts(point, normal, jnp.array([[0.001, 0.0], [-0.001, 0.0]]), 0.3))
    assert jam.status == pj.Status.JAMMED
    np.testing.assert_allclose(jam.margin, -0.001, rtol=1e-6)
    gap = solve(disc, pj.Contacts(point, normal, jnp.array([[0.001, 0.0], [-0.001, 0.0]]), 0.3, jnp.array([0, 0.003])))
    assert gap.status == pj.Status.MOVING
    np.testing.assert_allclose(gap.twist, [0.001, 0, 0], atol=1e-15)
    assert gap.mode[1] == pj.ContactMode.SEPARATED


def test_roots_of_very_different_sizes_are_found(rng):
    """Of cubics on an interval of length one with zero in it: three real roots, or one, from 1e-6 to 1."""
    n = 20_000
    root = 10 ** rng.uniform(-6, 0, (3, n)) * rng.choice([-1, 1], (3, n))
    single = rng.random(n) < 0.4  # then the first two are a complex pair's two parts
    a, b = np.where(single, -2 * root[0], -root[0] - root[1]), root[0] * root[1]
    b = np.where(single, root[0] ** 2 + root[1] ** 2, b)
    cubic = [-b * root[2], b - a * root[2], a - root[2], np.ones(n)]
    low = -rng.uniform(0, 1, n)
    places = jax.jit(jax.vmap(lambda c, low: roots(c, low, low + 1)))(tuple(map(jnp.asarray, cubic)), jnp.asarray(low))
    found = np.stack([np.where(is_root, place, np.inf) for place, is_root in places])
    for k in range(3):
        apart = np.min([np.abs(root[k] - root[j]) for j in range(3) if j != k], axis=0)
        wanted = (root[k] > low) & (root[k] < low + 1) & ((apart > 1e-2 * np.abs(root[k])) | (single & (k == 2)))
        wanted &= ~single | (k == 2)
        assert wanted.sum() > 3000
        off = np.abs(found - root[k]).min(axis=0) / np.abs(root[k])
        assert np.mean(off[wanted] < 1e-8) > 0.999  # but for those with a larger pair nearby, which rounding may part
        assert np.max(off[wanted]) < 1e-3


def moved(c: pj.Contacts, t) -> pj.Contacts:
    """Along a line through the inputs."""
    direction = jnp.arange(1.0, c.point.shape[0] + 1)
    angle = 0.3 * t * direction
    turn = jnp.stack([jnp.cos(angle), -jnp.sin(angle), jnp.sin(angle), jnp.cos(angle)], -1).reshape(-1, 2, 2)
    return pj.Contacts(
        c.point + t * 1e-2 * direction[:, None],
        jnp.einsum("mij,mj->mi", turn, c.normal),
        c.displacement * (1 + t * direction[:, None]),
        c.friction * (1 + t * direction),
        c.gap + t * 1e-3,
        c.active,
    )


def outcome(t, s, c):
    """A weighted sum of everything, and the modes it is within."""
    m = solve(s, moved(c, t))
    total = jnp.sum(m.twist * jnp.array([100.0, 50.0, 1.0])) + jnp.sum(m.wrench) + m.twist[0] * m.twist[2] * 1e3
    return total, (jnp.append(m.mode, m.status), m.unique)


forward = jax.jit(jax.vmap(lambda t, s, c: jax.jvp(lambda t: outcome(t, s, c), (t,), (1.0,), has_aux=True)))
reverse = jax.jit(jax.vmap(jax.value_and_grad(outcome, has_aux=True)))


@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("degree", [2, 4])
def test_derivatives_are_those_of_the_solution(count, degree):
    surface, contacts = first(problems(count, degree, seed=11, slots=3, condition=30.0, gaps=0.3), 200)
    zero = jnp.zeros(200)
    value, d1, (modes, unique) = forward(zero, surface, contacts)
    d2 = reverse(zero, surface, contacts)[1]
    assert np.all(np.isfinite(d1))
    assert np.all(np.isfinite(d2))

    def central(h):
        (above, _, (modes_above, _)), (below, _, (modes_below, _)) = (
            forward(zero + t, surface, contacts) for t in (h, -h)
        )
        return (above - below) / (2 * h), np.all((modes_above == modes_below) & (modes_above == modes), axis=1)

    (wide, same), (narrow, _) = central(1e-5), central(2.5e-6)
    scale = np.abs(narrow) + np.abs(value) + 1.0
    np.testing.assert_allclose(d1 / scale, d2 / scale, atol=1e-9)
    # near a jam the motion changes within a step of the differences, which then mean nothing
    judged = same & np.asarray(unique) & (np.abs(wide - narrow) < 1e-4 * scale)
    assert judged.sum() > 100
    assert np.quantile(np.abs(d1 - narrow)[judged] / scale[judged], 0.9) < DIFFERENCE
    assert np.max(np.abs(d1 - narrow)[judged] / scale[judged]) < 1e-4


def test_nothing_is_nan_in_degenerate_problems(either_square):
    point = jnp.array([[-0.045, 0.0], [0.045, 0.0], [0.0, 0.045]])
    normal = jnp.array([[1.0, 0.0], [-1.0, 0.0], [0.0, -1.0]])
    still, push = jnp.zeros((3, 2)), 1e-3 * normal
    cases = {
        "zero motion": (point, normal, still, 0.3),
        "no friction": (point, normal, push, 0.0),
        "jam": (point, normal, push, 0.5),
        "one point three times": (point[:1].repeat(3, 0), normal[:1].repeat(3, 0), push[:1].repeat(3, 0), 0.3),
        "grazing": (point, normal, jnp.flip(push, axis=1) * jnp.array([[1.0, -1.0]]), 0.3),
        "all at the centre": (0 * point, normal, push, 0.3),
        "tiny": (point, normal, 1e-12 * push, 0.3),
        "two of three": (point, normal, push * jnp.array([[1.0], [0.0], [1.0]]), 0.3),
    }

    def total(p, n, d, mu):
        m = solve(either_square, pj.Contacts(p, n, d, mu))
        margin = jnp.where(jnp.isfinite(m.margin), m.margin, 0)
        return jnp.sum(m.twist) + jnp.sum(m.wrench) + jnp.sum(m.force) + margin, m

    run = jax.jit(jax.value_and_grad(total, argnums=(0, 1, 2, 3), has_aux=True))
    for name, (p, n, d, mu) in cases.items():
        (_, motion), gradient = run(p, n, d, jnp.asarray(mu))
        assert motion.status != pj.Status.NOT_CONVERGED, name
        for leaf in jax.tree.leaves((motion.twist, motion.wrench, motion.force, gradient)):
            assert np.all(np.isfinite(leaf)), name


@pytest.mark.parametrize("degree", [2, 4])
def test_a_receding_pusher_can_drag_the_slider_along(degree, rng):
    """Beyond 90 degrees of the motion cone: one contact pulls by friction, the others only just touch. This motion
    satisfies every condition, so there is never a jam, and what is given has no less power."""
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
    motion = jax.jit(jax.vmap(lambda c: solve(surface, c)))(contacts)
    assert np.all(np.asarray(motion.status) == pj.Status.MOVING)
    surfaces = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (BATCH, *leaf.shape)), surface)
    batch = ProblemBatch.of(surfaces, contacts)
    assert violations(batch, motion.twist, motion.force, motion.wrench).worst().max() < CONDITIONS
    power = np.sum(np.asarray(motion.wrench) * np.asarray(motion.twist), axis=1)
    least = np.dot([1, 1, 2], twist) / np.sqrt(6)
    assert np.all(power > least * (1 - 1e-9))
    other = np.abs(np.asarray(motion.twist) - twist).max(axis=1) > 1e-6
    assert not np.any(other & np.asarray(motion.unique))


def test_free_is_not_unique_where_a_pusher_could_drag():
    surface, pad = pj.Ellipsoid(np.eye(3), 1.0), [[0.0, 0.0]]
    one = [[3.0, 1.0]], [[1.0, 0.0]], [[-0.1, 2.0]]
    two = pj.Contacts(*(a + b for a, b in zip(one, (pad, [[1.0, 0.0]], pad), strict=True)), 1.0, active=[True, False])
    for motion in (solve(surface, pj.Contacts(*one, 1.0)), solve(surface, two)):
        assert motion.status == pj.Status.FREE
        assert not motion.unique


def test_equal_contacts_share_equally(square):
    """One contact, and the same twice: half the force each, and half its derivatives; sticking and sliding."""
    point, normal = jnp.array([-0.04, 0.005]), jnp.array([1.0, 0.0])

    def force(x, times):
        given = (jnp.tile(value, (times, 1)) for value in (point + x[:2], normal, x[2:4]))
        found = solve(square, pj.Contacts(*given, x[4])).force
        return found, found

    run = {k: jax.jit(jax.vmap(jax.jacfwd(lambda x, k=k: force(x, k), has_aux=True))) for k in (1, 2)}
    mu = jnp.array([1e-7, 1e-6, 1e-4, 1e-2, 0.2, 0.5])
    x = jnp.stack([jnp.array([0.0, 0.0, 1e-3, d, m]) for d in (2e-4, -6e-4) for m in mu])
    (slope, one), (slopes, two) = run[1](x), run[2](x)
    np.testing.assert_allclose(two, jnp.repeat(one, 2, axis=1) / 2, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(slopes, jnp.repeat(slope, 2, axis=1) / 2, rtol=1e-8, atol=1e-8)


def test_light_and_small_pushes_in_float32(square):
    """A contact pressed by next to nothing beside a fast one, and a hand that hardly moves."""
    as32 = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), square)

    def status(displacement, gap):
        contacts = flat_push(displacement=displacement)
        given = (a.astype(jnp.float32) for a in (contacts.point, contacts.normal, contacts.displacement))
        return solve(as32, pj.Contacts(*given, jnp.float32(0.3), gap)).status

    grazing = jax.jit(jax.vmap(lambda g: status(((0.0, 1e-2), (0.0, 1e-2)), -g)))
    assert np.all(grazing(jnp.array([1e-9, 1e-12, 1e-14, 1e-20], jnp.float32)) == pj.Status.MOVING)
    small = jax.jit(jax.vmap(lambda s: status(s * jnp.array([[1.0, 0.2], [1.0, 0.2]], jnp.float32), jnp.float32(0))))
    assert np.all(small(jnp.array([1e-3, 1e-12, 1e-19, 1e-24], jnp.float32)) == pj.Status.MOVING)


def test_padding_may_be_no_number(square):
    flat = flat_push()
    arrays = [jnp.concatenate([a, jnp.full((1, 2), jnp.nan)]) for a in (flat.point, flat.normal, flat.displacement)]
    friction, active = jnp.array([0.5, 0.5, jnp.nan]), jnp.array([True, True, False])
    more = pj.Contacts(*arrays, friction, active=active)
    expected = solve(square, flat)
    np.testing.assert_allclose(solve(square, more).twist, expected.twist, atol=1e-15)
    with pytest.raises(ValueError, match="point must be finite"):
        pj.Contacts(*arrays, friction)
    slope = jax.grad(lambda d: jnp.sum(solve(square, pj.Contacts(*arrays[:2], d, friction, active=active)).twist))
    assert np.all(np.isfinite(slope(arrays[2])))


def test_traced_values_that_are_no_numbers_are_invalid(square):
    contacts = flat_push()
    run = jax.jit(lambda d, mu: solve(square, pj.Contacts(contacts.point, contacts.normal, d, mu)))
    bad = run(contacts.displacement.at[1, 0].set(jnp.nan), jnp.array(0.3))
    assert bad.status == pj.Status.INVALID
    assert np.all(np.isfinite(bad.twist))
    assert np.all(np.isfinite(bad.force))
    assert run(contacts.displacement, jnp.array(-0.3)).status == pj.Status.INVALID


@pytest.mark.parametrize("count", [0, 9])
def test_number_of_contacts(square, count):
    with pytest.raises(ValueError, match=f"from one to 8 are supported; got {count}"):
        solve(
            square,
            pj.Contacts(jnp.zeros((count, 2)), jnp.tile(jnp.array([1.0, 0.0]), (count, 1)), jnp.zeros((count, 2)), 0.3),
        )


def test_a_solver_of_one_contact_refuses_two(square):
    with pytest.raises(ValueError, match="ScalarRoot solves one contact; got 2"):
        solve(square, flat_push(), solver=pj.ScalarRoot())
