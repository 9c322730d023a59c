"""The exact limit surface of support points: facets, other wrenches, derivatives; pushes on three and many feet."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import AS_USERS

import pushjax as pj
from pushjax.contact.near_contacts import solve_sliders
from pushjax.contact.sliders_problem import SlidersProblem
from pushjax.friction.feet import Feet
from pushjax.friction.support_points import SupportPoints
from pushjax.simulation.slider import Slider

SLOW = pytest.mark.slow
BOX = pj.Polygon.rectangle(0.09, 0.06)
FINGER = pj.Hand.finger(0.005)
PATH, ORIGIN = pj.line((-0.055, 0.0), (-0.04, 0.0), steps=4), (0.0, 0.0, 0.0)
TRIPOD = np.array([[-0.03, -0.02], [0.03, -0.02], [0.0, 0.025]])
solve = jax.jit(solve_sliders, compiler_options=AS_USERS)
patch = jax.jit(lambda point, limit, wrench: SupportPoints(point, limit).patch(wrench), compiler_options=AS_USERS)


def random_feet(count: int, seed: int, cases: int = 1000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, limits and wrenches, with the cases last."""
    rng = np.random.default_rng(seed)
    limit = rng.dirichlet(np.ones(count), cases).T
    return rng.uniform(-1, 1, (2, count, cases)), limit, rng.normal(size=(3, cases))


def missing_force(point, limit, gauge, twist, wrench, still=1e-8):
    """Return how far forces at the points are from a wrench of gauge one, by Coulomb's law at each of them."""
    velocity = np.stack([twist[0] - point[1] * twist[2], twist[1] + point[0] * twist[2]])
    speed = np.hypot(*velocity)
    slides = speed > still * np.max(speed, axis=0)
    force = np.where(slides, limit * velocity / np.where(slides, speed, 1.0), 0.0)
    x, y = point
    left = wrench / gauge - np.stack([*np.sum(force, axis=1), np.sum(x * force[1] - y * force[0], axis=0)])
    # a point that stands still takes what is left: a force at that point, up to its limit
    pivot, rows = np.argmin(speed, axis=0), np.arange(speed.shape[1])
    rests = ~slides[pivot, rows]
    arm = point[:, pivot, rows]
    torque = np.abs(left[2] - arm[0] * left[1] + arm[1] * left[0])
    beyond = np.maximum(torque, np.hypot(left[0], left[1]) - limit[pivot, rows])
    return np.where(rests, beyond, np.max(np.abs(left), axis=0)), rests


@pytest.mark.parametrize("count", [3, pytest.param(2, marks=SLOW), pytest.param(16, marks=SLOW)])
def test_every_wrench_has_its_twist(count):
    given = random_feet(count, count)
    gauge, twist, curvature = (np.asarray(x) for x in patch(*(jnp.asarray(x) for x in given)))
    point, limit, wrench = given
    off, rests = missing_force(point, limit, gauge, twist, wrench)
    assert 0.05 < rests.mean() < 0.9
    assert off.max() < 1e-9
    np.testing.assert_allclose(np.sum(wrench * twist, axis=0), gauge, rtol=1e-9)
    # the gauge grows in proportion to the wrench, and its normal changes across the wrench only
    np.testing.assert_allclose(np.einsum("ijb,jb->ib", curvature, wrench / gauge), 0, atol=1e-6)
    assert np.linalg.eigvalsh(np.moveaxis(curvature, 2, 0)).min() > -1e-6


def test_float32():
    given = random_feet(4, 5)
    gauge, twist, _ = (np.asarray(x, float) for x in patch(*(jnp.asarray(x, jnp.float32) for x in given)))
    exact, _, _ = (np.asarray(x) for x in patch(*(jnp.asarray(x) for x in given)))
    np.testing.assert_allclose(gauge, exact, rtol=2e-4)
    assert np.all(np.isfinite(twist))


