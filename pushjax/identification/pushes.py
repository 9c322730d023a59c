"""Recorded pushes as arrays, the data of identification."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pushjax._internal.checks import (
    ArrayLike,
    as_float,
    check_finite,
    check_non_negative,
    check_shape,
    check_type,
    common_dtype,
)
from pushjax.datasets.recordings import Recordings
from pushjax.geometry.shape import Shape
from pushjax.identification.pushes_of_recordings import push_arrays

STEPS = 50  # default number of steps of each path


class Pushes(eqx.Module):
    """Pushes of one slider by one hand; with a leading axis, pushes of several conditions.

    The poses of one push share a total weight of one, because their errors are correlated. So do its pairs of wrench
    and twist.

    Attributes:
        start: (pushes, 3) slider's pose before each push, world, m and rad.
        path: (pushes, steps + 1, dof) path of the hand, world, as in `rollout`.
        end: (pushes, 3) slider's pose after each push, world, m and rad. The angle is the one that the slider really
            turned to (not wrapped).
        weight: (pushes,) weight of each push; zero leaves it out. Default: ones.
        poses_between: (pushes, k, 3) slider's poses during the push, at the ends of all but the last of its k + 1 equal
            parts (`observed_steps`), world, m and rad. Default: none.
        wrench: (pushes, p, 3) wrenches on the slider, in the body frame about its origin, of any scale. Default: none.
        twist: (pushes, p, 3) motion of the slider under each wrench, in the body frame about its origin, of any scale.
            If the wrench or the motion is zero, the pair does not count. Default: none.
        age: (pushes,) time of each push, from 0 (the first) to 1 (the last). The friction may depend on it, if
            `Unknowns.friction_drift` is given. Default: zeros.
        side: (pushes,) index of the slider's side that was pushed, from 0. The friction may depend on it, if
            `Unknowns.friction_by_side` is given. A side beyond `Unknowns.sides` counts as the last. Default: zeros.

    Raises:
        ValueError: If an array has the wrong shape or is not finite, or if a weight or side is negative.
    """

    start: Float[Array, "*conditions pushes 3"]
    path: Float[Array, "*conditions pushes steps+1 dof"]
    end: Float[Array, "*conditions pushes 3"]
    weight: Float[Array, "*conditions pushes"]
    poses_between: Float[Array, "*conditions pushes between 3"]
    wrench: Float[Array, "*conditions pushes pairs 3"]
    twist: Float[Array, "*conditions pushes pairs 3"]
    age: Float[Array, "*conditions pushes"]
    side: Float[Array, "*conditions pushes"]

    def __init__(
        self,
        start: ArrayLike,
        path: ArrayLike,
        end: ArrayLike,
        weight: ArrayLike | None = None,
        *,
        poses_between: ArrayLike | None = None,
        wrench: ArrayLike | None = None,
        twist: ArrayLike | None = None,
        age: ArrayLike | None = None,
        side: ArrayLike | None = None,
    ):
        dtype = common_dtype(start, path, end)
        self.start, self.path, self.end = (as_float(value, dtype) for value in (start, path, end))
        if self.start.ndim not in (2, 3):
            raise ValueError(f"start has shape {self.start.shape}; expected (pushes, 3), or with conditions in front")
        leading = self.start.shape[:-1]
        zeros, no_rows = jnp.zeros(leading, dtype), jnp.zeros((*leading, 0, 3), dtype)

        def given(value: ArrayLike | None, default: Array, name: str) -> Array:
            return default if value is None else as_float(value, dtype, name)

        self.weight = given(weight, jnp.ones(leading, dtype), "weight")
        self.age, self.side = given(age, zeros, "age"), given(side, zeros, "side")
        self.poses_between = given(poses_between, no_rows, "poses_between")
        self.wrench, self.twist = given(wrench, no_rows, "wrench"), given(twist, no_rows, "twist")
        check_shape("end", self.end, (*leading, 3))
        check_shape("path", self.path, (*leading, "steps + 1", "dof"))
        for name in ("weight", "age", "side"):
            check_shape(name, getattr(self, name), leading)
        check_shape("poses_between", self.poses_between, (*leading, "k", 3))
        check_shape("wrench", self.wrench, (*leading, "p", 3))
        check_shape("twist", self.twist, self.wrench.shape)
        steps, between = self.path.shape[-2] - 1, self.poses_between.shape[-2]
        if steps < 1:
            raise ValueError(f"path has shape {self.path.shape}; a push needs at least one step, two rows")
        if between >= steps:
            raise ValueError(
                f"poses_between has {between} poses for each push; a path of {steps} steps has room for {steps - 1}"
            )
        for name, value in vars(self).items():
            check_finite(name, value)
        check_non_negative("weight", self.weight)
        check_non_negative("side", self.side)

    @property
    def observed_steps(self) -> np.ndarray:
        """(k + 1,) steps of the path after which the slider's pose was measured; the last is the end."""
        parts = self.poses_between.shape[-2] + 1
        return np.round(np.arange(1, parts + 1) / parts * (self.path.shape[-2] - 1)).astype(int)

    @property
    def poses(self) -> Float[Array, "*conditions pushes observed 3"]:
        """(pushes, k + 1, 3) slider's poses measured after the start: `poses_between`, then `end`."""
        return jnp.concatenate([self.poses_between, self.end[..., None, :]], axis=-2)

    @property
    def has_pair(self) -> Bool[Array, "*conditions pushes pairs"]:
        """(pushes, p) whether neither the wrench nor the motion of a pair is zero."""
        return jnp.any(self.wrench != 0, axis=-1) & jnp.any(self.twist != 0, axis=-1)

    def as_conditions(self) -> "Pushes":
        """Return the pushes with a leading axis of conditions, of length one if there is none yet."""
        return jax.tree.map(lambda leaf: leaf[None], self) if self.weight.ndim == 1 else self

    @staticmethod
    def of(log: Recordings, steps: int = STEPS, *, parts: int = 1, shape: Shape | None = None) -> "Pushes":
        """Make pushes from the usable pushes of a log.

        Args:
            log: The recordings of a log.
            steps: Number of steps of each path.
            parts: Number of equal parts of each push. The slider's pose after each part is used, if it was tracked
                during all pushes. Otherwise only the final pose is used.
            shape: Outline of the slider. If it is given, and the forces of a single finger were recorded, wrenches are
                used too: the mean of each part. This needs more than one part.

        Returns:
            The pushes.

        Raises:
            ValueError: If `steps` or `parts` is less than one, or if several `parts` are not fewer than `steps`.
            TypeError: If `log` is of another type.
        """
        check_type("log", log, Recordings)
        return Pushes(**push_arrays(log, steps, parts, shape))

    @staticmethod
    def conditions(several: Sequence["Pushes"]) -> "Pushes":
        """Stack the pushes of several conditions.

        Args:
            several: Pushes of each condition. A condition with fewer pushes is padded with pushes of weight zero.

        Returns:
            Pushes with a leading axis of conditions.

        Raises:
            ValueError: If `several` is empty, or if the conditions' arrays differ in shape.
        """
        if not several:
            raise ValueError("several: expected at least one condition's pushes; got none")
        longest = max(one.weight.shape[0] for one in several)
        names = tuple(vars(several[0]))
        for name in names:
            shapes = {getattr(one, name).shape[1:] for one in several}
            if len(shapes) > 1:
                raise ValueError(f"several: the conditions' {name} differ in shape: {sorted(shapes)}")

        def padded(name: str) -> Array:
            """Stack one field of all conditions, padded with copies of each condition's first push."""
            rows = []
            for one in several:
                value = getattr(one, name)
                missing = longest - value.shape[0]
                padding = jnp.broadcast_to(value[:1], (missing, *value.shape[1:]))
                rows.append(jnp.concatenate([value, 0 * padding if name == "weight" else padding]))
            return jnp.stack(rows)

        return Pushes(**{name: padded(name) for name in names})

    def weighted(self, weight: ArrayLike) -> "Pushes":
        """Return the same pushes with other weights, for example of a training set or a bootstrap sample.

        Args:
            weight: Weights in the shape of the present ones, (pushes,) or with conditions in front.
        """
        value = as_float(weight, self.weight.dtype, "weight")
        check_shape("weight", value, self.weight.shape)
        return eqx.tree_at(lambda p: p.weight, self, value)
