"""Derivatives of pushes, in both modes: against central differences where they are smooth, finite where singular."""

import functools
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contact_batches import square
from slopes import slopes

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
H = 1e-6


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


def outcome(inputs: Inputs):
    """Return the final pose; twist, wrench and force of every step, in units of order one; and the run.

    The places of the contacts come last. They are recorded, but not differentiated.
    """
    slider = Slider(Polygon(inputs.vertices, convex=True), Quartic(inputs.surface, LENGTH))
    run = rollout(slider, Hand.finger(inputs.radius), inputs.path, pose=inputs.pose, friction=inputs.friction)
    unit = jnp.array([[1.0, 1.0, LENGTH]], inputs.pose.dtype)
    steps = jnp.concatenate([1e3 * run.twist * unit, run.wrench / unit, run.force[:, 0]], axis=1)
    return (run.pose[-1] * unit[0] / LENGTH, steps, (run.contact_point, run.contact_normal)), run


program = jax.jit(jax.vmap(functools.partial(slopes, outcome)))


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


def stack(inputs, dtype: Any = np.float64) -> Inputs:
    """Stack inputs as rows, repeated up to the number that the program takes."""
    columns = (np.stack(column) for column in zip(*inputs, strict=True))
    return Inputs(*(jnp.asarray(np.resize(c, (ROWS, *c.shape[1:])), dtype) for c in columns))


ZERO = Inputs(*(np.zeros_like(v) for v in next(iter(CASES.values()))))


def directions() -> list[Inputs]:
    """Return each input by itself, and random combinations of some of the long ones, in units of `UNITS`."""
    rng = np.random.default_rng(0)
    chosen = [ZERO._replace(friction=np.ones(())), ZERO._replace(radius=np.ones(()))]
    chosen += [ZERO._replace(pose=row) for row in np.eye(3)]
    chosen += [ZERO._replace(vertices=row.reshape(4, 2)) for row in np.eye(8)]
    chosen += [ZERO._replace(surface=rng.normal(size=15)) for _ in range(5)]
    chosen += [ZERO._replace(path=np.eye(STEPS + 1)[at][:, None] * rng.normal(size=2)) for at in (0, 1, 5, STEPS)]
    chosen += [ZERO._replace(path=rng.normal(size=(STEPS + 1, 2)) * 0.1) for _ in range(2)]
    assert len(chosen) == PER_CASE
    return [Inputs(*(v * u for v, u in zip(d, UNITS, strict=True))) for d in chosen]


FRICTION, POSE = 0, slice(2, 5)  # directions of these inputs alone


def by_case(values) -> np.ndarray:
    return np.asarray(values).reshape(len(CASES), PER_CASE, *np.shape(values)[1:])


def weights(dtype: Any = np.float64):
    """Return weights of the outcome: in the first rows of each case one of the final pose, then random ones."""
    rng = np.random.default_rng(1)
    end, steps = rng.normal(size=(PER_CASE, 3)), rng.normal(size=(PER_CASE, STEPS, 8)) / STEPS
    end[:3], steps[:3] = np.eye(3), 0
    each = end, steps, (np.ones((PER_CASE, STEPS, 1, 2)),) * 2
    return jax.tree.map(lambda w: jnp.asarray(np.tile(w, (len(CASES), *[1] * (w.ndim - 1))), dtype), each)


def spread(dtype: Any = np.float64) -> tuple[Inputs, Inputs]:
    """Combine every case with every direction."""
    along = directions()
    return stack([case for case in CASES.values() for _ in along], dtype), stack(along, dtype)


@pytest.fixture(scope="module")
def derivatives():
    """Return outcomes, runs, and derivatives in both modes, of all cases along all directions."""
    return jax.tree.map(np.asarray, program(*spread(), weights()))


def inner(tree, other) -> np.ndarray:
    """Return the inner products of two trees, (cases, directions)."""
    products = (np.sum(np.multiply(a, b), axis=tuple(range(1, a.ndim))) for a, b in zip(tree, other, strict=True))
    return by_case(sum(products))


