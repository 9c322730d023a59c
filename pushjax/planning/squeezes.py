"""Squeezes in a row that bring a slider whose pose is not known into a pose that is.

A belief is a set of samples of the slider's pose. When a parallel jaw closes, every sample moves: the slider slides and
turns until both pads hold it. So samples that were different become the same, up to the symmetry of the slider. After
a squeeze the jaw opens, which moves nothing, is lifted, and squeezes again from another side. Nothing is measured in
between.

All candidates for a squeeze are simulated from the same samples with the same friction. A squeeze costs the entropy of
the poses that it leads to, and more if it leaves the slider outside of the jaw. The best few sequences are continued
(beam search), because the squeeze that tells most is not always the one that the next can build on.

The entropy compares every sample i with every sample j, by a Gaussian kernel of the width h:

    entropy = -mean over i of log(mean over j of exp(-d_ij^2 / (4 h^2))).

Here d_ij^2 is the squared distance of the positions plus the squared difference of the angles times a length. The
entropy is zero if all samples are the same, log k for k poses far apart that are equally likely, and at most the
logarithm of the number of samples. So its exponential is the number of distinct poses.

References: Goldberg, Orienting polygonal parts without sensors, 1993. Zhou, Paolini, Johnson, Bagnell & Mason, A
probabilistic planning framework for planar grasping under uncertainty, 2017.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from pushjax._internal.checks import ArrayLike, check_count, check_key, check_positive, checked_array, common_dtype
from pushjax._internal.jit import quick_jit
from pushjax.contact.status import Status
from pushjax.friction.friction_model import FrictionModel
from pushjax.planning.goal import ANGLE_TOLERANCE, PlanStatus, symmetric_turns
from pushjax.planning.push_batch import in_batches
from pushjax.planning.scene import draw_friction
from pushjax.simulation.arguments import check_slider_and_hand
from pushjax.simulation.hand import Hand
from pushjax.simulation.random_rollout import Draws, rollout_under_draws
from pushjax.simulation.slider import Slider

ROWS = 512  # squeezes that are simulated together; fewer are padded, so that one program does for all
NOT_HELD, FAILED = 2.0, 10.0  # cost of a squeeze that does not hold the slider, and of one that fails, nats
WIDTH = 0.1  # poses that are nearer than this are the same, in units of the surface's length


class Squeezes(eqx.Module):
    """The squeezes that a jaw can do around the mean position of a belief.

    Args:
        opening: Distance of the pads before a squeeze, m. The slider has to fit between them at any pose of the belief.
        closed: Distance of the pads of the closed jaw, m.
        steps: Number of steps in which the jaw closes.
        angles: Number of directions, at equal spacing over half a turn.
        offsets: Displacements of the jaw along its pads, (offsets,), m.

    Raises:
        ValueError: For a count below one, lengths that are not finite, a `closed` that is not positive, or an opening
            that is not larger than `closed`.
    """

    opening: Float[Array, ""]
    closed: Float[Array, ""]
    offsets: Float[Array, "offsets"]
    steps: int = eqx.field(static=True)
    angles: int = eqx.field(static=True)

    def __init__(
        self,
        opening: ArrayLike,
        *,
        closed: ArrayLike = 0.001,
        steps: int = 48,
        angles: int = 24,
        offsets: ArrayLike = (0.0,),
    ):
        self.opening = checked_array("opening", opening, ())
        self.closed = checked_array("closed", closed, (), positive=True)
        self.offsets = checked_array("offsets", offsets, ("offsets",))
        if not self.opening > self.closed:
            raise ValueError(f"opening must be larger than closed, {float(self.closed)} m; got {float(self.opening)}")
        check_count("offsets", len(self.offsets))
        check_count("steps", steps)
        check_count("angles", angles)
        self.steps, self.angles = steps, angles

    def around(self, center: np.ndarray) -> np.ndarray:
        """Return the poses of the jaw for squeezes around a position (2,), (candidates, 3), m and rad."""
        angle, offset = np.meshgrid(np.arange(self.angles) * np.pi / self.angles, np.asarray(self.offsets, float))
        angle, offset = angle.ravel(), offset.ravel()
        return np.stack([center[0] + offset * np.cos(angle), center[1] + offset * np.sin(angle), angle], axis=1)

    def path(self, jaw: Float[Array, "3"]) -> Float[Array, "steps+1 4"]:
        """Return the configurations of a jaw that closes at a pose (3,)."""
        part = jnp.linspace(0, 1, self.steps + 1, dtype=jaw.dtype)[:, None]
        distance = self.opening.astype(jaw.dtype) * (1 - part) + self.closed.astype(jaw.dtype) * part
        return jnp.concatenate([jnp.broadcast_to(jaw, (self.steps + 1, 3)), distance], axis=1)


class SqueezeOutcomes(NamedTuple):
    """What squeezes do to samples of a belief."""

    poses: np.ndarray  # of the slider before the first squeeze and after each, (samples, squeezes + 1, 3), world
    held: np.ndarray  # whether the jaw holds the slider at the end of each squeeze, (samples, squeezes)
    failed: np.ndarray  # whether the simulation of a squeeze failed in some step, (samples, squeezes)


class SqueezePlan(NamedTuple):
    """A plan of squeezes.

    Attributes:
        status: Whether it is sure enough.
        jaws: Poses of the jaw in each squeeze, (squeezes, 3), world, m and rad.
        pose: The most likely pose of the slider at the end, (3,), world.
        success: Predicted probability that nothing fails, and the slider is held at the end, within the tolerances of
            `pose`.
        entropy: Predicted entropy of the pose before the first squeeze and after each, (squeezes + 1,), nats.
        outcomes: Prediction for all samples of the belief, under friction that the search has not seen: the `poses`
            before the first squeeze and after each, (samples, squeezes + 1, 3), and whether the slider is `held` and
            the simulation `failed`, (samples, squeezes).
        history: Least cost after each squeeze in the search, (squeezes,).
    """

    status: PlanStatus
    jaws: np.ndarray
    pose: np.ndarray
    success: float
    entropy: np.ndarray
    outcomes: SqueezeOutcomes
    history: np.ndarray


def plan_squeezes(
    key: PRNGKeyArray,
    slider: Slider,
    hand: Hand,
    belief: ArrayLike,
    *,
    model: FrictionModel,
    squeezes: Squeezes,
    count: int = 3,
    symmetry: int | ArrayLike = 1,
    position_tolerance: float = 0.005,
    angle_tolerance: float = ANGLE_TOLERANCE,
    width: float | None = None,
    samples: int = 64,
    beam: int = 2,
    success: float = 0.9,
) -> SqueezePlan:
    """Plan squeezes after which the pose of the slider is known, without measuring anything.

    The same arguments give the same bits. All candidates start from the same samples with the same friction.

    Args:
        key: PRNG key of everything random.
        slider: The slider.
        hand: The jaw, with the configuration x, y, theta, opening.
        belief: Samples of the slider's pose, (poses, 3), world, m and rad.
        model: Distribution of limit surface and contact friction. Each sample keeps its friction.
        squeezes: The squeezes that can be chosen.
        count: Number of squeezes.
        symmetry: Number of angles in a full turn at which the slider looks the same, or the turns, as in `Goal`.
        position_tolerance: Distance within which the final pose counts as known, m.
        angle_tolerance: The same of the angle, rad.
        width: Width of the kernel of the entropy, m; poses that are nearer count as the same. By default a tenth of the
            length of the limit surface.
        samples: Number of poses of the belief that the search uses. The prediction uses all.
        beam: Number of sequences that are continued.
        success: Probability that is asked for.

    Returns:
        The plan.

    Raises:
        ValueError: For a count below one, a belief that is not finite or of another shape, a probability outside
            [0, 1], tolerances or a width that are not positive, or a hand with another configuration.
        TypeError: For arguments of other types.
    """
    for name, value in (("count", count), ("samples", samples), ("beam", beam)):
        check_count(name, value)
    for name, value in (("position_tolerance", position_tolerance), ("angle_tolerance", angle_tolerance)):
        check_positive(name, value)
    if not 0 <= success <= 1:
        raise ValueError(f"success must be a probability; got {success!r}")
    poses = _checked(key, slider, hand, belief)
    turns = np.asarray(symmetric_turns(symmetry), float)
    length = float(slider.surface.length)
    width = WIDTH * length if width is None else width
    check_positive("width", width)
    chosen = poses[np.arange(samples) * len(poses) // samples]
    draws = draw_friction(key, slider.surface, model, samples)
    jaws, history = np.zeros((1, 0, 3)), []
    beliefs = chosen[None]
    for _ in range(count):
        tried = np.stack([squeezes.around(each[:, :2].mean(axis=0)) for each in beliefs])
        after, held, failed = _squeezed(slider, hand, squeezes, draws, beliefs[:, None], tried)
        cost = entropy(after, turns, length, width)
        cost = cost + NOT_HELD * (1 - held.mean(axis=-1)) + FAILED * failed.mean(axis=-1)
        best = np.unravel_index(np.argsort(cost, axis=None, kind="stable")[:beam], cost.shape)
        jaws = np.concatenate([jaws[best[0]], tried[best][:, None]], axis=1)
        beliefs = after[best]
        history.append(cost[best][0])
    unseen = jax.random.fold_in(key, 1)
    outcomes = squeeze_outcomes(unseen, slider, hand, poses, jaws[0], model=model, squeezes=squeezes)
    likeliest, near = most_likely(outcomes.poses[:, -1], turns, position_tolerance, angle_tolerance)
    probability = float(np.mean(near & outcomes.held[:, -1] & ~outcomes.failed.any(axis=1)))
    entropies = entropy(np.moveaxis(outcomes.poses, 1, 0), turns, length, width)
    status = PlanStatus.FOUND if probability >= success else PlanStatus.UNLIKELY
    pose = outcomes.poses[likeliest, -1]
    return SqueezePlan(status, jaws[0], pose, probability, entropies, outcomes, np.array(history))


def squeeze_outcomes(
    key: PRNGKeyArray,
    slider: Slider,
    hand: Hand,
    belief: ArrayLike,  # samples of the slider's pose, (poses, 3), world, m and rad
    jaws: ArrayLike,  # poses of the jaw in each squeeze, (squeezes, 3), world, m and rad
    *,
    model: FrictionModel,
    squeezes: Squeezes,
) -> SqueezeOutcomes:
    """Simulate squeezes in a row under sampled friction. Each sample keeps its friction for all squeezes."""
    poses = _checked(key, slider, hand, belief)
    placed = checked_array("jaws", jaws, ("squeezes", 3))
    draws = draw_friction(key, slider.surface, model, len(poses))
    after, done = poses, []
    for jaw in np.asarray(placed, float):
        done.append(_squeezed(slider, hand, squeezes, draws, after, jaw))
        after = done[-1][0]
    reached, held, failed = (np.stack(each, axis=1) for each in zip(*done, strict=True))
    return SqueezeOutcomes(np.concatenate([poses[:, None], reached], axis=1), held, failed)


def distances(
    poses: np.ndarray,  # (..., samples, 3), m and rad
    turns: np.ndarray,  # (turns,), after which the slider looks the same, rad
    length: float,  # distance that counts as much as an angle of one radian, m
) -> tuple[np.ndarray, np.ndarray]:
    """Return distances of positions, and of angles times `length`, between samples, (..., samples, samples), m."""
    difference = poses[..., :, None, :] - poses[..., None, :, :]
    position_distance = np.hypot(difference[..., 0], difference[..., 1])
    angles = difference[..., 2, None] - turns
    angles = np.abs(angles - 2 * np.pi * np.round(angles / (2 * np.pi))).min(axis=-1)
    return position_distance, length * angles


def entropy(
    poses: np.ndarray,
    turns: np.ndarray,
    length: float,
    width: float,  # of the kernel, m: poses that are nearer than about this are the same
) -> np.ndarray:
    """Return the entropy of samples of poses, (...,), in nats, with `poses`, `turns` and `length` as in `distances`."""
    position_distance, angle_distance = distances(poses, turns, length)
    kernel = np.exp(-(position_distance**2 + angle_distance**2) / (4 * width**2))
    return -np.log(kernel.mean(axis=-1)).mean(axis=-1)


def most_likely(poses: np.ndarray, turns: np.ndarray, max_distance: float, max_angle: float) -> tuple[int, np.ndarray]:
    """Return the index of the sample with the most others near it, and whether each is near it, (samples,)."""
    # Near are poses within `max_distance`, m, and `max_angle`, rad.
    position_distance, angle_distance = distances(poses, turns, 1.0)  # with this length the second one is in rad
    near = (position_distance <= max_distance) & (angle_distance <= max_angle)
    best = int(np.argmax(near.sum(axis=1)))
    return best, near[best]


def _checked(key: PRNGKeyArray, slider: Slider, hand: Hand, belief: ArrayLike) -> np.ndarray:
    """Check the arguments that planning and simulation share, and return the belief, (poses, 3)."""
    check_key(key)
    check_slider_and_hand(slider, hand)
    if hand.dof != 4:
        raise ValueError(f"hand must have the configuration x, y, theta, opening; this one has {hand.dof} coordinates")
    poses = checked_array("belief", belief, ("poses", 3), common_dtype(slider, hand))
    check_count("number of poses in belief", len(poses))
    return np.asarray(poses, float)


def _squeezed(
    slider: Slider,
    hand: Hand,
    squeezes: Squeezes,
    draws: Draws,  # friction of each sample
    poses: np.ndarray,  # (..., samples, 3)
    jaws: np.ndarray,  # poses of the jaw, (..., 3), the same for all samples
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Squeeze once, in batches of one size, and return the poses afterwards, whether held, and whether failed."""
    # The results have the shape (..., samples, 3) of `poses`, and (..., samples). The leading axes of poses and jaws
    # are broadcast.
    poses, jaws = np.broadcast_arrays(poses, jaws[..., None, :])
    shape, dtype = poses.shape[:-1], np.dtype(common_dtype(slider, hand))
    flat_poses, flat_jaws = poses.reshape(-1, 3).astype(dtype), jaws.reshape(-1, 3).astype(dtype)
    numpy_draws = jax.tree.map(lambda leaf: np.asarray(leaf, dtype), draws)

    def squeeze(rows: np.ndarray) -> Any:
        draw = jax.tree.map(lambda leaf: leaf[rows % shape[-1]], numpy_draws)
        return _squeeze_rows(slider, hand, squeezes, draw, flat_poses[rows], flat_jaws[rows])

    after, held, failed = in_batches(len(flat_poses), ROWS, squeeze)
    return after.reshape(*shape, 3).astype(float), held.reshape(shape), failed.reshape(shape)


@quick_jit
def _squeeze_rows(slider: Slider, hand: Hand, squeezes: Squeezes, draws: Draws, poses: Any, jaws: Any):
    """Return the pose (rows, 3) after each squeeze, whether the slider is held, and whether it failed, (rows,)."""

    def squeeze(draw: Draws, pose: Array, jaw: Array):
        done = rollout_under_draws(draw, slider.shape, hand, squeezes.path(jaw), pose, None, None, None, ())
        return done.pose[-1], done.status[-1] == Status.GRASPED, jnp.any(done.failed)

    return jax.vmap(squeeze)(draws, poses, jaws)
