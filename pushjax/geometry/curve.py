"""Smooth closed curves: cubic B-splines as shapes, with interpolation and least-squares fits."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pushjax._internal.checks import ArrayLike, checked_array, concrete, in_numpy
from pushjax._internal.jit import quick_jit
from pushjax._internal.xla import compute_once, entry_at
from pushjax._math.vec import Vec2
from pushjax.geometry.shape import Shape, equally_spaced, find_self_intersection, gauss_legendre, signed_area
from pushjax.geometry.spline import SAMPLES, SplineOutline, spline_segments

# Intervals per segment over which the arc length is integrated. The speed is smooth within an interval.
ARC_NODES = 8
# Iterations of a fit. Each one fits the curve and moves every parameter toward the closest point on the curve.
FIT_ITERATIONS = 20


class Curve(Shape):
    """A smooth closed curve in the body frame: a uniform cubic B-spline, with continuous curvature.

    The curve runs near its control points, not through them. `Curve.through` interpolates points, and `Curve.fit`
    approximates a dense outline. The control points are stored counterclockwise, as for `Polygon`. While they are
    traced (under `jit`, `grad` or `vmap`), they are taken as they are and must be counterclockwise already.

    A query costs the same for all query points, in proportion to the number of control points.

    Args:
        control: Control points, shape (controls, 2), m, at least four, in either orientation. The first point is not
            repeated at the end.
        convex: Whether the curve is convex, so that a finger touches it in one place only. None: determined from the
            control points; if they are traced, convexity is not assumed.

    Raises:
        ValueError: If there are fewer than four control points; if one of them is not finite, or coincides with the
            next one; if the curve crosses itself, encloses no area or has a cusp; or if it is not convex although
            `convex` is True.
    """

    control: Float[Array, "controls 2"]
    convex: bool = eqx.field(static=True)

    def __init__(self, control: ArrayLike, *, convex: bool | None = None):
        array = _checked_points("control", control)
        known = concrete(array)
        if known is not None and _checked_signed_area(known.astype(np.float64)) < 0:
            array = jnp.roll(array[::-1], 1, axis=0)
        self.control = array
        self.convex = _is_convex(array, convex)

    @staticmethod
    def through(points: ArrayLike, *, convex: bool | None = None) -> "Curve":
        """Create the curve that passes through the given points, with one control point for each.

        Args:
            points: Points, shape (points, 2), m, body frame, at least four. They should be about evenly spaced along
                the curve.
            convex: As for `Curve`.

        Returns:
            The interpolating curve.

        Raises:
            ValueError: As for `Curve`.
        """
        array = _checked_points("points", points)
        identity = np.eye(len(array))
        knot_weights = (4 * identity + np.roll(identity, 1, axis=0) + np.roll(identity, -1, axis=0)) / 6
        return Curve(_solve(jnp.asarray(knot_weights, array.dtype), array), convex=convex)

    @staticmethod
    def fit(points: ArrayLike, controls: int = 24, *, convex: bool | None = None) -> "Curve":
        """Fit a curve to a dense outline by least squares.

        Each point is weighted by the length of the outline around it. Distances are measured to the closest point of
        the curve, not to the point at the same fraction of the length.

        Args:
            points: Vertices in order along the outline, shape (points, 2), m, body frame, at least twice as many as
                `controls`. They must be known, not traced.
            controls: Number of control points of the curve, at least four.
            convex: As for `Curve`.

        Returns:
            The fitted curve.

        Raises:
            ValueError: If the points are traced, `controls` is out of range, or as for `Curve`.
        """
        array = _checked_points("points", points)
        known = concrete(array)
        if known is None:
            raise ValueError("points are traced; a curve is fitted only to known points, outside jit, grad and vmap")
        if not 4 <= controls <= len(known) // 2:
            raise ValueError(f"controls must be from 4 to half the number of points, {len(known) // 2}; got {controls}")
        return Curve(jnp.asarray(_fit_control_points(known.astype(np.float64), controls), array.dtype), convex=convex)

    def is_valid(self) -> Bool[Array, ""]:
        return jax.lax.stop_gradient(self.area) > 0

    @property
    @quick_jit
    def area(self) -> Float[Array, ""]:
        x, y, dx, dy, weight = self._quadrature()
        return jnp.sum(weight * (x * dy - y * dx)) / 2

    @property
    @quick_jit
    def centroid(self) -> Float[Array, "2"]:
        x, y, dx, dy, weight = self._quadrature()
        moment = jnp.stack([jnp.sum(weight * x * x * dy), -jnp.sum(weight * y * y * dx)]) / 2
        return self.control[0] + moment / (jnp.sum(weight * (x * dy - y * dx)) / 2)

    def _quadrature(self) -> tuple[Array, ...]:
        """Return (x, y, dx, dy, weight) at Gauss-Legendre nodes; x and y are relative to the first control point, m."""
        # The derivatives dx and dy are by the segment's parameter.
        # Relative points keep a curve far from the origin from losing digits.
        segments = jax.tree.map(lambda field: field[:, None], spline_segments(self.control - self.control[:1]))
        nodes, weights = gauss_legendre(self.control.dtype)
        point, velocity, _ = segments.evaluate(nodes[None])
        return *point, *velocity, weights[None]

    @property
    @quick_jit
    def bounds(self) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
        segments = spline_segments(self.control)
        low, high = zip(*(_coordinate_range(*fields) for fields in zip(*segments[:4], strict=True)), strict=True)
        return jnp.stack(low), jnp.stack(high)

    @property
    @quick_jit
    def perimeter(self) -> Float[Array, ""]:
        """Length of the curve, m."""
        nodes, weights = (part / 2 for part in np.polynomial.legendre.leggauss(5))
        all_nodes = (np.arange(ARC_NODES)[:, None] + nodes + 0.5).ravel() / ARC_NODES
        segments = jax.tree.map(lambda field: field[:, None], spline_segments(self.control))
        _, velocity, _ = segments.evaluate(jnp.asarray(all_nodes, self.control.dtype)[None])
        all_weights = jnp.asarray(np.tile(weights, ARC_NODES) / ARC_NODES, self.control.dtype)
        return jnp.sum(jnp.hypot(*velocity) * all_weights[None])

    def boundary(self, points: int) -> Float[Array, "points 2"]:
        count = len(self.control)
        nodes = jnp.linspace(0, count, count * ARC_NODES + 1, dtype=self.control.dtype)
        parameters, _ = equally_spaced(lambda nodes: jnp.hypot(*_evaluate(self.control, nodes)[1]), nodes, points)
        return jnp.stack(_evaluate(self.control, parameters)[0], axis=1)

    def outline(self) -> SplineOutline:
        segments = spline_segments(self.control)
        nodes = jnp.arange(SAMPLES, dtype=self.control.dtype) / SAMPLES
        points, velocities, _ = jax.tree.map(lambda field: field[:, None], segments).evaluate(nodes[None])
        flat_points, flat_velocities = (
            Vec2(field.x.reshape(-1), field.y.reshape(-1)) for field in (points, velocities)
        )
        # Computed once here, and not again for each query of a batch.
        outline = SplineOutline(segments, flat_points, flat_velocities.scale(1 / SAMPLES), self.perimeter, self.convex)
        return compute_once(outline, self.control[0, 0])


def _coordinate_range(c0: Array, c1: Array, c2: Array, c3: Array) -> tuple[Array, Array]:
    """Return the least and largest value of one coordinate over all segments, given its power coefficients."""
    discriminant = c2 * c2 - 3 * c1 * c3
    # q / (3 c3) and c1 / q are the roots of the derivative, in the forms without cancellation.
    q = -(c2 + jnp.where(c2 < 0, -1.0, 1.0) * jnp.sqrt(jnp.where(discriminant > 0, discriminant, 0.0)))
    stationary = q / jnp.where(c3 == 0, jnp.inf, 3 * c3), c1 / jnp.where(q == 0, jnp.inf, q)
    # The extremes lie at the ends of the segments or at the stationary points between them.
    candidates = [jnp.zeros_like(c0), *(jax.lax.stop_gradient(jnp.clip(t, 0, 1)) for t in stationary)]
    values = jnp.stack([c0 + t * (c1 + t * (c2 + t * c3)) for t in candidates])
    return jnp.min(values), jnp.max(values)


def _checked_points(name: str, points: ArrayLike) -> Array:
    """Return the argument `name` as an array of at least four finite points, each unlike the next, or raise."""
    array = checked_array(name, points, (name, 2))
    if len(array) < 4:
        raise ValueError(f"{name}: a curve needs at least 4; got {len(array)}")
    known = concrete(array)
    if known is not None:
        gap = np.linalg.norm(np.roll(known, -1, axis=0) - known, axis=1)
        if gap.min() <= 1e-9 * np.max(np.ptp(known, axis=0)):
            first = int(np.argmin(gap))
            raise ValueError(
                f"{name}: {first} and {(first + 1) % len(known)} are the same point; each is given once, and the "
                "first is not repeated at the end"
            )
    return array


def _evaluate(control: Any, parameter: Any, xp: Any = jnp) -> tuple[Vec2, Vec2, Vec2]:
    """Return the point and its first and second derivative at parameters of any shape, counted in segments."""
    # with NumPy as `xp` in float64, whatever precision JAX runs in
    index = xp.floor(parameter).astype(int)
    return entry_at(spline_segments(control, xp), index % len(control)).evaluate(parameter - index, xp)


def _checked_signed_area(control: np.ndarray) -> float:
    """Return the approximate signed area, m^2; raise if the curve encloses no area, has a cusp or crosses itself."""
    samples = max(4, min(16, 1200 // len(control)))  # per segment; all pairs of samples are compared
    point, velocity, _ = _evaluate(control, np.arange(len(control) * samples) / samples, np)
    points, speed = np.stack(point, axis=1), np.hypot(*velocity)
    size, area = float(np.max(np.ptp(points, axis=0))), signed_area(np, points)
    if abs(area) <= 1e-9 * size**2:
        raise ValueError(f"control: the curve encloses no area ({abs(area):.3g} m^2)")
    if speed.min() <= 1e-6 * speed.max():
        raise ValueError(f"control: the curve has a cusp near control point {int(np.argmin(speed)) // samples}")
    crossed = find_self_intersection(points, 1e-9 * size)
    if crossed is not None:
        raise ValueError(
            "control: the curve crosses or touches itself (near control points "
            f"{crossed[0] // samples} and {crossed[1] // samples}, counted from 0)"
        )
    return area


def _is_convex(control: Array, claimed: bool | None) -> bool:
    """Return whether the curve turns inward at none of 32 points per segment, up to roundoff; if traced, `claimed`."""
    known = concrete(control)
    if known is None:
        return bool(claimed)
    count = len(known)
    points, velocity, second = _evaluate(known.astype(np.float64), np.arange(32 * count) / 32, np)
    curvature = np.asarray(velocity.cross(second)) / np.hypot(*velocity) ** 3
    # Error of the curvature from roundoff in the second differences of the control points.
    roundoff = 16 * float(jnp.finfo(control.dtype).eps) * count**2
    tolerance = roundoff * np.max(np.abs(known)) / np.max(np.ptp(points, axis=1)) ** 2
    convex = bool(curvature.min() >= -tolerance)
    if claimed and not convex:
        near = int(np.argmin(curvature)) // 32
        raise ValueError(
            f"convex is True, but the curve is not: it turns inward near control point {near}, "
            "counted counterclockwise from 0"
        )
    return convex if claimed is None else bool(claimed)


@in_numpy
def _solve(xp, matrix, right):
    """Solve a linear system."""
    return xp.linalg.solve(matrix, right)


# Maps the four control points around a segment (before it, near its two ends, after it) to its power coefficients.
_BASIS = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6


def _fit_control_points(points: np.ndarray, controls: int) -> np.ndarray:
    """Return the control points, shape (controls, 2), m, that alternating least squares fits to `points`."""
    before, after = (np.linalg.norm(points - np.roll(points, k, axis=0), axis=1) for k in (1, -1))
    weight = np.sqrt((before + after) / 2)[:, None]
    arc_length = np.concatenate([[0], np.cumsum(after)])
    # A point's parameter starts at its fraction of the outline's length.
    parameter = arc_length[:-1] / arc_length[-1] * controls
    normal, tangent = np.broadcast_to(np.eye(2)[:, None], (2, len(points), 2))
    for iteration in range(FIT_ITERATIONS):
        index = np.floor(parameter).astype(int)
        basis = (parameter - index)[:, None] ** np.arange(4)[None] @ _BASIS
        design = np.zeros((len(points), controls))
        for k in range(4):
            design[np.arange(len(points)), (index + k - 1) % controls] += basis[:, k]
        # The first iterations minimize the whole distance between a point and the curve's point at its parameter. The
        # later ones weight mostly the distance along the normal, because the parameter can compensate for the rest.
        tangent_weight = 1.0 if iteration < FIT_ITERATIONS // 4 else 0.1
        rows = [weight * scale * direction for scale, direction in ((1.0, normal), (tangent_weight, tangent))]
        stacked_design = np.concatenate([(row[:, :, None] * design[:, None]).reshape(len(points), -1) for row in rows])
        stacked_value = np.concatenate([np.sum(row * points, axis=1) for row in rows])
        control = np.linalg.lstsq(stacked_design, stacked_value, rcond=None)[0].reshape(2, controls).T
        point, first, second = _evaluate(control, parameter, np)
        offset = Vec2(*points.T) - point
        # One Newton step for the parameters. The lower bound on the curvature keeps it a descent step.
        squared = first.dot(first)
        curvature = np.maximum(squared - offset.dot(second), 0.5 * squared)
        parameter = parameter + np.clip(offset.dot(first) / curvature, -0.25, 0.25)
        tangent = np.stack(_evaluate(control, parameter, np)[1], axis=1)
        tangent = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
        normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    return control
