"""Random contact problems with a stated difficulty, for tests and benchmarks.

Everything is drawn from a key; batches come from `vmap` over split keys.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from pushjax._vec import Vec3
from pushjax.limit_surface import Ellipsoid, LimitSurface, Quartic, QuarticForm
from pushjax.limit_surface.sums import squared_quadratics


class ContactProblem(NamedTuple):
    """One contact on a random limit surface. Body frame, m; `normal` points into the slider; `friction` is mu."""

    surface: LimitSurface
    point: Float[Array, "2"]
    normal: Float[Array, "2"]
    displacement: Float[Array, "2"]
    friction: Float[Array, ""]


def random_contact_problem(
    key: Key[Array, ""], *, degree: int = 4, condition: float = 1e3, friction: float = 3.0
) -> ContactProblem:
    """A contact anywhere on a slider of some 0.1 m, pushed from any direction of the half plane that pushes.

    degree: 2 or 4. condition: the Hessian's condition number over the unit sphere is log-uniform up to about this.
    friction: mu is uniform from 0 to this. The displacement's length is log-uniform from 0.1 to 10 mm.
    """
    k_surface, k_point, k_normal, k_push, k_mu, k_speed, k_length = jax.random.split(key, 7)
    length = jax.random.uniform(k_length, minval=0.02, maxval=0.1)
    surface = random_surface(k_surface, degree=degree, condition=condition, length=length)
    point = jax.random.uniform(k_point, (2,), minval=-0.1, maxval=0.1)
    angle = jax.random.uniform(k_normal, maxval=2 * jnp.pi)
    push = angle + jax.random.uniform(k_push, minval=-jnp.pi / 2, maxval=jnp.pi / 2)
    size = 10 ** jax.random.uniform(k_speed, minval=-4.0, maxval=-2.0)
    return ContactProblem(
        surface,
        point,
        jnp.stack([jnp.cos(angle), jnp.sin(angle)]),
        size * jnp.stack([jnp.cos(push), jnp.sin(push)]),
        jax.random.uniform(k_mu, maxval=friction),
    )


def random_surface(
    key: Key[Array, ""], *, degree: int = 4, condition: float = 1e3, length: float | Array = 0.05
) -> LimitSurface:
    """A random limit surface whose Hessian's condition number is log-uniform up to about `condition`.

    Degree 2: random axes and eigenvalues. Degree 4: a sum of squares of five quadratics (some of them squares of a
    single linear form, which leaves almost flat directions), plus as much of |F|^4 as brings the condition number,
    over a sweep of the sphere, to the one drawn; |F|^4 itself has 3.
    """
    k_shape, k_rank, k_scale, k_condition = jax.random.split(key, 4)
    worst = 10 ** jax.random.uniform(k_condition, minval=0.0, maxval=jnp.log10(condition))
    if degree == 2:
        q, _ = jnp.linalg.qr(jax.random.normal(k_shape, (3, 3)))
        # fl: the two ends of the spectrum are drawn, the middle lies between
        middle = jax.random.uniform(k_scale)
        eigenvalues = jnp.stack([jnp.ones_like(worst), worst**-middle, 1 / worst])
        return Ellipsoid(q @ jnp.diag(eigenvalues) @ q.T, length)
    if degree != 4:
        raise ValueError(f"degree must be 2 or 4; got {degree}")
    factors = jax.random.normal(k_shape, (5, 3, 3))
    thin = jax.random.bernoulli(k_rank, 0.5, (5,))
    kept = ~thin[:, None, None] | (jnp.arange(3) == 0)[None, None, :]  # a thin one keeps its first column: rank one
    factors = jnp.where(kept, factors, 0.0)
    weights = jax.random.exponential(k_scale, (5,))
    c = squared_quadratics(jnp.sqrt(weights)[:, None, None] * factors @ jnp.swapaxes(factors, 1, 2))
    low, high = _spectrum(c)
    worst = jnp.maximum(worst, 3.5)
    # (high + 12 e) / (low + 4 e) = worst
    round_part = jnp.maximum(0.0, (high - worst * low) / (4 * worst - 12))
    ball = squared_quadratics(jnp.eye(3)[None])
    c = c + round_part * ball
    return Quartic(c / _spectrum(c)[1], length)


def _spectrum(c: Float[Array, "15"]) -> tuple[Array, Array]:
    """Smallest and largest eigenvalue of the Hessian over a sweep of the half sphere."""
    k = jnp.arange(200) + 0.5
    height, angle = 1 - k / 200, jnp.pi * (1 + 5**0.5) * k
    ring = jnp.sqrt(1 - height**2)
    form = QuarticForm(tuple(c), jnp.ones(()))
    hessian = jax.vmap(lambda x, y, z: form.hessian(Vec3(x, y, z)).array())(
        ring * jnp.cos(angle), ring * jnp.sin(angle), height
    )
    values = jnp.linalg.eigvalsh(hessian)
    return jnp.min(values), jnp.max(values)
