"""One contact: recorded answers, conditions, singular cases, derivatives, bad input."""

import functools
import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contact_batches import problems
from slopes import slopes

from pushjax import (
    ContactMode,
    Contacts,
    Ellipsoid,
    HessianIteration,
    Quartic,
    Status,
    friction_cone,
    motion_cone,
    solve_contacts,
)
from pushjax.friction.sum_of_squares import squared_quadratics
from pushjax.testing.problems import random_surface

FLOATS = pytest.mark.parametrize("dtype", [np.float64, np.float32], ids=["float64", "float32"])
# The surface and the solver; a surface of degree 2 as its square has the same motion.
KINDS = ["ellipsoid", "quartic", "hessian", "hessian, ellipsoid"]

# Two algorithms in float64. In float32 the recorded surfaces (condition of the Hessian up to 3e5) amplify 6e-8.
TWIST_TOLERANCE = {np.float64: 1e-6, np.float32: 1e-3}
# The direction of the wrench is less well determined than that of the twist, by the condition of the Hessian.
WRENCH_ANGLE = {np.float64: 1e-6, np.float32: 1e-3}
# Arithmetic on a few products: only roundoff.
ROUNDING = {np.float64: 1e-13, np.float32: 2e-5}
# Central differences with a relative step of 1e-6 leave 1e-10 of roundoff and less truncation, times the condition.
GRADIENT_TOLERANCE = 1e-5
# Second derivatives by differences of the first ones.
HESSIAN_TOLERANCE = 1e-5
# Every batch has this many rows, so that each surface and dtype needs one program.
ROWS = 1152


class Problem(NamedTuple):
    """One contact problem in arrays; `surface` is its coefficients: (3, 3) or (15,)."""

    surface: Any
    length: Any
    point: Any
    normal: Any
    displacement: Any
    friction: Any
    gap: Any
    active: Any


class Solved(NamedTuple):
    """Motions of problems, and derivatives of their (twist, wrench, force) in both modes."""

    motion: Any
    forward: Any = None
    reverse: Any = None


def surface_of(p: Problem):
    return (Ellipsoid if p.surface.shape[-2:] == (3, 3) else Quartic)(p.surface, p.length)


def coefficients_of(surface) -> jax.Array:
    return surface.A if isinstance(surface, Ellipsoid) else surface.coefficients


def outcome(p: Problem, solver=None):
    contacts = Contacts(p.point[None], p.normal[None], p.displacement[None], p.friction, p.gap, p.active)
    m = solve_contacts(surface_of(p), contacts, solver=solver)
    return (m.twist, m.wrench, m.force[0]), m


@jax.jit
@jax.vmap
def with_slopes(p: Problem, along, weights) -> Solved:
    return Solved(*slopes(outcome, p, along, weights)[1:])


by_hessian = jax.jit(jax.vmap(lambda p: Solved(outcome(p, HessianIteration())[1])))


def solve(p: Problem, along=None, weights=None, hessian: bool = False) -> Solved:
    """Solve a batch of problems, with derivatives along `along`, by default ones, and of the weighted outcome."""
    count = len(p.gap)
    assert count <= ROWS

    def rows(tree):
        return jax.tree.map(lambda x: jnp.asarray(np.resize(x, (ROWS, *x.shape[1:]))), tree)

    dtype = p.gap.dtype
    if along is None:
        along = p._replace(active=None)
        along = jax.tree.map(lambda x: np.ones_like(x), along)
        weights = tuple(np.ones((count, size), dtype) for size in (3, 3, 2))
    found = by_hessian(rows(p)) if hessian else with_slopes(rows(p), rows(along), rows(weights))
    return jax.tree.map(lambda x: np.asarray(x)[:count], found)


def cast(tree, dtype):
    return jax.tree.map(lambda x: x if np.asarray(x).dtype == bool else np.asarray(x, dtype), tree)


# --- recorded answers, and the conditions of random ones ---


