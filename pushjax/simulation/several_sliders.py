"""Rollouts of several sliders that push each other."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from pushjax._math.vec import Scalar, Vec2, Vec3
from pushjax.contact.problem import form_and_friction
from pushjax.contact.sliders_solving import Start
from pushjax.friction.limit_surface import Form
from pushjax.geometry.disk import Disk
from pushjax.geometry.polygon import Polygon
from pushjax.geometry.shape import Shape
from pushjax.simulation.domain import are_valid, poses_are_moderate, replace_invalid
from pushjax.simulation.finger_motion import FingerMotion, allowed_penetration, holding_distance, max_displacement
from pushjax.simulation.fixtures import Fixtures
from pushjax.simulation.hand import Finger, Hand, Pad, RoundFinger
from pushjax.simulation.prepared_push import prepared_push
from pushjax.simulation.slider import Slider
from pushjax.simulation.slider_speed import SpeedJudgment, judge_speed
from pushjax.simulation.sliders_step import (
    Body,
    can_push,
    compute_sliders_step,
    contact_counts,
    depth_of_sliders,
    meetings_of,
)
from pushjax.simulation.step import StepRecord
from pushjax.simulation.substeps import (
    BRACING,
    SMALLEST_PART,
    PushState,
    StepEnd,
    first_state,
    next_state,
    simulate_in_substeps,
)
from pushjax.simulation.trajectory import Trajectory, trajectory_of


class PreparedSliders(NamedTuple):
    """Everything about a push of several sliders that stays the same from trial to trial; as `PreparedPush`."""

    bodies: tuple[Body, ...]
    forms: tuple[Form, ...]
    steps: int
    motions_at: Callable[[Int[Array, ""], Array], tuple[FingerMotion, ...]]
    friction_at: Callable[[Int[Array, ""]], Array]  # of the fingers, in a step
    fixtures: tuple[FingerMotion, ...] = ()
    num_steps: Int[Array, ""] | None = None

    @property
    def end(self) -> Int[Array, ""] | int:
        """Index of the step at which the push has ended."""
        return self.steps if self.num_steps is None else self.num_steps

    def first_state(self, pose: Vec3) -> PushState:
        """Return the state before the first trial."""
        first = jnp.zeros((), jnp.int32)
        motions = self.motions_at(first, self.friction_at(first))
        meetings = meetings_of(self.bodies, motions, self.fixtures)
        overlap = depth_of_sliders(self.bodies, meetings, pose, 0.0)
        contacts = sum(contact_counts(self.bodies, meetings))
        return first_state(pose, overlap, Start.none(contacts, jnp.zeros_like(overlap + pose.x)))

    def trial(self, state: PushState, number: Int[Array, ""]) -> tuple[PushState, tuple[StepRecord, StepEnd]]:
        """Try the next part of a step: the state after it, the record of the part, and how the step ended."""
        mu = self.friction_at(state.step)
        motions = self.motions_at(state.step, mu)
        length = jnp.min(jnp.stack([form.length for form in self.forms]))
        displacement = max_displacement(motions)
        part = tuple(motion.part(state.done, state.part) for motion in motions)
        extra = jnp.where(jnp.all(mu >= 0), jnp.where(state.braced, BRACING, 0.0), jnp.nan)
        part, fixtures = (
            tuple(motion._replace(friction=motion.friction + extra) for motion in motions)
            for motions in (part, self.fixtures)
        )
        bodies = tuple(body._replace(friction=body.friction + extra) for body in self.bodies)
        record, last_stage = compute_sliders_step(
            self.forms,
            bodies,
            part,
            fixtures,
            state.pose,
            state.overlap,
            holding_distance(state.part * displacement, length),
            state.guess,
            state.step < self.end,
        )

        def depth_at(pose: Vec3) -> Scalar:
            return depth_of_sliders(bodies, meetings_of(bodies, part, fixtures), pose, 1.0)

        twist, is_smallest = record.twist, state.part < 2 * SMALLEST_PART
        speeds = [
            judge_speed(Vec3(x, y, z), middle, state.part * displacement, form.length, is_smallest)
            for x, y, z, middle, form in zip(*twist, last_stage.middle, self.forms, strict=True)
        ]
        speed = SpeedJudgment(*(jnp.all(jnp.stack(each)) for each in zip(*speeds, strict=True)))
        tolerance = allowed_penetration(displacement, length)
        following, end = next_state(state, record, number, last_stage, depth_at, tolerance, speed, self.end)
        return following, (record, end)


def simulate_sliders(
    sliders: tuple[Slider, ...],
    hand: Hand,
    path: Array,  # (steps + 1, dof), world
    pose: Array,  # at the start, (sliders, 3), world
    mu: Array,  # of the fingers
    between: Array,  # friction of sliders with each other, (sliders, sliders)
    fixtures: Fixtures,
    num_steps: Array | None = None,
) -> Trajectory:
    """Roll out a path, with arguments that have been checked. `rollout` is the public function."""
    valid, bodies, forms = jnp.all(between >= 0), [], []
    for k, slider in enumerate(sliders):
        form, known = form_and_friction(slider.surface, jnp.ones_like(pose[0, 0]))
        shape_valid = are_valid((slider.shape,), form.length)
        valid &= shape_valid & poses_are_moderate(pose[k], form.length) & ~jnp.isnan(known)
        shape = replace_invalid(slider.shape, shape_valid, form.length)
        bodies.append(Body(shape.outline(), *_as_finger(shape), jnp.where(valid, between[k], 0.0)))
        forms.append(form)
    push, _ = prepared_push(
        sliders[0].shape, hand, path, pose[0], None, lambda *_: (forms[0], jnp.where(valid, mu, jnp.nan)), fixtures
    )
    first = jnp.where(valid, pose, 0.0)
    prepared = PreparedSliders(
        tuple(bodies),
        tuple(forms),
        push.steps,
        push.motions_at,
        lambda step: push.friction_at(step, Vec3.of(first[0]))[1],
        push.fixtures,
        num_steps,
    )
    records, fraction = simulate_in_substeps(prepared, Vec3.of(first.T))
    lengths = jnp.stack([form.length for form in forms])
    return trajectory_of(records, lengths, path, first, fraction, pose, valid)


def _as_finger(shape: Shape) -> tuple[Finger | None, Vec2]:
    """Return a slider as a finger that pushes others, None if it cannot be one, and the center of the finger."""
    if isinstance(shape, Disk):
        return RoundFinger(shape.radius), Vec2.of(shape.center)
    zero = jnp.zeros_like(jax.tree.leaves(shape)[0].ravel()[0])
    return Pad(shape) if isinstance(shape, Polygon) and can_push(shape) else None, Vec2(zero, zero)
