"""The motion of several sliders of one example, in physical units: batched by `vmap`, and differentiable.

The guess is tried first: Newton steps with the unknowns that could be positive in the stage before. Where that fails,
LCPs are solved in rounds (`several_sliders`); in a batch, these examples follow the others (`in_tiles`).
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from pushjax._internal.autodiff import search_result
from pushjax._internal.tiles import in_tiles
from pushjax._internal.trailing_batch import with_batch_last
from pushjax._internal.xla import tree_where
from pushjax._math.vec import Scalar, Vec2, Vec3
from pushjax.contact.contact_plane import Contact
from pushjax.contact.linear_patch import MixedSurfaces, Surface
from pushjax.contact.near_contacts import solve_sliders
from pushjax.contact.several_sliders import SlidersMotion, Start, differentiable_motion
from pushjax.contact.sliders_problem import SlidersProblem
from pushjax.contact.status import ContactMode, Status
from pushjax.friction.feet import FeetForm
from pushjax.friction.limit_surface import Form
from pushjax.friction.polynomial import Polynomial
from pushjax.friction.support_points import SupportPoints

# Problems that a CPU solves at once, times their contacts, so that tableaus stay in the cache; and the fewest problems.
TILE, LEAST_TILE = 128, 16


class Touching(NamedTuple):
    """Contacts of sliders with each other and with pushers, with one axis; those of one example."""

    contact: Contact  # in the frame of the first slider; its displacement is that of the second body
    point: Vec2  # the same points in the frame of the second slider, m; of no meaning for a pusher
    normal: Vec2  # the same normals
    pairs: tuple[tuple[int, int | None], ...]  # the two sliders of each contact; None for a pusher
    active: Bool[Array, "contacts"]


class SlidersSolution(NamedTuple):
    """The motion of several sliders of one example."""

    twist: Vec3  # body frames, m, m, rad, (sliders,) each; zero of a slider that rests
    wrench: Vec3  # normalized, N
    force: Vec2  # along (normal, tangent), (contacts,) each, N
    slip: Vec2  # motion (n, t) at each contact beyond the displacement and the gap of its second body, m
    mode: Int[Array, "contacts"]  # `ContactMode`
    rests: Bool[Array, "sliders"]
    status: Int[Array, ""]  # `Status`
    best: Start  # where the next solution may start: here, or where this one started


def solve_touching(forms: tuple[Form, ...], touching: Touching, guess: Start | None) -> SlidersSolution:
    """Find the motion of several sliders."""
    problem, displacement_unit, force_unit = _scaled(forms, touching)
    guess = Start.none(problem.count, problem.rows[0, 0, :, 0]) if guess is None else guess
    motion = _solve(problem, guess)
    ones = jnp.ones_like(displacement_unit)
    units = jnp.stack([jnp.stack([ones, ones, 1 / form.length]) for form in forms], axis=1) * displacement_unit
    moves = motion.status == Status.MOVING
    found = Start(moves, motion.force, motion.dissipation, motion.basic, motion.patch.normal)
    return SlidersSolution(
        Vec3.of(motion.twist * units),
        Vec3.of(motion.wrench * force_unit),
        Vec2.of(motion.force * force_unit),
        Vec2.of(problem.slips(motion.twist) * displacement_unit),
        motion.mode,
        ~(moves & (motion.dissipation > 0)),
        motion.status,
        jax.lax.stop_gradient(tree_where(moves, found, guess)),
    )


def _scaled(forms: tuple[Form, ...], touching: Touching) -> tuple[SlidersProblem, Scalar, Scalar]:
    """The dimensionless problem, and the units of displacement and force, which are constants to every derivative."""
    contact, active = touching.contact, touching.active
    surface, force_unit = _surface(forms)

    size = jnp.maximum(jnp.maximum(jnp.abs(contact.displacement.x), jnp.abs(contact.displacement.y)), -contact.gap)
    unit = jax.lax.stop_gradient(jnp.max(jnp.where(active & jnp.isfinite(size), size, 0.0)))
    unit = jnp.where(unit > 0, unit, 1.0)
    tangent = contact.normal.perp()
    goal = jnp.stack([contact.displacement.dot(contact.normal) - contact.gap, contact.displacement.dot(tangent)]) / unit
    sides = [(_rows(contact.point, contact.normal), 1.0), (_rows(touching.point, touching.normal), -1.0)]
    rows = []
    for slider, form in enumerate(forms):
        scale = jnp.stack([jnp.ones_like(form.length), jnp.ones_like(form.length), 1 / form.length])
        own = jnp.zeros((2, 3, len(touching.pairs)), goal.dtype)
        for side, (of_side, sign) in enumerate(sides):
            takes_part = jnp.asarray([pair[side] == slider for pair in touching.pairs])
            own += jnp.where(takes_part[None, None], sign * of_side * scale[None, :, None], 0.0)
        rows.append(own)
    return SlidersProblem(surface, jnp.stack(rows, axis=2), goal, contact.friction, active), unit, force_unit


def _surface(forms: tuple[Form, ...]) -> tuple[Surface, Scalar]:
    """The limit surfaces of all sliders in a unit of force in which none is large, and that unit, N."""
    is_exact = [isinstance(form, FeetForm) for form in forms]
    # of each kind, a slider of the other kind has any surface
    eye = jnp.eye(3, dtype=forms[0].length.dtype)
    sphere, two_points = Polynomial(2 * eye[:, :, None]), SupportPoints(eye[:2, :2], eye[0, :1].repeat(2))
    polynomials = [sphere if isinstance(form, FeetForm) else Polynomial.of(form.table()) for form in forms]
    if any(polynomial.degree == 4 for polynomial in polynomials):
        polynomials = [each if each.degree == 4 else each.squared() for each in polynomials]
    points = [form.points if isinstance(form, FeetForm) else two_points for form in forms]
    most = max(len(each.limit) for each in points)
    points = [
        jax.tree.map(lambda leaf: jnp.pad(leaf, (*[(0, 0)] * (leaf.ndim - 1), (0, most - leaf.shape[-1]))), each)
        for each in points
    ]
    units = [
        jnp.sum(support.limit) if exact else 1 / polynomial.root(polynomial.scale())
        for exact, support, polynomial in zip(is_exact, points, polynomials, strict=True)
    ]
    unit = jax.lax.stop_gradient(jnp.max(jnp.stack(units)))
    polynomial, support = (
        jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=-1), *each) for each in (polynomials, points)
    )
    polynomial = Polynomial(polynomial.table * unit**polynomial.degree)
    support = support._replace(limit=support.limit / unit)
    if not any(is_exact):
        return polynomial, unit
    return support if all(is_exact) else MixedSurfaces(polynomial, support, jnp.asarray(is_exact)), unit


def _rows(point: Vec2, normal: Vec2) -> Float[Array, "2 3 contacts"]:
    """The motion (n, t) of points by a twist."""
    tangent = normal.perp()
    return jnp.stack([jnp.stack([axis.x, axis.y, point.cross(axis)]) for axis in (normal, tangent)])


@eqx.filter_custom_jvp
def _solve(problem: SlidersProblem, guess: Start) -> SlidersMotion:
    """Solve a problem of one example."""
    usable, valid = jax.tree.map(lambda leaf: leaf[..., None], problem).usable()
    needed = (usable.pushes() | ~valid)[0]  # else nothing moves
    found = in_tiles(_attempt, needed, guess.exists, problem, guess, tile=max(TILE // problem.count, LEAST_TILE))
    still = jnp.full_like(found.mode, ContactMode.SEPARATED), jnp.full_like(found.status, Status.FREE)
    mode, status = tree_where(needed, (found.mode, found.status), still)
    return found._replace(mode=mode, status=status)


@_solve.def_jvp
def _solve_jvp(primals, tangents):
    (problem, guess), change = primals, tangents[0]
    motion = search_result(_solve(problem, guess))
    known = jax.lax.stop_gradient(motion)
    leaves, structure = jax.tree.flatten((problem, known))
    near = partial(_near, structure, [leaf.ndim for leaf in leaves])
    _, slopes = eqx.filter_jvp(lambda problem: with_batch_last(near, (problem, known)), (problem,), (change,))
    unchanged = jax.tree.map(lambda leaf: jnp.zeros_like(leaf) if eqx.is_inexact_array(leaf) else None, motion)
    return motion, unchanged._replace(**slopes)


def _near(structure: Any, ranks: list[int], given: tuple[SlidersProblem, SlidersMotion]) -> dict[str, Array]:
    """What can be differentiated of the motion, with any number of axes for the batch."""
    leaves = jax.tree.leaves(given)
    batch = jnp.broadcast_shapes(*(leaf.shape[rank:] for leaf, rank in zip(leaves, ranks, strict=True)))
    flat = [
        jnp.broadcast_to(leaf, (*leaf.shape[:rank], *batch)).reshape(*leaf.shape[:rank], -1)
        for leaf, rank in zip(leaves, ranks, strict=True)
    ]
    motion = differentiable_motion(*jax.tree.unflatten(structure, flat))
    slopes = {name: getattr(motion, name) for name in ("twist", "wrench", "force", "dissipation")}
    return {name: value.reshape(*value.shape[:-1], *batch) for name, value in slopes.items()}


def _attempt(
    again: Int[Array, ""], problem: SlidersProblem, guess: Start
) -> tuple[SlidersMotion, Bool[Array, " batch"]]:
    """Solve a batch of problems from the guess, or in the second attempt anew."""
    motion = solve_sliders(problem, guess, again > 0)
    return motion, (motion.status == Status.NOT_CONVERGED)
