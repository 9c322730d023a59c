"""Rollouts of several sliders that push each other."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from pushjax._math.vec import Scalar, Vec3
from pushjax.contact.problem import form_and_friction
from pushjax.contact.sliders_solving import Start
from pushjax.friction.limit_surface import Form, LimitSurface
from pushjax.geometry.shape import Shape
from pushjax.simulation.domain import are_valid, poses_are_moderate, replace_invalid
from pushjax.simulation.finger_motion import FingerMotion, allowed_penetration, holding_distance, max_displacement
from pushjax.simulation.fixtures import Fixtures
from pushjax.simulation.hand import Hand
from pushjax.simulation.prepared_push import prepared_push
from pushjax.simulation.slider_speed import SpeedJudgment, judge_speed
from pushjax.simulation.sliders_step import (
    Body,
    Meeting,
    compute_sliders_step,
    contact_counts,
    depths_of_sliders,
    meetings_of,
    shortest,
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


class SlidersFriction(NamedTuple):
    """Friction of several sliders."""

    forms: tuple[Form, ...]  # of their limit surfaces
    fingers: Float[Array, "fingers"]  # coefficient of friction mu with each finger
    between: Float[Array, "sliders sliders"]  # and with each other

    @staticmethod
    def of(surfaces: tuple[LimitSurface, ...], fingers: Array, between: Array) -> "SlidersFriction":
        """Friction without invalid numbers, but for a coefficient of NaN."""
        forms = []
        for surface in surfaces:
            form, fingers = form_and_friction(surface, fingers)
            forms.append(form)
        known = jnp.all(jnp.isfinite(between) & (between >= 0))
        return SlidersFriction(tuple(forms), jnp.where(known, fingers, jnp.nan), jnp.where(known, between, 0.0))


class PreparedSliders(NamedTuple):
    """Everything about a push of several sliders that stays the same from trial to trial; as `PreparedPush`."""

    bodies: Callable[[SlidersFriction], tuple[Body, ...]]
    steps: int
    motions_at: Callable[[Int[Array, ""], Array], tuple[FingerMotion, ...]]
    friction_at: Callable[[Int[Array, ""]], SlidersFriction]  # in a step
    fixtures: tuple[FingerMotion, ...] = ()
    num_steps: Int[Array, ""] | None = None

    @property
    def end(self) -> Int[Array, ""] | int:
        """Index of the step at which the push has ended."""
        return self.steps if self.num_steps is None else self.num_steps

    def _first_meetings(self) -> tuple[tuple[Body, ...], list[Meeting]]:
        """Return the sliders, and everything that may meet, in the first step."""
        first = jnp.zeros((), jnp.int32)
        friction = self.friction_at(first)
        bodies, motions = self.bodies(friction), self.motions_at(first, friction.fingers)
        return bodies, meetings_of(bodies, motions, self.fixtures)

    def contact_names(self) -> tuple[tuple[str, str], ...]:
        """Return the names of the two bodies of each contact; as in `Trajectory`."""
        bodies, meetings = self._first_meetings()
        names = []
        for kind in ("finger", "fixture"):  # in the order of `meetings_of`
            each = [m for m in meetings if m.other is None and m.is_fixture == (kind == "fixture")]
            names += [f"{kind} {k % (len(each) // len(bodies))}" for k in range(len(each))]
        names += [f"slider {m.other}" for m in meetings if m.other is not None]
        sizes = contact_counts(bodies, meetings)
        named = zip(meetings, names, sizes, strict=True)
        return tuple((f"slider {m.slider}", name) for m, name, size in named for _ in range(size))

    def first_state(self, pose: Vec3) -> PushState:
        """Return the state before the first trial."""
        bodies, meetings = self._first_meetings()
        overlap = jnp.max(depths_of_sliders(bodies, meetings, pose, 0.0))
        contacts = sum(contact_counts(bodies, meetings))
        return first_state(pose, overlap, Start.none(contacts, jnp.zeros_like(overlap + pose.x)))

    def trial(self, state: PushState, number: Int[Array, ""]) -> tuple[PushState, tuple[StepRecord, StepEnd]]:
        """Try the next part of a step: the state after it, the record of the part, and how the step ended."""
        friction = self.friction_at(state.step)
        forms, mu, _ = friction
        motions = self.motions_at(state.step, mu)
        length = shortest(forms)
        displacement = max_displacement(motions)
        part = tuple(motion.part(state.done, state.part) for motion in motions)
        extra = jnp.where(jnp.all(mu >= 0), jnp.where(state.braced, BRACING, 0.0), jnp.nan)
        part, fixtures = (
            tuple(motion._replace(friction=motion.friction + extra) for motion in motions)
            for motions in (part, self.fixtures)
        )
        bodies = self.bodies(friction._replace(between=friction.between + extra))
        record, last_stage = compute_sliders_step(
            forms,
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
            return jnp.max(depths_of_sliders(bodies, meetings_of(bodies, part, fixtures), pose, 1.0))

        twist, is_smallest = record.twist, state.part < 2 * SMALLEST_PART
        speeds = [
            judge_speed(Vec3(x, y, z), middle, state.part * displacement, form.length, is_smallest)
            for x, y, z, middle, form in zip(*twist, last_stage.middle, forms, strict=True)
        ]
        speed = SpeedJudgment(*(jnp.all(jnp.stack(each)) for each in zip(*speeds, strict=True)))
        tolerance = allowed_penetration(displacement, length)
        following, end = next_state(state, record, number, last_stage, depth_at, tolerance, speed, self.end)
        return following, (record, end)


def simulate_sliders(
    shapes: tuple[Shape, ...],
    hand: Hand,
    path: Array,  # (steps + 1, dof), world
    pose: Array,  # at the start, (sliders, 3), world
    friction_at: Callable[[Array], SlidersFriction],  # each of its surfaces must keep its length
    fixtures: Fixtures,
    num_steps: Array | None = None,
) -> Trajectory:
    """Roll out a path, with arguments that have been checked. `rollout` is the public function."""
    prepared, first, valid = prepared_sliders(shapes, hand, path, pose, friction_at, fixtures)
    records, fraction = simulate_in_substeps(prepared._replace(num_steps=num_steps), Vec3.of(first.T))
    lengths = jnp.stack([form.length for form in friction_at(jnp.zeros((), jnp.int32)).forms])
    return trajectory_of(records, lengths, path, first, fraction, pose, valid, prepared.contact_names())


def prepared_sliders(
    shapes: tuple[Shape, ...],
    hand: Hand,
    path: Array,
    pose: Array,
    friction_at: Callable[[Array], SlidersFriction],
    fixtures: Fixtures = (),
) -> tuple[PreparedSliders, Array, Bool[Array, ""]]:
    """Return what a rollout needs, with arguments as `simulate_sliders`, the first poses, and whether all are valid."""
    lengths = [form.length for form in friction_at(jnp.zeros((), jnp.int32)).forms]
    valid, usable = jnp.ones((), bool), []
    for shape, length, start in zip(shapes, lengths, pose, strict=True):
        shape_valid = are_valid((shape,), length)
        valid &= shape_valid & poses_are_moderate(start, length)
        usable.append(replace_invalid(shape, shape_valid, length))

    def own_friction_at(step: Array) -> SlidersFriction:
        friction = friction_at(step)
        return friction._replace(fingers=jnp.where(valid, friction.fingers, jnp.nan))

    def first_form_and_friction(step: Array, _: Vec3) -> tuple[Form, Array]:
        friction = own_friction_at(step)
        return friction.forms[0], friction.fingers

    push, _ = prepared_push(usable[0], hand, path, pose[0], None, first_form_and_friction, fixtures)
    first = jnp.where(valid, pose, 0.0)
    prepared = PreparedSliders(
        lambda friction: tuple(Body.of(shape, row) for shape, row in zip(usable, friction.between, strict=True)),
        push.steps,
        push.motions_at,
        lambda step: own_friction_at(step)._replace(fingers=push.friction_at(step, Vec3.of(first[0]))[1]),
        push.fixtures,
    )
    return prepared, first, valid