def test_forward_equals_reverse(derivatives):
    _, _, forward, reverse = derivatives
    one, other = inner(forward[:2], weights()[:2]), inner(reverse, spread()[1])
    # roundoff decides there whether the finger touches, differently in each compiled program and with other derivatives
    clear = np.array([name != "grazing along an edge" for name in CASES])
    scale = 1 + np.abs(by_case(forward[0])).max(axis=(1, 2)) + np.abs(by_case(forward[1])).max(axis=(1, 2, 3))
    np.testing.assert_allclose(
        (one / scale[:, None])[clear], (other / scale[:, None])[clear], rtol=0, atol=FORWARD_REVERSE
    )


def test_derivatives_match_central_differences(derivatives):
    """Those of the final pose, and of a sum over twist, wrench and force of every step."""
    inputs, along = spread()
    (plus, one, *_), (minus, other, *_) = (
        program(jax.tree.map(lambda a, d, h=h: a + h * d, inputs, along), along, weights()) for h in (H, -H)
    )
    random = np.random.default_rng(2).normal(size=(STEPS, 8)) / STEPS

    def both(parts):
        return by_case(parts[0]), by_case(np.einsum("rsk,sk->r", parts[1], random))[..., None]

    modes = [by_case(run.mode[:, :, 0]) for run in (one, other)]
    seen = set()
    for i, name in enumerate(SMOOTH):
        # the same sequence of modes on both sides of every difference
        assert all((mode[i] == modes[0][i, 0]).all() for mode in modes), name
        seen |= set(modes[0][i].ravel().tolist())
        for mine, above, below, least in zip(*map(both, (derivatives[2], plus, minus)), (0.1, 0.01), strict=True):
            numeric = (above[i] - below[i]) / (2 * H)
            scale = np.abs(numeric).max()
            assert scale > least, name  # the derivative is not just zero
            assert np.abs(mine[i] - numeric).max() < DIFFERENCE * scale, name
    assert seen == set(ContactMode)


def test_derivatives_are_finite_where_they_are_singular(derivatives):
    _, run, forward, reverse = derivatives
    for i, name in enumerate(CASES):
        for leaf in jax.tree.leaves((run.pose, forward, reverse)):
            assert np.isfinite(by_case(leaf)[i]).all(), name
    slope = dict(zip(CASES, by_case(forward[0]), strict=True))
    assert not slope["free"][FRICTION].any()
    np.testing.assert_allclose(slope["free"][POSE], np.eye(3), rtol=1e-15)
    assert not slope["sticking"][FRICTION].any()
    assert np.abs(slope["sliding left"][FRICTION]).max() > 1e-2
    assert not any(np.any(places) for places in forward[2])


@pytest.mark.slow
def test_derivatives_in_float32(derivatives):
    """In float32 derivatives are finite everywhere, and close to float64's where the push is smooth."""
    _, _, forward, reverse = program(*spread(np.float32), weights(np.float32))
    for leaf in jax.tree.leaves((forward, reverse)):
        assert leaf.dtype == np.float32
        assert np.isfinite(leaf).all()
    for rough, fine, unit in zip(reverse, derivatives[3], UNITS, strict=True):
        difference = by_case(unit * np.asarray(rough, float) - unit * fine)
        for i, name in enumerate(SMOOTH):
            np.testing.assert_allclose(difference[i, :3], 0, rtol=0, atol=FLOAT32, err_msg=name)


def test_singular_cases_are_what_they_are_called(derivatives):
    run = dict(
        zip(
            CASES,
            (jax.tree.map(lambda x, i=i: by_case(x)[i, 0], derivatives[1]) for i in range(len(CASES))),
            strict=True,
        )
    )
    assert (run["free"].mode == ContactMode.SEPARATED).all()
    np.testing.assert_allclose(run["grazing along an edge"].pose, 0, rtol=0, atol=1e-13)
    assert (run["sticking"].mode[4:] == ContactMode.STICKING).all()
    assert run["slipping off"].mode[-1] == ContactMode.SEPARATED
    assert run["slipping off"].mode[5] == ContactMode.SLIDING_LEFT
    assert (run["deep inside"].status[:5] == Status.OVERLAPPING).all()


# --- one step ---


