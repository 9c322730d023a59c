"""Recorded pushes as arrays: what identification learns from."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pushjax._checks import Numeric, as_float, common_dtype, finite, instance, non_negative, shaped
from pushjax.shapes import Shape

STEPS = 50
ARRAYS = ("start", "path", "end", "weight", "along", "wrench", "twist", "age", "side")


class Given(NamedTuple):
    """A push before it happens; see `Pushes`."""

    start: Float[Array, "*pushes 3"]
    path: Float[Array, "*pushes steps+1 dof"]
    age: Float[Array, "*pushes"]
    side: Float[Array, "*pushes"]


class Pushes(eqx.Module):
    """Pushes of one slider by one hand; with a leading axis, of several conditions.

    start, end: (pushes, 3), the slider's pose before and after, world, m and rad; the end angle is the one that the
    slider really turned to. path: (pushes, steps + 1, dof), the hand's, world, as in `rollout`. weight: (pushes,), how
    much each counts; zero leaves it out.

    What else may have been recorded. along: (pushes, k, 3), the slider's pose on the way, after the path's steps
    `rows`: at equal parts of it. wrench, twist: (pushes, p, 3), wrenches on the slider and the motion that it made
    under each, both in the body frame about its origin, of any scale; where either is zero there is none. All poses of
    a push together count as much as one, for they are off together; and so do all its pairs.

    What friction may depend on, if `Unknowns` says so. age: (pushes,), when each push was, from 0 (the first) to 1 (the
    last). side: (pushes,), which side of the slider was pushed, from 0 on; one that `Unknowns.sides` has not is the
    last.

    Raises ValueError for arrays of the wrong shape, not finite, or a negative weight or side.
    """

    start: Float[Array, "*conditions pushes 3"]
    path: Float[Array, "*conditions pushes steps+1 dof"]
    end: Float[Array, "*conditions pushes 3"]
    weight: Float[Array, "*conditions pushes"]
    along: Float[Array, "*conditions pushes seen 3"]
    wrench: Float[Array, "*conditions pushes pairs 3"]
    twist: Float[Array, "*conditions pushes pairs 3"]
    age: Float[Array, "*conditions pushes"]
    side: Float[Array, "*conditions pushes"]

    def __init__(
        self,
        start: Numeric,
        path: Numeric,
        end: Numeric,
        weight: Numeric | None = None,
        *,
        along: Numeric | None = None,
        wrench: Numeric | None = None,
        twist: Numeric | None = None,
        age: Numeric | None = None,
        side: Numeric | None = None,
    ):
        dtype = common_dtype(start, path, end)
        self.start, self.path, self.end = (as_float(value, dtype) for value in (start, path, end))
        if self.start.ndim not in (2, 3):
            raise ValueError(f"start has shape {self.start.shape}; expected (pushes, 3), or with conditions in front")
        many = self.start.shape[:-1]
        none = jnp.zeros((*many, 0, 3), dtype)
        self.weight = jnp.ones(many, dtype) if weight is None else as_float(weight, dtype)
        self.along, self.wrench, self.twist = (
            none if value is None else as_float(value, dtype) for value in (along, wrench, twist)
        )
        self.age, self.side = (
            jnp.zeros(many, dtype) if value is None else as_float(value, dtype) for value in (age, side)
        )
        shaped("end", self.end, (*many, 3))
        shaped("path", self.path, (*many, "steps + 1", "dof"))
        shaped("weight", self.weight, many)
        shaped("age", self.age, many)
        shaped("side", self.side, many)
        shaped("along", self.along, (*many, "k", 3))
        shaped("wrench", self.wrench, (*many, "p", 3))
        shaped("twist", self.twist, self.wrench.shape)
        steps, seen = self.path.shape[-2] - 1, self.along.shape[-2]
        if steps < 1:
            raise ValueError(f"path has shape {self.path.shape}; a push needs at least one step, two rows")
        if seen >= steps:
            raise ValueError(f"along has {seen} poses on the way; between {steps} steps there are {steps - 1}")
        for name in ARRAYS:
            finite(name, getattr(self, name))
        non_negative("weight", self.weight)
        non_negative("side", self.side)

    @property
    def rows(self) -> np.ndarray:
        """(k + 1,): the steps of the path after which the slider was seen; the last is the end."""
        parts = self.along.shape[-2] + 1
        return np.round(np.arange(1, parts + 1) / parts * (self.path.shape[-2] - 1)).astype(int)

    @property
    def poses(self) -> Float[Array, "*conditions pushes seen 3"]:
        """Every pose seen after the start, the last one included."""
        return jnp.concatenate([self.along, self.end[..., None, :]], axis=-2)

    @property
    def given(self) -> "Given":
        """What is known of every push before it."""
        return Given(self.start, self.path, self.age, self.side)

    @property
    def paired(self) -> Bool[Array, "*conditions pushes pairs"]:
        """Where there are a wrench and a motion."""
        return jnp.any(self.wrench != 0, axis=-1) & jnp.any(self.twist != 0, axis=-1)

    def as_conditions(self) -> "Pushes":
        """With a leading axis of conditions, of one if there is none yet."""
        return jax.tree.map(lambda leaf: leaf[None], self) if self.weight.ndim == 1 else self

    @staticmethod
    def of(log: Any, steps: int = STEPS, *, parts: int = 1, shape: Shape | None = None) -> "Pushes":
        """The usable pushes of a log (`pushjax.datasets.PushLog`, or the `Recordings` of `load_recordings`), their
        paths in `steps`.

        parts: of a push, after each of which the slider's pose counts, if all saw it on the way; else
        only the end's does. shape: with it, and with forces of a single finger, wrenches count too. Raises ValueError
        for fewer than one part, or not fewer than steps, and TypeError for another kind of log.
        """
        from pushjax.datasets import PushLog
        from pushjax.identify.recorded import Recordings, recorded

        instance("log", log, PushLog, Recordings)
        recordings = log if isinstance(log, Recordings) else Recordings.of_log(log)
        return recorded(recordings, steps, parts, shape)

    @staticmethod
    def conditions(several: Sequence["Pushes"]) -> "Pushes":
        """Several conditions side by side; where one has fewer pushes, pushes of no weight fill it up."""
        if not several:
            raise ValueError("several: expected at least one condition's pushes; got none")
        most = max(one.weight.shape[0] for one in several)
        for name in ARRAYS:
            shapes = {getattr(one, name).shape[1:] for one in several}
            if len(shapes) > 1:
                raise ValueError(f"several: the conditions' {name} differ in shape: {sorted(shapes)}")

        def filled(name: str) -> Array:
            rows = []
            for one in several:
                value = getattr(one, name)
                rest = most - value.shape[0]
                again = jnp.broadcast_to(value[:1], (rest, *value.shape[1:]))
                rows.append(jnp.concatenate([value, 0 * again if name == "weight" else again]))
            return jnp.stack(rows)

        return Pushes(**{name: filled(name) for name in ARRAYS})

    def weighted(self, weight: Numeric) -> "Pushes":
        """The same pushes with other weights (pushes,): a part to learn from, a bootstrap sample."""
        value = as_float(weight, self.weight.dtype)
        shaped("weight", value, self.weight.shape)
        return eqx.tree_at(lambda p: p.weight, self, value)
