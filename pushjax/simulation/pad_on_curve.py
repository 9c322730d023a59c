"""Contacts and distance of a pad and a smooth outline.

An edge of the pad touches where the outward normal of the outline is opposite to the normal of the edge. These points
(`Outline.facing`) depend on the direction only. A corner of the pad touches at the point of the outline nearest to it.
Past the end of an edge the first kind of contact becomes the second, so no contact is missed and none jumps.

The first number of a contact's features is that of the corner or of the edge. The second is that of the point among
those that face the edge, or -1 for a corner.
"""

from functools import partial

import jax
import jax.numpy as jnp

from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.polygon_outline import Edge
from pushjax.geometry.shape import Outline
from pushjax.simulation.candidate import Candidates, FingerPose, Touches, joined, pick
from pushjax.simulation.pad_on_polygon import END_TOLERANCE, TILT_TOLERANCE, Corner, is_inside
from pushjax.simulation.pair import MAX_PENETRATION, Pair

CORNER = -1


class PadOnCurve(Pair):
    """A pad and a smooth outline that is no disk."""

    def count(self, finger, outline):
        return 2

    def are_convex(self, finger, outline):
        return outline.is_convex and finger.shape.convex

    def distance(self, finger, outline, pose):
        pad = finger.shape.outline()
        at_corners = jax.vmap(outline.closest)(pose.center + pad.edges.start.rotate(pose.angle))
        places, local, _ = jax.vmap(lambda edge: _places_on_edge(edge, outline, pose))(pad.edges)
        at_edges = jax.vmap(jax.vmap(pad.closest))(local)
        of_edges = jax.tree.map(jnp.ravel, (at_edges.distance, -at_edges.normal.rotate(pose.angle)))
        valid = jnp.concatenate([jnp.ones(at_corners.distance.shape, bool), places.exists.ravel()])
        distance, normal = joined((at_corners.distance, at_corners.normal), of_edges)
        return pick((distance, normal), jnp.argmin(jnp.where(valid, distance, jnp.inf)))

    def candidates(self, finger, outline, pose, displacement_at, length):
        pad, too_deep = finger.shape.outline(), -2 * MAX_PENETRATION * length
        corner = Corner.of(pad).turned(pose.angle, pose.center)
        closest = jax.vmap(outline.closest)(corner.point)
        faces = (corner.onward.dot(closest.normal) >= -TILT_TOLERANCE) & (
            corner.back.dot(closest.normal) >= -TILT_TOLERANCE
        )
        at_corners = Touches(closest.distance, closest.point, -closest.normal, faces & (closest.distance > too_deep))
        places, local, along = jax.vmap(lambda edge: _places_on_edge(edge, outline, pose))(pad.edges)
        # A point past the end of an edge touches its corner.
        length_of_edge = pad.edges.length[:, None]
        tolerance = END_TOLERANCE[length_of_edge.dtype.itemsize] * length_of_edge
        within = (along >= -tolerance) & (along <= length_of_edge + tolerance) & (places.distance > too_deep)
        if not pad.is_convex:  # a point that is behind an edge may be outside, at another one
            within &= (places.distance >= -tolerance) | jax.vmap(jax.vmap(partial(is_inside, pad.edges)))(local)
        at_edges = places._replace(exists=places.exists & within)
        number, (edge, point) = jnp.arange(len(pad.edges.length)), jnp.indices(along.shape)
        of_edges = Candidates(at_edges, edge, point)
        candidates = joined(
            Candidates(at_corners, number, jnp.full_like(number, CORNER)), jax.tree.map(jnp.ravel, of_edges)
        )
        return Candidates(candidates.touches, *(n.astype(jnp.int32) for n in candidates[1:]))

    def touches(self, finger, outline, pose, features):
        pad = finger.shape.outline()

        def touch(first, second) -> Touches:
            edge = pick(pad.edges, first)
            closest = outline.closest(pose.center + edge.start.rotate(pose.angle))
            at_corner = Touches(closest.distance, closest.point, -closest.normal, jnp.ones((), bool))
            at_edge = pick(_places_on_edge(edge, outline, pose)[0], second)
            return jax.tree.map(lambda a, b: jnp.where(second == CORNER, a, b), at_corner, at_edge)

        places = jax.vmap(touch)(features.first, features.second)
        return places._replace(exists=places.exists & features.present)


def _places_on_edge(edge: Edge, outline: Outline, pose: FingerPose) -> tuple[Touches, Vec2, Scalar]:
    """Return where a smooth outline may touch an edge of a pad, there in the pad's frame, and along the edge, m."""
    normal = edge.normal.rotate(pose.angle)
    point, exists = outline.facing(-normal)
    local = (point - pose.center).unrotate(pose.angle)
    relative = local - edge.start
    height = edge.normal.dot(relative)
    return (
        Touches(height, point, jax.tree.map(lambda n: jnp.full_like(height, n), normal), exists),
        local,
        relative.dot(edge.along),
    )
