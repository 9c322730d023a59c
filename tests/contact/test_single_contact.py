"""One contact: recorded answers, singular cases, derivatives, bad input."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest

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
from pushjax.contact.sticking import ScalarRoot
from pushjax.testing.problems import random_contact_problem, random_surface

SOLVERS = (ScalarRoot(), HessianIteration())
DTYPES = (np.float64, np.float32)
FLOATS = pytest.mark.parametrize("dtype", DTYPES, ids=["float64", "float32"])
EITHER_SOLVER = pytest.mark.parametrize("solver", SOLVERS, ids=["root", "hessian"])

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


def surface_of(p: Problem):
    return (Ellipsoid if p.surface.shape[-2:] == (3, 3) else Quartic)(p.surface, p.length)


def coefficients_of(surface) -> jax.Array:
    return surface.A if isinstance(surface, Ellipsoid) else surface.coefficients


def contacts_of(p: Problem) -> Contacts:
    return Contacts(p.point[None], p.normal[None], p.displacement[None], p.friction, p.gap, p.active)


def motion_of(p: Problem, solver=None):
    return solve_contacts(surface_of(p), contacts_of(p), solver=solver)


@eqx.filter_jit
def motions(problems: Problem, solver=None):
    """A batch of problems through the public interface: vmapped over `Contacts` and surfaces."""
    surfaces, contacts = jax.vmap(surface_of)(problems), jax.vmap(contacts_of)(problems)
    return jax.vmap(lambda surface, contact: solve_contacts(surface, contact, solver=solver))(surfaces, contacts)


def cast(tree, dtype):
    def leaf(value):
        value = jnp.asarray(value)
        return value.astype(dtype) if jnp.issubdtype(value.dtype, jnp.floating) else value

    return jax.tree.map(leaf, tree)


def slips(problems: Problem, twist: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Relative motion of slider and pusher along normal and tangent: J V - displacement."""
    p = jax.tree.map(np.asarray, problems)
    moved = twist[:, :2] + twist[:, 2:] * np.stack([-p.point[:, 1], p.point[:, 0]], axis=1)
    w = moved - p.displacement
    tangent = np.stack([-p.normal[:, 1], p.normal[:, 0]], axis=1)
    return np.sum(w * p.normal, axis=1), np.sum(w * tangent, axis=1)


# --- recorded answers ---


@pytest.fixture(scope="module")
def recorded(oracle):
    """Return the recorded problems by degree, in our conventions, with true twist (normalized), wrench and mode."""
    d = np.load(oracle / "single_contact.npz")

    def column(name):
        return np.concatenate([d[name], d["adv_" + name]])

    kind = column("ls_type")
    assert len(kind) == 2142
    by_degree = {}
    for degree in (2, 4):
        rows = kind == (0 if degree == 2 else 1)
        count = int(rows.sum())
        problem = Problem(
            column("A" if degree == 2 else "coeffs")[rows],
            column("rho")[rows],
            column("point")[rows],
            -column("normal")[rows],
            column("vel")[rows],
            column("mu")[rows],
            np.zeros(count),
            np.ones(count, bool),
        )
        by_degree[degree] = (
            problem,
            column("V_true")[rows],
            column("F_true_level1")[rows],
            column("mode_true_id")[rows],
        )
    assert sum(len(v[3]) for v in by_degree.values()) == 2142
    return by_degree


@FLOATS
@EITHER_SOLVER
@pytest.mark.parametrize("degree", [2, 4])
def test_recorded_answers(recorded, degree, solver, dtype):
    problem, twist, wrench, mode = recorded[degree]
    motion = motions(cast(problem, dtype), solver)
    assert motion.twist.dtype == dtype
    np.testing.assert_array_equal(motion.mode[:, 0], mode)
    expected = np.where(mode == ContactMode.SEPARATED, Status.FREE, Status.MOVING)
    np.testing.assert_array_equal(motion.status, expected)

    length, speed = problem.length[:, None], np.linalg.norm(problem.displacement, axis=1)
    ours = np.asarray(motion.twist, np.float64) * np.concatenate([0 * length + 1, 0 * length + 1, length], axis=1)
    error = np.linalg.norm(ours - twist, axis=1) / speed
    assert error.max() < TWIST_TOLERANCE[dtype]

    moves = mode != ContactMode.SEPARATED
    ours = np.asarray(motion.wrench, np.float64) / np.concatenate([0 * length + 1, 0 * length + 1, length], axis=1)
    assert not ours[~moves].any()
    a, b = ours[moves], wrench[moves]
    angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))
    size = np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    np.testing.assert_allclose(size, 1, rtol=WRENCH_ANGLE[dtype])
    assert angle.max() < WRENCH_ANGLE[dtype]