@pytest.fixture(scope="module")
def recorded(oracle):
    """Return the recorded problems by kind, in our conventions, with true twist (normalized), wrench and mode."""
    d = np.load(oracle / "single_contact.npz")
    assert len(d["ls_type"]) + len(d["adv_ls_type"]) == 2142

    def columns(degree):
        rows = np.concatenate([d["ls_type"], d["adv_ls_type"]]) == (0 if degree == 2 else 1)
        names = "A" if degree == 2 else "coeffs", "rho", "point", "normal", "vel", "mu"
        given = [np.concatenate([d[name], d["adv_" + name]])[rows] for name in names]
        given[3] = -given[3]
        true = [
            np.concatenate([d[name], d["adv_" + name]])[rows] for name in ("V_true", "F_true_level1", "mode_true_id")
        ]
        return Problem(*given, np.zeros(rows.sum()), np.ones(rows.sum(), bool)), *true

    ellipsoid, quartic = columns(2), columns(4)
    return dict(zip(KINDS, (ellipsoid, quartic, quartic, (squared(ellipsoid[0]), *ellipsoid[1:])), strict=True))


def squared(p: Problem) -> Problem:
    return p._replace(surface=np.asarray(jax.vmap(squared_quadratics)(p.surface[:, None])))


def test_recorded_answers(recorded):
    for dtype, kind in itertools.product((np.float64, np.float32), KINDS):
        problem, twist, wrench, mode = recorded[kind]
        motion = solve(cast(problem, dtype), hessian="hessian" in kind).motion
        assert motion.twist.dtype == dtype
        np.testing.assert_array_equal(motion.mode[:, 0], mode)
        expected = np.where(mode == ContactMode.SEPARATED, Status.FREE, Status.MOVING)
        np.testing.assert_array_equal(motion.status, expected)

        length, speed = problem.length[:, None], np.linalg.norm(problem.displacement, axis=1)
        unit = np.concatenate([0 * length + 1, 0 * length + 1, length], axis=1)
        error = np.linalg.norm(motion.twist.astype(float) * unit - twist, axis=1) / speed
        assert error.max() < TWIST_TOLERANCE[dtype]

        moves = mode != ContactMode.SEPARATED
        ours = motion.wrench.astype(float) / unit
        assert not ours[~moves].any()
        a, b = ours[moves], wrench[moves]
        angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))
        size = np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
        np.testing.assert_allclose(size, 1, rtol=WRENCH_ANGLE[dtype])
        assert angle.max() < WRENCH_ANGLE[dtype]


def random_problems(degree: int, seed: int, condition: float) -> Problem:
    """Return random problems whose pushes are in all directions up to 87 degrees from the normal, without gaps."""
    surface, contacts = jax.tree.map(lambda x: np.asarray(x)[:ROWS], problems(1, degree, seed, condition=condition))
    rng, normal = np.random.default_rng(seed), contacts.normal[:, 0]
    push = rng.uniform(0.05, 1, (ROWS, 1)) * normal + rng.uniform(-1, 1, (ROWS, 1)) * normal[:, ::-1] * [-1, 1]
    push *= 10 ** rng.uniform(-4, -2, (ROWS, 1))
    rest = contacts.point[:, 0], normal, push, rng.uniform(0, 1, ROWS), np.zeros(ROWS), np.ones(ROWS, bool)
    return Problem(coefficients_of(surface), surface.length, *rest)


