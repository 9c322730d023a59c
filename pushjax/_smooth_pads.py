"""A pad against a smooth outline: where they may touch, when they first do, how deep they overlap.

An edge of the pad touches where the outline's outward normal is opposite to the edge's own, `Outline.facing`, which
depends on nothing but the direction; a corner touches at the outline's point nearest to it. Past the end of an edge the
one becomes the other, so nothing is missed and nothing jumps.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._vec import Scalar, Vec2
from pushjax.shapes import Outline, PolygonOutline
from pushjax.shapes.polygon import Edge


class Seen(NamedTuple):
    """The places of an outline that face an edge of a pad, as arrays over all edges' places: whether there is one; the
    outline's point, and the edge's outward normal, in the outline's frame; the point in the pad's frame; how far along
    the edge, whose length that is, and how high above it."""

    real: Bool[Array, "places"]
    point: Vec2
    normal: Vec2
    local: Vec2
    along: Scalar
    length: Scalar
    height: Scalar


def seen_by(edges: tuple[Edge, ...], outline: Outline, center: Vec2, angle: Vec2) -> Seen:
    """What faces each edge of a pad."""

    def facing_one(edge: Edge) -> Seen:
        normal = edge.normal.rotate(angle)
        facing = outline.facing(-normal)
        local = (facing.point - center).unrotate(angle)
        rel = local - edge.start
        height = edge.normal.dot(rel)
        normal, length = jax.tree.map(lambda entry: jnp.full_like(height, entry), (normal, edge.length))
        return Seen(facing.real, facing.point, normal, local, rel.dot(edge.along), length, height)

    # all edges at once: written out edge by edge, a jaw's program took much longer to trace and to compile
    stacked = jax.tree.map(lambda *entries: jnp.stack(entries), *edges)
    return jax.tree.map(jnp.ravel, jax.vmap(facing_one)(stacked))


def sweep(pad: PolygonOutline, seen: Seen, outline: Outline, corners: Vec2, path: Vec2, back: Vec2) -> Scalar:
    """Fraction of `path` after which they touch; corners: the pad's, in the outline's frame; back: the path of the
    outline in the pad's."""
    zero = jnp.zeros_like(path.x)
    first = jnp.min(jax.vmap(lambda corner: outline.sweep(corner, path, zero))(corners))
    met = pad.sweep(seen.local, back, zero)
    return jnp.minimum(first, jnp.min(jnp.where(seen.real, met, jnp.inf)))


def overlap(pad: PolygonOutline, seen: Seen, outline: Outline, corners: Vec2) -> Scalar:
    """How deep a corner is in the outline, or a place that faces an edge in the pad; negative where they are apart."""
    deepest = jnp.max(-jax.vmap(lambda corner: outline.closest(corner).distance)(corners))
    depth = -pad.closest(seen.local).distance
    return jnp.maximum(deepest, jnp.max(jnp.where(seen.real, depth, -jnp.inf)))