@FLOATS
@EITHER_SOLVER
@pytest.mark.parametrize("degree", [2, 4])
def test_recorded_problems_satisfy_every_condition(recorded, degree, solver, dtype):
    """Check Coulomb's law, complementarity and dissipation from the numbers of the answer."""
    problem = cast(recorded[degree][0], dtype)
    motion = motions(problem, solver)
    p = jax.tree.map(lambda x: np.asarray(x, np.float64), problem)
    twist, wrench, force = (np.asarray(x, np.float64) for x in (motion.twist, motion.wrench, motion.force[:, 0]))
    fn, ft = force[:, 0], force[:, 1]
    eps = ROUNDING[dtype]

    # the force sums to the wrench
    f = fn[:, None] * p.normal + ft[:, None] * np.stack([-p.normal[:, 1], p.normal[:, 0]], axis=1)
    summed = np.concatenate([f, (p.point[:, :1] * f[:, 1:] - p.point[:, 1:] * f[:, :1])], axis=1)
    size = np.linalg.norm(f, axis=1, keepdims=True) + 1e-30
    assert np.max(np.abs(summed - wrench) / size) < eps

    # on the level set where the slider moves
    moves = np.asarray(motion.status) == Status.MOVING
    level = np.asarray(jax.jit(jax.vmap(lambda q, w: surface_of(q).value(w)))(problem, motion.wrench))
    assert np.max(np.abs(level[moves] - 1)) < 10 * eps

    # inside the cone, pushing, not penetrating
    assert np.all(fn >= 0)
    assert np.all(np.abs(ft) <= p.friction * fn * (1 + eps))
    speed = np.linalg.norm(p.displacement, axis=1)
    wn, wt = slips(p, twist)
    reach = speed + np.abs(twist[:, 2]) * np.linalg.norm(p.point, axis=1)  # size of the terms that cancel
    assert np.all(wn >= -eps * reach)
    assert np.all(np.abs(wn[moves]) <= eps * reach[moves])
    sticks = np.asarray(motion.mode[:, 0]) == ContactMode.STICKING
    assert np.all(np.abs(wt[sticks]) <= eps * reach[sticks])
    left = np.asarray(motion.mode[:, 0]) == ContactMode.SLIDING_LEFT
    right = np.asarray(motion.mode[:, 0]) == ContactMode.SLIDING_RIGHT
    assert left.any()
    assert right.any()
    assert np.all(wt[left] < 0)
    assert np.all(wt[right] > 0)
    np.testing.assert_allclose(ft[left], (p.friction * fn)[left], rtol=10 * eps)
    np.testing.assert_allclose(ft[right], -(p.friction * fn)[right], rtol=10 * eps)

    # friction takes power at the contact and under the slider
    assert np.all(-ft * wt >= -eps * np.abs(ft) * reach)
    assert np.all(np.sum(twist * wrench, axis=1)[moves] > 0)
    assert not twist[~moves].any()
    assert not force[~moves].any()


# --- singular cases ---

SCALES = {np.float64: (1e-60, 1e60), np.float32: (1e-14, 1e14)}


def base(degree: int) -> Problem:
    """Return a well-conditioned problem that sticks."""
    surface = random_surface(jax.random.key(3), degree=degree, condition=10.0, length=0.03)
    coefficients = coefficients_of(surface)
    f = jnp.asarray
    return Problem(
        f(coefficients, jnp.float64),
        f(0.03),
        f([-0.045, 0.02]),
        f([1.0, 0.0]),
        f([1e-3, 2e-4]),
        f(0.6),
        f(0.0),
        f(True),
    )


