"""Stable pushes: a hand carries a slider to a pose without slip, whatever friction is.

Where two fingers or a pad push an edge, there are curvatures at which both contacts stick for every sampled limit
surface and coefficient of friction (`line_contact`). Along a path of such curvatures the slider moves with the hand as
one body. The shortest one between two poses is a Dubins path (`dubins`). So the final pose does not depend on friction
at all, over any distance.

A bound from samples holds for the samples. A surface that was not sampled may be more extreme than all that were. The
margin and the number of samples say how much of this is allowed for.

Reference: Lynch & Mason 1996. Zhou & Mason 2017.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from pushjax._internal.checks import ArrayLike, check_count, check_type, checked_array
from pushjax.friction.friction_model import FrictionModel
from pushjax.geometry.polygon import Polygon
from pushjax.geometry.se2_numpy import compose, inverse
from pushjax.planning.dubins import DubinsPath, dubins
from pushjax.planning.goal import PlanStatus
from pushjax.planning.line_contact import LineContact, Turn, hand_front, line_contacts, tightest_turn
from pushjax.planning.scene import draw_friction
from pushjax.simulation.hand import Hand
from pushjax.simulation.slider import Slider

STEP = 0.05  # default length of a step, in units of the length of the limit surface


class StableContact(NamedTuple):
    """A hand against an edge of a slider that can carry it without slip."""

    contact: LineContact  # where the hand is
    turn: Turn  # the tightest turns without slip
    opening: np.ndarray  # what a configuration of the hand has beyond its pose, (dof - 3,)

    @property
    def reference(self) -> np.ndarray:
        """Pose in the slider of the frame that moves like a car along the path, (3,), m and rad."""
        heading = self.contact.heading
        point = self.turn.point * np.array([np.cos(heading), np.sin(heading)])
        return compose(self.contact.frame, np.array([*point, heading]))


class StablePush(NamedTuple):
    """A push that carries the slider without slip, or the reason why there is none.

    Attributes:
        status: FOUND, NOT_STABLE or OUT_OF_REACH.
        reason: The status in a sentence.
        path: Path of the hand, (steps + 1, dof), world; None if there is none.
        pose: Poses of the slider along it, (steps + 1, 3), world; None if there is none.
        contact: The contact that is used, as from `stable_contacts`; None if there is none.
        dubins: Path of the contact's reference frame, of three parts with the `lengths` (3,), m, and the `curvature`
            (3,), 1/m, positive to the left; None if there is none.
    """

    status: PlanStatus
    reason: str
    path: Float[Array, "steps+1 dof"] | None = None
    pose: Float[Array, "steps+1 3"] | None = None
    contact: StableContact | None = None
    dubins: DubinsPath | None = None


def stable_contacts(
    key: PRNGKeyArray,
    slider: Slider,
    hand: Hand,
    *,
    model: FrictionModel,
    opening: ArrayLike = (),
    samples: int = 64,
    margin: float = 0.1,
) -> tuple[StableContact, ...]:
    """Find the edges of a slider against which a hand can push it without slip, and how tightly it can turn there.

    Args:
        key: PRNG key of the sampled friction.
        slider: The slider, a polygon.
        hand: A hand whose configuration begins with its pose (x, y, theta), and whose foremost part along the x axis of
            its frame is a flat pad, or two round fingers side by side.
        model: Distribution of limit surface and contact friction.
        opening: The other numbers of the hand's configuration, (dof - 3,), such as the distance of two fingers.
        samples: Number of sampled limit surfaces and coefficients of friction. The contact sticks for all of them.
        margin: Fraction by which coefficient of friction and width of the contact are reduced, at least 0 and below 1.

    Returns:
        The contacts, one an edge at most, with the largest curvatures of a turn without slip to the left and right,
        `turn.left` and `turn.right`, 1/m. None on an edge where a straight push is not stable for every sample.

    Raises:
        ValueError: For a hand that touches an edge in one point only or is not a rigid body in x, y and theta, for a
            margin outside [0, 1), and for `samples` below one.
        TypeError: If the slider is not a polygon, and for a key, slider, hand or model of another type.
    """
    check_type("slider", slider, Slider)
    check_type("slider.shape", slider.shape, Polygon)
    check_type("hand", hand, Hand)
    if not 0 <= margin < 1:
        raise ValueError(f"margin must be at least 0 and below 1; got {margin!r}")
    rest = np.asarray(checked_array("opening", opening, ("numbers",)), np.float64)
    front = hand_front(hand, rest, float(slider.surface.length))
    draws = jax.tree.map(lambda leaf: leaf[:, 0], draw_friction(key, slider.surface, model, samples))
    friction = draws.friction.astype(slider.surface.length.dtype)
    turns = [(each, tightest_turn(each, draws.surface, friction, margin)) for each in line_contacts(slider, front)]
    return tuple(StableContact(each, found, rest) for each, found in turns if found is not None)


def stable_push(
    key: PRNGKeyArray,
    slider: Slider,
    hand: Hand,
    start: ArrayLike,
    goal: ArrayLike,
    *,
    model: FrictionModel,
    opening: ArrayLike = (),
    samples: int = 64,
    margin: float = 0.1,
    steps: int | None = None,
) -> StablePush:
    """Plan a push that carries a slider from one pose to another without slip, whatever friction is.

    The hand is put against the edge from which the path is shortest. It starts in contact, and how it gets there is not
    part of the plan. The plan is the same for all friction: it is valid for every sampled friction, and `samples` and
    `margin` say how surely it is for others.

    For many goals call `stable_contacts` once and `shortest_push` for each goal.

    Args:
        key: PRNG key of the sampled friction.
        slider: The slider, a polygon.
        hand: The hand, as in `stable_contacts`.
        start: Pose of the slider at the start, (3,), world, m and rad.
        goal: Pose of the slider at the goal, (3,), world, m and rad; the angle modulo a full turn.
        model: Distribution of limit surface and contact friction.
        opening: As in `stable_contacts`.
        samples: As in `stable_contacts`.
        margin: As in `stable_contacts`.
        steps: Number of steps of the path; None for steps of a twentieth of the surface's length.

    Returns:
        The push. Its status is NOT_STABLE if the contact slips for some sample on every edge even straight ahead.

    Raises:
        ValueError: As in `stable_contacts`, for poses that are not finite, and for fewer than three steps.
        TypeError: As in `stable_contacts`.

    Examples:
        >>> import jax, pushjax as pj
        >>> slider = pj.Slider.uniform(pj.Polygon.rectangle(0.09, 0.06), degree=2)
        >>> model = pj.FrictionModel(dof=200, friction=(0.3, 0.5))
        >>> hand, there = pj.Hand.two_fingers(0.005), (0.1, 0.2, 1.0)
        >>> push = stable_push(jax.random.key(0), slider, hand, (0, 0, 0), there, model=model, opening=(0.04,))
        >>> push.status.name, push.dubins.word
        ('FOUND', 'LSR')
    """
    contacts = stable_contacts(key, slider, hand, model=model, opening=opening, samples=samples, margin=margin)
    return shortest_push(contacts, start, goal, steps=steps, step=STEP * float(slider.surface.length))


def shortest_push(
    contacts: Sequence[StableContact],
    start: ArrayLike,
    goal: ArrayLike,
    *,
    steps: int | None = None,
    step: float = 2e-3,
) -> StablePush:
    """Plan the shortest push from one pose to another with one of several stable contacts.

    Args:
        contacts: The contacts, from `stable_contacts`.
        start: Pose of the slider at the start, (3,), world, m and rad.
        goal: Pose of the slider at the goal, (3,), world, m and rad; the angle modulo a full turn.
        steps: Number of steps of the path, at least three; None for steps of the length `step`.
        step: Length of a step, m.

    Returns:
        The push.

    Raises:
        ValueError: For poses that are not finite or have another shape, and for fewer than three steps.
    """
    given = {"start": start, "goal": goal}
    ends = [np.asarray(checked_array(name, value, (3,)), np.float64) for name, value in given.items()]
    if steps is not None:
        check_count("steps", steps)
        if steps < 3:
            raise ValueError(f"steps must be at least 3, one for each part of the path; got {steps}")
    if not contacts:
        reason = "on no edge does the contact stick for every sampled friction, not even when it pushes straight ahead"
        return StablePush(PlanStatus.NOT_STABLE, reason)
    paths = [
        dubins(compose(ends[0], each.reference), compose(ends[1], each.reference), *each.turn.radii)
        for each in contacts
    ]
    found = [(path, each) for path, each in zip(paths, contacts, strict=True) if path is not None]
    if not found:
        return StablePush(PlanStatus.OUT_OF_REACH, "no contact can turn to either side without slip")
    path, best = min(found, key=lambda pair: pair[0].length)
    count = steps or max(3, int(np.ceil(path.length / step)))
    pose = compose(path.poses(count), inverse(best.reference))
    hand = compose(pose, best.contact.hand)
    rows = np.concatenate([hand, np.tile(best.opening, (len(hand), 1))], axis=1)
    reason = f"edge {best.contact.edge}, {path.word}, {path.length:.3f} m"
    return StablePush(PlanStatus.FOUND, reason, jnp.asarray(rows), jnp.asarray(pose), best, path)
