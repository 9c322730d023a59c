"""The outcome of a solve, and of each contact. Arrays of both are int8."""

from enum import IntEnum


class ContactMode(IntEnum):
    """How the pusher and the slider move relative to each other at a contact.

    LEFT and RIGHT name the pusher's slip relative to the slider. Left is toward the tangent t = (-n_y, n_x), where n is
    the inward normal. When the pusher slides left, the friction on the slider is +mu f_n.

    Attributes:
        SEPARATED: The contact does not touch. Every contact also has this mode where the slider does not move.
        STICKING: The contact touches and does not slip.
        SLIDING_LEFT: The pusher slips to the left.
        SLIDING_RIGHT: The pusher slips to the right.

    Reference: Zhou et al. 2017, section IV.A.
    """

    SEPARATED = 0
    STICKING = 1
    SLIDING_LEFT = 2
    SLIDING_RIGHT = 3


class Status(IntEnum):
    """Outcome of a contact problem, or of one step of a rollout.

    Attributes:
        MOVING: The slider moves.
        FREE: Nothing pushes the slider.
        JAMMED: No twist satisfies every contact.
        NOT_CONVERGED: No answer was found. In rollouts also: no answer leaves every finger outside the slider, however
            small the parts into which the step was divided. The slider is left where it is.
        GRASPED: Jammed with every finger and no fixture on the slider (rollouts only).
        OVERLAPPING: The hand or a fixture is too deep inside the slider for contact to mean anything. The slider is
            left where it is (rollouts only).
        INVALID: An input was NaN, infinite or outside its domain, and could not be refused because it was traced. The
            slider is left where it is.
    """

    # Up to FREE the contact problem is solved; from OVERLAPPING on there is none to solve.
    MOVING = 0
    FREE = 1
    JAMMED = 2
    NOT_CONVERGED = 3
    GRASPED = 4
    OVERLAPPING = 5
    INVALID = 6

    @property
    def failed(self) -> bool:
        """Whether the solve or the step found no valid answer. A jam and a grasp are valid answers."""
        return self in (Status.NOT_CONVERGED, Status.OVERLAPPING, Status.INVALID)
