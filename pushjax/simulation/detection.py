"""Contact detection: where a finger or a wall and a slider may touch, and how far they are apart.

Every place where a finger and the slider may touch is a contact candidate with its own gap, closed or open. The contact
problem finds which of them are closed within the step. A round finger has one candidate, or two on an outline that is
not convex. A pad has one on a disk. Otherwise a pad or a wall has many, of which `contact_selection` selects two or
three. The selection is new in each step and stays the same within the step.

The way to find them depends on the kinds of the two bodies, which `PAIRS` lists.
"""

import functools

import jax
import jax.numpy as jnp

from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.disk import DiskOutline
from pushjax.geometry.polygon_outline import PolygonOutline
from pushjax.geometry.shape import ClosestPoint, Outline
from pushjax.simulation.candidate import Candidates, FingerPose, Touches, pick
from pushjax.simulation.fixtures import Wall
from pushjax.simulation.hand import Finger, Pad, RoundFinger
from pushjax.simulation.pad_on_curve import PadOnCurve
from pushjax.simulation.pad_on_polygon import PadOnPolygon
from pushjax.simulation.pair import Pair


class DiskPair(Pair):
    """A disk, which is the finger or the slider, and an outline."""

    def touches_of_disk(self, outline: Outline, center: Vec2, radius: Scalar) -> Touches:
        """Return where a disk touches an outline: points on the outline, and normals out of it."""
        places = outline.contact_candidates(center)
        all_places: ClosestPoint = jax.tree.map(lambda *entries: jnp.stack(entries), *places)
        distance, point, normal = all_places.distance - radius, all_places.point, all_places.normal
        # a second place that does not exist repeats the first
        differs = [entry != entry[:1] for entry in (point.x, point.y, normal.x, normal.y)]
        exists = functools.reduce(jnp.logical_or, differs).at[0].set(True)
        return Touches(distance, point, normal, exists)

    def matched(self, touches, at_start):
        if len(touches.exists) == 1:
            return touches
        # the nearest place is the first, and another one may be nearest now
        squares = [
            [
                (p := Vec2(touches.point.x[i] - at_start.point.x[j], touches.point.y[i] - at_start.point.y[j])).dot(p)
                for j in range(2)
            ]
            for i in range(2)
        ]
        has_second, had_second = touches.exists[1], at_start.exists[1]
        second = jnp.where(has_second, squares[1][0] - jnp.where(had_second, squares[1][1], squares[0][0]), 0.0)
        first = jnp.where(had_second, squares[0][1] - squares[0][0], 0.0)
        swaps = jax.lax.stop_gradient((first + second < 0) & (has_second | had_second))
        return jax.tree.map(lambda entry: jnp.where(swaps, entry[::-1], entry), touches)


class RoundFingerPair(DiskPair):
    """A round finger and any outline."""

    def count(self, finger, outline):
        return outline.max_touches

    def distance(self, finger, outline, pose):
        closest = outline.closest(pose.center)
        return closest.distance - finger.radius, closest.normal

    def pieces(self, finger, outline, pose):
        distances, normals = outline.pieces(pose.center)
        return distances - finger.radius, normals

    def touches(self, finger, outline, pose, features):
        touches = self.touches_of_disk(outline, pose.center, finger.radius)
        return touches._replace(normal=-touches.normal)


class PadOnDisk(DiskPair):
    """A pad and a disk."""

    def count(self, finger, outline):
        return 1 if finger.shape.convex else 2

    def are_convex(self, finger, outline):
        return finger.shape.convex

    def distance(self, finger, outline, pose):
        closest = finger.shape.outline().closest((outline.center - pose.center).unrotate(pose.angle))
        return closest.distance - outline.radius, -closest.normal.rotate(pose.angle)

    def touches(self, finger, outline, pose, features):
        center = (outline.center - pose.center).unrotate(pose.angle)
        touches = self.touches_of_disk(finger.shape.outline(), center, outline.radius)
        normal = touches.normal.rotate(pose.angle)
        return touches._replace(point=outline.center - normal.scale(outline.radius), normal=normal)


class WallPair(Pair):
    """A wall and any outline."""

    def count(self, finger, outline):
        return outline.max_rests

    def distance(self, finger, outline, pose):
        places = self._places(outline, pose)
        return jnp.min(jnp.where(places.exists, places.distance, jnp.inf)), pose.angle

    def candidates(self, finger, outline, pose, displacement_at, length):
        places = self._places(outline, pose)
        number = jnp.arange(places.distance.size, dtype=jnp.int32)
        return Candidates(places, number, jnp.zeros_like(number))

    def touches(self, finger, outline, pose, features):
        return pick(self._places(outline, pose), features.first)

    def _places(self, outline: Outline, pose: FingerPose) -> Touches:
        """Return every place where a slider may touch a wall."""
        normal = pose.angle
        points, valid = outline.facing(-normal)
        distance = normal.dot(points - pose.center)
        return Touches(distance, points, jax.tree.map(lambda n: jnp.broadcast_to(n, distance.shape), normal), valid)


# The pair of each kind of finger with each kind of outline, by the most special class of the outline.
PAIRS: dict[type, dict[type, Pair]] = {
    RoundFinger: {Outline: RoundFingerPair()},
    Pad: {DiskOutline: PadOnDisk(), PolygonOutline: PadOnPolygon(), Outline: PadOnCurve()},
    Wall: {Outline: WallPair()},
}


def pair_of(finger: Finger | Wall, outline: Outline) -> Pair:
    """Return how a finger or a wall and an outline meet."""
    kinds = PAIRS[type(finger)]
    return next(kinds[kind] for kind in type(outline).__mro__ if kind in kinds)


def num_contacts(finger: Finger | Wall, outline: Outline) -> int:
    """Return the number of contacts that a finger or a wall may have, which is static."""
    return pair_of(finger, outline).count(finger, outline)
