"""Random friction: moments, convexity and its certificate, derivatives, keys, bad input."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import pushjax as pj
from pushjax._math.vec import Vec3
from pushjax.friction.convexity import Gram, antisymmetric_of, coefficients_of, max_feasible_scale
from pushjax.friction.friction_model import FrictionModel
from pushjax.friction.quartic import MONOMIALS, least_curvature
from pushjax.friction.sum_of_squares import decompose, squared_quadratics
from pushjax.testing.convexity import least_curvatures

DRAWS = 20_000
# the programs of one dtype see nearly all that those of the other see
DTYPES = pytest.mark.parametrize("dtype", [pytest.param("float32", marks=pytest.mark.slow), "float64"])


@pytest.fixture(scope="module")
def quartic():
    """Return the quartic of a square on 64 points, as in the paper."""
    support = pj.Support.uniform(pj.Polygon.rectangle(0.09, 0.09), points=64)
    return pj.fit_limit_surface(*support.wrench_twist_pairs(jax.random.key(0), 400), degree=4)


around = jax.jit(lambda model, surface: model.around(surface))


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, 0))
def draw(distribution, key):
    drawn = distribution.sample(key)
    return drawn.surface.coefficients, drawn.shrinkage, drawn.surface.is_valid()


def sampled(model, surface, keys=None):
    """Return coefficients and shrinkage of `DRAWS` samples, and whether they are valid, all by the same programs."""
    keys = jax.random.split(jax.random.key(1), DRAWS) if keys is None else keys
    coefficients, shrinkage, valid = draw(around(model, surface), keys)
    return np.asarray(coefficients, float), np.asarray(shrinkage, float), np.asarray(valid)


def with_coefficients(surface, coefficients):
    """Return the quartic with coefficients that are checked no more than traced ones."""
    return eqx.tree_at(lambda s: s.coefficients, surface, jnp.asarray(coefficients, surface.length.dtype))


def test_a_gram_matrix_is_one(quartic, rng):
    """A Gram matrix represents H, and z' hess H(F) z / 12, for any N; coefficients and N can be recovered from it."""
    c = np.asarray(quartic.coefficients)
    n = rng.normal(size=6)
    gram = Gram.of(jnp.asarray(c), jnp.asarray(n))
    six, three = map(np.asarray, gram)
    for _ in range(5):
        f, z = rng.normal(size=(2, 3))
        products = np.array([f[0] ** 2, f[1] ** 2, f[2] ** 2, f[0] * f[1], f[0] * f[2], f[1] * f[2]])
        wrench = f * np.array([1, 1, quartic.length])
        assert products @ six @ products == pytest.approx(float(quartic.value(wrench)))
        s, a = (np.outer(z, f) + np.outer(f, z)) / 2, np.cross(z, f) / 2
        v = np.array([s[0, 0], s[1, 1], s[2, 2], s[0, 1], s[0, 2], s[1, 2]])
        assert v @ six @ v + a @ three @ a == pytest.approx(
            z @ np.asarray(quartic.form().hessian(Vec3(*f)).array()) @ z / 12
        )
    np.testing.assert_allclose(coefficients_of(gram.symmetric), c, rtol=1e-12)
    np.testing.assert_allclose(antisymmetric_of(gram.symmetric), three, rtol=1e-10, atol=1e-12)


@pytest.mark.slow
def test_certificate_agrees_with_the_sweep(quartic):
    """The certificate agrees with the sweep on Wishart samples before repair, and on the repaired quartics."""
    c, pull, _ = sampled(FrictionModel(dof=12, friction=0.3), quartic)
    c, pull = c[:400], pull[:400, None]
    raw = (c - pull * np.asarray(quartic.coefficients)) / (1 - pull)
    curvature = np.array([least_curvature(x) for x in raw])
    assert 0.02 < np.mean(pull > 0) < 0.4
    assert np.all(curvature[pull[:, 0] == 0] >= -1e-9)
    # the search may end a thousandth short, so only pulls larger than this prove that a sample is not convex
    assert np.all(curvature[pull[:, 0] > 2e-3] < 0)
    assert np.all(least_curvatures(c) >= -1e-9)


