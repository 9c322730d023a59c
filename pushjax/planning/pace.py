"""How fast a finger moves, and how long its motions take."""

from typing import NamedTuple

import numpy as np


class Pace(NamedTuple):
    """Speeds of a finger. Times are in control steps.

    Attributes:
        free: Largest speed where it does not touch the slider, m per control step.
        push: Largest speed in a push, m per control step.
        acceleration: Largest change of the speed in a control step, m per control step.
    """

    free: float
    push: float
    acceleration: float

    def free_time(self, distance):
        """Return the number of control steps of a transit of a length in m, from rest to rest."""
        ramp = self.free**2 / self.acceleration
        short = 2 * np.sqrt(np.minimum(distance, ramp) / self.acceleration)
        return short + np.maximum(distance - ramp, 0) / self.free

    def push_time(self, distance):
        """Return the number of control steps of a push of a length in m."""
        return distance / self.push + self.push / self.acceleration

    def next_speed(self, speed: float, remaining: float, limit: float) -> float:
        """Return the length of the next control step's motion.

        Args:
            speed: That of the step before, m.
            remaining: Distance to where the finger must stop, m.
            limit: Largest speed, m per control step.
        """
        if remaining <= 0:
            return 0.0
        stopping = np.sqrt(2 * self.acceleration * remaining + self.acceleration**2 / 4) - self.acceleration / 2
        return float(min(limit, speed + self.acceleration, max(stopping, 0.1 * self.push), remaining))