@FLOATS
@pytest.mark.parametrize("kind", KINDS)
def test_answers_satisfy_every_condition(kind, dtype):
    """Check Coulomb's law, complementarity and dissipation from the numbers of the answer."""
    # a square has the condition of its ellipsoid squared
    condition = 10.0 if kind == "hessian, ellipsoid" else 1e3
    problem = random_problems(2 if "ellipsoid" in kind else 4, seed=12, condition=condition)
    backwards = np.arange(ROWS) % 10 == 0
    problem = problem._replace(displacement=problem.displacement * np.where(backwards, -1, 1)[:, None])
    problem = cast(squared(problem) if kind == "hessian, ellipsoid" else problem, dtype)
    motion = solve(problem, hessian="hessian" in kind).motion
    level = np.asarray(jax.jit(jax.vmap(lambda q, w: surface_of(q).value(w)))(problem, motion.wrench))
    p, motion = jax.tree.map(lambda x: np.asarray(x, np.float64), (problem, motion))
    twist, wrench, mode = motion.twist, motion.wrench, motion.mode[:, 0]
    fn, ft = motion.force[:, 0].T
    eps = ROUNDING[dtype]
    tangent = np.stack([-p.normal[:, 1], p.normal[:, 0]], axis=1)

    # the force sums to the wrench
    f = fn[:, None] * p.normal + ft[:, None] * tangent
    summed = np.concatenate([f, (p.point[:, :1] * f[:, 1:] - p.point[:, 1:] * f[:, :1])], axis=1)
    size = np.linalg.norm(f, axis=1, keepdims=True) + 1e-30
    assert np.max(np.abs(summed - wrench) / size) < eps

    # on the level set where the slider moves
    moves = motion.status == Status.MOVING
    assert np.max(np.abs(level[moves] - 1)) < 10 * eps

    # inside the cone, pushing, not penetrating
    assert np.all(fn >= 0)
    assert np.all(np.abs(ft) <= p.friction * fn * (1 + eps))
    slip = twist[:, :2] + twist[:, 2:] * np.stack([-p.point[:, 1], p.point[:, 0]], axis=1) - p.displacement
    wn, wt = np.sum(slip * p.normal, axis=1), np.sum(slip * tangent, axis=1)
    # size of the terms that cancel
    reach = np.linalg.norm(p.displacement, axis=1) + np.abs(twist[:, 2]) * np.linalg.norm(p.point, axis=1)
    assert np.all(wn >= -eps * reach)
    assert np.all(np.abs(wn[moves]) <= eps * reach[moves])
    sticks = mode == ContactMode.STICKING
    assert np.all(np.abs(wt[sticks]) <= eps * reach[sticks])
    for sliding, sign in ((ContactMode.SLIDING_LEFT, 1), (ContactMode.SLIDING_RIGHT, -1)):
        slides = mode == sliding
        assert slides.any()
        assert np.all(sign * wt[slides] < 0)
        np.testing.assert_allclose(ft[slides], sign * (p.friction * fn)[slides], rtol=10 * eps)

    # friction takes power at the contact and under the slider
    assert np.all(-ft * wt >= -eps * np.abs(ft) * reach)
    assert np.all(np.sum(twist * wrench, axis=1)[moves] > 0)
    assert not twist[~moves].any()
    assert not fn[~moves].any()
    assert not ft[~moves].any()


# --- singular cases ---

SCALES = {np.float64: (1e-60, 1e60), np.float32: (1e-14, 1e14)}


@functools.cache
def base(degree: int) -> Problem:
    """Return a well-conditioned problem that sticks."""
    surface = jax.jit(lambda key: random_surface(key, degree=degree, condition=10.0, length=0.03))(jax.random.key(3))
    rest = 0.03, [-0.045, 0.02], [1.0, 0.0], [1e-3, 2e-4], 0.6, 0.0, True
    return Problem(*(np.asarray(value) for value in (coefficients_of(surface), *rest)))


def stacked(problems) -> Problem:
    return Problem(*(np.stack(column) for column in zip(*problems, strict=True)))