def test_surface_of_feet(tmp_path):
    support = pj.Support.tripod(TRIPOD, load=2.0)
    surface = Slider.on(BOX, support, exact=True).surface
    assert isinstance(surface, Feet)
    np.testing.assert_allclose(surface.length, support.radius_of_gyration)
    surface.save(tmp_path / "feet.json")
    np.testing.assert_array_equal(pj.LimitSurface.load(tmp_path / "feet.json").form().limit, support.limit)
    for twist in np.array([[1.0, 0.3, 0.0], [0.2, -1.0, 30.0]]):
        wrench = surface.wrench(twist)
        np.testing.assert_allclose(wrench, support.wrench(twist), atol=1e-12)
        np.testing.assert_allclose(surface.value(wrench), 1.0, rtol=1e-9)
        np.testing.assert_allclose(surface.on_level_set(3 * wrench), wrench, rtol=1e-8)
        found = np.asarray(surface.twist(wrench))
        np.testing.assert_allclose(found / np.linalg.norm(found), twist / np.linalg.norm(twist), atol=1e-7)


def test_random_loads():
    """Each load has its mean, and a relative variance of 2 / dof."""
    surface = Slider.on(BOX, pj.Support.tripod(TRIPOD, load=2.0), exact=True).surface
    around = pj.FrictionModel(20.0, 0.3).around(surface)
    drawn = jax.vmap(lambda key: around.sample(key).surface)(jax.random.split(jax.random.key(0), 20_000))
    factor = np.asarray(drawn.limit / surface.limit[None])
    np.testing.assert_allclose(factor.mean(axis=0), 1, atol=0.01)
    np.testing.assert_allclose(factor.var(axis=0), 2 / 20, rtol=0.05)
    assert np.abs(np.corrcoef(factor.T) - np.eye(3)).max() < 0.03
    np.testing.assert_array_equal(drawn.length, np.full(20_000, surface.length))


@SLOW
def test_searches_that_start_near_end_where_others_do():
    for item in (jnp.float64, jnp.float32):
        for points in (2, 3, 16):
            place, limit, wrench = (jnp.asarray(x, item) for x in random_feet(points, 1000))
            _, normal, _ = patch(place, limit, wrench)
            for far in (1e-4, 1e-2, 0.1, 1.0):
                moved = wrench + far * jnp.asarray(np.random.default_rng(1).normal(size=wrench.shape), item)
                gauge = patch(place, limit, moved)[0]
                again = jax.jit(lambda *x: SupportPoints(x[0], x[1]).patch(x[2], x[3])[0])(place, limit, moved, normal)
                np.testing.assert_allclose(again, gauge, rtol=1e-12 if item == jnp.float64 else 2e-6)


@SLOW
def test_derivatives_are_those_of_differences():
    point, limit, wrench = (jnp.asarray(x[..., 0]) for x in random_feet(4, 8))
    # one wrench where all slide, and one on the facet of the first point
    pivot = jnp.stack([point[1, 0], -point[0, 0], jnp.ones(())])
    velocity = jnp.stack([pivot[0] - point[1] * pivot[2], pivot[1] + point[0] * pivot[2]])
    speed = jnp.hypot(*velocity)
    force = limit[None] * velocity / jnp.where(speed > 1e-9, speed, 1.0)[None]
    force = force.at[:, 0].set(0.3 * limit[0])
    facet = jnp.stack([*jnp.sum(force, axis=1), jnp.sum(point[0] * force[1] - point[1] * force[0])])
    for given in (wrench, facet):
        directions = [jnp.asarray(np.random.default_rng(k).normal(size=x.shape)) for k, x in enumerate((point, limit))]
        for inputs, changes in (((point, limit), directions), ((given,), [directions[1][:3]])):

            def found(t, inputs=inputs, changes=changes, given=given):
                moved = [x + t * d for x, d in zip(inputs, changes, strict=True)]
                support, force = (moved, given) if len(moved) == 2 else ((point, limit), moved[0])
                gauge, twist, _ = SupportPoints(*support).patch(force)
                return jnp.concatenate([gauge[None], twist])

            found = jax.jit(found)
            forward = jax.jvp(found, (jnp.zeros(()),), (jnp.ones(()),))[1]
            np.testing.assert_allclose(forward, (found(1e-6) - found(-1e-6)) / 2e-6, rtol=1e-4, atol=1e-5)
            np.testing.assert_allclose(jax.jacrev(found)(jnp.zeros(())), forward, rtol=1e-6, atol=1e-8)


