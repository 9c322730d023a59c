"""Ellipses, whose closest points are roots on the outline.

The semi-axes are a along x and b along y; coordinates are relative to the center. The outline is parameterized by a
unit vector q = (c, s) = (cos phi, sin phi). The point at q is p = (a c, b s), and the outward normal n is (b c, a s),
normalized. A fixed number of bracketed iterations, which JAX does not differentiate, finds the root. One more,
differentiable iteration then gives the root its derivatives. Derivatives are by phi, but angles appear only as small
rotations of q.

Closest point to x: q is a critical point of the distance where f(q) = (a^2 - b^2) s c - a |x| s + b |y| c = 0. In the
quadrant of (|x|, |y|), f falls through zero at exactly one q, and this is the closest point. The iterations use
Halley's method for two reasons. It is of third order, so that second derivatives are also right after one iteration.
And at the cusps of the evolute, where the root is threefold, it still halves the error in each iteration.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from pushjax._internal.checks import ArrayLike, checked_array, common_dtype
from pushjax._internal.xla import compute_once, tree_where
from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.shape import ClosestPoint, FacingPoints, OvalOutline, Shape, equally_spaced

# Most points reach roundoff in 6 iterations. Near the cusps of the evolute each iteration only halves the error, but
# there f determines the angle of q only to a third of its digits.
CLOSEST_ITERATIONS = {False: 8, True: 16}  # key: whether the type is float64
# Number of intervals for the arc length. Its integrand is smooth between two nodes, down to axes of 1 : 100.
ARC_NODES = 512


class EllipseOutline(OvalOutline):
    """Outline of an ellipse with its axes along the body axes, in m."""

    center: Vec2
    semi: Vec2  # semi-axes along x and y

    def closest(self, x: Vec2) -> ClosestPoint:
        rel = x - self.center
        q = _closest_parameter(self.semi, rel)
        foot, normal = Vec2(self.semi.x * q.x, self.semi.y * q.y), _unit(Vec2(self.semi.y * q.x, self.semi.x * q.y))
        return ClosestPoint(normal.dot(rel - foot), self.center + foot, normal)

    def facing(self, direction: Vec2) -> FacingPoints:
        scaled_direction = Vec2(self.semi.x * direction.x, self.semi.y * direction.y)
        height = jnp.sqrt(scaled_direction.dot(scaled_direction))
        point = self.center + Vec2(self.semi.x * scaled_direction.x, self.semi.y * scaled_direction.y).scale(1 / height)
        return FacingPoints(jax.tree.map(lambda entry: entry[None], point), jnp.ones(1, bool))


def _unit(v: Vec2) -> Vec2:
    """Normalize `v`, which is never zero."""
    return v.scale(1 / jnp.sqrt(v.dot(v)))


def _rotated(q: Vec2, angle: Scalar) -> Vec2:
    """Return the unit vector `q` rotated by a small angle, exact to second order."""
    return _unit(q + q.perp().scale(angle))


def _lies_on_arc(q: Vec2, low: Vec2, high: Vec2) -> Array:
    """Return whether `q` lies on the counterclockwise arc from `low` to `high`, up to roundoff."""
    slack = -4 * jnp.finfo(q.x.dtype).eps
    return (low.cross(q) >= slack) & (q.cross(high) >= slack)


def _arc_midpoint(low: Vec2, high: Vec2) -> Vec2:
    """Return the midpoint of the counterclockwise arc from `low` to `high`, also if they are opposite."""
    return _unit(low + high + low.perp().scale(float(jnp.finfo(low.x.dtype).eps)))


def _falling_root_on_circle(
    function, q: Vec2, low: Vec2, high: Vec2, zero_tolerance: Scalar, iterations: int, like: Scalar
) -> Vec2:
    """Find where a function of q falls through zero on the arc from `low` to `high`; not differentiated."""
    # `function` returns its value, its slope by the angle of q, and the step (an angle) to take. It is positive after
    # `low` and negative before `high`, which lies counterclockwise from `low`.

    def iterate(_, carry):
        q, low, high = carry
        value, slope, step = function(q)
        proposal = _rotated(q, step)
        is_positive, is_zero = compute_once((value > 0, jnp.abs(value) <= zero_tolerance), like)
        low, high = tree_where(is_positive, q, low), tree_where(is_positive, high, q)
        (is_usable,) = compute_once((_lies_on_arc(proposal, low, high) & (slope < 0) & (jnp.abs(step) < 1),), like)
        return tree_where(is_zero, q, tree_where(is_usable, proposal, _arc_midpoint(low, high))), low, high

    return jax.lax.fori_loop(0, iterations, iterate, (q, low, high))[0]


def _closest_residual(
    a2_minus_b2: Scalar, ax: Scalar, by: Scalar, q: Vec2, least_slope: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    """Return f(q), its derivative by the angle of q, and Halley's step to its root, in rad."""
    # Here `ax` is a |x| and `by` is b |y|, both in m^2.
    c, s = q
    value = a2_minus_b2 * s * c - ax * s + by * c
    slope = a2_minus_b2 * (c * c - s * s) - ax * c - by * s
    second_derivative = -4 * a2_minus_b2 * s * c + ax * s - by * c
    safe_slope = jnp.where(jnp.abs(slope) > least_slope, slope, -least_slope)
    newton = -value / safe_slope
    return value, slope, newton / (1 - jnp.clip(-newton * second_derivative / (2 * safe_slope), -1.0, 0.5))


