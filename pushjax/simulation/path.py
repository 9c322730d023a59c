"""Paths of a hand: arrays of configurations, one row for the start of each step and one for the end of the path."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax._internal.checks import (
    ArrayLike,
    as_float,
    check_count,
    check_shape,
    checked_array,
    common_dtype,
    concrete,
    in_numpy,
)


def line(start: ArrayLike, end: ArrayLike, steps: int) -> Float[Array, "{steps}+1 dof"]:
    """Straight path of equal steps between two configurations, both included.

    Args:
        start: First configuration, (dof,).
        end: Last configuration, (dof,).
        steps: Number of steps.

    Returns:
        The path, (steps + 1, dof).

    Raises:
        ValueError: For fewer than one step, or for configurations that differ in shape or are not finite.

    Examples:
        >>> line((0.0, 0.0), (0.5, 0.0), steps=2).tolist()
        [[0.0, 0.0], [0.25, 0.0], [0.5, 0.0]]
    """
    check_count("steps", steps)
    dtype = common_dtype(start, end)
    a = checked_array("start", start, ("dof",), dtype)
    b = checked_array("end", end, (a.shape[0],), dtype)
    return _line(a, b, steps=steps)


@in_numpy
def _line(xp: Any, start: Array, end: Array, *, steps: int) -> Array:
    fraction = xp.arange(steps + 1, dtype=start.dtype)[:, None] / steps
    return start[None] * (1 - fraction) + end[None] * fraction  # exact at both ends


def arc(start: ArrayLike, center: ArrayLike, angle: ArrayLike, steps: int) -> Float[Array, "{steps}+1 dof"]:
    """Circular path of equal steps: the hand turns about a point like a rigid body.

    Args:
        start: First configuration, (dof,): x and y, m; then, if there are more, the angle of the hand, rad, which turns
            with it, and numbers that stay, such as an opening.
        center: Point about which the hand turns, (2,), world, m.
        angle: Angle by which it turns, rad, counterclockwise.
        steps: Number of steps.

    Returns:
        The path, (steps + 1, dof).

    Raises:
        ValueError: For fewer than one step, for a configuration of fewer than two numbers, or for values that are not
            finite.

    Examples:
        >>> import numpy as np
        >>> arc((0.1, 0.0, 0.0), (0.0, 0.0), np.pi / 2, steps=2).round(4).tolist()
        [[0.1, 0.0, 0.0], [0.0707, 0.0707, 0.7854], [0.0, 0.1, 1.5708]]
    """
    check_count("steps", steps)
    dtype = common_dtype(start, center, angle)
    start_array = checked_array("start", start, ("dof",), dtype)
    if start_array.shape[0] < 2:
        raise ValueError(f"start must hold at least x and y; got shape {start_array.shape}")
    center_array = checked_array("center", center, (2,), dtype)
    angle_array = checked_array("angle", angle, (), dtype)
    return _arc(start_array, center_array, angle_array, steps=steps)


@in_numpy
def _arc(xp: Any, start: Array, center: Array, angle: Array, *, steps: int) -> Array:
    angles = xp.arange(steps + 1, dtype=start.dtype) / steps * angle
    cos, sin = xp.cos(angles), xp.sin(angles)
    offset_x, offset_y = start[0] - center[0], start[1] - center[1]
    columns = [center[0] + cos * offset_x - sin * offset_y, center[1] + sin * offset_x + cos * offset_y]
    if start.shape[0] > 2:
        columns.append(start[2] + angles)
    columns += [xp.full_like(angles, 1) * start[k] for k in range(3, start.shape[0])]
    return xp.stack(columns, axis=-1)


def through(configurations: ArrayLike, steps: int | Sequence[int]) -> Float[Array, "points dof"]:
    """Path that goes straight from each waypoint to the next and meets all of them exactly.

    Args:
        configurations: Waypoints, (points, dof).
        steps: Number of equal steps on each stretch between waypoints: one number for all stretches, or one for each.

    Returns:
        The path, (sum of all steps + 1, dof).

    Raises:
        ValueError: For fewer than two waypoints, for fewer than one step on a stretch, for a wrong number of `steps`,
            or for values that are not finite.
    """
    waypoints = checked_path(configurations, None)
    num_stretches = waypoints.shape[0] - 1
    counts: list[Any] = (
        np.broadcast_to(steps, num_stretches).tolist() if np.ndim(steps) == 0 else np.ravel(steps).tolist()
    )
    if len(counts) != num_stretches:
        raise ValueError(f"steps must be one number, or one for each of {num_stretches} stretches; got {len(counts)}")
    return jnp.concatenate(
        [waypoints[:1], *(line(waypoints[k], waypoints[k + 1], n)[1:] for k, n in enumerate(counts))]
    )


def resample(path: ArrayLike, steps: int) -> Float[Array, "{steps}+1 dof"]:
    """Resample a recorded path into steps of equal length along it; its first and last points stay.

    Length is in the units of the configuration, straight from point to point. Interpolation would turn an angle that
    jumps from pi to -pi back through zero, so unwrap such angles first. A path that does not move repeats its first
    point.

    Args:
        path: Recorded configurations, (points, dof).
        steps: Number of steps of the result.

    Returns:
        The path, (steps + 1, dof).

    Raises:
        ValueError: For fewer than two points or one step, or for values that are not finite.
    """
    check_count("steps", steps)
    points = checked_path(path, None)
    lengths = arc_length(points)
    return interpolate_arc_length(points, lengths, jnp.arange(steps + 1, dtype=points.dtype) / steps * lengths[-1])


def arc_length(points: Float[Array, "points n"]) -> Float[Array, "points"]:
    """Return the length from the first point to each point, straight from point to point."""
    squared = jnp.sum(jnp.diff(points, axis=0) ** 2, axis=1)
    moves = squared > 0  # the derivative of the square root is infinite where a recording pauses
    distances = jnp.where(moves, jnp.sqrt(jnp.where(moves, squared, 1.0)), 0.0)
    return jnp.concatenate([jnp.zeros(1, points.dtype), jnp.cumsum(distances)])


def interpolate_arc_length(path: Array, arc: Float[Array, "points"], at: Float[Array, "k"]) -> Float[Array, "k dof"]:
    """Return the configurations at the lengths `at`; beyond an end of the path, that end."""
    return jnp.stack([jnp.interp(at, arc, column) for column in path.T], axis=1)


def checked_path(path: ArrayLike, dof: int | None, dtype: Any = None) -> Float[Array, "points dof"]:
    """Return a path as a floating array; raise ValueError for fewer than two rows or for values that are not finite."""
    array = as_float(path, dtype, "path")
    check_shape("path", array, ("steps + 1", "dof" if dof is None else dof))
    if array.shape[0] < 2:
        raise ValueError(f"path needs at least one step, two configurations; got {array.shape[0]}")
    known = concrete(array)
    if known is not None:
        bad = np.flatnonzero(~np.isfinite(known).all(axis=1))
        if bad.size:
            raise ValueError(f"path must be finite; {bad.size} configuration(s) are not, the first at index {bad[0]}")
    return array