@SLOW
@pytest.mark.parametrize("sticks", [True, False])
def test_contact_moves_with_least_dissipation(sticks):
    # a contact that sticks, or one without friction, does no work of its own
    point, limit, _ = random_feet(4, 11)
    rng = np.random.default_rng(12)
    cases = point.shape[2]
    angle, place = rng.uniform(-np.pi, np.pi, cases), rng.uniform(-1, 1, (2, cases))
    normal = np.stack([np.cos(angle), np.sin(angle)])
    tangent = np.stack([-normal[1], normal[0]])
    axes = (normal, tangent)
    rows = np.stack([np.stack([a[0], a[1], place[0] * a[1] - place[1] * a[0]]) for a in axes])[:, :, None, None]
    goal = np.stack([np.ones(cases), rng.uniform(-0.5, 0.5, cases)])[:, None]
    mu = np.full((1, cases), 1.0 if sticks else 0.0)
    support = SupportPoints(jnp.asarray(point)[:, :, None], jnp.asarray(limit)[:, None])
    problem = SlidersProblem(support, *(jnp.asarray(x) for x in (rows, goal, mu, mu >= 0)))
    motion = solve(problem)
    moves, found = np.asarray(motion.status) == pj.Status.MOVING, np.asarray(motion.twist)[:, 0]
    assert moves.mean() >= 0.998
    judged = moves & (np.asarray(motion.mode[0]) == pj.ContactMode.STICKING) if sticks else moves
    assert judged.mean() > 0.5

    def power(twist):
        velocity = np.stack([twist[0] - point[1] * twist[2], twist[1] + point[0] * twist[2]])
        return np.sum(limit * np.hypot(*velocity), axis=0)

    # no motion that the contact allows dissipates less
    for _ in range(200):
        omega, slip = rng.normal(size=(2, cases)) * 10 ** rng.uniform(-6, 1, cases)
        turn = np.stack([omega * place[1], -omega * place[0], omega])
        slide = np.concatenate([tangent * slip, np.zeros((1, cases))])
        other = power(found + turn + (0.0 if sticks else slide))
        assert np.all(~judged | (other >= power(found) * (1 - 1e-9)))


def push_of(surface) -> pj.Trajectory:
    return pj.rollout(Slider(BOX, surface), FINGER, PATH, pose=ORIGIN, friction=0.3)


def test_push_through_the_center_of_pressure_does_not_turn():
    support = pj.Support.tripod(TRIPOD)
    y = float(support.center[1])
    path = pj.line((-0.05, y), (0.0, y), steps=16)
    push = pj.rollout(Slider.on(BOX, support, exact=True), FINGER, path, pose=ORIGIN, friction=0.3)
    np.testing.assert_allclose(push.pose[-1], [0.05, 0.0, 0.0], atol=1e-9)


@SLOW
def test_slider_pivots_about_a_heavy_foot():
    support = pj.Support.points([[-0.02, 0.0], [0.03, 0.01], [0.02, -0.02]], [8.0, 1.0, 1.0])
    slider = Slider.on(BOX, support, exact=True)
    path = pj.line((0.04, -0.035), (0.04, -0.02), steps=32)
    push = pj.rollout(slider, FINGER, path, pose=ORIGIN, friction=0.5)
    np.testing.assert_array_equal(push.status, pj.Status.MOVING)
    x, y, angle = np.asarray(push.pose).T
    assert angle[-1] > 0.2
    # the foot stays where it is
    np.testing.assert_allclose(x - 0.02 * np.cos(angle), -0.02, atol=1e-6)
    np.testing.assert_allclose(y - 0.02 * np.sin(angle), 0.0, atol=1e-6)


def test_one_point_alone_is_refused():
    with pytest.raises(ValueError, match="all loads are on one point"):
        Slider.on(BOX, pj.Support.points([[0.0, 0.0], [0.1, 0.0]], [1.0, 0.0]), exact=True)


@SLOW
def test_one_point_alone_that_is_traced_is_invalid():
    status = jax.jit(lambda x: push_of(Feet(jnp.stack([jnp.zeros(2), x]), jnp.ones(2))).status)(jnp.zeros(2))
    assert set(np.asarray(status).tolist()) == {int(pj.Status.INVALID)}


def test_polynomials_are_asked_for_by_name():
    surface = Slider.on(BOX, pj.Support.tripod(TRIPOD), exact=True).surface
    with pytest.raises(TypeError, match="exact one of support points"):
        pj.rollout(Slider(BOX, surface), FINGER, PATH, pose=ORIGIN, friction=0.3, solver=pj.Exhaustive())