def singular(degree: int, dtype) -> dict[str, Problem]:
    """Return problems at the limits of the formulas' domain."""
    p = base(degree)
    edges = np.asarray(motion_cone(surface_of(p), p.point, p.normal, p.friction))
    low, high = SCALES[dtype]
    tilt = np.array([0.8, 0.6])
    p = Problem(*(np.asarray(value) for value in p))
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
    return {name: Problem(*(v.astype(dtype) if v.dtype != bool else v for v in case)) for name, case in cases.items()}


@eqx.filter_jit
def with_derivatives(problems: Problem, solver):
    """The motion, every forward derivative along ones, and every reverse derivative of the sum."""

    def outputs(p: Problem):
        m = motion_of(p, solver)
        return m.twist, m.wrench, m.force

    def one(p: Problem):
        floats, rest = eqx.partition(p, eqx.is_inexact_array)
        along = jax.tree.map(jnp.ones_like, floats)
        _, forward = jax.jvp(lambda q: outputs(eqx.combine(q, rest)), (floats,), (along,))
        value, pull = jax.vjp(lambda q: outputs(eqx.combine(q, rest)), floats)
        return motion_of(p, solver), forward, pull(jax.tree.map(jnp.ones_like, value))

    return jax.vmap(one)(problems)


@FLOATS
@pytest.mark.parametrize(("degree", "solver"), [(2, SOLVERS[0]), (4, SOLVERS[0]), (4, SOLVERS[1])])
def test_singular_cases_are_finite_and_named(degree, solver, dtype):
    cases = singular(degree, dtype)
    stacked = jax.tree.map(lambda *rows: jnp.asarray(np.stack(rows)), *cases.values())
    motion, forward, reverse = with_derivatives(stacked, solver)

    def culprits(tree):
        leaves = [np.asarray(x).reshape(len(cases), -1) for x in jax.tree.leaves(tree)]
        ok = np.isfinite(np.concatenate(leaves, axis=1)).all(axis=1).tolist()
        return [name for name, fine in zip(cases, ok, strict=True) if not fine]

    assert not culprits((motion.twist, motion.wrench, motion.force))
    assert not culprits(forward)
    assert not culprits(reverse)

    status = dict(zip(cases, np.asarray(motion.status), strict=True))
    mode = dict(zip(cases, np.asarray(motion.mode[:, 0]), strict=True))
    twist = dict(zip(cases, np.asarray(motion.twist), strict=True))
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

PER_MODE = 16


class Scaled(NamedTuple):
    """Changes of a problem in units of its own size, so that every derivative is of order one."""

    surface: jax.Array
    point: jax.Array
    angle: jax.Array
    displacement: jax.Array
    friction: jax.Array
    gap: jax.Array


def changed(p: Problem, by: Scaled) -> Problem:
    size = jnp.sqrt(jnp.sum(p.displacement**2))
    c, s = jnp.cos(by.angle), jnp.sin(by.angle)
    n = p.normal
    return p._replace(
        surface=p.surface * (1 + by.surface),
        point=p.point + 0.05 * by.point,
        normal=jnp.stack([c * n[0] - s * n[1], s * n[0] + c * n[1]]),
        displacement=p.displacement + size * by.displacement,
        friction=p.friction + by.friction,
        gap=p.gap + size * by.gap,
    )


def outputs(p: Problem, by: jax.Array) -> jax.Array:
    """Return twist, wrench and force, (8,), of a problem changed by a flat `Scaled`; lengths in units of the push."""
    blank = Scaled(jnp.zeros_like(p.surface), *(jnp.zeros_like(x) for x in (p.point, p.gap, p.point, p.gap, p.gap)))
    _, unflatten = jax.flatten_util.ravel_pytree(blank)
    m = motion_of(changed(p, unflatten(by)))
    unit = jnp.stack([jnp.ones_like(p.length), jnp.ones_like(p.length), p.length])
    return jnp.concatenate([m.twist * unit / jnp.sqrt(jnp.sum(p.displacement**2)), m.wrench / unit, m.force[0]])


value_batch = jax.jit(jax.vmap(outputs))


@jax.jit
@jax.vmap
def derivative_batch(p: Problem, by: jax.Array) -> tuple[jax.Array, jax.Array]:
    return jax.jacfwd(lambda b: outputs(p, b))(by), jax.jacrev(lambda b: outputs(p, b))(by)


STEP = 1e-5


