"""Contact detection for a pad against a smooth outline: contact candidates and penetration depth.

An edge of the pad touches where the outward normal of the outline is opposite to the normal of the edge. These support
points (`Outline.facing`) depend on the direction only. A corner of the pad touches at the point of the outline nearest
to it. Past the end of an edge the first kind of contact becomes the second, so no contact is missed and none jumps.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._internal.xla import largest
from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.polygon_outline import Edge, PolygonOutline
from pushjax.geometry.shape import Outline


class EdgeSupport(NamedTuple):
    """Points of an outline that face the edges of a pad (support points), as arrays over the points of all edges."""

    valid: Bool[Array, "points"]  # whether the point exists
    point: Vec2  # in the outline's frame, m
    normal: Vec2  # outward unit normal of the pad's edge, in the outline's frame
    local: Vec2  # the point in the pad's frame, m
    along: Scalar  # coordinate of the point along the edge, m
    length: Scalar  # of the edge, m
    height: Scalar  # of the point above the edge, m


def edge_support_points(edges: Edge, outline: Outline, center: Vec2, angle: Vec2) -> EdgeSupport:
    """Return the points of a smooth outline that face each edge of a pad, which is at `center`, m, and `angle`."""

    def supports_of_edge(edge: Edge) -> EdgeSupport:
        normal = edge.normal.rotate(angle)
        facing = outline.facing(-normal)
        local = (facing.point - center).unrotate(angle)
        relative = local - edge.start
        height = edge.normal.dot(relative)
        normal, length = jax.tree.map(lambda entry: jnp.full_like(height, entry), (normal, edge.length))
        return EdgeSupport(facing.valid, facing.point, normal, local, relative.dot(edge.along), length, height)

    return jax.tree.map(jnp.ravel, jax.vmap(supports_of_edge)(edges))


def penetration_depth(pad: PolygonOutline, supports: EdgeSupport, outline: Outline, corners: Vec2) -> Scalar:
    """Return the depth of the deepest corner in the outline or support point in the pad, m; negative if apart."""
    corner_depths = -jax.vmap(outline.closest)(corners).distance
    support_depths = jnp.where(supports.valid, -jax.vmap(pad.closest)(supports.local).distance, -jnp.inf)
    return largest(jnp.concatenate([corner_depths, support_depths]))
