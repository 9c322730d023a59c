"""The next push of a planner, and why there is none."""

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from pushjax.planning.roadmap import Transit


class PushStatus(IntEnum):
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
        return self >= PushStatus.NO_TRANSIT


class PlannedPush(NamedTuple):
    """The next push."""

    status: PushStatus  # what the push is for, or why there is none
    transit: Transit  # of the finger to where the run-up begins, world; without a push its length is infinite
    start: np.ndarray  # (2,), where the finger is about to touch the slider, world, m
    end: np.ndarray  # (2,), where the push ends, world, m
    target: np.ndarray  # (3,), pose of the slider that the push is for, world, m and rad
    cost: float  # predicted control steps to the goal


class PushChoice(NamedTuple):
    """A push that may come next."""

    status: PushStatus  # its kind
    entry: int  # of the library
    target: np.ndarray  # (3,), pose of the slider that it is for, world, m and rad
    cost: float  # predicted control steps to the goal