def _closest_parameter(semi: Vec2, rel: Vec2) -> Vec2:
    """Find q of the outline's point closest to `rel`, a point relative to the center; differentiable."""
    sign_x, sign_y = jnp.where(rel.x < 0, -1.0, 1.0), jnp.where(rel.y < 0, -1.0, 1.0)
    a2_minus_b2 = (semi.x + semi.y) * (semi.x - semi.y)
    ax, by = semi.x * sign_x * rel.x, semi.y * sign_y * rel.y
    fixed, fixed_semi = jax.lax.stop_gradient(((a2_minus_b2, ax, by), semi))
    q = _closest_in_first_quadrant(*fixed, fixed_semi)
    # The closest point has no derivative on the evolute. Close to the evolute the step would only magnify roundoff.
    least_slope = jnp.sqrt(jnp.finfo(ax.dtype).eps) * (
        jnp.abs(fixed[0]) + fixed[1] + fixed[2] + fixed_semi.dot(fixed_semi)
    )
    *_, step = _closest_residual(a2_minus_b2, ax, by, q, least_slope)
    q = _rotated(q, step)
    return Vec2(sign_x * q.x, sign_y * q.y)


def _closest_in_first_quadrant(a2_minus_b2: Scalar, ax: Scalar, by: Scalar, semi: Vec2) -> Vec2:
    """Find the root of f in the first quadrant for `ax` and `by` that are not negative; not differentiated."""
    one, zero = jnp.ones_like(ax), jnp.zeros_like(ax)
    # Halley's method can overshoot a root at an end of the quadrant. Where f has the right sign beyond that end, the
    # bracket extends past it. Where it does not, a root at that end is a critical point that is not the closest point,
    # and the search must not begin there.
    past_start, past_end = compute_once((ax > a2_minus_b2, by > -a2_minus_b2), ax)
    low = tree_where(past_start, Vec2(0.8 * one, -0.6 * one), Vec2(one, zero))
    high = tree_where(past_end, Vec2(-0.6 * one, 0.8 * one), Vec2(zero, one))
    # The closest point satisfies c = ax / (t + a^2) and s = by / (t + b^2) for one t, which is a b / speed times the
    # signed distance. Since c and s are at most one, t has a lower bound. Initial guess: (c, s) for that bound.
    t_bound = jnp.maximum(ax - semi.x * semi.x, by - semi.y * semi.y)
    guess = Vec2(ax * (t_bound + semi.y * semi.y), by * (t_bound + semi.x * semi.x))
    guess_size = jnp.abs(guess.x) + jnp.abs(guess.y)
    margin = 0.05 * guess_size + jnp.finfo(guess_size.dtype).tiny
    guess = Vec2(jnp.where(past_end, guess.x, guess.x + margin), jnp.where(past_start, guess.y, guess.y + margin))
    guess = guess.scale(1 / (jnp.abs(guess.x) + jnp.abs(guess.y) + jnp.finfo(guess_size.dtype).tiny))
    is_degenerate = compute_once(guess.x + guess.y < 0.5, ax)
    q = _unit(tree_where(is_degenerate, Vec2(one, one), guess))
    zero_tolerance = 2 * jnp.finfo(ax.dtype).eps * (jnp.abs(a2_minus_b2) + ax + by)
    least_slope = jnp.full_like(ax, jnp.finfo(ax.dtype).tiny)
    iterations = CLOSEST_ITERATIONS[ax.dtype == jnp.float64]

    def residual(q: Vec2) -> tuple[Scalar, Scalar, Scalar]:
        return _closest_residual(a2_minus_b2, ax, by, q, least_slope)

    return _falling_root_on_circle(residual, q, low, high, zero_tolerance, iterations, ax)


