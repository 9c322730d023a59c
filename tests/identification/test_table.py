"""Uneven tables: their effect on the limit surface, pushes on them, and their identification."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_identify import MU, RADIUS, expected, hand, planned, square  # noqa: F401

import pushjax as pj
from pushjax._math.vec import Vec3
from pushjax.friction.table import TransformedForm
from pushjax.geometry.se2 import compose, inverse

LENGTH = 0.05
RING = LENGTH * np.stack([np.cos(np.arange(400) * np.pi / 200), np.sin(np.arange(400) * np.pi / 200)], axis=1)


def quartic():
    points = np.array([[0.04, 0.0], [-0.01, 0.03], [-0.02, -0.04], [0.03, 0.03]])
    support = pj.Support.points(points, [1.0, 2.0, 1.5, 0.5])
    return pj.fit_limit_surface(*support.wrench_twist_pairs(jax.random.key(0), 200, length=LENGTH))


@pytest.mark.parametrize("kind", ["quartic", "ellipsoid"])
def test_form_is_of_one_polynomial(kind):
    """Gradient, Hessian and coefficients along a line agree with the value."""
    surface = quartic() if kind == "quartic" else pj.Ellipsoid(np.diag([1.0, 1.3, 0.8]), LENGTH)
    table = pj.Table(
        anisotropy=(0.2, -0.1), log_gradient=(3.0, -2.0), log_hessian=(20.0, 5.0, -10.0), origin=(0.1, 0.0)
    )
    form = TransformedForm(
        surface.form(), table.wrench_transform(Vec3(jnp.asarray(0.3), jnp.asarray(-0.1), jnp.asarray(0.7)), LENGTH)
    )
    f, b = jnp.array([0.4, -0.7, 0.5]), jnp.array([0.3, 0.2, -0.6])

    def value(f):
        return form.value(Vec3.of(f))

    np.testing.assert_allclose(form.gradient(Vec3.of(f)).array(), jax.grad(value)(f), rtol=1e-12)
    np.testing.assert_allclose(form.hessian(Vec3.of(f)).array(), jax.hessian(value)(f), atol=1e-12)
    c = form.restrict(Vec3.of(f), Vec3.of(b))
    assert len(c) == form.degree + 1
    for s in (-1.3, 0.4, 2.0):
        np.testing.assert_allclose(sum(each * s**k for k, each in enumerate(c)), value(f + s * b), rtol=1e-12)


def test_rising_friction_moves_the_pressure():
    """On a table whose friction rises to one side, a slider on its rim behaves as if it carried more load there."""
    twists = np.random.default_rng(0).normal(size=(300, 3)) / [1, 1, LENGTH]
    even = pj.Support.points(RING, np.full(400, 1 / 400))
    surface = pj.fit_limit_surface(*even.wrench_twist_pairs(jax.random.key(0), 400, length=LENGTH)).form()
    there = Vec3(*(jnp.zeros(()),) * 3)

    def astray(form, wrench):
        found = jax.vmap(lambda f: form.gradient(Vec3.of(f)).array())(wrench / jnp.array([[1, 1, LENGTH]]))
        real = twists * [1, 1, LENGTH]
        cos = np.sum(found * real, axis=1) / np.linalg.norm(found, axis=1) / np.linalg.norm(real, axis=1)
        return np.median(np.arccos(np.clip(cos, -1, 1)))

    off = []
    for rise in (4.0, 0.4):
        slope = np.array([rise, -rise / 2])
        weights = 1 + RING @ slope
        wrench = jax.vmap(pj.Support.points(RING, weights / weights.sum()).wrench)(jnp.asarray(twists))
        form = TransformedForm(surface, pj.Table(log_gradient=slope).wrench_transform(there, LENGTH))
        off.append((astray(form, wrench), astray(surface, wrench)))
    assert off[0][0] < off[0][1] / 3
    # for a small rise, the error of the fit itself remains
    assert off[1][0] < off[1][1]


def test_anisotropy_is_exact_for_translations():
    """For a slider that does not turn, friction |S f| <= 1 at every point makes it slip along S^2 f."""
    table = pj.Table(anisotropy=(0.3, 0.2))
    even = pj.Ellipsoid(np.eye(3), LENGTH).form()
    form = TransformedForm(even, table.wrench_transform(Vec3(*(jnp.zeros(()),) * 3), LENGTH))
    pull = 0.3, 0.2
    log = np.array([[pull[0], pull[1]], [pull[1], -pull[0]]])
    values, vectors = np.linalg.eigh(log)
    stretch = vectors @ np.diag(np.exp(-values)) @ vectors.T
    for angle in np.linspace(0, 3, 7):
        f = np.array([np.cos(angle), np.sin(angle)])
        g = form.gradient(Vec3.of(jnp.asarray([*f, 0.0]))).array()
        np.testing.assert_allclose(g[:2], 2 * stretch @ stretch @ f, rtol=1e-12)
    # along x it takes exp(2 g) times the force that it takes along y
    only = TransformedForm(even, pj.Table(anisotropy=(0.3, 0.0)).wrench_transform(Vec3(*(jnp.zeros(()),) * 3), LENGTH))
    along, across = (only.value(Vec3.of(jnp.asarray(f))) for f in ([1.0, 0, 0], [0, 1.0, 0]))
    assert np.sqrt(across / along) == pytest.approx(np.exp(0.6))


def push(table, pose, path, friction=0.3):
    slider = pj.Slider(pj.Disk(0.045), quartic())
    return pj.rollout(slider, pj.Hand.finger(RADIUS), path, pose=pose, friction=friction, table=table)


START = np.array([0.02, -0.01, 0.4])
PATH = np.linspace([-0.04, 0.0], [0.0, 0.03], 16)


def test_pushes_turn_with_the_world():
    """Table, slider and path rotated together give the same push; an even table has no effect, an uneven one has."""
    table = pj.Table(
        anisotropy=(0.3, -0.2), log_gradient=(4.0, 2.0), log_hessian=(10.0, -20.0, 15.0), origin=(0.01, 0.02)
    )
    here = push(table, START, PATH)
    assert not here.failed.any()
    even = push(None, START, PATH)
    np.testing.assert_allclose(push(pj.Table(), START, PATH).pose, even.pose, atol=1e-12)
    assert float(pj.deviation(here.pose[-1], even.pose[-1], LENGTH)) > 1e-3
    turn = np.array([0.3, -0.1, 1.1])
    c, s = np.cos(turn[2]), np.sin(turn[2])
    rotation = np.array([[c, -s], [s, c]])
    double = np.array([[np.cos(2 * turn[2]), -np.sin(2 * turn[2])], [np.sin(2 * turn[2]), np.cos(2 * turn[2])]])
    hess = rotation @ np.array([[10.0, 15.0], [15.0, -20.0]]) @ rotation.T
    there = pj.Table(
        double @ table.anisotropy, rotation @ table.log_gradient, (hess[0, 0], hess[1, 1], hess[0, 1]),
        rotation @ table.origin + turn[:2],
    )  # fmt: skip
    moved = push(there, compose(turn, START), PATH @ rotation.T + turn[:2])
    np.testing.assert_allclose(compose(inverse(turn), moved.pose), here.pose, atol=1e-10)


@pytest.mark.slow
def test_derivatives_and_bad_tables():
    """Derivatives by a table are right, also at an even one; a table that is not finite shows in the status."""

    def end(values):
        anisotropy, gradient, hessian = values[:2], 5 * values[2:4], 50 * values[4:7]
        return push(pj.Table(anisotropy, gradient, hessian), START, PATH).pose[-1]

    for at in (jnp.zeros(7), jnp.array([0.02, -0.01, 0.1, 0.2, -0.1, 0.1, 0.3])):
        forward = jax.jacfwd(end)(at)
        np.testing.assert_allclose(forward, jax.jacrev(end)(at), atol=1e-10)
        step = 1e-6
        for k in range(7):
            unit = step * jnp.eye(7)[k]
            np.testing.assert_allclose((end(at + unit) - end(at - unit)) / (2 * step), forward[:, k], atol=1e-7)
    with pytest.raises(ValueError, match="anisotropy has shape"):
        pj.Table(anisotropy=0.3)
    with pytest.raises(ValueError, match="log_gradient must be finite"):
        pj.Table(log_gradient=(np.nan, 0.0))
    with pytest.raises(TypeError, match="table"):
        push(0.3, START, PATH)
    broken = eqx.tree_at(lambda t: t.log_gradient, pj.Table(), jnp.array([jnp.nan, 0.0]))
    assert np.all(np.asarray(push(broken, START, PATH).status) == pj.Status.INVALID)
    np.testing.assert_array_equal(push(broken, START, PATH).pose[-1], START)


def test_float32_table():
    single = jax.tree.map(lambda x: x.astype(jnp.float32), pj.Table(anisotropy=(0.2, 0.1), log_gradient=(3.0, 1.0)))
    slider = pj.Slider(pj.Disk(0.045), quartic())
    cast = jax.tree.map(lambda x: x.astype(jnp.float32), (slider, pj.Hand.finger(RADIUS)))
    path, start = jnp.asarray(PATH, jnp.float32), jnp.asarray(START, jnp.float32)
    low = pj.rollout(*cast, path, pose=start, friction=jnp.float32(0.3), table=single)
    assert low.pose.dtype == jnp.float32
    high = push(pj.Table(anisotropy=(0.2, 0.1), log_gradient=(3.0, 1.0)), START, PATH)
    np.testing.assert_allclose(low.pose, high.pose, atol=2e-6)


@pytest.mark.slow
def test_found_again(square, expected, hand, tmp_path):  # noqa: F811
    """An uneven table, the offset of the frame, drift and sides are recovered from pushes simulated with them."""
    rng = np.random.default_rng(5)
    starts, paths = planned(rng, 120)
    age, side = np.linspace(0, 1, 120), rng.integers(3, size=120)
    table = pj.Table((0.1, -0.05), (2.0, -1.0), (10.0, -5.0, 8.0), origin=starts[:, :2].mean(axis=0))
    offset = np.array([0.001, -0.0007, 0.02])
    drift, sides = 0.3, np.array([0.2, -0.15, 0.1])
    mu = MU * np.exp(drift * age + sides[side])
    slider = pj.Slider(square, expected)

    @jax.jit
    @jax.vmap
    def ends(start, path, mu):
        run = pj.rollout(slider, hand, path, pose=compose(start, offset), friction=mu, table=table)
        return compose(run.pose[-1], inverse(offset))

    pushes = pj.Pushes(starts, paths, ends(starts, paths, mu), age=age, side=side)
    unknowns = pj.Unknowns(
        (0.0, 1.0),
        surface_dof=None,
        frame_offset=0.002,
        anisotropy=0.1,
        log_gradient=2.0,
        log_hessian=10.0,
        friction_drift=0.3,
        friction_by_side=0.3,
        sides=3,
    )
    found = pj.identify(pushes, slider, hand, unknowns, sigma=1e-5)
    own = found.parameters
    np.testing.assert_allclose(own.anisotropy, table.anisotropy, atol=1e-3)
    np.testing.assert_allclose(own.log_gradient, table.log_gradient, atol=0.02)
    np.testing.assert_allclose(own.log_hessian, table.log_hessian, atol=0.3)
    np.testing.assert_allclose(own.frame_offset, offset, atol=2e-5)
    np.testing.assert_allclose(own.friction_drift, drift, atol=5e-3)
    np.testing.assert_allclose(np.log(float(own.friction)) + own.friction_by_side, np.log(MU) + sides, atol=5e-3)
    predicted = found.predict(pushes, slider, hand)
    np.testing.assert_allclose(predicted.pose[:, -1], pushes.end, atol=1e-5)
    assert found.labels[-3:] == tuple(f"friction_by_side.{k}" for k in range(3))
    uneven = ["frame_offset", "anisotropy", "log_gradient", "log_hessian", "friction_drift", "friction_by_side"]
    assert set(found.interval()) == {"friction", *uneven}
    with pytest.raises(ValueError, match=f"corrected cannot represent {', '.join(uneven)};"):
        found.corrected(slider, hand, jnp.asarray(paths[0]))
    found.save(tmp_path / "found.json")
    again = pj.Identified.load(tmp_path / "found.json")
    assert jax.tree.structure(again) == jax.tree.structure(found)
    for one, other in zip(jax.tree.leaves(again), jax.tree.leaves(found), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_overlap_found_again(square, expected, hand):  # noqa: F811
    """For fingers logged to start up to 3 mm inside, the 70 % of that which is measurement error is recovered."""
    rng = np.random.default_rng(6)
    starts, paths = planned(rng, 60)
    into = np.diff(paths[:, :2], axis=1)[:, 0]
    into /= np.linalg.norm(into, axis=1)[:, None]
    paths = paths + rng.uniform(0, 0.004, 60)[:, None, None] * into[:, None]
    slider, share = pj.Slider(square, expected), 0.7

    @jax.jit
    @jax.vmap
    def ends(start, path):
        local = pj.se2.transform(pj.se2.inverse(start), path[0])
        distance, _, normal = square.closest(local)
        way = jnp.maximum(RADIUS - distance, 0) * pj.se2.transform(start.at[:2].set(0.0), normal)
        run = pj.rollout(slider, hand, path + share * way[None], pose=start, friction=MU)
        return run.pose[-1]

    pushes = pj.Pushes(starts, paths, ends(jnp.asarray(starts), jnp.asarray(paths)))
    found = pj.identify(pushes, slider, hand, pj.Unknowns((0.0, 1.0), surface_dof=None, overlap=0.5), sigma=1e-5)
    assert float(found.parameters.overlap) == pytest.approx(share, abs=2e-3)
    assert float(found.friction) == pytest.approx(MU, rel=1e-3)
    two = pj.Hand.two_fingers(RADIUS)
    wide = pj.Pushes(starts, jnp.zeros((*paths.shape[:2], two.dof)), starts)
    with pytest.raises(ValueError, match="overlap is for a single round finger; the hand has 2 fingers"):
        pj.identify(wide, slider, two, pj.Unknowns(overlap=0.5))
