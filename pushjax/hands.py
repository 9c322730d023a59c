"""Hands: the fingers, and where a configuration puts them; paths through configurations."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax._checks import Numeric, as_float, common_dtype, concrete, finite, in_numpy, non_negative, shaped
from pushjax.shapes import Polygon

Kinematics = Callable[[Array], Array]


class RoundFinger(eqx.Module):
    """A disc of `radius` m; zero is a point."""

    radius: Float[Array, ""]

    def __init__(self, radius: Numeric):
        r = as_float(radius)
        shaped("radius", r, ())
        finite("radius", r)
        non_negative("radius", r)
        self.radius = r


class Pad(eqx.Module):
    """A convex polygon, in the finger's own frame."""

    shape: Polygon

    def __init__(self, shape: Polygon):
        if not shape.convex:
            raise ValueError("shape: a pad must be a convex polygon whose vertices are known")
        self.shape = shape


Finger = RoundFinger | Pad


class Hand(eqx.Module):
    """A position-controlled hand: its fingers, and a map from configurations to where they are in the world.

    fingers: numbers (radii of discs, m), `Polygon`s (convex pads, in the finger's own frame), `RoundFinger`s or `Pad`s.
    kinematics: a function from a configuration (dof,) to the fingers' poses (fingers, 3), world, m and rad; or to their
    centres (fingers, 2), of a hand that never turns (not with pads). It is traced. least: what a configuration's last
    number, the opening, must not fall short of, if anything.

    Raises ValueError for no finger, or kinematics that do not give one pose a finger.
    """

    fingers: tuple[Finger, ...]
    kinematics: Kinematics = eqx.field(static=True)
    dof: int = eqx.field(static=True)
    least: Float[Array, ""] | None

    def __init__(self, fingers: Sequence[Any], kinematics: Kinematics, dof: int, least: Numeric | None = None):
        if not fingers:
            raise ValueError("fingers: a hand needs at least one; got none")
        self.fingers = tuple(_finger(finger) for finger in fingers)
        self.kinematics, self.dof = kinematics, dof
        self.least = None if least is None else as_float(least)
        shape = jax.eval_shape(kinematics, jax.ShapeDtypeStruct((dof,), jnp.result_type(float))).shape
        widths = (3,) if any(isinstance(f, Pad) for f in self.fingers) else (2, 3)
        if len(shape) != 2 or shape[0] != len(self.fingers) or shape[1] not in widths:
            wanted = " or ".join(f"({len(self.fingers)}, {width})" for width in widths)
            raise ValueError(f"kinematics gives shape {shape} for a configuration of {dof} numbers; expected {wanted}")

    @property
    def radius(self) -> Float[Array, "fingers"]:
        """m, of a hand with round fingers only."""
        return jnp.stack([finger.radius for finger in self.fingers])  # pyright: ignore[reportAttributeAccessIssue]

    @staticmethod
    def finger(radius: Numeric = 0.0) -> "Hand":
        """One round finger of `radius` m that does not turn; its configuration is (x, y) of its centre, world, m."""
        return Hand((radius,), _one, 2)

    @staticmethod
    def two_fingers(radius: Numeric = 0.0) -> "Hand":
        """Two round fingers of `radius` m at (0, d/2) and (0, -d/2) of the hand; configuration (x, y, theta, d)."""
        return Hand((radius, radius), _two, 4, least=2 * as_float(radius))

    @staticmethod
    def three_fingers(radius: Numeric = 0.0) -> "Hand":
        """Three round fingers of `radius` m at distance d from the hand's origin, the first on its +y axis, the others
        120 degrees apart; configuration (x, y, theta, d)."""
        return Hand((radius, radius, radius), _three, 4, least=2 / 3**0.5 * as_float(radius))

    @staticmethod
    def parallel_jaw(width: Numeric, thickness: Numeric) -> "Hand":
        """Two rectangular pads that face each other along the hand's y axis: faces of `width` m along x, `thickness` m
        behind them; configuration (x, y, theta, d), d the opening between the faces. A pad's pose is that of its face's
        middle."""
        pad = Polygon.rectangle(width, thickness).vertices
        behind = jnp.stack([jnp.zeros_like(pad[0, 1]), pad[2, 1]])
        upper, lower = (Polygon(pad + sign * behind[None], convex=True) for sign in (1, -1))
        return Hand((upper, lower), _two, 4, least=0.0)

    def poses(self, path: Float[Array, "*steps dof"]) -> Float[Array, "*steps fingers width"]:
        """World poses (3) or centres (2) of the fingers along a path."""
        shape = jax.eval_shape(self.kinematics, jax.ShapeDtypeStruct((self.dof,), path.dtype)).shape
        return jax.vmap(self.kinematics)(path.reshape(-1, self.dof)).reshape(*path.shape[:-1], *shape)


def _finger(finger: Any) -> Finger:
    if isinstance(finger, RoundFinger | Pad):
        return finger
    return Pad(finger) if isinstance(finger, Polygon) else RoundFinger(finger)


