"""Random contact problems of a given difficulty, for tests and benchmarks.

All numbers come from a PRNG key. For a batch, use `vmap` over split keys.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from pushjax._math.directions import fibonacci_hemisphere
from pushjax._math.vec import Vec3
from pushjax.contact.problem import Contacts
from pushjax.friction.ellipsoid import Ellipsoid
from pushjax.friction.limit_surface import LimitSurface
from pushjax.friction.quartic import Quartic, QuarticForm
from pushjax.friction.sum_of_squares import squared_quadratics


class ContactProblem(NamedTuple):
    """One contact on a random limit surface, in the body frame."""

    surface: LimitSurface
    point: Float[Array, "2"]  # m
    normal: Float[Array, "2"]  # unit vector into the slider
    displacement: Float[Array, "2"]  # of the pusher, m
    friction: Float[Array, ""]  # mu


def random_contact_problem(
    key: Key[Array, ""],
    *,
    degree: int = 4,  # of the limit surface, 2 or 4
    # the condition number of the Hessian over the unit sphere is log-uniform up to about this number
    condition: float = 1e3,
    friction: float = 3.0,  # mu is uniform from 0 to this number
) -> ContactProblem:
    """Generate a problem with one contact anywhere on a slider of some 0.1 m."""
    k_surface, k_point, k_normal, k_push, k_mu, k_speed, k_length = jax.random.split(key, 7)
    length = jax.random.uniform(k_length, minval=0.02, maxval=0.1)
    surface = random_surface(k_surface, degree=degree, condition=condition, length=length)
    point = jax.random.uniform(k_point, (2,), minval=-0.1, maxval=0.1)
    angle = jax.random.uniform(k_normal, maxval=2 * jnp.pi)
    push = angle + jax.random.uniform(k_push, minval=-jnp.pi / 2, maxval=jnp.pi / 2)
    size = 10 ** jax.random.uniform(k_speed, minval=-4.0, maxval=-2.0)  # m
    return ContactProblem(
        surface,
        point,
        jnp.stack([jnp.cos(angle), jnp.sin(angle)]),
        size * jnp.stack([jnp.cos(push), jnp.sin(push)]),
        jax.random.uniform(k_mu, maxval=friction),
    )


def random_surface(
    key: Key[Array, ""],
    *,
    degree: int = 4,  # 2 (an `Ellipsoid`) or 4 (a `Quartic`)
    condition: float | Array = 1e3,
    length: float | Array = 0.05,  # characteristic length, m
) -> LimitSurface:
    """Generate a limit surface whose Hessian has a condition number that is log-uniform up to about `condition`."""
    k_shape, k_rank, k_scale, k_condition = jax.random.split(key, 4)
    drawn_condition = 10 ** jax.random.uniform(k_condition, minval=0.0, maxval=jnp.log10(condition))
    if degree == 2:
        q, _ = jnp.linalg.qr(jax.random.normal(k_shape, (3, 3)))
        # The middle eigenvalue is log-uniform between the ends of the spectrum.
        middle = jax.random.uniform(k_scale)
        eigenvalues = jnp.stack([jnp.ones_like(drawn_condition), drawn_condition**-middle, 1 / drawn_condition])
        return Ellipsoid(q @ jnp.diag(eigenvalues) @ q.T, length)
    if degree != 4:
        raise ValueError(f"degree must be 2 or 4; got {degree}")
    # A sum of squares of five quadratics. Some of these are squares of a single linear form, which leaves almost flat
    # directions. A multiple of |F|^4, whose own condition number is 3, is added, so that the condition number over a
    # sweep of the sphere takes its random value.
    factors = jax.random.normal(k_shape, (5, 3, 3))
    is_rank_one = jax.random.bernoulli(k_rank, 0.5, (5,))
    # A factor of rank one keeps its first column only.
    kept = ~is_rank_one[:, None, None] | (jnp.arange(3) == 0)[None, None, :]
    factors = jnp.where(kept, factors, 0.0)
    weights = jax.random.exponential(k_scale, (5,))
    c = squared_quadratics(jnp.sqrt(weights)[:, None, None] * factors @ jnp.swapaxes(factors, 1, 2))
    low, high = _spectrum(c)
    drawn_condition = jnp.maximum(drawn_condition, 3.5)
    # The Hessian of |F|^4 has eigenvalues 4 and 12 on the unit sphere. With the weight e of |F|^4, the condition number
    # is at most (high + 12 e) / (low + 4 e), which is set to the random one.
    round_weight = jnp.maximum(0.0, (high - drawn_condition * low) / (4 * drawn_condition - 12))
    round_quartic = squared_quadratics(jnp.eye(3)[None])
    c = c + round_weight * round_quartic
    return Quartic(c / _spectrum(c)[1], length)


def _spectrum(c: Float[Array, "15"]) -> tuple[Array, Array]:
    """Return the smallest and the largest eigenvalue of the Hessian over a sweep of the half sphere."""
    directions = Vec3.of(jnp.asarray(fibonacci_hemisphere(200).T, c.dtype))
    hessian = QuarticForm(tuple(c), jnp.ones(())).hessian(directions).array()
    values = jnp.linalg.eigvalsh(jnp.moveaxis(hessian, -1, 0))
    return jnp.min(values), jnp.max(values)


class ContactsProblem(NamedTuple):
    """Several contacts on a random limit surface, in the body frame."""

    surface: LimitSurface
    contacts: Contacts


def random_contacts_problem(
    key: Key[Array, ""],
    *,
    contacts: int | Int[Array, ""],  # number of active contacts
    degree: int = 4,
    condition: float | Float[Array, ""] = 1e3,  # see `random_surface`
    # a tenth of the coefficients are zero, a tenth uniform up to four times this number, the others up to it
    friction: float | Float[Array, ""] = 1.5,
    gaps: float | Float[Array, ""] = 0.5,  # fraction of the problems with gaps
    # contacts that the arrays hold, the additional ones inactive and at random places; default: `contacts`
    slots: int | None = None,
    fixtures: int = 0,  # number of active contacts that do not move, like those of walls
) -> ContactsProblem:
    """Generate a problem with several contacts on a slider of some 0.1 m, from the cases that a solver must handle."""
    # All arguments but `degree`, `slots` and `fixtures` may be traced, so that one compiled program generates all
    # problems.
    k_surface, k_uniform, k_normal = jax.random.split(key, 3)
    num_slots = int(contacts) if slots is None else slots
    # One call generates all numbers of a kind, because each call takes a quarter of a second to compile.
    uniform_numbers = _Numbers(jax.random.uniform(k_uniform, (24 + 13 * num_slots,)))
    normal_numbers = _Numbers(jax.random.normal(k_normal, (3 + 2 * num_slots,)))
    length = 0.02 + 0.08 * uniform_numbers.take()
    surface = random_surface(k_surface, degree=degree, condition=condition, length=length)
    mu = _random_friction(uniform_numbers, num_slots, friction)
    point, normal, middle = _random_points_and_normals(uniform_numbers, mu, contacts)
    size = 10 ** (2 * uniform_numbers.take() - 4)  # m
    gap = _random_gaps(uniform_numbers, num_slots, gaps)
    push, dragged = _random_pushes(uniform_numbers, normal_numbers, surface, mu, point, normal, middle)
    # With the gaps added, pushes of the last kind act as they do without gaps.
    push = size * push + jnp.where(dragged, gap, 0.0)[:, None] * normal
    order = jnp.argsort(uniform_numbers.take(num_slots))
    index = jnp.arange(num_slots)
    active = index < contacts
    if fixtures:
        push = jnp.where((active & (index >= contacts - fixtures))[:, None], 0.0, push)
    return ContactsProblem(surface, Contacts(*(a[order] for a in (point, normal, push, mu, gap, active))))


class _Numbers:
    """An array of random numbers that are taken one after another."""

    def __init__(self, values: Array):
        self.values, self.taken = values, 0

    def take(self, *shape: int) -> Array:
        """Return the next unused numbers in the given shape."""
        begin, self.taken = self.taken, self.taken + math.prod(shape)
        assert self.taken <= self.values.size
        return self.values[begin : self.taken].reshape(shape)


def _unit_vector(angle: Array) -> Array:
    """Return the unit vectors (cos, sin) of angles in rad, stacked along a new last axis."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


