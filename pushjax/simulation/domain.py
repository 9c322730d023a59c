"""What a rollout computes with in place of numbers that are NaN, infinite or out of their domain.

Such numbers can be refused only where they are not traced. Elsewhere they must reach no arithmetic: the derivative of
what follows would be NaN, for this example and for all others that share an argument with it. So they are replaced, and
the friction of the steps that they belong to is NaN, which makes the status of these steps INVALID.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from pushjax._math.vec import Scalar
from pushjax.geometry.shape import Shape
from pushjax.simulation.fixtures import Fixture, Wall
from pushjax.simulation.hand import Hand, Pad, RoundFinger

MAX_FRICTION = 1e9  # its fourth power is still a number
ROUNDOFF = 1e-5  # by how much a traced path may close the hand farther than it may be closed, in units of the length


def replace_invalid(tree: Any, valid: Bool[Array, ""], length: Scalar) -> Any:
    """Return bodies as they are if they are `valid`, else with regular outlines and `length` for other numbers, m."""

    def replace(leaf: Array) -> Array:
        angle = 2 * jnp.pi * jnp.arange(len(leaf), dtype=leaf.dtype) / len(leaf) if leaf.ndim == 2 else None
        other = jnp.ones_like(leaf) if angle is None else jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
        return jnp.where(valid, leaf, jax.lax.stop_gradient(length) * other)

    return jax.tree.map(replace, tree)


def are_valid(bodies: Sequence[Shape | RoundFinger | Pad | Wall | Fixture], length: Scalar) -> Bool[Array, ""]:
    """Return whether the numbers of all bodies are in their domain."""
    valid = jnp.ones((), bool)
    for body in jax.lax.stop_gradient(tuple(bodies)):
        shape = body if isinstance(body, Shape) else getattr(body, "shape", None)
        if shape is not None:
            lengths = jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(shape)])
            valid &= are_moderate(lengths, length) & shape.is_valid()
            valid &= jnp.max(jnp.abs(lengths)) >= jnp.finfo(length.dtype).eps * length
        if isinstance(body, RoundFinger):
            valid &= are_moderate(body.radius[None], length) & (body.radius >= 0)
        if isinstance(body, Wall):
            valid &= are_moderate(body.point, length) & (jnp.sum(body.normal**2) > 0)
        if isinstance(body, Fixture):
            valid &= poses_are_moderate(body.pose, length)
        if isinstance(body, Wall | Fixture):
            valid &= (body.friction >= 0) & (body.friction <= MAX_FRICTION)
    return valid


def poses_are_moderate(poses: Float[Array, "*rows width"], length: Scalar) -> Bool[Array, "*rows"]:
    """Return whether poses (x, y, theta) or centers (x, y) are moderate, in units of `length` and of a radian."""
    unit = jnp.broadcast_to(length, poses.shape[-1:])
    return are_moderate(poses, unit.at[2].set(1.0) if len(unit) == 3 else unit)


def are_moderate(values: Float[Array, "*rows numbers"], unit: Float[Array, "*numbers"]) -> Bool[Array, "*rows"]:
    """Return whether all numbers in a row are so small that a float resolves a tenth of their unit."""
    values, unit = jax.lax.stop_gradient((values, jnp.broadcast_to(unit, values.shape[-1:])))
    largest = min(0.1 / float(jnp.finfo(values.dtype).eps), 1e9)
    return jnp.all(jnp.abs(values) <= largest * unit.reshape(*(1,) * (values.ndim - 1), -1), axis=-1)


def valid_path(hand: Hand, path: Float[Array, "steps+1 dof"], length: Scalar) -> tuple[Array, Bool[Array, "steps+1"]]:
    """Return poses of the fingers along a path, and which rows are valid; the first of these replaces the others."""
    valid = jnp.all(jnp.isfinite(path), axis=1)
    if hand.least is not None:
        valid &= path[:, -1] >= hand.least - ROUNDOFF * length

    def replaced(rows: Array) -> Array:
        mask = valid.reshape(-1, *(1,) * (rows.ndim - 1))
        first = jax.lax.stop_gradient(rows[jnp.argmax(valid)])
        return jnp.where(mask, rows, jnp.where(jnp.any(valid), first, 0.0))

    poses = hand.poses(replaced(path))
    valid &= jnp.all(poses_are_moderate(poses, length), axis=1)
    return replaced(poses), valid