@pytest.mark.parametrize(
    ("sampler", "dtype"),
    [
        pytest.param("gram", "float32", marks=pytest.mark.slow),
        pytest.param("gram", "float64", marks=pytest.mark.slow),
        ("sum_of_squares", "float32"),
        pytest.param("sum_of_squares", "float64", marks=pytest.mark.slow),
    ],
)
def test_samples_are_convex_around_their_mean(quartic, sampler, dtype):
    surface = jax.tree.map(lambda leaf: leaf.astype(dtype), quartic)
    mean = np.asarray(surface.coefficients, float)
    rays = np.random.default_rng(0).normal(size=(1000, 3))
    products = np.prod(rays[:, None] ** MONOMIALS, axis=2)
    for dof in (10, 20, 50, 250):
        c, pull, _ = sampled(FrictionModel(dof=np.float32(dof), friction=0.3, sampler=sampler), surface)
        # in float32 a coefficient is rounded, which also moves the boundary of convexity
        assert np.all(least_curvatures(c[:5000]) >= (-1e-9 if dtype == "float64" else -3e-7))
        raw = (c - pull[:, None] * mean) / (1 - pull[:, None])
        error = raw.std(axis=0) / np.sqrt(DRAWS)
        assert np.all(np.abs(raw.mean(axis=0) - mean) < 4.5 * error)
        if sampler == "sum_of_squares":
            assert not pull.any()
        # The relative variance of H is 2 / n: along every ray for "gram", in the mean over rays for "sum_of_squares".
        values = raw @ products.T
        relative = values.var(axis=0) / values.mean(axis=0) ** 2
        if sampler == "gram":
            np.testing.assert_allclose(relative, 2 / dof, rtol=0.1)
        assert relative.mean() == pytest.approx(2 / dof, rel=0.04)


def test_the_sweep_of_many_agrees_with_that_of_one(rng):
    c = np.array([1, 1, 1, 0, 0, 0, 0, 0, 0, 2, 2, 2, 0, 0, 0.0]) + 0.8 * rng.normal(size=(200, 15))
    many, one = least_curvatures(c), np.array([least_curvature(x) for x in c])
    assert 0.2 < np.mean(many < 0) < 0.9
    np.testing.assert_array_equal(many < -1e-9, one < -1e-10)


def test_moments_of_the_ellipsoid(rng):
    root = rng.normal(size=(3, 3))
    mean, n = root @ root.T + np.eye(3), 12.0
    model = FrictionModel(dof=n, friction=0.3).around(pj.Ellipsoid(mean, 0.03))
    drawn = np.asarray(jax.jit(jax.vmap(model.sample))(jax.random.split(jax.random.key(0), 200_000)).surface.A)
    variance = (mean**2 + np.outer(np.diag(mean), np.diag(mean))) / n
    assert np.all(np.abs(drawn.mean(axis=0) - mean) < 4.5 * np.sqrt(variance / len(drawn)))
    np.testing.assert_allclose(drawn.var(axis=0), variance, rtol=0.03)
    assert np.all(np.linalg.eigvalsh(drawn) > 0)


def test_decomposition_of_a_quartic_on_the_border():
    """x^4 + y^4 + z^4 has many flat places: any further and it is not convex."""
    c = jnp.array([1.0, 1, 1] + [0.0] * 12)
    lower, error = jax.jit(decompose)(c)
    np.testing.assert_allclose(squared_quadratics(lower @ jnp.swapaxes(lower, 1, 2)), c, atol=2 * error)


@DTYPES
def test_samples_around_means_on_the_border_are_convex(quartic, dtype):
    """They are pulled toward a quartic that is convex up to roundoff, although the mean has no curvature somewhere."""
    surface = jax.tree.map(lambda leaf: leaf.astype(dtype), quartic)
    for c in ([1.0, 1, 0], [1.0, 1, 1], [0, 0, 1.0]):
        mean = with_coefficients(surface, [*c, *[0.0] * 12])
        coefficients, pull, _ = sampled(FrictionModel(dof=np.float32(20), friction=0.3), mean)
        assert np.all(np.isfinite(coefficients))
        assert np.all(pull <= 1)
        assert np.mean(pull > 0) > 0.02
        assert np.all(least_curvatures(coefficients[:300]) >= (-1e-9 if dtype == "float64" else -3e-7))