def _perpendicular(v: Array) -> Array:
    """Return the vectors rotated by +90 degrees."""
    return jnp.stack([-v[..., 1], v[..., 0]], axis=-1)


def _random_points_and_normals(uniform: _Numbers, mu: Array, contacts: int | Array) -> tuple[Array, Array, Array]:
    """Return random points (m, 2), m, inward normals (m, 2) and the middle of the slider, (1, 2), m."""
    m = mu.size
    shared = uniform.take(12)
    phase, x, y, angle, along = uniform.take(5, m)
    middle = 0.04 * shared[None, :2] - 0.02
    axes = 0.02 + 0.06 * shared[None, 2:4]
    ahead = _unit_vector(2 * jnp.pi * shared[4:5])
    # (a, b) @ axes_directions is a along `ahead` and b orthogonal to it.
    axes_directions = jnp.concatenate([ahead, _perpendicular(ahead)])

    on_circle = _unit_vector(2 * jnp.pi * phase)
    on_ellipse = middle + (on_circle * axes) @ axes_directions
    outward = (on_circle / axes) @ axes_directions
    inward = -outward / jnp.linalg.norm(outward, axis=1, keepdims=True)

    anywhere = 0.2 * jnp.stack([x, y], axis=1) - 0.1

    index, along = jnp.arange(m)[:, None], 2 * along[:, None] - 1
    on_edge = index < 2 + jnp.floor(shared[5] * (jnp.maximum(contacts, 2) - 1))
    edge_point = (
        middle + jnp.concatenate([jnp.full_like(along, -axes[0, 0]), axes[0, 1] * along], axis=1) @ axes_directions
    )

    side = jnp.where(index % 2 == 0, 1.0, -1.0)
    place = jnp.where(shared[6] < 0.5, along[2 * (index[:, 0] // 2)], along)
    jaw_point = middle + jnp.concatenate([-axes[0, 0] * side, axes[0, 1] * place], axis=1) @ axes_directions

    in_wedge = index < 2
    miss = jnp.where(shared[8] < 0.5, 1.0, -1.0) * 10 ** (-1 - 4 * shared[9])
    lean = jnp.where(shared[10:12] < 0.5, 1.0, -1.0)[jnp.minimum(index[:, 0], 1)] * (jnp.arctan(mu) + miss)
    wedge_normal = side * _unit_vector(lean) @ axes_directions
    wedge_point = middle - axes[0, 0] * side * ahead

    which = jnp.floor(5 * shared[7]).astype(int)  # one of five kinds, with equal probability
    points = jnp.stack(
        [
            on_ellipse,
            anywhere,  # with any normals
            jnp.where(on_edge, edge_point, on_ellipse),  # two or more on one straight edge
            jaw_point,  # on the flat faces of two parallel jaws in turn, in half of the problems exactly opposite
            # Two form a wedge at the limit of holding itself: the friction cone of each of the two misses the other
            # contact, or contains it, by 1e-1 to 1e-5 rad.
            jnp.where(in_wedge, wedge_point, on_ellipse),
        ]
    )
    normals = jnp.stack(
        [
            inward,
            _unit_vector(2 * jnp.pi * angle),
            jnp.where(on_edge, ahead, inward),
            side * ahead,
            jnp.where(in_wedge, wedge_normal, inward),
        ]
    )
    return points[which], normals[which], jnp.where(which == 1, 0.0, middle)


def _random_pushes(
    uniform: _Numbers, gauss: _Numbers, surface: LimitSurface, mu: Array, point: Array, normal: Array, middle: Array
) -> tuple[Array, Array]:
    """Return random displacements (m, 2), the largest of length one, and whether they are of the last kind."""
    m = point.shape[0]
    shared, (fast, into) = uniform.take(6), uniform.take(2, m, 1)
    spin_rate, drift, free = gauss.take(), gauss.take(1, 2), gauss.take(m, 2)
    # The rotation moves contacts at a distance of some 0.05 m about as far as the translation does.
    spin = jnp.where(shared[0] < 0.5, 20 * spin_rate, 0.0)
    rigid = _unit_vector(2 * jnp.pi * shared[1:2]) + spin * _perpendicular(point)
    to_middle = middle - point
    to_middle /= jnp.maximum(jnp.linalg.norm(to_middle, axis=1, keepdims=True), 1e-3)
    uneven = (0.3 + 0.7 * fast) * to_middle + 0.5 * drift
    closing = jnp.where(shared[2] < 0.5, to_middle, uneven)
    leaving = jnp.sum(free * normal, axis=1, keepdims=True) < 0
    independent = jnp.where(leaving & (into < 0.5), -free, free)

    # The force of the first contact is on the edge of its friction cone, and this force alone moves the slider.
    side, mover = jnp.where(shared[4] < 0.5, 1.0, -1.0), jnp.arange(m)[:, None] == 0
    force = normal[0] + side * mu[0] * _perpendicular(normal[0])
    torque = point[0, 0] * force[1] - point[0, 1] * force[0]
    twist = surface.form().gradient(Vec3(force[0], force[1], torque / surface.length))
    moved = jnp.stack([twist.x, twist.y])[None] + twist.z / surface.length * _perpendicular(point)
    moved /= jnp.max(jnp.linalg.norm(moved, axis=1))
    behind = jnp.where(into < 0.3, 0.0, into)
    drag = moved + jnp.where(
        mover, side * 2 * shared[5] * _perpendicular(normal), free[:, :1] * _perpendicular(normal) - behind * normal
    )

    # The pushers move in one of four ways, with equal probability: as one rigid hand, in half of these problems without
    # rotation; toward the middle of the slider, in half of these problems exactly and equally fast; independently,
    # three quarters of them into the slider; or such that one slides along the slider and moves it alone, often while
    # it recedes, and the others stay behind or just touch.
    kind = jnp.floor(4 * shared[3]).astype(int)
    push = jnp.stack([rigid, closing, independent, drag])[kind]
    return push / jnp.max(jnp.linalg.norm(push, axis=1)), kind == 3


def _random_friction(uniform: _Numbers, m: int, most: float | Array) -> Array:
    """Return the friction coefficients of `random_contacts_problem`, (m,)."""
    same, (mu, kind) = uniform.take(), uniform.take(2, m)
    mu = most * jnp.where(kind < 0.1, 0.0, jnp.where(kind < 0.2, 4 * mu, mu))
    return jnp.where(same < 0.5, mu[0], mu)


def _random_gaps(uniform: _Numbers, m: int, share: float | Array) -> Array:
    """Return the gaps of `random_contacts_problem`, (m,), m; a fraction `share` of the problems has gaps."""
    has_gaps, (kind, size) = uniform.take(), uniform.take(2, m)
    # two fifths touch, two fifths are up to 3 mm apart, and a fifth overlap by up to 0.5 mm
    gap = jnp.where(kind < 0.4, 0.0, jnp.where(kind < 0.8, 3e-3 * size, -5e-4 * size))
    return jnp.where(has_gaps < share, gap, 0.0)
