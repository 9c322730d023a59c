"""Hands: the fingers, and where a configuration puts them; paths through configurations."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax._checks import Numeric, as_float, common_dtype, concrete, finite, non_negative, shaped
from pushjax._vec import Scalar, Vec2


class Hand(eqx.Module):
    """A position-controlled hand: round fingers, and a map from configurations to their centres in the world.

    radius: (fingers,), m; zero is a point. dof: numbers in a configuration.
    """

    radius: Float[Array, "fingers"]
    dof: int = eqx.field(static=True)

    def __check_init__(self):
        if self.radius.shape != (1,) or self.dof != 2:
            raise ValueError(f"a hand has one finger of two degrees of freedom; got {self.radius.shape}, {self.dof}")

    @staticmethod
    def finger(radius: Numeric = 0.0) -> "Hand":
        """One round finger of `radius` m that does not turn; its configuration is (x, y) of its centre, world, m."""
        r = as_float(radius)
        shaped("radius", r, ())
        finite("radius", r)
        non_negative("radius", r)
        return Hand(r[None], 2)

    def centers(self, configuration: tuple[Scalar, ...]) -> tuple[Vec2, ...]:
        """World position of each finger's centre."""
        x, y = configuration
        return (Vec2(x, y),)


def line(start: Numeric, end: Numeric, steps: int) -> Float[Array, "{steps}+1 dof"]:
    """A straight path of `steps` equal steps between two configurations (dof,), both included.

    Raises ValueError for fewer than one step, or configurations that differ in shape or are not finite.
    """
    _check_steps(steps)
    dtype = common_dtype(start, end)
    a, b = as_float(start, dtype), as_float(end, dtype)
    shaped("start", a, ("dof",))
    shaped("end", b, (a.shape[0],))
    finite("start", a)
    finite("end", b)
    t = jnp.arange(steps + 1, dtype=dtype)[:, None] / steps
    return a[None] * (1 - t) + b[None] * t  # exact at both ends


def resample(path: Numeric, steps: int) -> Float[Array, "{steps}+1 dof"]:
    """A recorded path (points, dof) as `steps` steps of equal length along it; its first and last points stay.

    Length is measured in the configuration's own units, straight from point to point. A path that does not move
    repeats its first point. Raises ValueError for fewer than two points or one step, or values that are not finite.
    """
    _check_steps(steps)
    p = checked_path(path, None)
    squared = jnp.sum(jnp.diff(p, axis=0) ** 2, axis=1)
    moves = squared > 0  # a root's derivative is infinite where a recording pauses
    hops = jnp.where(moves, jnp.sqrt(jnp.where(moves, squared, 1.0)), 0.0)
    arc = jnp.concatenate([jnp.zeros(1, p.dtype), jnp.cumsum(hops)])
    at = jnp.arange(steps + 1, dtype=p.dtype) / steps * arc[-1]
    return jnp.stack([jnp.interp(at, arc, column) for column in p.T], axis=1)


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
