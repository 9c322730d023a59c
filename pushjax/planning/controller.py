"""Feedback: from what is seen, the next action of the finger.

The controller is a state machine. It plans a push, goes around the slider to its start, pushes, and plans anew.

Going: the finger follows the transit as fast as its speed limits allow. Each action is tried on the model of the finger
    first; a step that would come too near to the slider or to a fixture is shortened.
Pushing: in each control step the end of the push is corrected. Rollouts of pushes to ends around it start at the poses
    that are seen; the end whose final pose is best is taken. The push is over once the finger is at the end that the
    last control step has chosen. So no control step both corrects a push and plans one.
Learning: with a `FrictionFilter`, each control step of a push updates a belief about friction. Rollouts of the feedback
    use its mean. If its samples are those of the planner's library, pushes are chosen by their weights.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from pushjax.geometry.polygon_numpy import signed_distances
from pushjax.geometry.se2_numpy import compose, inverse, to_body
from pushjax.planning.finger_control import FingerControl, FingerState
from pushjax.planning.friction_filter import BeliefStatus, FrictionBelief, FrictionFilter
from pushjax.planning.planned_push import PlannedPush, PushStatus
from pushjax.planning.push_batch import GROUP, LEG, simulate_pushes
from pushjax.planning.push_planner import PushPlanner
from pushjax.simulation.slider import Slider

# Lengths in units of the surface's length
ARRIVED = 0.007  # distance from a point at which the finger has arrived
MOVED = 0.03  # motion of the slider on the way to a push, from which the push is planned anew
CLOSE = 0.01  # distance that the finger keeps from slider and fixtures on the way to a push
SLOWER = np.array([1.0, 0.75, 0.5, 0.3, 0.15, 0.05])  # fractions of the speed that are tried
# Ends of a push that are tried around the planned one, along the push and across, in units of the surface's length
ALONG = np.array([-0.2, -0.11, -0.06, -0.025, 0, 0.025, 0.06, 0.11, 0.2])
ACROSS = np.array([-0.12, -0.055, -0.02, 0, 0.02, 0.055, 0.12])
CORRECTED = 1.3  # the end is corrected once it is nearer than this; longer pushes would be simulated too coarsely
# The offsets above are multiplied by a factor. It is FINE where the finger is at the end, and grows linearly with the
# finger's distance from the end, up to one at the distance FULL.
FINE, FULL = 0.25, 0.73
LATE = 1.5  # a push is over after this times its planned number of control steps, plus three
# Weights of the cost of an end: of its distance from the end before; and in a push that reaches the goal, of the score
# that is missing, and of the distance of the final pose from the target.
SHIFT_WEIGHT, SCORE_WEIGHT, DISTANCE_WEIGHT = 0.02, 7.3, 0.1
LEARNING_STEPS = 5  # steps of the simulation of a control step that updates the belief about friction
RANDOMIZE_AFTER = 5  # pushes after which costs are made random, more with each push, to leave a cycle


class Observation(NamedTuple):
    """What the controller sees.

    Attributes:
        finger: Center of the finger, (2,), world, m.
        pose: Pose of the slider, (3,), world, m and rad.
    """

    finger: np.ndarray
    pose: np.ndarray


class ControllerState(NamedTuple):
    """What the controller remembers between control steps."""

    push: PlannedPush | None  # the current push
    pushing: bool  # whether the finger is in the push, not on the way to it
    pose: np.ndarray  # (3,), of the slider when the push was planned, world, m and rad
    end: np.ndarray  # (2,), where the push ends, as corrected, world, m
    along: float  # how far along the transit the finger is, m
    speed: float  # length of the last control step, m
    velocity: np.ndarray  # (2,), of the finger by its own model, m/s
    taken: int  # control steps of the current push
    pushes: int  # pushes so far
    waited: int  # control steps in which there was no push to make
    status: PushStatus  # of the last plan
    belief: FrictionBelief | None = None  # about friction
    last: Observation | None = None  # one control step ago, if the finger was pushing then
    path: np.ndarray | None = None  # (points, 2), of the finger since then by its own model, world, m


class PushController:
    """Brings the slider of a planner to its goal, with a finger that moves as `control` says.

    Args:
        planner: Chooses the pushes.
        control: Model of the finger.
        feedback: Whether the end of a push is corrected while it runs.
        noise: Standard deviation of the positions that are seen, m.
        friction_filter: How a belief about friction is updated by what is seen. None: friction is the scene's mean.
        prior: Belief before anything is seen, from `friction_filter.init`. If the library has as many samples, they
            must be the same: build it with the same key.

    Raises:
        ValueError: If one of `friction_filter` and `prior` is given without the other, or if the filter is for another
            scene than the planner's library.
    """

    def __init__(
        self,
        planner: PushPlanner,
        control: FingerControl,
        *,
        feedback: bool = True,
        noise: float = 0.0,
        friction_filter: FrictionFilter | None = None,
        prior: FrictionBelief | None = None,
    ):
        if (friction_filter is None) != (prior is None):
            raise ValueError("friction_filter and prior must be given together")
        self.friction_filter, self.prior = friction_filter, prior
        if friction_filter is not None:
            planner.library_samples.check_made_for(friction_filter.scene)
        self.planner, self.control, self.feedback = planner, control, feedback
        self.scene = planner.scene
        self.length = planner.mean_library.length
        grid = np.stack(np.meshgrid(ALONG, ACROSS, indexing="ij"), axis=-1).reshape(-1, 2)
        self.offsets = self.length * grid
        self.moved = MOVED * self.length + 4 * noise
        self.arrived = ARRIVED * self.length + noise
        assert len(grid) <= GROUP

    def initial_state(self) -> ControllerState:
        """Return the state of the first control step; the finger is at rest."""
        zero = np.zeros(2)
        return ControllerState(None, False, np.zeros(3), zero, 0.0, 0.0, zero, 0, 0, 0, PushStatus.NO_PUSH, self.prior)

    def prepare(self) -> None:
        """Compile the programs of control steps, which are else compiled when they are first needed."""
        self._cost_noise(jax.random.key(0), 1)
        if self.friction_filter is not None and self.prior is not None:
            self.friction_filter.update(self.prior, np.zeros(3), np.zeros((LEARNING_STEPS + 1, 2)), np.zeros(3))
        if self.feedback:
            far = self.planner.goal[:2] + 10 * self.length
            self._reached(far, self.planner.goal, far + self.offsets, self.prior)

    def __call__(
        self, key: PRNGKeyArray, observation: Observation, state: ControllerState
    ) -> tuple[np.ndarray, ControllerState]:
        """Return the next action and the state after it.

        Args:
            key: Key of the random costs that end a cycle of pushes.
            observation: What is seen now.
            state: Result of the control step before, or `initial_state`.

        Returns:
            The action of `control`, (2,), and the state for the next control step.
        """
        finger = FingerState(np.asarray(observation.finger, float), state.velocity)
        pose = np.asarray(observation.pose, float)
        state = self._learned(pose, state)
        fresh = False
        for _ in range(3):  # a push may be over at once
            if state.push is None:
                state, fresh = self._plan(key, finger, pose, state), True
                if state.push is None:
                    return self._finish(finger, pose, finger.position, state._replace(waited=state.waited + 1))
            if not state.pushing:
                target, state = self._go(finger, pose, state)
            else:
                # the end of a push that has just been planned needs no correction
                target, state = self._push(finger, pose, state, correct=self.feedback and not fresh)
            if target is not None:
                return self._finish(finger, pose, target, state)
        return self._finish(finger, pose, finger.position, state)

    def _finish(
        self, finger: FingerState, pose: np.ndarray, target: np.ndarray, state: ControllerState
    ) -> tuple[np.ndarray, ControllerState]:
        """Return the action that brings the finger to `target`, (2,), and the state with what follows from it."""
        action = self.control.action(finger, target)
        state = state._replace(velocity=self.control.after(finger, action).velocity, last=None)
        if self.friction_filter is not None and state.pushing:
            path = np.concatenate([finger.position[None], self.control.motion(finger, action)])
            state = state._replace(last=Observation(finger.position, pose), path=path)
        return action, state

    def _learned(self, pose: np.ndarray, state: ControllerState) -> ControllerState:
        """Update the belief by the motion since the last control step, if the finger was pushing."""
        if self.friction_filter is None or state.last is None or state.path is None:
            return state
        assert state.belief is not None
        points = np.round(np.linspace(0, len(state.path) - 1, LEARNING_STEPS + 1)).astype(int)
        belief = self.friction_filter.update(state.belief, state.last.pose, state.path[points], pose)
        return state._replace(belief=belief)

    def _plan(
        self, key: PRNGKeyArray, finger: FingerState, pose: np.ndarray, state: ControllerState
    ) -> ControllerState:
        """Plan a push. If there is none, `push` stays None."""
        cost_noise = self._cost_noise(key, state.pushes) if state.pushes > RANDOMIZE_AFTER else None
        push = self._planner(state.belief).choose(pose, finger.position, cost_noise)
        planned = state._replace(status=push.status, pushing=False, pose=pose, along=0.0, taken=0)
        if push.status.failed:
            return planned._replace(push=None)
        return planned._replace(push=push, end=push.end, pushes=state.pushes + 1)

    def _cost_noise(self, key: PRNGKeyArray, pushes: int) -> np.ndarray:
        """Return random costs of all pushes, which grow with the number of pushes so far, control steps."""
        seed = np.asarray(jax.random.key_data(jax.random.fold_in(key, pushes))).ravel().tolist()
        return np.abs(np.random.default_rng(seed).normal(0, pushes, len(self.planner.mean_library.starts)))

    def _planner(self, belief: FrictionBelief | None) -> PushPlanner:
        """Return the planner, with the weights of the belief if it has as many samples as the library."""
        if belief is None or len(belief.weight) != len(self.planner.library_samples.outcomes):
            return self.planner
        if belief.status == BeliefStatus.PRIOR:
            return self.planner
        return self.planner.reweighted(np.asarray(belief.weight))

    def _go(
        self, finger: FingerState, pose: np.ndarray, state: ControllerState
    ) -> tuple[np.ndarray | None, ControllerState]:
        """Return the next target on the way to a push, or None if the push begins or must be planned anew."""
        features = self.planner.mean_library.features
        if np.linalg.norm(features(pose) - features(state.pose)) > self.moved:
            return None, state._replace(push=None)
        push = state.push
        assert push is not None
        points = np.concatenate([push.transit.points, push.start[None]])
        lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        total, run_up = lengths[-1], lengths[-1] - lengths[-2]
        speeds, remaining = self.planner.speeds, total - state.along
        if remaining <= run_up + self.arrived and remaining <= speeds.push:
            return None, state._replace(pushing=True)
        # slow enough at the start of the push
        braking = np.sqrt(speeds.push**2 + 2 * speeds.acceleration * max(remaining, 0.0))
        speed = speeds.next_speed(state.speed, remaining + speeds.push, min(speeds.free, braking))
        ahead = np.minimum(state.along + speed * SLOWER, total)
        targets = np.stack([np.interp(ahead, lengths, points[:, axis]) for axis in (0, 1)], axis=-1)
        motions = self.control.motion(finger, self.control.action(finger, targets))
        apart = self._clearance(pose, motions).min(-1)
        now = float(self._clearance(pose, finger.position))
        needed = min(CLOSE * self.length, now + 1e-3 * self.length)
        good = np.flatnonzero(apart >= needed)
        best = int(good[0]) if len(good) else int(np.argmax(apart))
        return targets[best], state._replace(along=float(ahead[best]), speed=float(ahead[best] - state.along))

    def _clearance(self, pose: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the distance of the finger at points (..., 2) from slider and fixtures, negative in one, (...,), m."""
        apart = signed_distances(self.planner.vertices, to_body(pose, points))
        return np.minimum(apart, self.planner.obstacles.point_clearance(points)) - self.scene.radius

    def _push(
        self, finger: FingerState, pose: np.ndarray, state: ControllerState, correct: bool
    ) -> tuple[np.ndarray | None, ControllerState]:
        """Return the next target in a push, or None if the push is over."""
        push, speeds = state.push, self.planner.speeds
        assert push is not None
        end = state.end
        remaining = float(np.linalg.norm(end - finger.position))
        # a finger that does not go where it should would try forever
        late = state.taken > LATE * speeds.push_time(np.linalg.norm(push.end - push.start)) + 3
        # no correction at the end: it would go on and on for less than the next push gains in the same time
        if remaining < self.arrived or late:
            return None, state._replace(push=None, pushing=False, speed=0.0)
        if correct and remaining < CORRECTED * self.length:
            end = self._corrected(finger.position, pose, end, push, state.belief)
        ahead = end - finger.position
        remaining = float(np.linalg.norm(ahead))
        speed = speeds.next_speed(state.speed, remaining, speeds.push)
        target = finger.position + ahead * min(speed / max(remaining, 1e-9), 1.0)
        return target, state._replace(end=end, speed=speed, taken=state.taken + 1)

    def _corrected(
        self, position: np.ndarray, pose: np.ndarray, end: np.ndarray, push: PlannedPush, belief: FrictionBelief | None
    ) -> np.ndarray:
        """Return the best of the ends around `end`, (2,), world, m."""
        ahead = end - position
        remaining = float(np.linalg.norm(ahead))
        along = ahead / remaining if remaining > 1e-9 else np.array([1.0, 0.0])
        across = np.array([-along[1], along[0]])
        scale = min(1.0, FINE + remaining / (FULL * self.length) * (1 - FINE))
        ends = end + scale * (self.offsets[:, :1] * along + self.offsets[:, 1:] * across)
        final = self._reached(position, pose, ends, belief)
        features = self.planner.mean_library.features
        # least distance from the push's target, or, if the push is to reach the goal, largest score
        missed = np.linalg.norm(features(final) - features(push.target), axis=1)
        cost = (missed + SHIFT_WEIGHT * np.linalg.norm(ends - end, axis=1)) / self.length
        if push.status == PushStatus.ONE_PUSH:
            score = self.planner.measure(compose(inverse(self.planner.goal), final))
            cost = SCORE_WEIGHT * (1 - score) + DISTANCE_WEIGHT * cost
        return ends[np.argmin(cost)]

    def _reached(
        self, position: np.ndarray, pose: np.ndarray, ends: np.ndarray, belief: FrictionBelief | None
    ) -> np.ndarray:
        """Return the poses of the slider after pushes from one position to each of the ends, (ends, 3)."""
        paths = position + (ends - position)[:, None] * np.linspace(0, 1, LEG + 1)[:, None]
        slider, friction = self.scene.one_slider, self.scene.mean_friction
        if belief is not None:
            surface, mu = _mean(belief)
            slider, friction = Slider(slider.shape, surface), float(mu)
        poses, _ = simulate_pushes(slider, self.scene.hand, paths, np.broadcast_to(pose, (len(ends), 3)), friction)
        return poses[:, -1].astype(float)


_mean = jax.jit(FrictionBelief.mean)