class Ellipse(Shape):
    """An ellipse whose axes are parallel to those of the body frame.

    Attributes:
        semi_x: Semi-axis along x, m, positive.
        semi_y: Semi-axis along y, m, positive.
        center: Center in the body frame, shape (2,), m. Default: the body origin.

    Raises:
        ValueError: If a semi-axis is not a positive finite scalar, or the center has another shape or is not finite.
    """

    semi_x: Float[Array, ""]
    semi_y: Float[Array, ""]
    center: Float[Array, "2"]

    def __init__(self, semi_x: ArrayLike, semi_y: ArrayLike, center: ArrayLike = (0.0, 0.0)):
        dtype = common_dtype(semi_x, semi_y, center)
        self.semi_x = checked_array("semi_x", semi_x, (), dtype, positive=True)
        self.semi_y = checked_array("semi_y", semi_y, (), dtype, positive=True)
        self.center = checked_array("center", center, (2,), dtype)

    def is_valid(self) -> Bool[Array, ""]:
        semi = jax.lax.stop_gradient(jnp.stack([self.semi_x, self.semi_y]))
        return jnp.min(semi) > jnp.finfo(semi.dtype).eps * jnp.max(semi)

    @property
    def area(self) -> Float[Array, ""]:
        return jnp.pi * self.semi_x * self.semi_y

    @property
    def centroid(self) -> Float[Array, "2"]:
        return self.center

    @property
    def bounds(self) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
        semi = jnp.stack([self.semi_x, self.semi_y])
        return self.center - semi, self.center + semi

    @property
    def perimeter(self) -> Float[Array, ""]:
        """Length of the outline, m."""
        return self._equally_spaced(1)[1]

    def boundary(self, points: int) -> Float[Array, "points 2"]:
        angle, _ = self._equally_spaced(points)
        return self.center[None] + jnp.stack([self.semi_x * jnp.cos(angle), self.semi_y * jnp.sin(angle)], axis=1)

    def _equally_spaced(self, points: int):
        """Return the angles phi of points equally spaced in arc length, rad, and the perimeter, m."""
        nodes = jnp.linspace(0, 2 * jnp.pi, ARC_NODES + 1, dtype=self.semi_x.dtype)
        return equally_spaced(
            lambda angle: jnp.hypot(self.semi_x * jnp.sin(angle), self.semi_y * jnp.cos(angle)), nodes, points
        )

    def outline(self) -> EllipseOutline:
        return EllipseOutline(Vec2.of(self.center), Vec2(self.semi_x, self.semi_y))
