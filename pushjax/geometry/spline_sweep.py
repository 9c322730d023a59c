"""First contact of a disk that moves along a straight path with a closed cubic spline.

A disk of radius r that starts at x touches the outline's point p(u) where x + t path = p(u) + r n(u), with the outward
normal n. So g(u) = cross(path, p + r n - x) = 0. The first contact is the root with the least t, because at every root
the disk's center is at most r from the outline.

The derivative is g' = cross(path, p') (1 + r kappa), where kappa is the curvature, negative in a hollow (a concave part
of the outline). The derivative changes sign at two kinds of places only. At the first, the outline is parallel to the
path; a quadratic per segment gives these places exactly. At the second, the disk has the same curvature as the hollow
it is in. These places do not depend on the path, and are found with a grid of `HOLLOW_SAMPLES` intervals per segment.
Between all these places g is monotone. So the values of g at them decide whether there is a root.
"""

from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._internal.xla import compute_once, decide, tree_where
from pushjax._math.roots import Proposal, bracketed_root
from pushjax._math.vec import Scalar, Vec2
from pushjax.geometry.shape import roundoff
from pushjax.geometry.spline_segment import SplineSegment, outward_normal

SWEEP_ITERATIONS = 10
# How many of the places where the disk enters the outline on the line of the path are solved for, nearest first. More
# than one is needed because their order is known only approximately beforehand.
MAX_ENTRIES = 3
# Intervals per segment. At their ends the sweep checks whether the disk fits into the curvature of the hollow. It
# misses a place that is too tight only between two ends.
HOLLOW_SAMPLES = 16


def first_contact(segments: SplineSegment, x: Vec2, path: Vec2, radius: Scalar, *, convex: bool) -> Scalar:
    """Return the fraction of `path` after which a disk first touches a closed spline, or inf; see `Outline.sweep`."""
    fixed = jax.lax.stop_gradient((segments, x, path, radius))
    index, t, fraction = _first_root(*fixed, convex=convex)
    # Evaluated again with the differentiable arguments, to give the fraction its derivatives.
    return jnp.where(fraction <= 1, _contact_fraction(segments.select(index), t, x, path, radius), jnp.inf)


class OffsetPoint(NamedTuple):
    """The center of a disk that touches a segment from outside: a point of the offset curve."""

    center: Vec2  # m
    velocity: Vec2  # by the segment's parameter, m

    @staticmethod
    def of(segment: SplineSegment, t: Scalar, radius: Scalar) -> "OffsetPoint":
        """Return the point of the offset curve for a disk of `radius` that touches `segment` at the parameter `t`."""
        point, first, second = segment.evaluate(t)
        normal, speed = outward_normal(first)
        # 1 + r kappa; negative where the hollow is too tight for the disk
        stretch = 1 + radius * first.cross(second) / (speed * speed * speed)
        return OffsetPoint(point + normal.scale(radius), first.scale(stretch))

    def relative_to_path(self, x: Vec2, path: Vec2) -> tuple[Scalar, Scalar, Scalar]:
        """Return g, its derivative by the segment's parameter, and the position along the path, m^2."""
        # g is the height over the line of the path that starts at `x`. All three include the path's length as a factor.
        rel = Vec2(self.center.x - x.x, self.center.y - x.y)
        return path.cross(rel), path.cross(self.velocity), path.dot(rel)


def _contact_fraction(segment: SplineSegment, t: Scalar, x: Vec2, path: Vec2, radius: Scalar) -> Scalar:
    """Return the fraction of the path at which a disk touches at the root `t` of g; infinite if not on the path."""
    height, slope, along = OffsetPoint.of(segment, t, radius).relative_to_path(x, path)
    # This Newton step makes the derivatives exact to third order. `stop_gradient` removes its value, because for a
    # grazing path it is magnified roundoff.
    step = -height / jnp.where(slope < 0, slope, -jnp.inf)
    t = t + step - jax.lax.stop_gradient(step)
    point, first, _ = segment.evaluate(t)
    normal, _ = outward_normal(first)
    rel, squared, approach = x - point, path.dot(path), -normal.dot(path)
    # The value comes from the projection of the touching disk's center on the path, which is well-conditioned even for
    # a path that only grazes the outline. The derivatives come from `by_tangent`, the fraction at which the disk
    # reaches the tangent line at `t`. Both fractions are equal.
    fraction = jax.lax.stop_gradient(along / jnp.where(squared > 0, squared, 1.0))
    tolerance = roundoff(jnp.abs(x.x) + jnp.abs(x.y) + jnp.abs(point.x) + jnp.abs(point.y) + radius)
    hits = (approach > 0) & (fraction * approach >= -tolerance) & (fraction <= 1)
    by_tangent = (normal.dot(rel) - radius) / jnp.where(hits, approach, 1.0)
    fraction = jnp.maximum(fraction, 0) + by_tangent - jax.lax.stop_gradient(by_tangent)
    return jnp.where(hits, fraction, jnp.inf)


