"""Result of a Monte Carlo run, on the host."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from pushjax.contact.status import ContactMode, Status

QUANTILES = (0.025, 0.25, 0.5, 0.75, 0.975)
COORDINATES = ("x", "y", "theta")


@dataclass(frozen=True)
class MonteCarlo:
    """Result of n pushes, in numpy.

    Push i was made with the key `fold_in(key, i)`. A jam and a grasp stay to the end of a push, so the status of the
    last step shows them.

    Attributes:
        start: Poses before the pushes, (n, 3), world, m and rad; of several sliders, (n, sliders, 3).
        pose: Poses after the pushes, of the same shape.
        status: `Status` of the last step, (n,).
        mode: `ContactMode` of each contact in the last step, (n, contacts).
        steps_in_mode: Number of steps that each contact was in each `ContactMode`, (n, contacts, 4).
        failed: Number of steps that failed (`Status.failed`), (n,).
        first_failure: Index of the first step that failed, or -1, (n,).
        stopped: Index of the step at which the hand jammed or grasped, or -1, (n,).
        friction: Sampled coefficients of friction mu, (n, draws).
        shrinkage: How far each sampled quartic was moved toward the mean to be convex, (n, draws); of several sliders,
            the largest.
        trajectory: All poses, (n, steps + 1, 3), world, m and rad, if they were kept; else None. Of several sliders,
            (n, steps + 1, sliders, 3).
        seconds: Duration of the run, s, compiling included.
    """

    start: np.ndarray
    pose: np.ndarray
    status: np.ndarray
    mode: np.ndarray
    steps_in_mode: np.ndarray
    failed: np.ndarray
    first_failure: np.ndarray
    stopped: np.ndarray
    friction: np.ndarray
    shrinkage: np.ndarray
    trajectory: np.ndarray | None
    seconds: float

    def __len__(self) -> int:
        return len(self.pose)

    @property
    def delta(self) -> np.ndarray:
        """Displacement of each slider in each push, shaped as `pose`, world, m and rad."""
        return self.pose - self.start

    def outcomes(self) -> dict[str, int]:
        """Count the pushes by outcome; the counts add up to n.

        Returns:
            Counts of "grasped", "jammed", "free" (none of the others, which is not `Status.FREE`) and "failed" (a step
            failed, whatever came after it).
        """
        failed = self.failed > 0
        grasped, jammed = (~failed & (self.status == status) for status in (Status.GRASPED, Status.JAMMED))
        masks = {"grasped": grasped, "jammed": jammed, "free": ~(failed | grasped | jammed), "failed": failed}
        return {name: int(np.sum(mask)) for name, mask in masks.items()}

    def histogram(self, values: np.ndarray, bins: int | np.ndarray = 40) -> dict[str, np.ndarray]:
        """Histogram of one number per push.

        Args:
            values: The numbers, (n,).
            bins: Number of bins, or their edges.

        Returns:
            "edges" (bins + 1,) and "counts" (bins,).
        """
        counts, edges = np.histogram(np.asarray(values, np.float64), bins=bins)
        return {"edges": edges, "counts": counts}

    def summary(self) -> dict[str, Any]:
        """Summarize the run in plain numbers, by name: counts, fractions, moments and quantiles.

        Of several sliders, "pose" is a list.
        """
        in_mode = self.steps_in_mode.sum(axis=0, dtype=np.int64)
        shares = in_mode / np.maximum(in_mode.sum(axis=1, keepdims=True), 1)
        statuses, counts = np.unique(self.status, return_counts=True)
        repaired = self.shrinkage > 0
        return {
            "n": len(self),
            "outcomes": self.outcomes(),
            "statuses": {Status(int(s)).name: int(c) for s, c in zip(statuses, counts, strict=True)},
            "modes": [
                {mode.name: float(share) for mode, share in zip(ContactMode, contact, strict=True)}
                for contact in shares
            ],
            "pose": _of_poses(self.pose) if self.pose.ndim == 2 else [_of_poses(p) for p in self.pose.swapaxes(0, 1)],
            "friction": _moments(self.friction),
            "repaired": {
                "share": float(repaired.mean()),
                "mean_shrinkage": float(self.shrinkage[repaired].mean()) if repaired.any() else 0.0,
            },
            "seconds": self.seconds,
        }


def _of_poses(poses: np.ndarray) -> dict[str, Any]:
    """Return moments and quantiles of each coordinate of poses (n, 3)."""
    return {
        name: _moments(values) | {"quantiles": {str(q): float(np.quantile(values, q)) for q in QUANTILES}}
        for name, values in zip(COORDINATES, np.asarray(poses, np.float64).T, strict=True)
    }


def _moments(values: np.ndarray) -> dict[str, float]:
    """Return mean and standard deviation of samples; the latter is 0 for a single push."""
    return {"mean": float(values.mean()), "std": float(values.std(ddof=1)) if len(values) > 1 else 0.0}
