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
    """Support points: points of an outline that face the edges of a pad, as arrays over the points of all edges.

    Attributes:
        valid: Whether the support point exists.
        point: Point of the outline, in the outline's frame, m.
        normal: Outward unit normal of the pad's edge, in the outline's frame.
        local: The point in the pad's frame, m.
        along: Coordinate of the point along the edge, m.
        length: Length of the edge, m.
        height: Height of the point above the edge, m.
    """

    valid: Bool[Array, "points"]
    point: Vec2
    normal: Vec2
    local: Vec2
    along: Scalar
    length: Scalar
    height: Scalar


def edge_support_points(edges: Edge, outline: Outline, center: Vec2, angle: Vec2) -> EdgeSupport:
    """Find the support points of an outline: those that face each edge of a pad.

    Args:
        edges: Edges of the pad, as arrays, in its own frame.
        outline: The smooth outline.
        center: Center of the pad in the outline's frame, m.
        angle: Angle of the pad in the outline's frame, as a unit vector.
    """

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
    """Depth of the deepest corner in the outline, or of the deepest support point in the pad, m; negative if apart."""
    corner_depths = -jax.vmap(outline.closest)(corners).distance
    support_depths = jnp.where(supports.valid, -jax.vmap(pad.closest)(supports.local).distance, -jnp.inf)
    return largest(jnp.concatenate([corner_depths, support_depths]))