def singular(degree: int, dtype) -> dict[str, Problem]:
    """Return problems at the limits of the formulas' domain."""
    p = base(degree)
    edges = np.asarray(motion_cone(surface_of(p), p.point, p.normal, p.friction))
    low, high = SCALES[dtype]
    tilt = np.array([0.8, 0.6])
    cases = {
        "sticking": p,
        "zero displacement": p._replace(displacement=np.zeros(2)),
        "no friction": p._replace(friction=np.asarray(0.0)),
        "no friction, straight": p._replace(friction=np.asarray(0.0), displacement=np.array([1e-3, 0.0])),
        "no friction through the center": p._replace(
            friction=np.asarray(0.0), point=np.array([-0.045, 0.0]), displacement=np.array([1e-3, 0.0])
        ),
        "grazing left": p._replace(displacement=np.array([0.0, 1e-3])),
        "grazing right": p._replace(displacement=np.array([0.0, -1e-3])),
        "almost grazing": p._replace(displacement=np.array([1e-9, 1e-3])),
        "receding": p._replace(displacement=np.array([-1e-3, 1e-4])),
        "on the left edge": p._replace(displacement=1e-3 * edges[0]),
        "on the right edge": p._replace(displacement=1e-3 * edges[1]),
        "through the center": p._replace(point=-0.05 * tilt, normal=tilt, displacement=1e-3 * tilt),
        "at the center": p._replace(point=np.zeros(2)),
        "huge H": p._replace(surface=high * p.surface),
        "tiny H": p._replace(surface=low * p.surface),
        "huge push": p._replace(displacement=1e6 * p.displacement),
        "tiny push": p._replace(displacement=1e-9 * p.displacement),
        "huge friction": p._replace(friction=np.asarray(1e4)),
        "sliding, huge H": p._replace(surface=high * p.surface, displacement=np.array([1e-3, 5e-3])),
        "sliding, tiny H": p._replace(surface=low * p.surface, displacement=np.array([1e-3, -5e-3])),
        "inactive": p._replace(active=np.asarray(False)),
        "gap as long as the push": p._replace(gap=p.displacement[0]),
        "overlap without a push": p._replace(gap=np.asarray(-1e-3), displacement=np.zeros(2)),
    }
    for at, name in enumerate(Problem._fields[:-1]):
        for bad in (np.nan, np.inf):
            value = p[at]
            broken = value.copy()
            broken[(0,) * value.ndim] = bad
            cases[f"{name} {bad}"] = p._replace(**{name: broken})
    cases["long normal"] = p._replace(normal=np.array([1.1, 0.0]))
    cases["no normal"] = p._replace(normal=np.zeros(2))
    cases["inactive padding"] = Problem(*(np.full_like(v, np.nan) for v in p[:-1]), np.asarray(False))._replace(
        surface=p.surface, length=p.length
    )
    cases["negative friction"] = p._replace(friction=np.asarray(-0.1))
    return {name: cast(case, dtype) for name, case in cases.items()}


@FLOATS
@pytest.mark.parametrize(("degree", "hessian"), [(2, False), (4, False), (4, True)])
def test_singular_cases_are_finite_and_named(degree, hessian, dtype):
    """Motions, and derivatives in both modes, are finite, and each case has its status."""
    cases = singular(degree, dtype)
    motion, forward, reverse = solve(stacked(cases.values()), hessian=hessian)

    def culprits(tree):
        leaves = [x.reshape(len(cases), -1) for x in jax.tree.leaves(tree)]
        ok = np.isfinite(np.concatenate(leaves, axis=1)).all(axis=1).tolist()
        return [name for name, fine in zip(cases, ok, strict=True) if not fine]

    assert not culprits((motion.twist, motion.wrench, motion.force))
    if not hessian:
        assert not culprits(forward)
        assert not culprits(reverse)

    status = dict(zip(cases, motion.status, strict=True))
    mode = dict(zip(cases, motion.mode[:, 0], strict=True))
    twist = dict(zip(cases, motion.twist, strict=True))
    free = {"zero displacement", "receding", "inactive", "inactive padding", "gap as long as the push"}
    free |= {"grazing left", "grazing right"}
    invalid = {"negative friction", "long normal", "no normal"}
    for name in cases:
        if name in invalid or name.split()[-1] in ("nan", "inf"):
            want = Status.INVALID
        else:
            want = Status.FREE if name in free else Status.MOVING
        assert status[name] == want, name
        if want != Status.MOVING:
            assert mode[name] == ContactMode.SEPARATED, name
            assert not twist[name].any(), name
    assert mode["almost grazing"] == ContactMode.SLIDING_LEFT
    assert mode["sticking"] == mode["huge H"] == mode["tiny H"] == mode["huge friction"] == ContactMode.STICKING
    assert mode["sliding, huge H"] == ContactMode.SLIDING_LEFT
    assert mode["sliding, tiny H"] == ContactMode.SLIDING_RIGHT
    eps = 10 * float(np.finfo(dtype).eps)
    for name in ("huge H", "tiny H"):
        np.testing.assert_allclose(twist[name], twist["sticking"], rtol=100 * eps, err_msg=name)
    np.testing.assert_allclose(twist["huge push"], 1e6 * twist["sticking"], rtol=100 * eps)
    np.testing.assert_allclose(twist["tiny push"], 1e-9 * twist["sticking"], rtol=100 * eps)


