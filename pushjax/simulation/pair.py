"""How a finger or a wall and a slider meet: the interface that each pair of kinds has."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import jax
from jaxtyping import Array, Float

from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.polygon_outline import PolygonOutline
from pushjax.simulation.candidate import Candidates, Features, FingerPose, Touches
from pushjax.simulation.contact_selection import select_contacts

# Called with points of the slider; all in the slider's frame, m.
DisplacementAt = Callable[[Vec2], Vec2]
# Largest overlap of finger and slider, in units of the limit surface's length, that is pushed out. Up to this it is a
# tracking error, not a finger on the wrong side.
MAX_PENETRATION = 0.2


class Pair(ABC):
    """How fingers or walls of one kind meet outlines of one kind. All lengths are in m, in the slider's frame."""

    @abstractmethod
    def count(self, finger: Any, outline: Any) -> int:
        """Return the number of contacts."""

    def are_convex(self, finger: Any, outline: Any) -> bool:
        """Return whether both are known to be convex, so that a plane separates them where they are apart."""
        return outline.is_convex

    @abstractmethod
    def distance(self, finger: Any, outline: Any, pose: FingerPose) -> tuple[Scalar, Vec2]:
        """Return the distance, negative in penetration, and the unit vector from the slider to the finger there."""

    def pieces(self, finger: Any, outline: Any, pose: FingerPose) -> tuple[Float[Array, "pieces"], Vec2 | None]:
        """Return the distances to convex pieces of the slider, and the unit vectors from them; None if not known."""
        distance, normal = self.distance(finger, outline, pose)
        convex = self.are_convex(finger, outline)
        return distance[None], jax.tree.map(lambda entry: entry[None], normal) if convex else None

    def candidates(
        self, finger: Any, outline: Any, pose: FingerPose, displacement_at: DisplacementAt, length: Scalar
    ) -> Candidates | None:
        """Return all places where the two may touch; None if all are contacts."""
        return None

    def features(
        self, finger: Any, outline: Any, pose: FingerPose, displacement_at: DisplacementAt, length: Scalar
    ) -> Features:
        """Return what meets at the contacts. It is not differentiated."""
        arguments = jax.lax.stop_gradient((finger, outline, pose))
        candidates, count = self.candidates(*arguments, displacement_at, length), self.count(finger, outline)
        if candidates is None:
            return Features.without_numbers(count)
        displacement = displacement_at(candidates.touches.point)
        is_smooth = not isinstance(outline, PolygonOutline)
        share_place = not is_smooth and not self.are_convex(finger, outline)
        return select_contacts(candidates, count, is_smooth, share_place, length, displacement)

    def matched(self, touches: Touches, at_start: Touches) -> Touches:
        """Return contacts in the order of those at the start of the step."""
        return touches

    @abstractmethod
    def touches(self, finger: Any, outline: Any, pose: FingerPose, features: Features) -> Touches:
        """Return the contacts of these features."""
