"""Random contact problems: two independent solvers, and the laws that every answer obeys."""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pushjax import ContactMode, Contacts, Ellipsoid, HessianIteration, Quartic, Status, solve_contacts
from pushjax._math.vec import Vec2, Vec3
from pushjax.contact.contact_plane import Contact, LimitCurve
from pushjax.contact.paper import hessian_round
from pushjax.friction.quartic import QuarticForm
from pushjax.testing.problems import random_contact_problem, random_surface, squared_quadratics

# 20 000 problems, half of each degree.
COUNT = 10_000
FEW = 2000  # for the laws
# Between the ratios of the two solvers, times the condition of the limit curve.
RATIO_TOLERANCE = 1e-10
# Problems whose push is nearer than this (sine) to an edge of the motion cone may be on either side of it.
EDGE = 1e-9
# The same problem in another frame, unit or order: roundoff, times the condition (up to 1e3 for the Hessian).
EQUIVALENT = 1e-9
# The Hessian of the square has the square of the condition, up to 1e6, and more in its last digits.
SQUARED = 1e-7

CENTRAL_ROUNDS, MOST_ROUNDS = 8, 25


class Solved(NamedTuple):
    """Answers of both solvers to a random problem, in the contact plane."""

    mode: jax.Array
    other_mode: jax.Array
    status: jax.Array
    other_status: jax.Array
    ratio: jax.Array
    other_ratio: jax.Array
    condition: jax.Array  # of the limit curve's Hessian at the sticking force
    free: jax.Array  # (2,) force of the Hessian iteration, without any cone
    residual: jax.Array
    rounds: jax.Array
    friction: jax.Array


def contacts_of(p, gap=0.0) -> Contacts:
    return Contacts(p.point[None], p.normal[None], p.displacement[None], p.friction, gap)


def curve_of(p) -> tuple[LimitCurve, Vec2]:
    contact = Contact(Vec2.of(p.point), Vec2.of(p.normal), Vec2.of(p.displacement), p.friction, jnp.zeros(()))
    return LimitCurve.of(p.surface.form(), contact), contact.approach()


@jax.jit
@jax.vmap
def by_iteration(p):
    """Return modes, status, force, condition, and the force without any cone with its residual and rounds."""
    hessian = solve_contacts(p.surface, contacts_of(p), solver=HessianIteration())
    curve, v = curve_of(p)
    free, rounds, residual = HessianIteration().trace(curve, v)

    def h(f):
        return f[0] ** curve.degree * curve.value(f[1] / f[0])

    spectrum = jnp.linalg.eigvalsh(jax.hessian(h)(free.array()))
    return hessian.mode[0], hessian.status, hessian.force[0], spectrum[1] / spectrum[0], free.array(), residual, rounds


@eqx.filter_jit
def solve_all(p, gap):
    return jax.vmap(lambda q, g: solve_contacts(q.surface, contacts_of(q, g)))(p, gap)


@functools.cache
def problems(degree: int, count: int = COUNT):
    keys = jax.random.split(jax.random.key(degree), count)
    return jax.jit(jax.vmap(lambda key: random_contact_problem(key, degree=degree)))(keys)


@pytest.fixture(scope="module", params=[2, 4], ids=["ellipsoid", "quartic"])
def solved(request) -> Solved:
    p = problems(request.param)
    rows = [jax.tree.map(lambda x, k=k: x[k : k + FEW], p) for k in range(0, COUNT, FEW)]
    parts = [solve_all(part, jnp.zeros(FEW)) for part in rows]  # by the program of the laws below
    mode, status, force = (np.concatenate([getattr(m, name) for m in parts]) for name in ("mode", "status", "force"))
    other_mode, other_status, other_force, *rest = map(np.asarray, by_iteration(p))
    ratio, other_ratio = (f[:, 1] / np.where(f[:, 0] > 0, f[:, 0], 1.0) for f in (force[:, 0], other_force))
    friction = np.asarray(p.friction)
    return Solved(mode[:, 0], other_mode, status, other_status, ratio, other_ratio, *rest, friction)


