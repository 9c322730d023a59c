"""Places where a finger or a fixture and the slider may touch."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._math.vec import Scalar, Vec2


class FingerPose(NamedTuple):
    """Pose of a finger or a wall in the slider's frame."""

    center: Vec2  # center of the finger, or a point of the wall, m
    angle: Vec2  # (cos, sin) of a pad's angle, or unit normal of a wall; of no meaning for a round finger


class Touches(NamedTuple):
    """Places where a finger and the slider may touch, in the slider's frame, as arrays with one axis."""

    distance: Scalar  # m; negative in penetration
    point: Vec2  # on the slider, m
    normal: Vec2  # of unit length, into the slider
    exists: Bool[Array, "places"]


class Features(NamedTuple):
    """What meets at each contact of a finger, by two numbers whose meaning depends on the kinds of the two bodies."""

    first: Int[Array, "contacts"]
    second: Int[Array, "contacts"]
    present: Bool[Array, "contacts"]  # False for a contact that the finger does not have

    @staticmethod
    def without_numbers(contacts: int) -> "Features":
        """Return contacts that are all there is, so that nothing has to be selected."""
        numbers = jnp.zeros(contacts, jnp.int32)
        return Features(numbers, numbers, jnp.ones(contacts, bool))


class Candidates(NamedTuple):
    """Touches, and the two numbers of what meets there."""

    touches: Touches
    first: Int[Array, "places"]
    second: Int[Array, "places"]


def pick(tree, index: Int[Array, "*picks"]):
    """Return the entries with these numbers of arrays with one axis, as masked sums, which are cheap in a batch."""

    def of(entries: Array) -> Array:
        mark = jnp.arange(entries.size).reshape(*(1,) * index.ndim, -1) == index[..., None]
        if entries.dtype == bool:
            return jnp.any(mark & entries.reshape(*(1,) * index.ndim, -1), axis=-1)
        values = jnp.where(mark, entries.reshape(*(1,) * index.ndim, -1), 0)
        return jnp.sum(values, axis=-1, dtype=entries.dtype)

    return jax.tree.map(of, tree)


def joined(*parts):
    """Return arrays with one axis, one after the other."""
    return jax.tree.map(lambda *arrays: jnp.concatenate(arrays), *parts)