def test_means_without_a_gram_matrix_and_too_few_degrees_of_freedom_give_invalid_steps(quartic):
    """They can only be traced. No surface is sampled that is not convex without a sign of it."""
    model = FrictionModel(dof=np.float32(20), friction=0.3)
    flat = [1e-9, 1e-9, 1e-9, 1.0, *np.zeros(11)]
    for c in (flat, -np.asarray(quartic.coefficients), np.full(15, np.nan), np.zeros(15)):
        coefficients, _, valid = sampled(model, with_coefficients(quartic, c))
        assert np.all(np.isnan(coefficients))
        assert not valid.any()
    for dof, enough in ((4.0, False), (5.0, False), (9.0, True)):
        few = eqx.tree_at(lambda m: m.dof, model, jnp.float32(dof))
        coefficients, _, valid = sampled(few, quartic)
        assert np.all(np.isfinite(coefficients) == enough)
        assert np.all(valid == enough)


def test_a_sample_beyond_the_search_is_the_mean(quartic):
    """A sample so far from convex that no candidate of the search is feasible is replaced, and says so."""
    distribution = around(FrictionModel(dof=np.float32(20), friction=0.3), quartic)
    far = eqx.tree_at(
        lambda d: (d.factor, d.loading), distribution, (0 * distribution.factor, 0 * distribution.loading - 1e9)
    )
    coefficients, shrinkage, _ = draw(far, jax.random.split(jax.random.key(0), DRAWS))
    assert np.all(shrinkage == 1)
    np.testing.assert_allclose(coefficients[0], quartic.coefficients, atol=1e-5)


