"""Area of the intersection of two simple polygons, convex or not.

Let the edge i of a counterclockwise polygon A run over an interval of x at the height y_i(x), and let s_i be +1 if it
runs toward +x and -1 otherwise. A point (x, y) is inside A if the sum of -s_i over the edges above it is one, and
outside if that sum is zero. So the area of A ∩ B is the sum over pairs of edges, i of A and j of B, of

    s_i s_j ∫ min(y_i(x), y_j(x)) dx

over the x that both edges cover. In min(y_i, y_j) = y_j + min(y_i - y_j, 0) the sum over i of the first term is zero,
because A is closed. What is left for each pair is the integral of min(d, 0), where d is linear from d_0 to d_1 over a
width w:

    ∫ min(d, 0) dx = -w m^2 / (2 (|d_0| + |d_1|)),  m = min(d_0, 0) + min(d_1, 0).

No point is classified as inside or outside, and no polygon is clipped. Every term is a continuous function of the
vertices, so edges that coincide, exactly or up to roundoff, need no special case.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax._internal.checks import ArrayLike, checked_array, common_dtype, concrete
from pushjax.geometry.shape import signed_area


def intersection_area(first: ArrayLike, second: ArrayLike) -> Float[Array, ""]:
    """Compute the area of the intersection of two simple polygons, convex or not.

    The result is exact up to roundoff, and differentiable wherever the area is. Elsewhere, for example where edges
    coincide, the derivative is one-sided.

    Args:
        first: Vertices of the first polygon, shape (first_vertices, 2), m. The first vertex is not repeated at the end.
        second: Vertices of the second polygon, shape (second_vertices, 2), m, in the same frame and of the same
            orientation: both polygons run counterclockwise, or both clockwise.

    Returns:
        The area, m^2. It is exactly zero if the boxes around the polygons do not overlap.

    Raises:
        ValueError: If an array has another shape, or fewer than three vertices, or is not finite, or if the polygons
            have different orientations. The last two are not checked for traced values.
        TypeError: If an array does not consist of real numbers.
    """
    dtype = common_dtype(first, second)
    polygons = []
    for name, vertices in (("first", first), ("second", second)):
        array = checked_array(name, vertices, ("vertices", 2), dtype)
        if array.shape[0] < 3:
            raise ValueError(f"{name}: a polygon needs at least three vertices; got {array.shape[0]}")
        polygons.append(array)
    known = [concrete(polygon) for polygon in polygons]
    if known[0] is not None and known[1] is not None and signed_area(np, known[0]) * signed_area(np, known[1]) < 0:
        raise ValueError("first and second: one polygon runs counterclockwise and the other clockwise")
    # Vertices are relative to one of them, so that polygons far from the origin do not lose digits.
    a, b = (polygon - polygons[1][:1] for polygon in polygons)
    boxes_overlap = jnp.all((jnp.max(a, axis=0) > jnp.min(b, axis=0)) & (jnp.max(b, axis=0) > jnp.min(a, axis=0)))
    area = jnp.sum(_pair_areas(_Edges.of(a).along(1), _Edges.of(b).along(0)))
    return jnp.where(boxes_overlap & (area > 0), area, 0.0)


class _Edges(NamedTuple):
    """Edges of a polygon as functions y(x), each field an array over the edges."""

    sign: Array  # +1 if the edge runs toward +x, and -1 otherwise
    left_x: Array
    left_y: Array
    right_x: Array
    right_y: Array
    slope: Array  # dy/dx; zero for a vertical edge, where both ends are known without it

    @staticmethod
    def of(vertices: Array) -> "_Edges":
        (x, y), (next_x, next_y) = vertices.T, jnp.roll(vertices, -1, axis=0).T
        # `where`, unlike `minimum`, also has the right derivative for a vertical edge: its ends are not averaged.
        toward_x = next_x >= x
        left_x, right_x = jnp.where(toward_x, x, next_x), jnp.where(toward_x, next_x, x)
        left_y, right_y = jnp.where(toward_x, y, next_y), jnp.where(toward_x, next_y, y)
        slope = _safe_divide(right_y - left_y, right_x - left_x)
        return _Edges(jnp.where(toward_x, 1.0, -1.0).astype(x.dtype), left_x, left_y, right_x, right_y, slope)

    def along(self, axis: int) -> "_Edges":
        """Return the edges with a new axis of length one at `axis`."""
        return _Edges(*(jnp.expand_dims(field, axis) for field in self))

    def at_left(self, x: Array) -> Array:
        """Return y at `x`, exact at the left end."""
        return self.left_y + self.slope * (x - self.left_x)

    def at_right(self, x: Array) -> Array:
        """Return y at `x`, exact at the right end."""
        return self.right_y + self.slope * (x - self.right_x)


def _pair_areas(a: _Edges, b: _Edges) -> Array:
    """Return the term of each pair of edges in the sum of this module's header."""
    # Where x of `a` and `b` are equal, x of `a` counts as the smaller one, in every comparison. So at a tie the
    # derivative applies to polygons that lie side by side, and is not a mixture that no small motion has.
    low = jnp.where(a.left_x > b.left_x, a.left_x, b.left_x)
    high = jnp.where(a.right_x > b.right_x, b.right_x, a.right_x)
    width = jnp.where((a.left_x <= b.right_x) & (b.left_x < a.right_x), high - low, 0.0)
    at_low = a.at_left(low) - b.at_left(low)
    at_high = a.at_right(high) - b.at_right(high)
    below = jnp.minimum(at_low, 0) + jnp.minimum(at_high, 0)
    # |d| is written as d - 2 min(d, 0). Its derivative at d = 0 matches the derivative of `below`, so the derivative of
    # the quotient does not jump.
    share = _safe_divide(below, at_low + at_high - 2 * below)
    return -0.5 * a.sign * b.sign * width * below * share


def _safe_divide(numerator: Array, denominator: Array) -> Array:
    """Return numerator / denominator, and zero where the denominator, a length, vanishes."""
    # Derivatives divide by the square of the denominator, second ones by its cube, which must not underflow.
    nonzero = denominator > jnp.cbrt(jnp.finfo(denominator.dtype).tiny)
    return jnp.where(nonzero, numerator / jnp.where(nonzero, denominator, 1.0), 0.0)