def _one(q: Array) -> Array:
    return q[None]


def _placed(q: Array, offsets: list[tuple[Any, Any]]) -> Array:
    """Poses of fingers that turn with the hand, at offsets in its frame."""
    c, s = jnp.cos(q[2]), jnp.sin(q[2])
    return jnp.stack([jnp.stack([q[0] + c * x - s * y, q[1] + s * x + c * y, q[2]]) for x, y in offsets])


def _two(q: Array) -> Array:
    return _placed(q, [(0.0, q[3] / 2), (0.0, -q[3] / 2)])


def _three(q: Array) -> Array:
    side = 3**0.5 / 2 * q[3]
    return _placed(q, [(0.0, q[3]), (side, -q[3] / 2), (-side, -q[3] / 2)])


def line(start: Numeric, end: Numeric, steps: int) -> Float[Array, "{steps}+1 dof"]:
    """A straight path of `steps` equal steps between two configurations (dof,), both included.

    Raises ValueError for fewer than one step, or configurations that differ in shape or are not finite.

    >>> line((0.0, 0.0), (0.5, 0.0), steps=2).tolist()
    [[0.0, 0.0], [0.25, 0.0], [0.5, 0.0]]
    """
    _check_steps(steps)
    dtype = common_dtype(start, end)
    a, b = as_float(start, dtype), as_float(end, dtype)
    shaped("start", a, ("dof",))
    shaped("end", b, (a.shape[0],))
    finite("start", a)
    finite("end", b)
    return _line(a, b, steps=steps)


@in_numpy
def _line(xp: Any, start: Array, end: Array, *, steps: int) -> Array:
    t = xp.arange(steps + 1, dtype=start.dtype)[:, None] / steps
    return start[None] * (1 - t) + end[None] * t  # exact at both ends


def through(configurations: Numeric, steps: int | Sequence[int]) -> Float[Array, "points dof"]:
    """A path straight from each way point to the next, all of which it meets exactly.

    configurations: the way points (points, dof). steps: equal steps on each stretch, one number for all or one each.
    Raises ValueError for fewer than two way points or one step on a stretch, or values that are not finite.
    """
    p = checked_path(configurations, None)
    stretches = p.shape[0] - 1
    each: list[Any] = np.broadcast_to(steps, stretches).tolist() if np.ndim(steps) == 0 else np.ravel(steps).tolist()
    if len(each) != stretches:
        raise ValueError(f"steps must be one number, or one for each of {stretches} stretches; got {len(each)}")
    return jnp.concatenate([p[:1], *(line(p[k], p[k + 1], n)[1:] for k, n in enumerate(each))])


def resample(path: Numeric, steps: int) -> Float[Array, "{steps}+1 dof"]:
    """A recorded path (points, dof) as `steps` steps of equal length along it; its first and last points stay.

    Length is measured in the configuration's own units, straight from point to point; an angle that jumps from pi to
    -pi on the way would be turned back through zero: unwrap it first. A path that does not move repeats its first
    point. Raises ValueError for fewer than two points or one step, or values that are not finite.
    """
    _check_steps(steps)
    p = checked_path(path, None)
    arc = arc_length(p)
    return at_lengths(p, arc, jnp.arange(steps + 1, dtype=p.dtype) / steps * arc[-1])


def arc_length(points: Float[Array, "points n"]) -> Float[Array, "points"]:
    """From the first point to each, straight from point to point."""
    squared = jnp.sum(jnp.diff(points, axis=0) ** 2, axis=1)
    moves = squared > 0  # a root's derivative is infinite where a recording pauses
    hops = jnp.where(moves, jnp.sqrt(jnp.where(moves, squared, 1.0)), 0.0)
    return jnp.concatenate([jnp.zeros(1, points.dtype), jnp.cumsum(hops)])


def at_lengths(path: Array, arc: Float[Array, "points"], at: Float[Array, "k"]) -> Float[Array, "k dof"]:
    """The path at other lengths than those of its points."""
    return jnp.stack([jnp.interp(at, arc, column) for column in path.T], axis=1)


def _check_steps(steps: int) -> None:
    if not isinstance(steps, (int, np.integer)):
        raise ValueError(f"steps must be a whole number; got {steps!r}")
    if steps < 1:
        raise ValueError(f"steps must be at least 1; got {steps}")


def checked_path(path: Numeric, dof: int | None, dtype: Any = None) -> Float[Array, "points dof"]:
    p = as_float(path, dtype)
    shaped("path", p, ("steps + 1", "dof" if dof is None else dof))
    if p.shape[0] < 2:
        raise ValueError(f"path needs at least one step, two configurations; got {p.shape[0]}")
    known = concrete(p)
    if known is not None:
        bad = np.flatnonzero(~np.isfinite(known).all(axis=1))
        if bad.size:
            raise ValueError(f"path must be finite; {bad.size} configuration(s) are not, the first at index {bad[0]}")
    return p
