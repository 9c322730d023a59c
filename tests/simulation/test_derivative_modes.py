"""Derivatives mode by mode: statements of docs/derivatives.md that no other test checks."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contact_batches import first, problems, square
from test_rollout_gradients import CASES, LENGTH, RADIUS, SMOOTH, STEPS, directions, push, stack

import pushjax as pj

DIFFERENCE = 1e-5  # against central differences
H = 1e-6
SQUARE = pj.Polygon.rectangle(0.09, 0.09)


# --- twist, wrench and force of every step ---


def total(inputs, weights) -> jax.Array:
    run = push(inputs)
    return sum(jnp.sum(w * part) for w, part in zip(weights, (run.twist, run.wrench, run.force), strict=True))


@pytest.mark.slow
def test_twist_wrench_and_force_of_every_step():
    """They are finite everywhere, and where a push is smooth they agree with central differences."""
    along = [directions()[k] for k in (0, 2, 3, 4, 13, 20)]
    base = list(CASES.values())
    rows = [jax.tree.map(lambda a, d, t=t: a + t * H * d, case, d) for case in base for d in along for t in (0, 1, -1)]
    rng = np.random.default_rng(0)
    # twists of a step, lengths of 1 mm; wrenches on H = 1, of order one
    unit = np.array([1e3, 1e3, 1e3 * LENGTH]), np.array([1.0, 1.0, 1 / LENGTH]), np.ones((1, 2))
    weights = tuple(jnp.asarray(rng.normal(size=(STEPS, *u.shape)) * u / STEPS) for u in unit)
    value, slope = jax.jit(jax.vmap(jax.value_and_grad(total), in_axes=(0, None)))(stack(rows), weights)
    for leaf in jax.tree.leaves(slope):
        assert np.all(np.isfinite(leaf))
    value = np.asarray(value).reshape(len(base), len(along), 3)
    leaves = [np.asarray(leaf).reshape(len(base), len(along), 3, -1)[:, :, 0] for leaf in slope]
    flat = [np.stack([np.ravel(d[k]) for d in along]) for k in range(len(leaves))]
    mine = sum(np.einsum("cdi,di->cd", g, d) for g, d in zip(leaves, flat, strict=True))
    central = (value[..., 1] - value[..., 2]) / (2 * H)
    for i, name in enumerate(CASES):
        if name in SMOOTH:
            scale = np.abs(central[i]).max()
            assert scale > 0.01, name
            assert np.abs(mine[i] - central[i]).max() < DIFFERENCE * scale, name


# --- one contact, on both sides of sticking ---


def test_the_motion_is_continuous_across_sticking_and_its_derivative_jumps():
    """By friction: twist and wrench are continuous, and constant once the contact sticks."""

    surface = square(4)

    @jax.jit
    @jax.vmap
    def at(mu):
        def motion(mu):
            contacts = pj.Contacts(
                jnp.array([[-0.045, 0.01]]), jnp.array([[1.0, 0.0]]), jnp.array([[1e-3, 8e-4]]), mu[None]
            )
            found = pj.solve_contacts(surface, contacts)
            outcome = 1e3 * found.twist[:2], 1e3 * LENGTH * found.twist[2:], found.wrench[:2], found.wrench[2:] / LENGTH
            return jnp.concatenate(outcome), found.mode[0]

        value, slope, mode = jax.jvp(motion, (mu,), (jnp.ones_like(mu),), has_aux=True)
        return value, slope, mode

    low, high = 0.0, 3.0  # slides, sticks
    for _ in range(6):  # refine the interval in which the mode changes
        mu = jnp.linspace(low, high, 101)
        value, slope, mode = (np.asarray(a) for a in at(mu))
        change = int(np.argmax(mode == pj.ContactMode.STICKING))
        low, high = float(mu[change - 1]), float(mu[change])
    assert high - low < 1e-11
    assert mode[change - 1] == pj.ContactMode.SLIDING_LEFT
    np.testing.assert_allclose(value[change - 1], value[change], rtol=0, atol=1e-9)
    assert np.all(slope[change:] == 0)
    assert np.abs(slope[change - 1]).max() > 0.1


# --- where nothing moves, or one side only exists ---


@pytest.fixture(scope="module")
def one_step():
    """Return the pose after a finger's step against a square, and derivatives by (mu, q0, q1, pose): (rows, 3, 8)."""
    slider = pj.Slider(pj.Polygon.rectangle(0.125, 0.125), square(4))

    def after(given):
        found = pj.step(slider, pj.Hand.finger(1 / 128), given[1:3], given[3:5], pose=given[5:], friction=given[0])
        return found.pose, found.status

    program = jax.jit(jax.vmap(lambda x: (*after(x), jax.jacfwd(after, has_aux=True)(x)[0])))
    return lambda rows: tuple(np.asarray(a) for a in program(jnp.asarray(np.resize(rows, (16, 8)), float)))