def one_step(rows) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return poses and statuses after a finger's step, and derivatives by (mu, q0, q1, pose), (rows, 3, 8)."""
    count, rows = len(rows), np.repeat(rows, 8, axis=0)
    along = np.tile(np.eye(8), (count, 1))

    def inputs(x, **others):
        return Inputs(
            x[0], pose=x[5:], path=np.concatenate([x[None, 1:3], np.repeat(x[None, 3:5], STEPS, 0)]), **others
        )

    others = {"surface": SURFACE, "radius": 1 / 128, "vertices": SQUARE / 0.045 / 16}
    given = stack([inputs(x, **others) for x in rows])
    change = stack([inputs(d, **{name: np.zeros(np.shape(value)) for name, value in others.items()}) for d in along])
    _, run, forward, _ = program(given, change, weights())
    slope = (
        np.asarray(forward[0])[: len(rows)].reshape(count, 8, 3).swapaxes(1, 2) * np.array([LENGTH, LENGTH, 1])[:, None]
    )
    return np.asarray(run.pose[: len(rows) : 8, -1]), np.asarray(run.status[: len(rows) : 8, 0]), slope


AT_REST = -1 / 16 - 1 / 128  # where the finger just touches, exact to the last bit


def test_a_step_that_moves_nothing_is_the_identity():
    """The derivative by the pose is the identity and all others are zero, from the side on which nothing happens."""
    rows = {
        "hand at rest, touching": [0.3, AT_REST, 0.01, AT_REST, 0.01, 0, 0, 0],
        "along an edge, touching": [0.3, AT_REST, 0.01, AT_REST, 0.02, 0, 0, 0],
        "leaving": [0.3, AT_REST, 0.01, AT_REST - 1e-3, 0.01, 0, 0, 0],
        "not there yet": [0.3, AT_REST - 2e-3, 0.01, AT_REST - 1e-3, 0.01, 0, 0, 0],
        "too deep inside": [0.3, 0.01, 0.01, 0.011, 0.01, 0, 0, 0],
        "no number": [0.3, AT_REST, 0.01, np.nan, 0.01, 0, 0, 0],
        "negative friction": [-0.3, AT_REST - 1e-3, 0.01, AT_REST + 1e-3, 0.01, 0, 0, 0],
    }
    pose, status, slope = one_step(np.array(list(rows.values())))
    expected = [Status.FREE] * 4 + [Status.OVERLAPPING, Status.INVALID, Status.INVALID]
    assert status[: len(rows)].tolist() == expected
    for k, name in enumerate(rows):
        assert not slope[k, :, :5].any(), name
        np.testing.assert_allclose(slope[k, :, 5:], np.eye(3), rtol=1e-15, err_msg=name)
        assert not pose[k].any()


def test_without_friction_the_derivative_is_that_of_more():
    """At mu = 0 the derivative is one-sided, because mu cannot be negative."""
    row, h = np.array([0.0, AT_REST - 1e-4, 0.01, AT_REST + 1e-3, 0.0104, 0, 0, 0]), 1e-6
    more = row[None] + h * np.arange(3)[:, None] * np.eye(8)[0]
    pose, status, slope = one_step(more)
    assert (status[:3] == Status.MOVING).all()
    ahead = (4 * pose[1] - 3 * pose[0] - pose[2]) / (2 * h)
    assert np.abs(ahead).max() > 1e-6
    np.testing.assert_allclose(slope[0, :, 0], ahead, rtol=1e-5, atol=1e-10)


# --- grasps ---