class MonotoneInterval(NamedTuple):
    """An interval of a segment on which g is monotone, or arrays of such intervals."""

    start: Scalar  # segment parameters
    end: Scalar
    height_start: Scalar  # g, m^2
    height_end: Scalar
    along_start: Scalar  # position along the path, times the path's length, m^2
    along_end: Scalar
    flat_start: Bool[Array, ""]  # whether g' is zero
    flat_end: Bool[Array, ""]

    def initial_guess(self) -> tuple[Array, Array, Array]:
        """Return a guess of the root as a fraction of the interval, and whether g is parabolic about start and end."""
        # g is taken to be linear, or parabolic about an end where it is flat.
        fall = self.height_start - self.height_end
        fraction = jnp.clip(self.height_start / jnp.where(fall > 0, fall, 1.0), 0, 1)
        both = self.flat_start & self.flat_end
        rooted, rest = (jnp.sqrt(part / jnp.where(both, 2, 1)) for part in (fraction, 1 - fraction))
        early = self.flat_start & (~both | (fraction < 0.5))
        late = self.flat_end & ~early
        return jnp.where(early, rooted, jnp.where(late, 1 - rest, fraction)), early, late


class FreeInterval(NamedTuple):
    """An interval of a segment that a disk can touch from outside, or arrays of such intervals."""

    low: Scalar  # segment parameters; the interval is empty if they are equal
    high: Scalar
    at_low: OffsetPoint  # the touching disks at `low` and `high`
    at_high: OffsetPoint


def _monotone_intervals(
    segment: SplineSegment, free_intervals: list[FreeInterval], x: Vec2, path: Vec2, radius: Scalar
) -> list[MonotoneInterval]:
    """Return the intervals of a segment, or of an array of segments, on which g is monotone; some can be empty."""
    # The two parameters at which the outline is parallel to the path: roots of a quadratic.
    constant, linear, square = (
        path.cross(c.scale(k)) for k, c in enumerate((segment.c1, segment.c2, segment.c3), start=1)
    )
    discriminant = linear * linear - 4 * constant * square
    q = -(linear + jnp.where(linear < 0, -1.0, 1.0) * jnp.sqrt(jnp.maximum(discriminant, 0))) / 2
    first_root, second_root = q / jnp.where(square == 0, jnp.inf, square), constant / jnp.where(q == 0, jnp.inf, q)
    turning = [
        jnp.where(discriminant > 0, jnp.clip(f(first_root, second_root), 0, 1), 0) for f in (jnp.minimum, jnp.maximum)
    ]
    heights = [OffsetPoint.of(segment, t, radius).relative_to_path(x, path) for t in turning]
    intervals = []
    for low, high, *ends in free_intervals:
        first, last = (end.relative_to_path(x, path) for end in ends)

        def within(t, turning_point, low=low, high=high, first=first, last=last):
            before, after = t <= low, t >= high
            height, _, along = tree_where(before, first, tree_where(after, last, turning_point))
            return jnp.clip(t, low, high), height, along, ~before & ~after

        stops = [within(t, turning_point) for t, turning_point in zip(turning, heights, strict=True)]
        stops = [(low, first[0], first[2], low > 0), *stops, (high, last[0], last[2], high < 1)]
        # The fields of `MonotoneInterval` alternate between the start and the end.
        intervals += [MonotoneInterval(*(end[k] for k in range(4) for end in ends)) for ends in pairwise(stops)]
    return intervals


def _free_intervals(segments: SplineSegment, radius: Scalar, convex: bool) -> list[tuple[Array, Array]]:
    """Return the first and last interval, as its start and end, of each segment that a disk can touch from outside."""
    zero = jnp.zeros_like(segments.c0.x)
    if convex:
        return [(zero, zero + 1)]
    grid = jnp.linspace(0, 1, HOLLOW_SAMPLES + 1, dtype=zero.dtype)
    columns = jax.tree.map(lambda field: field[:, None], segments)

    def clearance(segments, t):
        _, first, second = segments.evaluate(t)
        _, speed = outward_normal(first)
        return speed * speed * speed + radius * first.cross(second)

    # A segment without an interval gets one whose ends are equal. A third interval between the two is left out.
    fits = clearance(columns, jnp.broadcast_to(grid[None], (zero.size, grid.size))) > 0
    padded = jnp.pad(fits, ((0, 0), (1, 1)))
    rises, falls = fits & ~padded[:, :-2], fits & ~padded[:, 2:]

    def interval_end(node, outward):
        """Locate the end of an interval between its last node, where the disk fits, and the next, where it does not."""
        inner, outer = grid[node], jnp.clip(grid[node] + outward / HOLLOW_SAMPLES, 0, 1)
        values = clearance(segments, inner), clearance(segments, outer)
        for _ in range(6):  # false position; the value at the end that stays is halved
            t = inner + (outer - inner) * values[0] / jnp.where(values[0] == values[1], jnp.inf, values[0] - values[1])
            value = clearance(segments, t)
            kept = value > 0
            inner, outer = jnp.where(kept, t, inner), jnp.where(kept, outer, t)
            values = jnp.where(kept, value, values[0] / 2), jnp.where(kept, values[1] / 2, value)
        return inner

    last = grid.size - 1
    low, high = interval_end(jnp.argmax(rises, axis=1), -1), interval_end(jnp.argmax(falls, axis=1), 1)
    low_2, high_2 = (
        interval_end(last - jnp.argmax(rises[:, ::-1], axis=1), -1),
        interval_end(last - jnp.argmax(falls[:, ::-1], axis=1), 1),
    )
    has_one, has_two = jnp.any(fits, axis=1), jnp.sum(rises, axis=1) > 1
    return [
        (jnp.where(has_one, low, 0), jnp.where(has_one, high, 0)),
        (jnp.where(has_two, low_2, 1), jnp.where(has_two, high_2, 1)),
    ]


