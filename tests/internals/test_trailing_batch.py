import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pushjax._internal.trailing_batch import with_batch_last


def energy(matrix, vector, factor):
    image = jnp.sum(matrix * jnp.sin(vector)[None], axis=1)
    return image, jnp.sum(image * image, axis=0) * factor


def objective(function):
    def value(matrix, vector, factor):
        image, square = function(matrix, vector, factor)
        return image[0] * square + square**2

    return value


def nested(function):
    """`function` for a batch of five vectors by four, of which each of the four has a factor of its own."""
    return jax.vmap(jax.vmap(function, in_axes=(None, 0, 0)), in_axes=(None, 0, None))


TRANSFORMS = {
    "values": nested,
    "vmap of grad": lambda f: nested(jax.grad(f, argnums=(0, 1, 2))),
    "grad of vmap": lambda f: jax.grad(lambda *args: jnp.sum(nested(f)(*args)), argnums=(0, 1, 2)),
    "jacfwd": lambda f: nested(jax.jacfwd(f, argnums=(0, 1))),
    "vmap of hessian": lambda f: nested(jax.hessian(f, argnums=(0, 1))),
    "hessian of vmap": lambda f: jax.hessian(lambda *args: jnp.sum(nested(f)(*args)), argnums=1),
    "jacrev of jacrev": lambda f: nested(jax.jacrev(jax.jacrev(f, argnums=1), argnums=0)),
    "jit of checkpoint": lambda f: jax.jit(nested(jax.grad(jax.checkpoint(f), argnums=1))),
    "scan": lambda f: jax.grad(
        lambda matrix, vector, factor: jnp.sum(
            jax.lax.scan(
                lambda total, _: (total + nested(f)(matrix, vector + total[..., None], factor), None),
                jnp.zeros(vector.shape[:2]),
                length=3,
            )[0]
        ),
        argnums=(0, 1, 2),
    ),
}


@pytest.mark.parametrize("transform", TRANSFORMS)
def test_function_with_the_batch_last_is_that_of_single_examples(transform):
    rng = np.random.default_rng(0)
    args = [jnp.asarray(rng.normal(0, 0.4, shape)) for shape in [(3, 3), (5, 4, 3), (4,)]]
    of = TRANSFORMS[transform]
    # values op by op too; the rest compiled, which takes a third of the time
    way = jax.jit if transform != "values" else lambda f: f
    expected = way(of(objective(energy)))(*args)
    found = way(of(objective(lambda *args: with_batch_last(energy, *args))))(*args)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=2e-4, atol=2e-5)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_results_that_depend_on_nothing_have_the_batch_too(size):
    vectors = jnp.arange(3.0 * size).reshape(size, 3)
    fixed, twice = jax.vmap(lambda v: with_batch_last(lambda v: (jnp.array([1.0, 2.0, 3.0]), 2 * v), v))(vectors)
    np.testing.assert_array_equal(fixed, np.tile([1.0, 2.0, 3.0], (size, 1)))
    np.testing.assert_array_equal(twice, 2 * vectors)


def test_integer_arguments_and_linear_transposes():
    def function(vector, number):
        return jnp.where(number > 0, 3 * vector, vector)

    vectors, numbers = jnp.ones((2, 3)), jnp.array([0, 1])
    slopes = jax.vmap(jax.grad(lambda v, k: jnp.sum(with_batch_last(function, v, k))))(vectors, numbers)
    np.testing.assert_array_equal(slopes, [[1.0] * 3, [3.0] * 3])
    both = jax.linear_transpose(lambda a, b: with_batch_last(lambda a, b: 2 * a, a, b), vectors[0], vectors[0])
    np.testing.assert_array_equal(jnp.stack(both(vectors[0])), [[2.0] * 3, [0.0] * 3])