CLOSING = 60
INPUTS = 8  # friction; pose; the last configuration, which scales the whole path
HAND_DIFFERENCE = 1e-5  # for differences over H, where steps rotate the slider far


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hand", "opening"),
    [
        (Hand.two_fingers(0.005), (0.06, 0.04)),
        (Hand.three_fingers(0.003), (0.05, 0.015)),
        (Hand.parallel_jaw(0.027, 0.01), (0.06, 0.03)),
    ],
    ids=["two fingers", "three fingers", "jaw"],
)
def test_derivatives_of_grasps(hand, opening):
    """Derivatives of the final pose, once the object is held, by friction, start pose and the hand's path."""
    slider = Slider(Polygon.rectangle(0.05, 0.035), square(2))
    unit = np.array([1.0, LENGTH, LENGTH, 1.0, LENGTH, LENGTH, 1.0, LENGTH])

    def final(x):
        start, last = jnp.array([0.0, 0.0, 0.0, opening[0]]), x[4:]
        path = start[None] + jnp.linspace(0, 1, CLOSING + 1)[:, None] * (last - start)[None]
        run = rollout(slider, hand, path, pose=x[1:4], friction=x[0])
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
    assert np.isin(kind[:, 0, 0, CLOSING - 1], [Status.GRASPED, Status.JAMMED]).all()
    central = (end[:, 1] - end[:, 2]) / (2 * H)
    np.testing.assert_allclose(slope[:, 0], central, rtol=0, atol=HAND_DIFFERENCE * max(1, np.abs(central).max()))
    assert np.abs(slope[:, 0, 4:]).max() > 0.1
    if len(hand.fingers) == 2 and opening[0] == 0.06 and hand.least > 0:
        _turns_flat(forward, base[0])


def _turns_flat(forward, like):
    """Frictionless round fingers on parallel faces: the slider turns ever faster until it is held."""
    row = like * np.array([0, 1, 0, 1, 0, 0, 0, 1]) + np.array([0, 0, 0, 0.1, 0, 0, 0, -0.02])
    _, slope, kind = forward(jnp.asarray(np.tile(row, (6 * INPUTS, 1))), jnp.asarray(np.tile(np.eye(INPUTS), (6, 1))))
    assert set(np.asarray(kind[0, :CLOSING]).tolist()) == {Status.FREE, Status.MOVING, Status.GRASPED}
    assert np.all(np.isfinite(slope))


# --- programs ---


@pytest.mark.parametrize("reverse", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["forward", "reverse"])
def test_gradients_and_batches_along_paths_of_many_lengths_share_a_program(monkeypatch, derivatives, reverse):
    """As in a single push, whose path is filled up; a program that the user compiles has the path as it is."""
    traced = []
    simulate = rollout_module.simulate
    monkeypatch.setattr(rollout_module, "simulate", lambda *args: traced.append(len(args[2])) or simulate(*args))
    case = SMOOTH["sliding left"]
    slider, hand = Slider(Polygon(case.vertices), Quartic(case.surface, LENGTH)), Hand.finger(RADIUS)

    def turn(mu, path):
        return rollout(slider, hand, path, pose=np.zeros(3), friction=mu).pose[-1, 2]

    for steps in (STEPS, 9, 31):
        path = jnp.asarray(case.path if steps == STEPS else pj.line(case.path[0], case.path[-1], steps))
        if reverse:
            change, slope = jax.value_and_grad(turn)(0.1, path)
            assert jax.grad(turn, argnums=1)(0.1, path).shape == path.shape
        else:
            change, slope = jax.jvp(lambda mu: turn(mu, path), (0.1,), (1.0,))  # noqa: B023
        batch = jax.vmap(turn, in_axes=(0, None))(jnp.array([0.1, 0.2]), path)
        np.testing.assert_allclose(batch[0], change, rtol=1e-6)
        if steps == STEPS:
            once = len(traced)
            row = list(CASES).index("sliding left")
            compiled = (by_case(part[0])[row, FRICTION, 2] for part in (derivatives[0], derivatives[2]))
            np.testing.assert_allclose([change, slope], list(compiled), rtol=1e-5)
    assert len(traced) == once
    assert set(traced) == {33}


# --- random friction ---

PUSHES, DOF = 2000, 150.0


@pytest.fixture(scope="module")
def random_pushes():
    """Return final poses for many keys, friction, and derivatives of the poses by (dof, lowest, highest mu)."""
    slider, path = Slider(Polygon.rectangle(0.09, 0.09), square(2)), pj.line((-0.052, 0.012), (-0.03, 0.004), 12)

    def end(given, key):
        model = pj.FrictionModel(dof=given[0], friction=given[1:])
        found = pj.random_rollout(key, slider, Hand.finger(RADIUS), path, pose=jnp.zeros(3), model=model)
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