# --- derivatives ---

PER_MODE, DIRECTIONS, STEP = 16, 20, 1e-5


def random_changes(p: Problem, rng) -> Problem:
    """Return random changes of problems, in units of each input's size, so that derivatives are of order one."""
    count, size = len(p.gap), np.linalg.norm(p.displacement, axis=1)
    left = np.stack([-p.normal[:, 1], p.normal[:, 0]], axis=1)
    return Problem(
        p.surface * rng.normal(size=p.surface.shape),
        0 * p.length,
        0.05 * rng.normal(size=(count, 2)),
        rng.normal(size=(count, 1)) * left,
        size[:, None] * rng.normal(size=(count, 2)),
        rng.normal(size=count),
        size * rng.normal(size=count),
        None,
    )


def moved(p: Problem, changes: Problem, t) -> Problem:
    new = Problem(*(a + t * d for a, d in zip(p[:-1], changes[:-1], strict=True)), p.active)
    return new._replace(normal=new.normal / jnp.linalg.norm(new.normal, axis=-1, keepdims=True))


def scaled(parts, p: Problem) -> np.ndarray:
    """Return (twist, wrench, force) as (rows, 8), with lengths in units of the push."""
    unit = np.stack([np.ones_like(p.length)] * 2 + [p.length], axis=1)
    size = np.linalg.norm(p.displacement, axis=1, keepdims=True)
    return np.concatenate([parts[0] * unit / size, parts[1] / unit, parts[2]], axis=1)


@pytest.fixture(scope="module", params=[2, 4], ids=["degree 2", "degree 4"])
def smooth(request) -> tuple[Problem, np.ndarray]:
    """Return equally many moderately conditioned problems of each mode, and their modes.

    Some problems have a gap, some an overlap.
    """
    p = random_problems(request.param, seed=11, condition=30.0)
    gap = np.resize([0.0, 0.3, -0.2, 0.1], ROWS) * np.sum(p.displacement * p.normal, axis=1)
    p = p._replace(gap=gap)
    modes = solve(p).motion.mode[:, 0]
    chosen = np.concatenate([np.flatnonzero(modes == mode)[:PER_MODE] for mode in range(1, 4)])
    assert len(chosen) == 3 * PER_MODE
    return jax.tree.map(lambda x: x[chosen], p), modes[chosen]


def test_derivatives_match_central_differences(smooth, rng):
    """Forward derivatives agree with differences along random directions, and reverse derivatives with forward ones."""
    p, modes = jax.tree.map(lambda x: np.repeat(x, DIRECTIONS, axis=0), smooth)
    changes, weights = random_changes(p, rng), rng.normal(size=(len(modes), 8))
    alone = np.arange(len(modes)) % DIRECTIONS == 0  # the first direction of each problem is friction alone
    by_friction = Problem(*(0 * d for d in changes[:-1]), None)._replace(friction=np.ones(len(modes)))
    changes = jax.tree.map(
        lambda one, d: np.where(alone.reshape(-1, *[1] * (d.ndim - 1)), one, d), by_friction, changes
    )

    found = solve(p, changes, tuple(np.split(weights, [3, 6], axis=1)))
    ends = (solve(moved(p, changes, t)).motion for t in (STEP, -STEP))
    numeric = np.subtract(*(scaled((m.twist, m.wrench, m.force[:, 0]), p) for m in ends)) / (2 * STEP)
    forward = scaled(found.forward, p)
    scale = 1 + np.abs(numeric).reshape(3 * PER_MODE, -1).max(axis=1).repeat(DIRECTIONS)
    assert np.abs((forward - numeric) / scale[:, None]).max() < GRADIENT_TOLERANCE

    one = np.sum(weights * np.concatenate(found.forward, axis=1), axis=1)
    other = sum(
        np.sum(g * d, axis=tuple(range(1, g.ndim))) for g, d in zip(found.reverse[:-1], changes[:-1], strict=True)
    )
    size = np.sum(np.abs(weights * np.concatenate(found.forward, axis=1)), axis=1)
    assert np.all(np.abs(one - other) <= 1e-12 * scale * size)

    sticks = modes == ContactMode.STICKING
    assert not forward[alone & sticks].any()
    assert np.abs(forward[alone & ~sticks]).max(axis=1).min() > 1e-3


