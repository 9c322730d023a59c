"""Contact candidates: places where a finger or a fixture and the slider may touch."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from pushjax._math.vec import Scalar, Vec2

OUT_OF_REACH = 1e3  # m, distance of a candidate that does not exist; no finger moves so far


class FingerPose(NamedTuple):
    """Pose of a finger or a wall in the slider's frame."""

    center: Vec2  # center of the finger, or a point of the wall, m
    angle: Vec2 | None  # (cos, sin) of a pad's angle, or unit normal of a wall; None for a round finger


class Candidate(NamedTuple):
    """A place where a finger and the slider may touch, in the slider's frame; or several, as arrays."""

    distance: Scalar  # m; negative in penetration
    point: Vec2  # on the slider, m
    normal: Vec2  # of unit length, into the slider


# A tuple of candidates, or, for a pad, one `Candidate` of arrays. With the corners of a pad unrolled, the program for a
# jaw was twice as large and took nearly twice as long to compile.
Candidates = tuple[Candidate, ...] | Candidate


def take(candidates: Candidate, index: Int[Array, ""]) -> Candidate:
    """Return `candidates[index]`, computed as a masked sum, which is cheap in a batch."""
    mark = jnp.arange(candidates.distance.size) == index
    return jax.tree.map(lambda entries: jnp.sum(jnp.where(mark, entries, 0.0)), candidates)
