"""What became of a solve, and of each contact. Arrays of both are int8."""

from enum import IntEnum


class ContactMode(IntEnum):
    """How the pusher and the slider move against each other at a contact.

    LEFT and RIGHT name the pusher's slip relative to the slider, seen along the inward normal: left is towards
    the tangent t = (-n_y, n_x), and the friction on the slider is then +mu f_n (Zhou et al. 2017, section IV.A).
    """

    SEPARATED = 0
    STICKING = 1
    SLIDING_LEFT = 2
    SLIDING_RIGHT = 3


class Status(IntEnum):
    """Outcome of a contact problem, or of one step of a rollout.

    MOVING: the slider moves. FREE: nothing pushes it. JAMMED: no twist satisfies every contact. NOT_CONVERGED: no
    answer was found, or (rollouts only) none that leaves every finger outside the slider, however small the parts into
    which the step was divided; the slider is left where it is. GRASPED: jammed with every finger on the slider
    (rollouts only). OVERLAPPING: the hand is too deep inside the slider for contact to mean anything; the slider is
    left where it is (rollouts only). INVALID: an input was NaN, infinite or outside its domain where it could not be
    refused because it was traced; the slider is left where it is.
    """

    MOVING = 0
    FREE = 1
    JAMMED = 2
    NOT_CONVERGED = 3
    GRASPED = 4
    OVERLAPPING = 5
    INVALID = 6

    @property
    def failed(self) -> bool:
        """Whether the step's result is not an answer to the question asked (jams and grasps are answers)."""
        return self in (Status.NOT_CONVERGED, Status.OVERLAPPING, Status.INVALID)