def test_solvers_agree(solved):
    assert (solved.status == Status.MOVING).all()
    assert (solved.other_status == Status.MOVING).all()
    np.testing.assert_array_equal(solved.mode, solved.other_mode)
    sticks = solved.mode == ContactMode.STICKING
    assert 0.2 * COUNT < sticks.sum() < 0.8 * COUNT
    # a ratio s is tan(angle): as angles, large ratios have no more weight than small ones
    error = np.abs(np.arctan(solved.ratio) - np.arctan(solved.other_ratio))[sticks]
    assert (error <= RATIO_TOLERANCE * solved.condition[sticks]).all()


def test_modes_follow_from_the_force_free_of_any_cone(solved):
    """By convexity, the force without a cone is left of the friction cone where the pusher slides left.

    The motion rotates in the direction in which the force rotates. An iteration that does not use the cone therefore
    confirms the modes that are decided at the cone's edges.
    """
    fn, ft = solved.free.T
    lean = np.arctan2(ft, fn)
    cone = np.arctan(solved.friction)
    clear = np.abs(np.abs(lean) - cone) > EDGE * solved.condition
    assert clear.mean() > 0.99
    expected = np.where(lean > cone, ContactMode.SLIDING_LEFT, ContactMode.STICKING)
    expected = np.where(lean < -cone, ContactMode.SLIDING_RIGHT, expected)
    np.testing.assert_array_equal(solved.mode[clear], expected[clear])
    sticks = clear & (solved.mode == ContactMode.STICKING)
    error = np.abs(np.arctan(solved.ratio) - lean)[sticks]
    assert (error <= RATIO_TOLERANCE * solved.condition[sticks]).all()


def test_rounds_of_the_hessian_iteration(solved):
    assert np.percentile(solved.rounds, 99) <= CENTRAL_ROUNDS
    assert solved.rounds.max() < MOST_ROUNDS
    assert solved.residual.max() < 1e-12


def test_the_hessian_iteration_converges_quadratically():
    """From residuals r0, r1, r2 of successive iterations the order is log(r2 / r1) / log(r1 / r0)."""

    def residuals(p):
        curve, v = curve_of(p)
        unit = v.scale(1 / jnp.sqrt(v.dot(v)))

        def size(f):
            g = curve.motion(f.y / f.x).scale(f.x ** (curve.degree - 1))
            return jnp.sqrt((g - unit).dot(g - unit))

        def one_round(f, _):
            after = hessian_round(curve, unit, f)
            return after, size(after)

        return jax.lax.scan(one_round, hessian_round(curve, unit, unit), length=7)[1]

    r = np.asarray(jax.jit(jax.vmap(residuals))(problems(4)))
    r0, r1, r2 = r[:, :-2], r[:, 1:-1], r[:, 2:]
    # near the solution, but not yet at roundoff
    near = (r0 < 1e-2) & (r1 < 1e-1 * r0) & (r2 > 1e-12)
    order = np.log(r2[near] / r1[near]) / np.log(r1[near] / r0[near])
    assert len(order) > 500
    assert np.percentile(order, 1) > 1.8


@pytest.mark.parametrize("degree", [2, 4])
def test_random_problems_are_as_hard_as_stated(degree):
    """Problems are convex, the pushes press on the slider, and the conditions spread up to about the requested one."""
    p = problems(degree)
    assert (np.sum(np.asarray(p.normal) * np.asarray(p.displacement), axis=1) > 0).all()
    assert np.asarray(p.friction).min() >= 0
    assert 2.5 < np.asarray(p.friction).max() <= 3
    directions = jax.random.normal(jax.random.key(0), (300, 3))

    def condition(surface):
        one = jnp.ones_like(surface.length)
        scale = jnp.stack([one, one, surface.length])  # normalized wrenches to wrenches
        f = directions / jnp.linalg.norm(directions, axis=1, keepdims=True) * scale[None]
        hessian = jax.vmap(surface.hessian)(f) * (scale[:, None] * scale[None])[None]
        values = jnp.linalg.eigvalsh(hessian)
        return jnp.min(values), jnp.max(values) / jnp.min(values)

    lowest, worst = jax.jit(jax.vmap(condition))(jax.tree.map(lambda x: x[:500], p.surface))
    assert np.min(lowest) > 0
    assert 3e2 < np.max(worst) < 3e3
    assert np.min(worst) < 10