AT = -1 / 16 - 1 / 128  # where the finger just touches, exact to the last bit


@pytest.mark.slow
def test_a_step_that_moves_nothing_is_the_identity(one_step):
    """The derivative by the pose is the identity and all others are zero, from the side on which nothing happens."""
    rows = {
        "hand at rest, touching": [0.3, AT, 0.01, AT, 0.01, 0, 0, 0],
        "along an edge, touching": [0.3, AT, 0.01, AT, 0.02, 0, 0, 0],
        "leaving": [0.3, AT, 0.01, AT - 1e-3, 0.01, 0, 0, 0],
        "not there yet": [0.3, AT - 2e-3, 0.01, AT - 1e-3, 0.01, 0, 0, 0],
        "too deep inside": [0.3, 0.01, 0.01, 0.011, 0.01, 0, 0, 0],
        "no number": [0.3, AT, 0.01, np.nan, 0.01, 0, 0, 0],
        "negative friction": [-0.3, AT - 1e-3, 0.01, AT + 1e-3, 0.01, 0, 0, 0],
    }
    pose, status, slope = one_step(np.array(list(rows.values())))
    expected = [pj.Status.FREE] * 4 + [pj.Status.OVERLAPPING, pj.Status.INVALID, pj.Status.INVALID]
    assert status[: len(rows)].tolist() == expected
    for k, name in enumerate(rows):
        np.testing.assert_array_equal(slope[k], np.concatenate([np.zeros((3, 5)), np.eye(3)], axis=1), err_msg=name)
        assert not pose[k].any()


@pytest.mark.slow
def test_without_friction_the_derivative_is_that_of_more(one_step):
    """At mu = 0 the derivative is one-sided, because mu cannot be negative."""
    row, h = np.array([0.0, AT - 1e-4, 0.01, AT + 1e-3, 0.0104, 0, 0, 0]), 1e-6
    more = row[None] + h * np.arange(3)[:, None] * np.eye(8)[0]
    pose, status, slope = one_step(more)
    assert (status[:3] == pj.Status.MOVING).all()
    ahead = (4 * pose[1] - 3 * pose[0] - pose[2]) / (2 * h)
    assert np.abs(ahead).max() > 1e-6
    np.testing.assert_allclose(slope[0, :, 0], ahead, rtol=1e-5, atol=1e-10)


# --- grasps ---

CLOSING = 60
INPUTS = 8  # friction; pose; the last configuration, which scales the whole path
HAND_DIFFERENCE = 1e-5  # for differences over H, where steps rotate the slider far


