"""Recorded pushes as arrays, the data of identification."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pushjax._internal.checks import ArrayLike, as_float, check_shape, check_type, checked_array, common_dtype
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
        starts = as_float(start, dtype, "start")
        leading = starts.shape[:-1]
        if starts.ndim not in (2, 3):
            raise ValueError(f"start has shape {starts.shape}; expected (pushes, 3), or with conditions in front")
        zeros, no_rows = np.zeros(leading), np.zeros((*leading, 0, 3))

        def checked(
            name: str, value: ArrayLike, shape: tuple[int | str, ...] = (), non_negative: bool = False
        ) -> Array:
            return checked_array(name, value, (*leading, *shape), dtype, non_negative=non_negative)

        self.start = checked("start", starts, (3,))
        self.path = checked("path", path, ("steps + 1", "dof"))
        self.end = checked("end", end, (3,))
        self.weight = checked("weight", zeros + 1 if weight is None else weight, non_negative=True)
        self.poses_between = checked("poses_between", no_rows if poses_between is None else poses_between, ("k", 3))
        self.wrench = checked("wrench", no_rows if wrench is None else wrench, ("p", 3))
        self.twist = checked("twist", no_rows if twist is None else twist, self.wrench.shape[-2:])
        self.age = checked("age", zeros if age is None else age)
        self.side = checked("side", zeros if side is None else side, non_negative=True)
        steps, between = self.path.shape[-2] - 1, self.poses_between.shape[-2]
        if steps < 1:
            raise ValueError(f"path has shape {self.path.shape}; a push needs at least one step, two rows")
        if between >= steps:
            raise ValueError(
                f"poses_between has {between} poses for each push; a path of {steps} steps has room for {steps - 1}"
            )

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
        for name in vars(several[0]):
            shapes = {getattr(one, name).shape[1:] for one in several}
            if len(shapes) > 1:
                raise ValueError(f"several: the conditions' {name} differ in shape: {sorted(shapes)}")
        rows = np.arange(longest)

        def padded(one: "Pushes") -> "Pushes":
            """Append copies of the first push, of weight zero."""
            exists = rows < len(one.weight)
            filled = jax.tree.map(lambda leaf: leaf[np.where(exists, rows, 0)], one)
            return filled.weighted(jnp.where(exists, filled.weight, 0.0))

        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(padded, several))

    def weighted(self, weight: ArrayLike) -> "Pushes":
        """Return the same pushes with other weights, for example of a training set or a bootstrap sample.

        Args:
            weight: Weights in the shape of the present ones, (pushes,) or with conditions in front.
        """
        value = as_float(weight, self.weight.dtype, "weight")
        check_shape("weight", value, self.weight.shape)
        return eqx.tree_at(lambda p: p.weight, self, value)