def test_random_surfaces_of_other_degrees_are_refused():
    with pytest.raises(ValueError, match="degree must be 2 or 4; got 3"):
        random_surface(jax.random.key(0), degree=3)


# --- laws ---


def some(degree: int):
    return jax.tree.map(lambda x: x[:FEW], problems(degree))


def answers(p, gap: Any = 0.0):
    """Return twist, wrench and force in numpy, and the modes."""
    m = solve_all(p, jnp.broadcast_to(gap, p.friction.shape))
    return tuple(np.asarray(x) for x in (m.twist, m.wrench, m.force[:, 0], m.mode[:, 0], m.status))


@eqx.filter_jit
def substituted(p, matrix):
    """Return the surfaces as functions of F, H'(F) = H(matrix F), by interpolation; matrix is (3, 3)."""
    if isinstance(p.surface, Ellipsoid):
        return jax.vmap(lambda a, length: Ellipsoid(matrix.T @ a @ matrix, length))(p.surface.A, p.surface.length)
    sample = jax.random.normal(jax.random.key(1), (40, 3))
    form = jax.vmap(lambda c: jax.vmap(lambda f: value15(c, f))(sample))(jnp.eye(15)).T  # (samples, 15)
    mapped = jax.vmap(lambda c: jax.vmap(lambda f: value15(c, matrix @ f))(sample))(jnp.eye(15)).T
    change = jnp.linalg.lstsq(form, mapped)[0]
    return jax.vmap(lambda c, length: Quartic(change @ c, length))(p.surface.coefficients, p.surface.length)


def value15(c, f):
    """Return H of a quartic with coefficients c, convex or not."""
    return QuarticForm(tuple(c), jnp.ones(())).value(Vec3.of(f))


SWAPPED = np.array([0, 1, 3, 2])


def close(a, b, size, tolerance=EQUIVALENT):
    error = np.linalg.norm(a - b, axis=1) / size
    assert error.max() < tolerance, error.max()


def size_of(p, twist):
    return np.linalg.norm(p.displacement, axis=1) + 0.05 * np.abs(twist[:, 2])


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("degree", [2, 4])
def test_turned_and_mirrored_frames(degree, mirrored):
    p, (c, s), side = some(degree), (np.cos(0.7), np.sin(0.7)), -1.0 if mirrored else 1.0
    turn = np.array([[c, -side * s], [s, side * c]])  # of vectors
    whole = np.block([[turn, np.zeros((2, 1))], [np.zeros((1, 2)), np.full((1, 1), side)]])  # of twists and wrenches
    q = p._replace(
        surface=substituted(p, jnp.asarray(whole.T)),  # H'(F) = H(R^-1 F)
        point=p.point @ turn.T,
        normal=p.normal @ turn.T,
        displacement=p.displacement @ turn.T,
    )
    a, b = answers(p), answers(q)
    np.testing.assert_array_equal(b[3], SWAPPED[a[3]] if mirrored else a[3])
    close(b[0], a[0] @ whole.T, size_of(p, a[0]))
    close(b[2], a[2] * [1, side], np.linalg.norm(a[2], axis=1))


