"""What a Monte Carlo run gives, on the host."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from pushjax.status import ContactMode, Status

QUANTILES = (0.025, 0.25, 0.5, 0.75, 0.975)
COORDINATES = ("x", "y", "theta")


@dataclass(frozen=True)
class MonteCarlo:
    """n pushes, in numpy; push i was made with the key `fold_in(key, i)`.

    start, pose: (n, 3), before and after, world. status, mode: (n,), (n, contacts), of the last step (a jam and a grasp
    stay to the end). steps_in_mode: (n, contacts, 4), how many steps each contact was in each `ContactMode`. failed,
    first_failure: (n,), how many steps failed (`Status.failed`) and the first that did, or -1. stopped: (n,), the step
    at which the hand jammed or grasped, or -1. friction, pull: (n, draws), mu, and how far a drawn quartic was moved
    towards the mean to be convex. trajectory: (n, steps + 1, 3), if kept. seconds: what it took, compiling included.
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
    pull: np.ndarray
    trajectory: np.ndarray | None
    seconds: float

    def __len__(self) -> int:
        return len(self.pose)

    @property
    def delta(self) -> np.ndarray:
        """(n, 3): how far each push moved the slider, world."""
        return self.pose - self.start

    def outcomes(self) -> dict[str, int]:
        """How many pushes ended how: grasped, jammed, free (neither), or failed (a step did); they add up to n."""
        failed = self.failed > 0
        grasped, jammed = (~failed & (self.status == kind) for kind in (Status.GRASPED, Status.JAMMED))
        counted = {"grasped": grasped, "jammed": jammed, "free": ~(failed | grasped | jammed), "failed": failed}
        return {name: int(np.sum(which)) for name, which in counted.items()}

    def histogram(self, values: np.ndarray, bins: int | np.ndarray = 40) -> dict[str, np.ndarray]:
        """edges (bins + 1,) and counts (bins,) of one number a push."""
        counts, edges = np.histogram(np.asarray(values, np.float64), bins=bins)
        return {"edges": edges, "counts": counts}

    def summary(self) -> dict[str, Any]:
        """Counts, shares, moments and quantiles: plain numbers, by name."""
        pose = np.asarray(self.pose, np.float64)
        quantiles = np.quantile(pose, QUANTILES, axis=0)
        in_mode = self.steps_in_mode.sum(axis=0, dtype=np.int64)
        statuses, counts = np.unique(self.status, return_counts=True)
        repaired = self.pull > 0
        return {
            "n": len(self),
            "outcomes": self.outcomes(),
            "statuses": {Status(int(s)).name: int(c) for s, c in zip(statuses, counts, strict=True)},
            "modes": [
                {mode.name: float(c / max(total, 1)) for mode, c in zip(ContactMode, contact, strict=True)}
                for contact, total in zip(in_mode, in_mode.sum(axis=1), strict=True)
            ],
            "pose": {
                name: {
                    "mean": float(pose[:, k].mean()),
                    "std": float(pose[:, k].std(ddof=1)) if len(self) > 1 else 0.0,
                    "quantiles": {str(q): float(v) for q, v in zip(QUANTILES, quantiles[:, k], strict=True)},
                }
                for k, name in enumerate(COORDINATES)
            },
            "friction": {"mean": float(self.friction.mean()), "std": float(self.friction.std())},
            "repaired": {
                "share": float(repaired.mean()),
                "mean_pull": float(self.pull[repaired].mean()) if repaired.any() else 0.0,
            },
            "seconds": self.seconds,
        }