def test_the_motion_is_continuous_across_sticking_and_its_derivative_jumps():
    """By friction: twist and wrench are continuous, and constant once the contact sticks."""
    p = stacked([base(4)._replace(displacement=np.array([1e-3, 8e-4]))] * 101)
    along = Problem(*(0 * a for a in p[:-1]), None)._replace(friction=np.ones(101))
    weights = tuple(np.ones((101, size)) for size in (3, 3, 2))
    low, high = 0.0, 3.0  # slides, sticks
    for _ in range(6):  # refine the interval in which the mode changes
        mu = np.linspace(low, high, 101)
        motion, slope, _ = solve(p._replace(friction=mu), along, weights)
        change = int(np.argmax(motion.mode[:, 0] == ContactMode.STICKING))
        low, high = mu[change - 1], mu[change]
    assert high - low < 1e-11
    assert motion.mode[change - 1, 0] == ContactMode.SLIDING_LEFT
    value, slope = scaled((motion.twist, motion.wrench, motion.force[:, 0]), p)[:, :6], scaled(slope, p)[:, :6]
    np.testing.assert_allclose(value[change - 1], value[change], rtol=0, atol=1e-9)
    assert np.all(slope[change:] == 0)
    assert np.abs(slope[change - 1]).max() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("smooth", [4], indirect=True)
def test_second_derivatives_while_sticking(smooth, rng):
    """The implicit derivative is itself differentiable: compare `jax.hessian` with differences of the gradient."""
    problem, modes = smooth
    p = jax.tree.map(lambda x: x[modes == ContactMode.STICKING], problem)
    changes = [random_changes(p, rng) for _ in range(2)]

    def turn(by, p, changes):
        both = Problem(*(by[0] * a + by[1] * b for a, b in zip(*(c[:-1] for c in changes), strict=True)), None)
        return outcome(moved(p, both, 1))[0][0][2] * p.length / jnp.linalg.norm(p.displacement)

    curvature, gradient = (jax.jit(jax.vmap(d(turn), (None, 0, 0))) for d in (jax.hessian, jax.grad))
    exact = np.asarray(curvature(jnp.zeros(2), p, changes))
    ends = [[gradient(t * e, p, changes) for t in (STEP, -STEP)] for e in np.eye(2)]
    numeric = np.stack([(ahead - behind) / (2 * STEP) for ahead, behind in ends], axis=1)
    scale = 1 + np.abs(numeric).max(axis=(1, 2), keepdims=True)
    assert np.abs(numeric).max() > 1  # the curvature is not small, so an error would be seen
    assert np.abs((exact - numeric) / scale).max() < HESSIAN_TOLERANCE
    np.testing.assert_allclose(exact / scale, np.swapaxes(exact, 1, 2) / scale, rtol=0, atol=1e-10)


# --- bad input ---

GOOD = {
    "point": [[-0.045, 0.0]],
    "normal": [[1.0, 0.0]],
    "displacement": [[1e-3, 0.0]],
    "friction": 0.3,
    "gap": 0.0,
    "active": True,
}
BAD = [
    ({"point": [[np.nan, 0.0]]}, "point must be finite"),
    ({"displacement": [[np.inf, 0.0]]}, "displacement must be finite"),
    ({"friction": np.nan}, "friction must be finite"),
    ({"gap": -np.inf}, "gap must be finite"),
    ({"friction": -0.1}, "friction must not be negative"),
    ({"normal": [[2.0, 0.0]]}, "normal must have unit length"),
    ({"normal": [[0.0, 0.0]]}, "normal must have unit length"),
    ({"normal": [[np.nan, 0.0]]}, "normal must be finite"),
    ({"point": [-0.045, 0.0]}, "point has shape"),
    ({"point": [[-0.045, 0.0, 0.0]]}, "point has shape"),
    ({"normal": [1.0, 0.0]}, "normal has shape"),
    ({"displacement": [[1e-3, 0.0], [0.0, 0.0]]}, "displacement has shape"),
    ({"friction": [0.3, 0.3]}, "friction has shape"),
    ({"gap": [[0.0]]}, "gap has shape"),
    ({"active": [True, False]}, "active has shape"),
]