@pytest.mark.parametrize("degree", [2, 4])
def test_moved_frame(degree):
    """Moving the origin by d changes torques by d x f, so H'(F) = H(T F); the motion of the point stays the same."""
    p, d = some(degree), np.array([0.03, -0.02])
    q = p._replace(point=p.point + jnp.asarray(d)[None])
    p = p._replace(surface=eqx.tree_at(lambda s: s.length, p.surface, jnp.asarray(np.full(FEW, 0.05))))
    shear = jnp.array([[1.0, 0, 0], [0, 1.0, 0], [d[1] / 0.05, -d[0] / 0.05, 1.0]])
    q = q._replace(surface=substituted(p, shear))
    a, b = answers(p), answers(q)
    np.testing.assert_array_equal(a[3], b[3])
    expected = np.stack([a[0][:, 0] + a[0][:, 2] * d[1], a[0][:, 1] - a[0][:, 2] * d[0], a[0][:, 2]], axis=1)
    close(b[0], expected, size_of(p, a[0]))
    close(b[2], a[2], np.linalg.norm(a[2], axis=1))


@pytest.mark.parametrize("degree", [2, 4])
def test_linear_in_the_displacement_and_forces_follow_the_scale_of_h(degree):
    p = some(degree)
    a, b = answers(p), answers(p._replace(displacement=37.0 * p.displacement))
    np.testing.assert_array_equal(a[3], b[3])
    close(b[0], 37 * a[0], 37 * size_of(p, a[0]))
    close(b[1], a[1], np.linalg.norm(a[1], axis=1))
    name = "A" if degree == 2 else "coefficients"
    surface = eqx.tree_at(lambda s: getattr(s, name), p.surface, 1e-9 * getattr(p.surface, name))
    b = answers(p._replace(surface=surface))
    np.testing.assert_array_equal(a[3], b[3])
    close(b[0], a[0], size_of(p, a[0]))
    close(b[2], a[2] * 1e9 ** (1 / degree), 1e9 ** (1 / degree) * np.linalg.norm(a[2], axis=1))


def test_quartic_of_a_squared_ellipsoid():
    """A squared ellipsoid has the same level set H = 1, so answers agree to roundoff of the 15 coefficients."""
    p = some(2)
    squared = jax.vmap(lambda a, length: Quartic(squared_quadratics(a[None]), length))(p.surface.A, p.surface.length)
    a, b = answers(p), answers(p._replace(surface=squared))
    np.testing.assert_array_equal(a[3], b[3])
    np.testing.assert_array_equal(a[4], b[4])
    close(b[0], a[0], size_of(p, a[0]), SQUARED)
    close(b[2], a[2], np.linalg.norm(a[2], axis=1), SQUARED)


# --- the gap ---


@pytest.mark.parametrize("degree", [2, 4])
def test_gap(degree):
    p = some(degree)
    forward = jnp.sum(p.displacement * p.normal, axis=1)
    size = np.linalg.norm(p.displacement, axis=1)

    away = answers(p._replace(displacement=-p.displacement))
    assert (away[3] == ContactMode.SEPARATED).all()
    assert (away[4] == Status.FREE).all()
    assert not any(x.any() for x in away[:3])

    short = answers(p, 1.001 * forward)  # the gap is not closed
    assert (short[4] == Status.FREE).all()
    assert not short[0].any()

    # only the rest of the approach pushes
    part = answers(p, 0.3 * forward)
    less = answers(p._replace(displacement=p.displacement - (0.3 * forward)[:, None] * p.normal))
    np.testing.assert_array_equal(part[3], less[3])
    close(part[0], less[0], size)

    # an overlap is pushed out by exactly its depth, also if the pusher recedes by half of it, or stands still
    point, normal = np.asarray(p.point), np.asarray(p.normal)
    for displacement in (p.displacement, 0 * p.displacement, -0.5 * forward[:, None] * p.normal):
        out = answers(p._replace(displacement=displacement), -forward)
        assert (out[4] == Status.MOVING).all()
        at = out[0][:, :2] + out[0][:, 2:] * np.stack([-point[:, 1], point[:, 0]], axis=1)
        gap_after = np.sum((at - np.asarray(displacement)) * normal, axis=1) - np.asarray(forward)
        assert np.abs(gap_after / size_of(p, out[0])).max() < 1e-12
