"""The next push of a planner, and why there is none."""

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from pushjax.planning.transits.roadmap import Transit


class PlanStatus(IntEnum):
    """What the next push is for, or why there is none.

    Attributes:
        ONE_PUSH: It reaches the goal.
        TWO_PUSHES: It is the first of two that reach the goal.
        COST_TO_GO: It leads to where the cost to go is least.
        NO_TRANSIT: The finger gets to no push. The status of the transit tells why. If it is FOUND, the finger gets to
            where a run-up begins, but each run-up leads out of its limits or into a fixture.
        NO_PUSH: No push stays within the workspace and out of its fixtures.
        START_IN_FIXTURE: The slider is deeper in a fixture than a simulation would start from.
    """

    ONE_PUSH = 0
    TWO_PUSHES = 1
    COST_TO_GO = 2
    NO_TRANSIT = 3
    NO_PUSH = 4
    START_IN_FIXTURE = 5

    @property
    def failed(self) -> bool:
        """Whether there is no push."""
        return self >= PlanStatus.NO_TRANSIT


class PlannedPush(NamedTuple):
    """The next push.

    Attributes:
        status: What the push is for, or why there is none.
        transit: Transit of the finger to where the run-up begins, world. Without a push it has infinite length.
        start: Where the finger is about to touch the slider, (2,), world, m.
        end: Where the push ends, (2,), world, m.
        target: Pose of the slider that the push is for, (3,), world, m and rad.
        cost: Predicted number of control steps to the goal.
    """

    status: PlanStatus
    transit: Transit
    start: np.ndarray
    end: np.ndarray
    target: np.ndarray
    cost: float


class PushChoice(NamedTuple):
    """A push that may come next: its kind, its entry in the library, the pose it is for, and its predicted cost."""

    status: PlanStatus
    entry: int
    target: np.ndarray
    cost: float
