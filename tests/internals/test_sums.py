"""Sums and repetitions of `_math.sums`, which are primitives of their own, under every transformation."""

import jax
import jax.numpy as jnp
import numpy as np

from pushjax._math.sums import repeated, summed

X = np.random.default_rng(0).normal(size=(3, 4, 5))
CASES = [(lambda x, axis=axis: summed(x, axis), lambda x, axis=axis: jnp.sum(x, axis)) for axis in (0, -1, (0, 1))]
CASES += [
    (lambda x, axis=axis: repeated(x, axis, 7), lambda x, axis=axis: jnp.stack([x] * 7, axis)) for axis in (0, 1, 3)
]
TRANSFORMS = {
    "value": lambda f: f,
    "vmap": lambda f: jax.vmap(lambda k: f(k * jnp.asarray(X)), out_axes=-1),
    "jacfwd": lambda f: jax.jacfwd(lambda x: jnp.sin(f(x * x))),
    "jacrev": lambda f: jax.jacrev(lambda x: jnp.sin(f(x * x))),
    "hessian": lambda f: jax.hessian(lambda x: jnp.sum(jnp.sin(f(x * x)))),
    "vmap of grad": lambda f: jax.vmap(jax.grad(lambda k: jnp.sum(jnp.sin(f(k * jnp.asarray(X)))))),
}


def test_agrees_with_plain_jax():
    """Values and derivatives are those of jnp.sum and of a stack of copies."""

    def transformed(kind):
        arguments = {name: jnp.arange(1.0, 3.0) if "vmap" in name else jnp.asarray(X) for name in TRANSFORMS}
        return {name: [of(case[kind])(arguments[name]) for case in CASES] for name, of in TRANSFORMS.items()}

    ours, plain = (jax.jit(transformed, static_argnums=0)(kind) for kind in (0, 1))
    ours["at once"], plain["at once"] = [f(jnp.asarray(X)) for f, _ in CASES], plain["value"]
    for name, of_cases in plain.items():
        for found, expected in zip(ours[name], of_cases, strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5, err_msg=name)


def test_integers_and_shards():
    """Integers are summed, too, and so are the shards of an array."""
    assert summed(jnp.arange(4), 0) == 6
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1]), ("device",))
    spec = jax.sharding.PartitionSpec("device")
    of_shards = jax.shard_map(lambda x: summed(x, 1), mesh=mesh, in_specs=spec, out_specs=spec)
    np.testing.assert_allclose(jax.jit(of_shards)(jnp.asarray(X)), X.sum(axis=1), rtol=1e-5)