def _entry_estimate(interval: MonotoneInterval, squared: Scalar, tolerance: Scalar) -> Scalar:
    """Estimate how far along the path the disk enters the outline in an interval; infinite if it does not."""
    fall = interval.height_start - interval.height_end
    enters = (interval.height_start >= -tolerance) & (interval.height_end <= tolerance) & (fall > 0)
    begin, *_ = interval.initial_guess()
    along = interval.along_start + begin * (interval.along_end - interval.along_start)
    # In a hollow, the positions in the interval lie at most this far beyond those of its ends.
    spread = fall + jnp.abs(interval.along_end - interval.along_start)
    on_path = (along + spread >= -tolerance) & (along - spread <= squared + tolerance)
    return jnp.where(enters & on_path, along, jnp.inf)


def _first_root(segments: SplineSegment, x: Vec2, path: Vec2, radius: Scalar, *, convex: bool):
    """Return the segment's index, the parameter and the fraction of the path at the first root of g, or inf if none."""
    # The free intervals and the extent do not depend on the path, so they are computed once for a batch of paths.
    like = segments.c0.x[0]
    free_intervals = [
        FreeInterval(low, high, OffsetPoint.of(segments, low, radius), OffsetPoint.of(segments, high, radius))
        for low, high in compute_once(_free_intervals(segments, radius, convex), like)
    ]
    extent = jnp.max(jnp.abs(segments.c0.x)) + jnp.max(jnp.abs(segments.c0.y))
    free_intervals, extent = compute_once((free_intervals, extent), like)
    squared = path.dot(path)
    length = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
    tolerance = roundoff(extent + jnp.abs(x.x) + jnp.abs(x.y) + radius) * length
    intervals = _monotone_intervals(segments, free_intervals, x, path, radius)
    entry_estimates = jnp.concatenate([_entry_estimate(interval, squared, tolerance) for interval in intervals])

    def solve_nearest_entry(_, carry):
        entry_estimates, best = carry
        chosen = jnp.argmin(entry_estimates)
        interval_number, index = jnp.divmod(chosen, segments.c0.x.size)
        segment, free = jax.tree.map(lambda field: field[index], (segments, free_intervals))
        intervals = _monotone_intervals(segment, free, x, path, radius)
        interval = intervals[0]
        for k, candidate in enumerate(intervals[1:], start=1):
            interval = tree_where(interval_number == k, candidate, interval)
        t = _root_in_interval(segment, interval, x, path, radius)
        fraction = _contact_fraction(segment, t, x, path, radius)
        (is_sooner,) = decide(((entry_estimates[chosen] < jnp.inf) & (fraction < best[2]),), x.x)
        entry_estimates = jnp.where(jnp.arange(entry_estimates.size) == chosen, jnp.inf, entry_estimates)
        return entry_estimates, tree_where(is_sooner, (index, t, fraction), best)

    none = jnp.zeros_like(jnp.argmin(entry_estimates)), jnp.zeros_like(tolerance), jnp.full_like(tolerance, jnp.inf)
    return jax.lax.fori_loop(0, MAX_ENTRIES, solve_nearest_entry, (entry_estimates, none))[1]


def _root_in_interval(
    segment: SplineSegment, interval: MonotoneInterval, x: Vec2, path: Vec2, radius: Scalar
) -> Scalar:
    """Return where g falls through zero in an interval, by Newton's method with bisection if it leaves the bracket."""
    guess, early, late = interval.initial_guess()
    # If g is nearly parabolic about an end, Newton's method solves for the squared distance from that end.
    center, parabolic = jnp.where(early, interval.start, interval.end), early | late

    def propose(t: Scalar) -> Proposal:
        height, slope, _ = OffsetPoint.of(segment, t, radius).relative_to_path(x, path)
        step = -height / jnp.where(slope < 0, slope, -jnp.inf)
        offset = t - center
        target_squared = offset * (offset + 2 * step)
        parabolic_root = center + jnp.where(offset < 0, -1.0, 1.0) * jnp.sqrt(jnp.maximum(target_squared, 0))
        proposal = jnp.where(parabolic & (target_squared >= 0), parabolic_root, t + step)
        return Proposal(height > 0, proposal, usable=slope < 0, is_tiny=jnp.abs(proposal - t) < 1e-6)

    start = interval.start + guess * (interval.end - interval.start)
    return compute_once(bracketed_root(propose, start, interval.start, interval.end, SWEEP_ITERATIONS), x.x)
