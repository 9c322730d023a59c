"""How fast a finger may move, and where it is after a control step with an action."""

from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np


class FingerState(NamedTuple):
    """Where a finger is and how fast it moves."""

    position: np.ndarray  # center, (2,), world, m
    velocity: np.ndarray  # (2,), m/s


class FingerControl(Protocol):
    """The motion of a finger in one control step, as a function of the action."""

    def action(self, state: FingerState, target: np.ndarray) -> np.ndarray:
        """Return the action after which the finger is at `target`, or as near as the limits allow, (..., 2)."""
        ...

    def motion(self, state: FingerState, action: np.ndarray) -> np.ndarray:
        """Return positions during the control step, the last one at its end, (..., points, 2), m."""
        ...

    def after(self, state: FingerState, action: np.ndarray) -> FingerState:
        """Return the state after the control step."""
        ...


class PositionControl(NamedTuple):
    """A finger that goes to any position in a straight line in one control step. The action is that position."""

    def action(self, state: FingerState, target: np.ndarray) -> np.ndarray:
        return target

    def motion(self, state: FingerState, action: np.ndarray) -> np.ndarray:
        part = np.arange(1, 11)[:, None] / 10
        return state.position + part * (action[..., None, :] - state.position)

    def after(self, state: FingerState, action: np.ndarray) -> FingerState:
        return FingerState(np.asarray(action, float), np.zeros(2))


class SpringDamper:
    """A finger of unit mass that a spring pulls to the action and a damper brakes.

    In each of the substeps, first the velocity changes by the acceleration, stiffness * (action - position) - damping *
    velocity, and then the position by the velocity.

    Args:
        stiffness: Acceleration per distance, 1/s^2.
        damping: Acceleration per velocity, 1/s.
        substep: Duration of a substep, s.
        substeps: Number of substeps of a control step.
        low: Lowest action, (2,), world, m.
        high: Highest action, (2,), world, m.
    """

    def __init__(
        self, stiffness: float, damping: float, substep: float, substeps: int, low: np.ndarray, high: np.ndarray
    ):
        self.low, self.high = np.asarray(low, float), np.asarray(high, float)
        kick = np.array([[1.0, 0.0], [-stiffness * substep, 1.0 - damping * substep]])
        drift = np.array([[1.0, substep], [0.0, 1.0]])
        self.substeps, self.once = substeps, drift @ kick

    @cached_property
    def powers(self) -> np.ndarray:
        """The map of (position - action, velocity) over 1, 2, … substeps, (substeps, 2, 2)."""
        return np.stack([np.linalg.matrix_power(self.once, k) for k in range(1, self.substeps + 1)])

    def action(self, state: FingerState, target: np.ndarray) -> np.ndarray:
        (by_position, by_velocity), _ = self.powers[-1]
        wanted = (target - by_position * state.position - by_velocity * state.velocity) / (1 - by_position)
        return np.clip(wanted, self.low, self.high)

    def motion(self, state: FingerState, action: np.ndarray) -> np.ndarray:
        by_position, by_velocity = self.powers[:, 0, 0, None], self.powers[:, 0, 1, None]
        away = (state.position - action)[..., None, :]
        return action[..., None, :] + by_position * away + by_velocity * state.velocity

    def after(self, state: FingerState, action: np.ndarray) -> FingerState:
        by_position, by_velocity = self.powers[-1, 1]
        velocity = by_position * (state.position - action) + by_velocity * state.velocity
        return FingerState(self.motion(state, action)[..., -1, :], velocity)


class SpeedLimits(NamedTuple):
    """Speeds of a finger. Times are in control steps.

    Attributes:
        free: Largest speed where it does not touch the slider, m per control step.
        push: Largest speed in a push, m per control step.
        acceleration: Largest change of the speed, m per control step, from one control step to the next.
    """

    free: float
    push: float
    acceleration: float

    def free_time(self, distance):
        """Return the number of control steps that a motion without contact takes, from rest to rest.

        Args:
            distance: Length of the motion, m, of any shape.
        """
        ramp = self.free**2 / self.acceleration
        short = 2 * np.sqrt(np.minimum(distance, ramp) / self.acceleration)
        return short + np.maximum(distance - ramp, 0) / self.free

    def push_time(self, distance):
        """Return the number of control steps that a push takes, from rest to rest.

        It is too large for a push that is too short to reach the speed `push`.

        Args:
            distance: Length of the push, m, of any shape.
        """
        return distance / self.push + self.push / self.acceleration

    def next_speed(self, speed: float, remaining: float, limit: float) -> float:
        """Return the speed in the next control step, m per control step, with which the finger can still stop in time.

        Args:
            speed: Speed in the control step before, m per control step.
            remaining: Distance to where the finger must stop, m.
            limit: Largest speed, m per control step.
        """
        if remaining <= 0:
            return 0.0
        stopping = np.sqrt(2 * self.acceleration * remaining + self.acceleration**2 / 4) - self.acceleration / 2
        # never slower than a tenth of a push, or the last bit of the way would take forever
        return float(min(limit, speed + self.acceleration, max(stopping, 0.1 * self.push), remaining))
