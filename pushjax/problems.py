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
from pushjax.solve.contacts import Contacts


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


class ContactsProblem(NamedTuple):
    """Several contacts on a random limit surface."""

    surface: LimitSurface
    contacts: Contacts


def random_contacts_problem(
    key: Key[Array, ""],
    *,
    contacts: int,
    degree: int = 4,
    condition: float = 1e3,
    friction: float = 1.5,
    gaps: float = 0.5,
    padding: int = 0,
) -> ContactsProblem:
    """Several contacts on a slider of some 0.1 m, in the mix that a solver must survive.

    contacts: how many count. degree, condition: of the surface, see `random_surface`. padding: how many more are
    inactive, anywhere among them, with numbers of their own. Each choice below is drawn for each problem.

    - Where they touch, a quarter each: on an ellipse, anywhere about it; anywhere with any normals; two or more on one
      straight edge and the others on the ellipse; the flat faces of two parallel jaws, in turn, half of these exactly
      opposite.
    - How the pushers move, a third each: as one rigid hand, half of these without rotation; towards the slider's
      middle, half of these equally fast and exactly, the others unevenly and with some drift; independently, three
      quarters of them into the slider. Sizes are log-uniform from 0.1 to 10 mm.
    - friction: in half of the problems one mu for all. A tenth of them zero, a tenth up to four times `friction`, the
      others uniform up to it.
    - gaps: the share of problems with gaps: there, two fifths of the contacts touch, two fifths are up to 3 mm apart,
      a fifth overlap by up to 0.5 mm. In the others all touch.
    """
    k_surface, k_length, k_where, k_how, k_size, k_mu, k_gap, k_order = jax.random.split(key, 8)
    m = contacts + padding
    length = jax.random.uniform(k_length, minval=0.02, maxval=0.1)
    surface = random_surface(k_surface, degree=degree, condition=condition, length=length)
    point, normal, middle = _random_places(k_where, contacts, m)
    size = 10 ** jax.random.uniform(k_size, minval=-4.0, maxval=-2.0)
    order = jax.random.permutation(k_order, m)
    problem = Contacts(
        point[order],
        normal[order],
        size * _random_pushes(k_how, point, normal, middle)[order],
        _random_friction(k_mu, m, friction)[order],
        _random_gaps(k_gap, m, gaps)[order],
        (jnp.arange(m) < contacts)[order],
    )
    return ContactsProblem(surface, problem)


def _unit(angle: Array) -> Array:
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


# Below, one call draws all the numbers of a kind: each call costs a quarter of a second of compilation.


def _random_places(key: Key[Array, ""], contacts: int, m: int) -> tuple[Array, Array, Array]:
    """Points and inward normals (m, 2) of the kinds of `random_contacts_problem`, and the slider's middle (1, 2)."""
    k_all, k_each = jax.random.split(key)
    all_ = jax.random.uniform(k_all, (8,))
    phase, x, y, angle, along = jax.random.uniform(k_each, (5, m))
    middle = 0.04 * all_[None, :2] - 0.02
    axes = 0.02 + 0.06 * all_[None, 2:4]
    ahead = _unit(2 * jnp.pi * all_[4:5])
    aside = jnp.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    turned = jnp.concatenate([ahead, aside])  # (a, b) @ turned: a along the one, b along the other

    on_circle = _unit(2 * jnp.pi * phase)
    on_ellipse = middle + (on_circle * axes) @ turned
    outward = (on_circle / axes) @ turned
    inward = -outward / jnp.linalg.norm(outward, axis=1, keepdims=True)

    anywhere = 0.2 * jnp.stack([x, y], axis=1) - 0.1

    index, along = jnp.arange(m)[:, None], 2 * along[:, None] - 1
    on_edge = index < 2 + jnp.floor(all_[5] * (max(contacts, 2) - 1))
    edge_point = middle + jnp.concatenate([jnp.full_like(along, -axes[0, 0]), axes[0, 1] * along], axis=1) @ turned

    side = jnp.where(index % 2 == 0, 1.0, -1.0)
    place = jnp.where(all_[6] < 0.5, along[2 * (index[:, 0] // 2)], along)
    jaw_point = middle + jnp.concatenate([-axes[0, 0] * side, axes[0, 1] * place], axis=1) @ turned

    which = jnp.floor(4 * all_[7]).astype(int)
    points = jnp.stack([on_ellipse, anywhere, jnp.where(on_edge, edge_point, on_ellipse), jaw_point])
    normals = jnp.stack([inward, _unit(2 * jnp.pi * angle), jnp.where(on_edge, ahead, inward), side * ahead])
    return points[which], normals[which], jnp.where(which == 1, 0.0, middle)


def _random_pushes(key: Key[Array, ""], point: Array, normal: Array, middle: Array) -> Array:
    """Displacements (m, 2) of the kinds of `random_contacts_problem`; the fastest has length one."""
    m = point.shape[0]
    k_uniform, k_normal = jax.random.split(key)
    uniform, gauss = jax.random.uniform(k_uniform, (4 + 2 * m,)), jax.random.normal(k_normal, (3 + 2 * m,))
    fast, into = uniform[4:].reshape(2, m, 1)
    # a rotation moves contacts some 0.05 m away about as far as the translation does
    spin = jnp.where(uniform[0] < 0.5, 20 * gauss[0], 0.0)
    rigid = _unit(2 * jnp.pi * uniform[1:2]) + spin * jnp.stack([-point[:, 1], point[:, 0]], axis=1)
    to_middle = middle - point
    to_middle /= jnp.maximum(jnp.linalg.norm(to_middle, axis=1, keepdims=True), 1e-3)
    uneven = (0.3 + 0.7 * fast) * to_middle + 0.5 * gauss[None, 1:3]
    close = jnp.where(uniform[2] < 0.5, to_middle, uneven)
    independent = gauss[3:].reshape(m, 2)
    leaving = jnp.sum(independent * normal, axis=1, keepdims=True) < 0
    independent = jnp.where(leaving & (into < 0.5), -independent, independent)
    push = jnp.stack([rigid, close, independent])[jnp.floor(3 * uniform[3]).astype(int)]
    return push / jnp.max(jnp.linalg.norm(push, axis=1))


def _random_friction(key: Key[Array, ""], m: int, most: float) -> Array:
    uniform = jax.random.uniform(key, (2 * m + 1,))
    mu, kind = uniform[1:].reshape(2, m)
    mu = most * jnp.where(kind < 0.1, 0.0, jnp.where(kind < 0.2, 4 * mu, mu))
    return jnp.where(uniform[0] < 0.5, mu[0], mu)


def _random_gaps(key: Key[Array, ""], m: int, share: float) -> Array:
    uniform = jax.random.uniform(key, (2 * m + 1,))
    kind, size = uniform[1:].reshape(2, m)
    gap = jnp.where(kind < 0.4, 0.0, jnp.where(kind < 0.8, 3e-3 * size, -5e-4 * size))
    return jnp.where(uniform[0] < share, gap, 0.0)