def test_derivative_by_dof_is_that_of_the_quantile():
    """The derivative by dof is that of the quantile: A_11 = a chi2(n) / n at a fixed probability."""
    surface, n = pj.Ellipsoid(2 * np.eye(3), 0.03), 7.5

    def drawn(dof, key):
        return FrictionModel(dof=dof, friction=0.3).sample(key, surface)[0].A[0, 0]

    keys = jax.random.split(jax.random.key(5), 50)
    value, slope = jax.jit(jax.vmap(jax.value_and_grad(drawn), in_axes=(None, 0)))(n, keys)
    probability, h = scipy.stats.chi2.cdf(np.asarray(value) * n / 2, n), 1e-3
    above, below = (2 * scipy.stats.chi2.ppf(probability, n + d) / (n + d) for d in (h, -h))
    np.testing.assert_allclose(slope, (above - below) / (2 * h), rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize(("sampler", "dtype"), [("gram", "float64"), ("sum_of_squares", "float32")])
def test_derivatives(quartic, sampler, dtype):
    """Derivatives by dof, friction range and mean surface agree, averaged over samples, with those of the moments."""
    surface = jax.tree.map(lambda leaf: leaf.astype(dtype), quartic)
    wrench = jnp.asarray([0.3, -0.2, 0.01], dtype)
    level = surface.value(wrench)

    def values(dof, low, scale, key):
        """Return H along a ray, relative to that of the mean; its square; and mu."""
        mean = pj.Quartic(scale * surface.coefficients, surface.length)
        model = FrictionModel(dof=dof, friction=jnp.stack([low, low + 0.2]), sampler=sampler)
        noisy, mu = model.sample(key, mean)
        h = noisy.value(wrench) / level
        return jnp.stack([h, h * h, mu])

    at, n = tuple(jnp.asarray(x, dtype) for x in (150.0, 0.1, 1.0)), 2000  # at this dof no sample is repaired
    keys = jax.random.split(jax.random.key(3), n)
    slopes = jax.jit(jax.vmap(jax.jacrev(values, argnums=(0, 1, 2)), in_axes=(None, None, None, 0)))(*at, keys)
    by_dof, by_low, by_scale = (np.asarray(slope) for slope in slopes)
    assert by_dof.dtype == by_low.dtype == by_scale.dtype == dtype
    assert np.isfinite([by_dof, by_low, by_scale]).all()

    def agrees(slope, expected):
        assert abs(slope.mean() - expected) < 4.5 * slope.std() / np.sqrt(n)

    agrees(by_dof[:, 0], 0.0)
    if sampler == "gram":
        agrees(by_dof[:, 1], -2 / 150**2)
        agrees(by_scale[:, 1], 2 * (1 + 2 / 150))
    else:
        assert by_dof[:, 1].mean() < -1 / 150**2
    agrees(by_scale[:, 0], 1.0)
    np.testing.assert_allclose(by_low[:, 2], 1, rtol=1e-6)
    assert not by_low[:, :2].any()
    assert not by_scale[:, 2].any()


def test_keys(quartic):
    """The same key gives the same bits, also in another batch."""
    model = FrictionModel(dof=np.float32(20), friction=(0.15, 0.35))
    keys = jax.random.split(jax.random.key(0), DRAWS)
    many, again, back = (sampled(model, quartic, k)[0] for k in (keys, keys, keys[::-1]))
    np.testing.assert_array_equal(many, again)
    np.testing.assert_array_equal(many, back[::-1])
    surface = pj.Ellipsoid(np.diag([1.0, 2.0, 3.0]), 0.03)
    a, mu = jax.jit(jax.vmap(lambda k: model.sample(k, surface)))(keys[:5])
    assert len(np.unique(np.asarray(mu))) == 5
    assert np.all((np.asarray(mu) >= 0.15) & (np.asarray(mu) <= 0.35))
    # the sampled surface is that of `around` for the first half of the key
    alone = jax.jit(lambda k: (model.sample(k, surface), model.around(surface).sample(jax.random.split(k)[0]).surface))
    (one, its), same = alone(keys[2])
    np.testing.assert_allclose(one.A, a.A[2], rtol=1e-12)
    np.testing.assert_allclose(its, mu[2], rtol=1e-12)
    np.testing.assert_allclose(same.A, one.A, rtol=1e-12)


def test_nothing_random():
    surface = pj.Ellipsoid(np.eye(3), 0.03)
    same, mu = FrictionModel(dof=None, friction=0.3).sample(jax.random.key(0), surface)
    np.testing.assert_array_equal(same.A, surface.A)
    assert mu == pytest.approx(0.3)


def test_bad_input(quartic):
    for dof, message in (
        (2.0, "dof must be at least 3"),
        (np.nan, "dof must be finite"),
        ([1.0, 2.0], "dof has shape"),
    ):
        with pytest.raises(ValueError, match=message):
            FrictionModel(dof=dof, friction=0.3)
    for friction, message in (
        ((0.4, 0.2), r"friction must be \(lowest, highest\); got \(0.4, 0.2\)"),
        (-0.1, "friction must not be negative"),
        ((0.1, 0.2, 0.3), "friction has shape"),
        (np.inf, "friction must be finite"),
    ):
        with pytest.raises(ValueError, match=message):
            FrictionModel(dof=20, friction=friction)
    with pytest.raises(ValueError, match="sampler must be 'gram' or 'sum_of_squares'"):
        FrictionModel(dof=20, friction=0.3, sampler="wishart")
    with pytest.raises(ValueError, match="dof must be at least 9, the size of a quartic's Gram matrix; got 5"):
        FrictionModel(dof=5, friction=0.3).sample(jax.random.key(0), quartic)


def test_a_mean_that_is_singular_up_to_roundoff():
    almost_one = 1 - np.finfo(np.float32).eps
    matrix = np.array([[1, almost_one, 0], [almost_one, 1, 0], [0, 0, 1]], np.float32)
    model = FrictionModel(dof=20, friction=0.3)
    with pytest.raises(ValueError, match="surface: A is singular up to roundoff"):
        model.around(pj.Ellipsoid(matrix, np.float32(0.03)))
    traced = jax.jit(lambda a: model.sample(jax.random.key(0), pj.Ellipsoid(a, np.float32(0.03)))[0].A)(matrix)
    assert np.isnan(traced).all()


def test_largest_share_of_itself(quartic):
    """All of a Gram matrix can be subtracted from itself, exactly; of the ball's, a positive multiple."""
    c, ball = quartic.coefficients / quartic.coefficients[0], jnp.array([0.2, 0.2, 0.2, 0, 0, 0])
    gram = Gram.of(c, ball)
    one = max_feasible_scale(gram, Gram.identity(c.dtype), enough=np.inf, tolerance=1e-6)
    assert one.converged
    assert one.scale > 0
    again = max_feasible_scale(gram, Gram.of(c, ball + one.change), enough=np.inf, tolerance=1e-6)
    assert float(again.scale) == pytest.approx(1.0, abs=1e-5)


@DTYPES
def test_the_largest_scale_is_that_of_an_eigenvalue(dtype, rng):
    """It is proved by the Gram matrix, in batches of batches; minus infinity if there is none."""
    c = np.array([1, 1, 1, 0, 0, 0, 0, 0, 0, 2, 2, 2, 0, 0, 0.0]) + 0.4 * rng.normal(size=(2, 150, 15))
    c[0, 0] = 1e9 * c[0, 0] * (-1) ** np.arange(15)
    c, ball = jnp.asarray(c, dtype), jnp.array([0.2, 0.2, 0.2, 0, 0, 0], dtype)
    tolerance = 1e-6 if dtype == "float64" else 1e-3  # less is roundoff

    @jax.jit
    def search(c, enough=np.inf):
        def one(c):
            return max_feasible_scale(Gram.of(c, ball), Gram.identity(dtype), enough=enough, tolerance=tolerance)

        return jax.vmap(jax.vmap(one))(c)

    found = search(c)
    assert found.scale.dtype == found.change.dtype == dtype
    assert found.scale[0, 0] == -np.inf
    assert not found.converged[0, 0]
    scale, change = np.asarray(found.scale).ravel()[1:], np.asarray(found.change).reshape(-1, 6)[1:]
    assert np.mean(np.asarray(found.converged)) > 0.99
    assert 0.1 < np.mean(scale > 0) < 0.9
    root = np.sqrt([1, 1, 1, 2, 2, 2])  # of the identity
    for k in range(20):
        gram = Gram.of(c.reshape(-1, 15)[1 + k], ball + change[k])
        six, three = np.asarray(gram.symmetric) / np.outer(root, root), np.asarray(gram.antisymmetric) / 2
        least = min(np.linalg.eigvalsh(six)[0], np.linalg.eigvalsh(three)[0])
        assert scale[k] - 1e-6 < least < scale[k] + tolerance
    # where zero is enough, the search stops at once or as soon as it is reached
    np.testing.assert_array_equal(search(c, 0.0).scale >= 0, found.scale >= 0)


def test_traced_degrees_of_freedom_that_are_too_few_give_invalid_steps():
    """They cannot be checked. Each push of a batch says so itself, and its pose stays where it was."""
    block, surface = pj.Polygon.rectangle(0.09, 0.09), pj.Ellipsoid(np.eye(3), 0.03)
    slider, hand, path = pj.Slider(block, surface), pj.Hand.finger(0.005), pj.line((-0.06, 0.012), (-0.04, 0.012), 4)

    def push(dof):
        model = FrictionModel(dof, 0.3)
        return pj.random_rollout(jax.random.key(0), slider, hand, path, pose=jnp.zeros(3), model=model).push

    both = jax.jit(jax.vmap(push))(jnp.array([1.0, 20.0]))
    few, enough = (jax.tree.map(lambda leaf, k=k: leaf[k], both) for k in (0, 1))
    assert np.all(few.status == pj.Status.INVALID)
    np.testing.assert_array_equal(few.pose, np.zeros((5, 3)))
    assert not np.any(enough.status == pj.Status.INVALID)
    assert np.any(enough.pose[-1] != 0)
