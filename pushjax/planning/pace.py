"""How fast a finger moves, and how long its motions take."""

from typing import NamedTuple

import numpy as np


class Pace(NamedTuple):
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
