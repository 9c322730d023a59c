"""Parameters of pushes: from a few numbers to the path of a hand.

A push is a line in the slider's body frame: a direction, and a signed distance from the body origin. The hand comes
along that line from outside. Where it first touches the outline is found (`pushjax.simulation.impact`), and the push
goes on from there by a length. So contact point, direction and length are free, for any outline, without a border
between its edges. With bends the path is a Bezier curve whose ends are those of the line.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray
from scipy.special import binom

from pushjax._internal.checks import ArrayLike, check_count, checked_array
from pushjax._math.vec import Vec2, Vec3
from pushjax.geometry import se2
from pushjax.simulation.finger_motion import BodyFrame, FingerMotion
from pushjax.simulation.hand import Hand, RoundFinger
from pushjax.simulation.impact import time_of_impact
from pushjax.simulation.slider import Slider


class PushSequence(eqx.Module):
    """Several pushes in a row, each given by three numbers and its bends.

    The numbers of a push, in units that make all of them of order one:

    - direction, rad, in the slider's body frame at the start of the push;
    - distance of the line from the body origin to the left, in units of the slider's radius about its origin;
    - length of the push from first contact, in units of `length`, clipped to [0, 1];
    - sideways displacement of each inner control point, in units of the push's length;
    - if there is a choice, which slider it is made on: the whole part is an index of `sliders`.

    A push of length zero ends where the hand touches, so a plan of three pushes contains those of fewer.

    Args:
        count: Number of pushes.
        length: Longest push from first contact, m.
        steps: Number of steps of each push.
        clearance: Distance before first contact at which a push starts, m.
        bends: Number of inner control points of the path; zero for a straight line.
        opening: For a hand that turns: what its configuration has beyond x, y and theta, (dof - 3,). The x axis of such
            a hand points in the direction of the push.
        sliders: In a scene of several, the indices of those that a push may be made on. By default only the first, of
            which the goal is.

    Raises:
        ValueError: For a count below one, a negative number of bends, a length or clearance that is not positive, or
            `sliders` that are empty or no indices.
    """

    count: int = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    bends: int = eqx.field(static=True)
    sliders: tuple[int, ...] = eqx.field(static=True)
    length: Float[Array, ""]
    clearance: Float[Array, ""]
    opening: Float[Array, "numbers"]

    def __init__(
        self,
        count: int = 1,
        *,
        length: ArrayLike,
        steps: int = 12,
        clearance: ArrayLike = 0.01,
        bends: int = 0,
        opening: ArrayLike = (),
        sliders: Sequence[int] = (0,),
    ):
        check_count("count", count)
        check_count("steps", steps)
        if not isinstance(bends, (int, np.integer)) or isinstance(bends, bool) or bends < 0:
            raise ValueError(f"bends must be a whole number, at least 0; got {bends!r}")
        if not len(sliders) or any(not isinstance(k, (int, np.integer)) or k < 0 for k in sliders):
            raise ValueError(f"sliders must be indices of sliders, at least one; got {sliders!r}")
        self.count, self.steps, self.bends = int(count), int(steps), int(bends)
        self.sliders = tuple(int(k) for k in sliders)
        self.length = checked_array("length", length, (), positive=True)
        self.clearance = checked_array("clearance", clearance, (), positive=True)
        self.opening = checked_array("opening", opening, ("numbers",))

    @property
    def size(self) -> int:
        """Number of parameters of all pushes."""
        return len(self.scale)

    @property
    def scale(self) -> np.ndarray:
        """Change of each parameter that makes a clearly different push, (size,); a slider stays the same."""
        return np.tile([0.5, 0.3, 0.3] + [0.2] * self.bends + [0.0] * self._chooses, self.count)

    @property
    def _chooses(self) -> bool:
        """Whether there is a choice of sliders."""
        return len(self.sliders) > 1

    def pushed(self, parameters: Float[np.ndarray, "size"]) -> Int[np.ndarray, "count"]:
        """Return the index of the slider that each push is made on."""
        choice = parameters.reshape(self.count, -1)[:, -1] if self._chooses else np.zeros(self.count)
        return np.array(self.sliders)[np.clip(choice, 0, len(self.sliders) - 1).astype(int)]

    def sample(self, key: PRNGKeyArray, candidates: int) -> np.ndarray:
        """Draw random pushes from all sides, (candidates, size)."""
        low = np.tile([-np.pi, -0.8, 0.0] + [-0.2] * self.bends + [0.0] * self._chooses, self.count)
        last = [float(len(self.sliders))] * self._chooses
        high = np.tile([np.pi, 0.8, 1.0] + [0.2] * self.bends + last, self.count)
        return low + (high - low) * np.asarray(jax.random.uniform(key, (candidates, self.size)), np.float64)

    def check_hand(self, hand: Hand) -> None:
        """Raise an error unless the hand consists of round fingers, and its configuration is as the pushes have it.

        Raises:
            TypeError: For a hand with pads.
            ValueError: For a hand with another number of coordinates.
        """
        if not all(isinstance(finger, RoundFinger) for finger in hand.fingers):
            raise TypeError("hand: plans of pushes need round fingers; got a pad")
        expected = 2 if hand.dof == 2 else 3 + len(self.opening)
        if hand.dof != expected or (hand.dof == 2 and len(self.opening)):
            raise ValueError(
                f"opening has {len(self.opening)} number(s), which does not fit a hand of {hand.dof} coordinates; "
                "it is what a configuration has beyond x, y and theta"
            )

    def path(
        self, numbers: Float[Array, "numbers"], sliders: tuple[Slider, ...], hand: Hand, pose: Float[Array, "sliders 3"]
    ) -> Float[Array, "steps+1 dof"]:
        """Return the path of the hand for one push, given the poses of all sliders, world."""
        each = jnp.stack([self._path_on(numbers, sliders[k], hand, pose[k]) for k in self.sliders])
        return each[jnp.clip(numbers[-1], 0, len(each) - 1).astype(int) if self._chooses else 0]

    def _path_on(
        self, numbers: Float[Array, "numbers"], slider: Slider, hand: Hand, pose: Float[Array, "3"]
    ) -> Float[Array, "steps+1 dof"]:
        """Return the path of the hand for one push on one slider."""
        length = self.length * jnp.clip(numbers[2], 0, 1)
        ahead = jnp.stack([jnp.cos(numbers[0]), jnp.sin(numbers[0])])
        left = jnp.stack([-ahead[1], ahead[0]])
        radius = jnp.sqrt(jnp.max(jnp.sum(slider.shape.boundary(64) ** 2, axis=1)))
        line = numbers[1] * radius * left
        touch = self._first_contact(slider, hand, line, ahead, numbers[0], radius)
        # distances along and to the left of the line, of control points and then of the path
        inner = np.arange(1, self.bends + 1) / (self.bends + 1)
        start, end = touch - self.clearance, touch + length
        along = jnp.concatenate([start[None], start + (end - start) * jnp.asarray(inner, start.dtype), end[None]])
        zero = jnp.zeros(1, start.dtype)
        aside = jnp.concatenate([zero, numbers[3 : 3 + self.bends] * length, zero])
        weights = jnp.asarray(_bernstein(self.bends + 1, self.steps), start.dtype)
        points = line[None] + (weights @ along)[:, None] * ahead[None] + (weights @ aside)[:, None] * left[None]
        points = se2.transform(pose, points)
        if hand.dof == 2:
            return points
        rest = jnp.concatenate([(pose[2] + numbers[0])[None], self.opening.astype(points.dtype)])
        return jnp.concatenate([points, jnp.broadcast_to(rest, (self.steps + 1, len(rest)))], axis=1)

    def _first_contact(
        self, slider: Slider, hand: Hand, line: Array, ahead: Array, angle: Array, radius: Array
    ) -> Array:
        """Return how far along its line the hand first touches, m; zero, abreast of the origin, if it never does."""
        rest = jnp.concatenate([angle[None], self.opening.astype(angle.dtype)])[: hand.dof - 2]
        centers = hand.poses(jnp.concatenate([line, rest]))[:, :2]
        # far enough for every finger to start outside; `radius` is that of points on the outline, not of its corners
        reach = 2 * radius + jnp.max(hand.radius + jnp.max(jnp.abs(centers - line[None]), axis=1) * 2**0.5)
        zero, outline = jnp.zeros_like(reach), slider.shape.outline()
        start, way = Vec2.of(-reach * ahead), Vec2.of(2 * reach * ahead)
        fingers = tuple(
            FingerMotion(finger, zero, Vec2.of(center) + start, way, None, None)
            for finger, center in zip(hand.fingers, centers, strict=True)
        )
        at_rest = BodyFrame.at(Vec3(zero, zero, zero))
        first = time_of_impact(fingers, outline, at_rest, slider.surface.length)
        return jnp.where(first < 1, (2 * first - 1) * reach, 0.0)


def _bernstein(degree: int, steps: int) -> np.ndarray:
    """Return the weights of the control points of a Bezier curve at equal steps, (steps + 1, degree + 1)."""
    t = np.arange(steps + 1)[:, None] / steps
    k = np.arange(degree + 1)[None]
    return binom(degree, k) * t**k * (1 - t) ** (degree - k)
