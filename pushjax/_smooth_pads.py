"""A pad against a smooth outline: where they may touch, when they first do, how deep they overlap.

An edge of the pad touches where the outline's outward normal is opposite to the edge's own, `Outline.facing`, which
depends on nothing but the direction; a corner touches at the outline's point nearest to it. Past the end of an edge the
one becomes the other, so nothing is missed and nothing jumps.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from pushjax._vec import Scalar, Vec2
from pushjax.shapes import Facing, Outline, PolygonOutline
from pushjax.shapes.polygon import Edge


class Seen(NamedTuple):
    """The places of an outline that face one edge of a pad, in the pad's frame: how far along the edge, and how high
    above it."""

    edge: Edge
    facing: Facing
    rel: Vec2
    along: Scalar
    height: Scalar


def seen_by(edges: tuple[Edge, ...], outline: Outline, center: Vec2, angle: Vec2) -> list[Seen]:
    """What faces each edge of a pad."""
    found = []
    for edge in edges:
        facing = outline.facing(-edge.normal.rotate(angle))
        local = (facing.point - center).unrotate(angle)
        rel = local - edge.start
        found.append(Seen(edge, facing, local, rel.dot(edge.along), edge.normal.dot(rel)))
    return found


def sweep(pad: PolygonOutline, seen: list[Seen], outline: Outline, corners: Vec2, path: Vec2, back: Vec2) -> Scalar:
    """Fraction of `path` after which they touch; corners: the pad's, in the outline's frame; back: the path of the
    outline in the pad's."""
    zero = jnp.zeros_like(path.x)
    first = jnp.min(jax.vmap(lambda corner: outline.sweep(corner, path, zero))(corners))
    for one in seen:
        met = pad.sweep(one.rel, back, zero)
        first = jnp.minimum(first, jnp.min(jnp.where(one.facing.real, met, jnp.inf)))
    return first


def overlap(pad: PolygonOutline, seen: list[Seen], outline: Outline, corners: Vec2) -> Scalar:
    """How deep a corner is in the outline, or a place that faces an edge in the pad; negative where they are apart."""
    deepest = jnp.max(-jax.vmap(lambda corner: outline.closest(corner).distance)(corners))
    for one in seen:
        depth = -pad.closest(one.rel).distance
        deepest = jnp.maximum(deepest, jnp.max(jnp.where(one.facing.real, depth, -jnp.inf)))
    return deepest