@pytest.mark.parametrize(
    ("hand", "opening"),
    [
        pytest.param(pj.Hand.two_fingers(0.005), (0.06, 0.04), marks=pytest.mark.long),
        pytest.param(pj.Hand.three_fingers(0.003), (0.05, 0.015), marks=pytest.mark.long),
        pytest.param(pj.Hand.parallel_jaw(0.027, 0.01), (0.06, 0.03), marks=pytest.mark.long),
    ],
    ids=["two fingers", "three fingers", "jaw"],
)
def test_derivatives_of_grasps(hand, opening):
    """Derivatives of the final pose, once the object is held, by friction, start pose and the hand's path."""
    slider = pj.Slider(pj.Polygon.rectangle(0.05, 0.035), square(2))
    unit = np.array([1.0, LENGTH, LENGTH, 1.0, LENGTH, LENGTH, 1.0, LENGTH])

    def final(x):
        start, last = jnp.array([0.0, 0.0, 0.0, opening[0]]), x[4:]
        path = start[None] + jnp.linspace(0, 1, CLOSING + 1)[:, None] * (last - start)[None]
        run = pj.rollout(slider, hand, path, pose=x[1:4], friction=x[0])
        return run.pose[-1] / jnp.array([LENGTH, LENGTH, 1.0]), (run.status, run.mode)

    @jax.jit
    @jax.vmap
    def forward(x, along):
        end, slope, kind = jax.jvp(final, (x,), (along,), has_aux=True)
        return end, slope, jnp.concatenate([kind[0], kind[1].ravel()])

    starts = np.array([[0.3, 0.002, 0.001, 0.2], [0.25, -0.003, 0.0005, -0.15]])
    base = np.concatenate([starts, np.tile([0.001, -0.001, 0.03, opening[1]], (2, 1))], axis=1)
    along = np.tile(np.diag(unit), (3 * len(base), 1))
    sides = np.repeat(np.array([0, 1, -1])[:, None], INPUTS, axis=0)
    rows = np.repeat(base, 3 * INPUTS, axis=0) + H * np.tile(sides, (2, 1)) * along
    shape = len(base), 3, INPUTS, -1
    end, slope, kind = (np.asarray(a).reshape(shape) for a in forward(jnp.asarray(rows), jnp.asarray(along)))
    assert np.all(np.isfinite(slope))
    assert (kind == kind[:, :1, :1]).all()
    assert np.isin(kind[:, 0, 0, CLOSING - 1], [pj.Status.GRASPED, pj.Status.JAMMED]).all()
    central = (end[:, 1] - end[:, 2]) / (2 * H)
    np.testing.assert_allclose(slope[:, 0], central, rtol=0, atol=HAND_DIFFERENCE * max(1, np.abs(central).max()))
    assert np.abs(slope[:, 0, 4:]).max() > 0.1
    if len(hand.fingers) == 2 and opening[0] == 0.06 and hand.least > 0:
        _turns_flat(forward, base[0])


def _turns_flat(forward, like):
    """Frictionless round fingers on parallel faces: the slider turns ever faster until it is held."""
    row = like * np.array([0, 1, 0, 1, 0, 0, 0, 1]) + np.array([0, 0, 0, 0.1, 0, 0, 0, -0.02])
    _, slope, kind = forward(jnp.asarray(np.tile(row, (6 * INPUTS, 1))), jnp.asarray(np.tile(np.eye(INPUTS), (6, 1))))
    assert set(np.asarray(kind[0, :CLOSING]).tolist()) == {pj.Status.FREE, pj.Status.MOVING, pj.Status.GRASPED}
    assert np.all(np.isfinite(slope))


# --- the contact problem's forces and margin ---

FEW, SLOTS = 240, 2


@pytest.mark.slow
def test_forces_and_margin_of_several_contacts():
    """Derivatives by the displacements: forces where the motion is unique, margins everywhere, away from kinks."""
    surface, contacts = first(problems(SLOTS, 2, seed=21, condition=30.0, gaps=0.3), FEW)
    direction = jnp.array([[0.3, -0.5], [0.2, 0.7]])

    @jax.jit
    @jax.vmap
    def along(surface, contacts, t):
        size = jnp.max(jnp.abs(contacts.displacement))

        def outcome(t):
            moved = eqx.tree_at(lambda c: c.displacement, contacts, contacts.displacement + t * size * direction)
            motion = pj.solve_contacts(surface, moved)
            margin = jnp.where(jnp.isfinite(motion.margin), motion.margin, 0) / size
            return jnp.stack([*motion.force.ravel(), margin]), motion

        value, slope, motion = jax.jvp(outcome, (t,), (jnp.ones_like(t),), has_aux=True)
        return value, slope, motion

    def at(t):
        value, slope, motion = along(surface, contacts, jnp.full(FEW, t))
        return np.asarray(value), np.asarray(slope), jax.tree.map(np.asarray, motion)

    _, slope, motion = at(0.0)
    ends = [at(t) for t in (H, -H, H / 4, -H / 4)]
    wide, narrow = (ends[0][0] - ends[1][0]) / (2 * H), (ends[2][0] - ends[3][0]) / (H / 2)
    assert np.all(np.isfinite(slope))
    only = motion.unique & (motion.status == pj.Status.MOVING)
    for _, _, end in ends:
        only &= np.all(end.mode == motion.mode, axis=1) & (end.status == motion.status)
    for columns, judged in ((slice(0, -1), only), (slice(-1, None), np.isfinite(motion.margin))):
        scale = 1 + np.abs(narrow[:, columns]).max(axis=1)
        judged = judged & (np.abs(wide - narrow)[:, columns].max(axis=1) < 1e-4 * scale)
        error = (np.abs(slope - narrow)[:, columns].max(axis=1) / scale)[judged]
        assert judged.sum() > FEW / 4
        assert np.quantile(error, 0.9) < DIFFERENCE
        assert error.max() < 1e-4