@pytest.mark.parametrize(("change", "message"), BAD, ids=[m + str(i) for i, (_, m) in enumerate(BAD)])
def test_contacts_refuse_bad_input(change, message):
    Contacts(**GOOD)
    with pytest.raises(ValueError, match=message):
        Contacts(**(GOOD | change))


def test_shapes_are_refused_while_traced_too():
    with pytest.raises(ValueError, match="normal has shape"):
        jax.jit(lambda n: Contacts(**(GOOD | {"normal": n})).gap)(jnp.ones(2))


# --- cones ---


def test_friction_cone_edges():
    edges = np.asarray(friction_cone([0.6, 0.8], 0.5))
    left = np.array([0.6, 0.8]) + 0.5 * np.array([-0.8, 0.6])
    np.testing.assert_allclose(edges[0], left / np.linalg.norm(left), rtol=1e-15)
    right = np.array([0.6, 0.8]) - 0.5 * np.array([-0.8, 0.6])
    np.testing.assert_allclose(edges[1], right / np.linalg.norm(right), rtol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(edges, axis=1), 1, rtol=1e-15)
    for arguments, message in (
        (([1.0, 0.0, 0.0], 0.5), "normal has shape"),
        (([1.0, 0.0], -0.5), "friction must not"),
        (([1.0, 0.0], [0.5]), "friction has shape"),
        (([np.nan, 0.0], 0.5), "normal must be finite"),
        (([3.0, 0.0], 0.5), "normal must have unit length"),
        (([1.0, 0.0], np.nan), "friction must be finite"),
    ):
        with pytest.raises(ValueError, match=message):
            friction_cone(*arguments)


@pytest.mark.parametrize("degree", [2, 4])
def test_pushes_stick_exactly_inside_the_motion_cone(degree):
    p = base(degree)
    edges = np.asarray(motion_cone(surface_of(p), p.point, p.normal, p.friction))
    np.testing.assert_allclose(np.linalg.norm(edges, axis=1), 1, rtol=1e-15)
    weight = 1e-6 * np.array([1, 1, -1, -1])[:, None]
    pushes = edges[[0, 1, 0, 1]] + weight * (edges[[1, 0, 1, 0]])
    modes = solve(stacked(p._replace(displacement=1e-3 * push) for push in pushes)).motion.mode[:, 0]
    expected = [ContactMode.STICKING, ContactMode.STICKING, ContactMode.SLIDING_LEFT, ContactMode.SLIDING_RIGHT]
    np.testing.assert_array_equal(modes, expected)


def test_motion_cone_refuses_bad_input():
    surface = Ellipsoid(np.eye(3), 0.03)
    for arguments, message in (
        (([0.0], [1.0, 0.0], 0.5), "point has shape"),
        (([0.0, 0.0], [2.0, 0.0], 0.5), "normal must have unit length"),
        (([0.0, 0.0], [1.0, 0.0], -0.5), "friction must not"),
        (([0.0, np.nan], [1.0, 0.0], 0.5), "point must be finite"),
    ):
        with pytest.raises(ValueError, match=message):
            motion_cone(surface, *arguments)


@pytest.mark.parametrize("wide", range(4))
def test_motion_cone_computes_in_the_widest_type_given(wide):
    """One argument in float64, also the friction, makes the result float64."""
    types = [jnp.float64 if k == wide else jnp.float32 for k in range(4)]
    surface = Ellipsoid(jnp.eye(3, dtype=types[0]), jnp.asarray(0.03, types[0]))
    values = ((0.02, -0.04), (0.0, 1.0), 0.25)
    arguments = [jnp.asarray(value, dtype) for value, dtype in zip(values, types[1:], strict=True)]
    assert motion_cone(surface, *arguments).dtype == jnp.float64