def nearby(problems: Problem, size: int) -> tuple[Problem, jax.Array]:
    """Return every problem with every change of +STEP, then with every change of -STEP, for central differences."""
    count = len(problems.gap)
    changes = STEP * np.concatenate([np.eye(size), -np.eye(size)])
    return jax.tree.map(lambda x: jnp.repeat(x, 2 * size, axis=0), problems), jnp.asarray(np.tile(changes, (count, 1)))


def central(values: jax.Array, count: int) -> np.ndarray:
    """Return central differences, (problems, ..., changes), from the values at `nearby` problems."""
    plus, minus = np.split(np.asarray(values).reshape(count, -1, *values.shape[1:]), 2, axis=1)
    return np.moveaxis((plus - minus) / (2 * STEP), 1, -1)


@pytest.fixture(scope="module", params=[2, 4], ids=["ellipsoid", "quartic"])
def smooth(request) -> tuple[Problem, np.ndarray, int]:
    """Return equally many moderately conditioned problems of each mode, and the number of changes.

    Some problems have a gap, some an overlap.
    """
    degree = request.param

    @jax.jit
    @jax.vmap
    def draw(key, gap):
        p = random_contact_problem(key, degree=degree, condition=30.0, friction=1.0)
        surface = coefficients_of(p.surface)
        gap = gap * jnp.sum(p.displacement * p.normal)
        f = Problem(surface, p.surface.length, p.point, p.normal, p.displacement, p.friction, gap, jnp.asarray(True))
        return f, motion_of(f).mode[0]

    problems, modes = draw(jax.random.split(jax.random.key(11), 400), jnp.tile(jnp.array([0.0, 0.3, -0.2, 0.1]), 100))
    modes = np.asarray(modes)
    chosen = np.concatenate([np.flatnonzero(modes == mode)[:PER_MODE] for mode in range(1, 4)])
    assert len(chosen) == 3 * PER_MODE
    return jax.tree.map(lambda x: x[chosen], problems), modes[chosen], (9 if degree == 2 else 15) + 7


def test_derivatives_match_central_differences(smooth):
    problems, modes, size = smooth
    count = len(modes)
    # the same number as for the second derivatives, so that both tests share one compiled program
    tiled = jax.tree.map(lambda x: x[np.arange(2 * size * PER_MODE) % count], problems)
    jacobians = derivative_batch(tiled, jnp.zeros((2 * size * PER_MODE, size)))
    forward, reverse = (np.asarray(d)[:count] for d in jacobians)
    numeric = central(value_batch(*nearby(problems, size)), count)
    scale = 1 + np.abs(numeric).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(forward / scale, reverse / scale, rtol=0, atol=1e-12)
    assert np.abs((forward - numeric) / scale).max() < GRADIENT_TOLERANCE

    by_friction = forward[:, :, -2]
    sticks = modes == ContactMode.STICKING
    assert not by_friction[sticks].any()
    assert np.abs(by_friction[~sticks]).max(axis=1).min() > 1e-3


@pytest.mark.long
@pytest.mark.parametrize("smooth", [4], indirect=True, ids=["quartic"])
def test_second_derivatives_while_sticking(smooth):
    """The implicit derivative is itself differentiable: compare `jax.hessian` with differences of the gradient."""
    problems, modes, size = smooth
    sticking = jax.tree.map(lambda x: x[modes == ContactMode.STICKING], problems)
    zero = jnp.zeros(size)
    exact = np.asarray(jax.jit(jax.vmap(lambda p: jax.hessian(lambda by: outputs(p, by)[2])(zero)))(sticking))
    _, reverse = derivative_batch(*nearby(sticking, size))
    numeric = central(reverse[:, 2], PER_MODE)
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
    edges = motion_cone(surface_of(p), p.point, p.normal, p.friction)
    np.testing.assert_allclose(np.linalg.norm(edges, axis=1), 1, rtol=1e-15)
    middle = edges[0] + edges[1]
    weight = 1e-6
    pushes = jnp.stack(
        [
            (1 - weight) * edges[0] + weight * middle,
            (1 - weight) * edges[1] + weight * middle,
            (1 + weight) * edges[0] - weight * middle,
            (1 + weight) * edges[1] - weight * middle,
        ]
    )
    problems = jax.tree.map(lambda x: jnp.stack([x] * 4), p)._replace(displacement=1e-3 * pushes)
    modes = motions(problems).mode[:, 0]
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