# --- random friction ---

PUSHES, DOF = 2000, 150.0


@pytest.fixture(scope="module")
def random_pushes():
    """Return final poses for many keys, friction, and derivatives of the poses by (dof, lowest, highest mu)."""
    slider, path = pj.Slider(SQUARE, square(2)), pj.line((-0.052, 0.012), (-0.03, 0.004), 12)

    def end(given, key):
        model = pj.FrictionModel(dof=given[0], friction=given[1:])
        found = pj.random_rollout(key, slider, pj.Hand.finger(RADIUS), path, pose=jnp.zeros(3), model=model)
        return found.push.pose[-1] / jnp.array([LENGTH, LENGTH, 1.0]), (found.draws, found.push)

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(None, 0))
    def program(given, key):
        slope, (draws, run) = jax.jacfwd(end, has_aux=True)(given, key)
        return run.pose[-1] / jnp.array([LENGTH, LENGTH, 1.0]), slope, draws, run.mode

    keys = jax.random.split(jax.random.key(8), PUSHES)
    return lambda *given: jax.tree.map(np.asarray, program(jnp.array(given), keys))


@pytest.mark.slow
def test_random_pushes_by_the_range_of_friction(random_pushes):
    """For each key, the derivative agrees with the difference of two pushes with it, if their modes are the same."""
    h = 1e-6
    _, slope, draws, _ = random_pushes(DOF, 0.1, 0.4)
    share = (draws.friction[:, 0] - 0.1) / 0.3
    for k, part in ((1, 1 - share), (2, share)):
        shift = h * np.eye(3)[k]
        (above, _, _, one), (below, _, _, other) = (
            random_pushes(*(np.array([DOF, 0.1, 0.4]) + sign * shift)) for sign in (1, -1)
        )
        same = (one == other).all(axis=(1, 2))
        assert same.mean() > 0.9
        off = np.abs(slope[same, :, k] - ((above - below) / (2 * h))[same]).max(axis=1)
        # the mode of the first stage of a step is not recorded, and may change too
        assert np.mean(off < 1e-6) > 0.99
        assert off.max() < 0.01
        # the range affects the push only through mu
        both = slope[:, :, 1] + slope[:, :, 2]
        np.testing.assert_allclose(slope[:, :, k], part[:, None] * both, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_random_pushes_by_dof(random_pushes):
    """Averaged over keys, the derivative by dof is right for a second moment, which depends on dof to first order.

    The sample of a single key jumps.
    """
    h = 30.0
    end, slope, draws, _ = random_pushes(DOF, 0.2, 0.2)
    assert not draws.shrinkage.any()
    assert np.isfinite(slope).all()
    middle = end.mean(axis=0)
    (above, *_), (below, *_) = (random_pushes(DOF + sign * h, 0.2, 0.2) for sign in (1, -1))
    mine = 2 * (end - middle) * slope[:, :, 0]
    theirs = ((above - middle) ** 2 - (below - middle) ** 2) / (2 * h)
    error = (mine - theirs).std(axis=0) / np.sqrt(PUSHES)
    # The variance is proportional to 1 / dof, so a difference of this width is 1 / (1 - (h / dof)^2) of its derivative.
    theirs = theirs.mean(axis=0) * (1 - (h / DOF) ** 2)
    assert np.all(np.abs(mine.mean(axis=0) - theirs) < 4.5 * error)
    assert np.all(mine.mean(axis=0) < -3 * error)
