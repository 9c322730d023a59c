"""Rollout of a path whose steps are divided where they are too long.

A step is too long if its result leaves a finger inside the slider. This happens if the slider turned so far that
another of its corners came to touch, or if it slid past the end of what a finger rests on; no contact that is detected
at the start shows either. A step is also too long if a contact that carries a force slides past the end of its edge,
as if the edge were longer, or if the slider moves far and much faster than the hand (`slider_speed`). Such a step is
undone and tried again with half the size, down to a part of `SMALLEST_PART` of the step. A part that succeeds is
followed by one of twice the size. Right after a failure it is first followed by one of the same size. Before a part is
accepted or halved, a contact that the result violates and that was not in the contact problem joins the problem
(`working_set`), which is then solved again. If the smallest part fails, the step is NOT_CONVERGED, and the slider stays
where the step began.

Each push of a batch advances at its own pace: a round of the one loop is the next trial of every push, in whichever
step that push is. So a push that divides its steps delays the others only at the end, and no trial is made for a push
that has ended. Trials that are undone do not contribute to derivatives, which are those of the accepted parts.

A jam is proved to first order only: within a long step the slider may turn out of it. So a whole step that jams is
divided, too, and its first part has the size `EVENT_PART`. If a part of that size jams, the hand stops where that part
began. If all parts move, so does the step.

If a body that holds the slider has no friction, the slider turns ever faster, without bound, while the last gap closes:
no step ends exactly where nothing moves any more. So if the smallest part fails, it is tried once more with `BRACING`
added to every friction. If it jams then, so does the push.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._internal.autodiff import save_search_results
from pushjax._internal.xla import compute_once, skippable, tree_where
from pushjax._math.vec import Scalar, Vec3
from pushjax.contact.scaled_problem import ContactSolver, EdgeSet
from pushjax.contact.status import Status
from pushjax.contact.sticking import StickingSolver
from pushjax.friction.limit_surface import Form
from pushjax.geometry.shape import Outline
from pushjax.simulation.detection import num_contacts
from pushjax.simulation.finger_motion import (
    FingerMotion,
    allowed_penetration,
    holding_distance,
    max_displacement,
    max_penetration,
)
from pushjax.simulation.slider_speed import SpeedJudgment, judge_speed
from pushjax.simulation.step import StepRecord, compute_step, hand_stops
from pushjax.simulation.working_set import LOADED, Urgency, initial_urgency

SMALLEST_PART = 1 / 256  # of a step
EVENT_PART = 1 / 16  # of a step: the part of a jam that has to jam, too, and that may end past the end of an edge
# A path of n steps has at most TRIALS_PER_STEP * n + EXTRA_TRIALS trials. The steps that are left after that are
# NOT_CONVERGED, and the slider stays where the last accepted part left it. A grasp of a slider with many corners takes
# 1.1 trials per step.
TRIALS_PER_STEP, EXTRA_TRIALS = 4, 64
# Added to all coefficients of friction where the smallest part fails. What jams with it could only move some ten times
# as fast as the hand without it.
BRACING = 0.1
NO_TRIAL = -1  # the number of a trial that is not there
MAX_SWAPS = 3  # changes of the working set before a part is divided
# A contact that is not in the contact problem may be violated by this fraction of the allowed penetration.
MISSED_FRACTION = 0.01


class PushState(NamedTuple):
    """State of a push between two trials, and what is tried next."""

    pose: Vec3  # of the slider now, world
    origin: Vec3  # pose of the slider at the start of the step, world
    step: Int[Array, ""]  # index; past the last step once the push has ended
    done: Scalar  # fraction of the step that is done
    part: Scalar  # fraction of the step that is tried next
    halved: Bool[Array, ""]  # whether a part of twice the size failed
    whole_step_jams: Bool[Array, ""]  # whether the step as a whole jams
    urgency: Urgency | None  # of each contact; None if all are solved together
    braced: Bool[Array, ""]  # whether the smallest part has failed, and is tried with more friction
    swaps: Int[Array, ""]  # changes of this part's working set
    overlap: Scalar  # depth of the deepest finger or fixture now, m
    stop_status: Int[Array, ""]  # status that stopped the hand, or zero
    abandon_status: Int[Array, ""]  # status of a step that is given up, or zero
    failed: Bool[Array, ""]  # whether the previous step failed
    twist: Vec3  # of the slider, the sum over the parts of the step that are done, body frame
    source: Int[Array, ""]  # number of the trial of the last part in which the slider moved in this step, or -1
    guess: Any  # what the next contact problem may start from; None with one contact


class Outcome(NamedTuple):
    """What a step leaves."""

    pose: Vec3  # of the slider after the step, world
    twist: Vec3  # over the step, body frame
    status: Int[Array, ""]
    overlap: Scalar  # as in `StepRecord`
    source: Int[Array, ""]  # number of the trial that wrench, forces and contacts are those of, or -1 for none


class StepEnd(NamedTuple):
    """How a step ended, if a trial ended one."""

    ended: Bool[Array, ""]
    step: Int[Array, ""]  # index
    outcome: Outcome


def max_trials(steps):
    """Number of trials of a path after which the steps that are left are NOT_CONVERGED."""
    return TRIALS_PER_STEP * steps + EXTRA_TRIALS


class PreparedPush(NamedTuple):
    """Everything about a push that stays the same from step to step and from trial to trial."""

    outline: Outline
    steps: int  # of the path, with those that only fill it up
    # motion of the fingers over a step, from its index and the friction of each finger
    motions_at: Callable[[Int[Array, ""], Array], tuple[FingerMotion, ...]]
    solver: ContactSolver | StickingSolver | None
    # limit surface and friction of a step, from its index and the pose before it
    friction_at: Callable[[Int[Array, ""], Vec3], tuple[Form, Array]]
    fixtures: tuple[FingerMotion, ...] = ()  # as fingers that stay where they are
    num_steps: Int[Array, ""] | None = None  # steps to simulate; None for all

    @property
    def end(self) -> Int[Array, ""] | int:
        """Index of the step at which the push has ended."""
        return self.steps if self.num_steps is None else self.num_steps

    def first_state(self, pose: Vec3) -> PushState:
        """Return the state before the first trial, with the slider at `pose`, world."""
        first = jnp.zeros((), jnp.int32)
        motions = self.motions_at(first, self.friction_at(first, pose)[1])
        overlap = max_penetration(self.outline, motions + self.fixtures, pose, 0.0)
        counts = self._counts(motions)
        guess = EdgeSet.none(overlap) if sum(counts) > 1 else None
        return first_state(pose, overlap, guess, initial_urgency(counts, overlap))

    def trial(self, state: PushState, number: Int[Array, ""]) -> tuple[PushState, tuple[StepRecord, StepEnd]]:
        """Try the next part of a step: the state after it, the record of the part, and how the step ended."""
        form, mu = self.friction_at(state.step, state.origin)
        motions = self.motions_at(state.step, mu)
        displacement = max_displacement(motions)
        reach = holding_distance(state.part * displacement, form.length)
        tolerance = allowed_penetration(displacement, form.length)
        part = tuple(motion.part(state.done, state.part) for motion in motions)
        # not every contact is solved, so friction that is not valid must be that of all bodies
        extra = jnp.where(jnp.all(mu >= 0), jnp.where(state.braced, BRACING, 0.0), jnp.nan)
        bodies = tuple(motion._replace(friction=motion.friction + extra) for motion in part + self.fixtures)
        part, fixtures = bodies[: len(part)], bodies[len(part) :]
        record, last_stage = compute_step(
            form,
            self.outline,
            part,
            self.solver,
            state.pose,
            state.overlap,
            reach,
            urgency=state.urgency,
            ongoing=state.step < self.end,
            fixtures=fixtures,
            is_first_try=state.swaps == 0,
            guess=state.guess,
        )
        is_smallest = state.part < 2 * SMALLEST_PART

        def depth_at(pose: Vec3) -> Scalar:
            return max_penetration(self.outline, part + fixtures, pose, 1.0)

        speed = judge_speed(record.twist, last_stage.middle, state.part * displacement, form.length, is_smallest)
        following, end = next_state(state, record, number, last_stage, depth_at, tolerance, speed, self.end)
        urgency = initial_urgency(self._counts(motions), state.pose.x)
        if last_stage.urgency_after is not None and urgency is not None:
            following = following._replace(urgency=jnp.where(following.swaps > 0, last_stage.urgency_after, urgency))
        return following, (record, end)

    def _counts(self, motions: tuple[FingerMotion, ...]) -> list[int]:
        """Return the number of contacts of each finger and fixture."""
        return [num_contacts(motion.finger, self.outline) for motion in motions + self.fixtures]


def first_state(pose: Vec3, overlap: Scalar, guess: Any, urgency: Urgency | None = None) -> PushState:
    """Return the state before the first trial, given the depth of the deepest body, m."""
    zero, none, no = jnp.zeros_like(overlap), jnp.zeros((), jnp.int8), jnp.zeros((), bool)
    return PushState(
        pose=pose,
        origin=pose,
        step=jnp.zeros((), jnp.int32),
        done=zero,
        part=jnp.ones_like(overlap),
        halved=no,
        whole_step_jams=no,
        urgency=urgency,
        braced=no,
        swaps=none,
        overlap=overlap,
        stop_status=none,
        abandon_status=none,
        failed=no,
        twist=jax.tree.map(jnp.zeros_like, pose),
        source=jnp.full((), NO_TRIAL, jnp.int32),
        guess=guess,
    )


def simulate_in_substeps(push: Any, pose: Vec3) -> tuple[StepRecord, Scalar]:
    """Return the stacked records of all steps, and the fraction of its last step that a stopped hand did."""
    # `push` is a `PreparedPush`, or a `PreparedSliders`
    initial_state, numbers = push.first_state(pose), jnp.arange(max_trials(push.steps), dtype=jnp.int32)

    def is_ongoing(state: PushState, number: Int[Array, ""]) -> Bool[Array, ""]:
        ongoing = state.step < push.end
        if push.num_steps is not None:
            ongoing &= number < max_trials(push.num_steps)
        return ongoing

    trial = skippable(is_ongoing, push.trial, initial_state, numbers[0])
    # Reverse mode keeps only poses and what searches found, and computes a step again: writing everything that a step
    # computes to memory and reading it back took twice as long.
    trial = jax.checkpoint(trial, prevent_cse=False, policy=save_search_results)
    last, (records, ends) = jax.lax.scan(trial, initial_state, numbers)
    return _records_of_steps(records, ends, push.steps, last), last.done


def _records_of_steps(records: StepRecord, ends: StepEnd, steps: int, last: PushState) -> StepRecord:
    """Return for each step how the trial that ended it left it, or what the last trial left if none did."""
    numbers = jnp.arange(len(ends.ended), dtype=jnp.int32)
    step = jnp.where(ends.ended, ends.step, steps)
    trial_of_step = jnp.full(steps, NO_TRIAL).at[step].set(numbers, mode="drop")
    stop_status = jnp.where(last.stop_status != 0, last.stop_status, Status.NOT_CONVERGED).astype(jnp.int8)
    zero = jax.tree.map(jnp.zeros_like, last.twist)
    unfinished = Outcome(last.pose, zero, stop_status, last.overlap, jnp.full_like(last.source, NO_TRIAL))

    def at(number: Int[Array, "steps"], rows: Any, otherwise: Any) -> Any:
        """Return the rows of these trials; another value where there is none."""

        def of(rows: Array, otherwise: Any) -> Array:
            is_known = (number >= 0).reshape(-1, *(1,) * (rows.ndim - 1))
            rows = rows[jnp.maximum(number, 0)]
            return jnp.where(is_known, rows, jnp.broadcast_to(otherwise, rows.shape))

        return jax.tree.map(of, rows, otherwise)

    outcome = at(trial_of_step, ends.outcome, unfinished)
    records = at(outcome.source, records, jax.tree.map(lambda _: 0, records))
    return records._replace(pose=outcome.pose, twist=outcome.twist, status=outcome.status, overlap=outcome.overlap)


class Decision(NamedTuple):
    """What follows from a trial: one of these, or else a smaller part is tried next."""

    accepted: Bool[Array, ""]  # the part is done
    joins: Bool[Array, ""]  # a contact that the result violates joins the problem, and the part is tried again
    braces: Bool[Array, ""]  # the smallest part is tried again with more friction
    stops: Bool[Array, ""]  # the hand stops where the part began
    abandons: Bool[Array, ""]  # the step is given up, and tried as a whole for the overlap of a slider that stays
    fails: Bool[Array, ""]  # the step ends with the status `reason`
    reason: Int[Array, ""]  # status of a step that fails or is given up


def _decide(
    state: PushState,  # before the trial
    record: StepRecord,  # of the trial
    last_stage: Any,
    depth: Scalar,  # of the deepest finger after the trial, m
    tolerance: Scalar,  # how much deeper a finger may be after a whole step, m
    speed: SpeedJudgment,
) -> Decision:
    """Decide what follows from a trial."""
    fails = state.abandon_status != 0
    is_solved = (record.status == Status.MOVING) | (record.status == Status.FREE)
    # overlaps do not accumulate, because the next part pushes them out: so the smallest part may leave as much as a
    # whole step
    allowed_share = jnp.where(state.part < 2 * SMALLEST_PART, 1.0, state.part)
    clear = speed.allowed & (depth <= jnp.maximum(state.overlap, allowed_share * tolerance))
    clear &= ~last_stage.slides_off | (state.part < 2 * EVENT_PART) | state.failed
    # In a step that is divided for another reason, only the smallest part can confirm a jam, because a slider that
    # squirts out turns far in one step.
    smallest = jnp.where(state.whole_step_jams, EVENT_PART, SMALLEST_PART)
    # if the slider was left behind in the previous step, the step is not tried in parts again
    may_not_divide = (state.part < 2 * smallest) | state.failed
    stops = may_not_divide & hand_stops(record.status) & ~fails
    joins, urgency_after = jnp.zeros((), bool), last_stage.urgency_after
    if urgency_after is not None:
        worst = jnp.max(jnp.where(urgency_after < LOADED, urgency_after, -jnp.inf))
        joins = is_solved & ~fails & (state.swaps < MAX_SWAPS) & (worst > MISSED_FRACTION * state.part * tolerance)
    accepted = is_solved & clear & ~fails & ~joins & ~state.braced
    accepted, stops, joins = compute_once((accepted, stops, joins), state.done)
    is_bad, is_smallest = record.status >= Status.OVERLAPPING, state.part / 2 < SMALLEST_PART
    hopeless = (is_smallest | state.failed | is_bad) & ~accepted & ~stops & ~fails & ~joins
    braces = hopeless & is_smallest & ~is_bad & ~state.braced & (record.force.x.size > 1)
    abandons = hopeless & ~braces
    # If nothing moved and the trial took the hand to the end of the step, its overlap is known and no further trial is
    # needed.
    ends_at_once = abandons & ~is_solved & (state.part == 1)
    reason = jnp.where(is_solved, Status.NOT_CONVERGED, record.status)
    reason = jnp.where(fails, state.abandon_status, reason).astype(jnp.int8)
    fails = compute_once(fails | ends_at_once, state.done)
    return Decision(accepted, joins, braces, stops, abandons & ~ends_at_once, fails, reason)


def next_state(
    state: PushState,
    record: StepRecord,
    number: Int[Array, ""],  # of the trial
    last_stage: Any,  # `Stage`, or that of several sliders
    depth_at: Callable[[Vec3], Scalar],  # of the deepest body after the trial, with the slider at a pose, m
    tolerance: Scalar,
    speed: SpeedJudgment,
    steps: Int[Array, ""] | int,
) -> tuple[PushState, StepEnd]:
    """Return the state after a trial, and how its step ended."""
    ongoing = state.step < steps
    pose = tree_where(compute_once(state.abandon_status != 0, state.done), state.origin, record.pose)
    depth = depth_at(pose)
    decision = _decide(state, record, last_stage, depth, tolerance, speed)
    accepted, stops, fails = decision.accepted, decision.stops, decision.fails

    moves = compute_once(record.status == Status.MOVING, state.done)
    twist, source = state.twist + record.twist, jnp.where(moves, number, state.source)
    done = state.done + state.part
    ends = ongoing & (fails | stops | (accepted & (done >= 1)))
    status = jnp.where(source >= 0, Status.MOVING, Status.FREE)
    still, none = jax.tree.map(jnp.zeros_like, twist), jnp.full_like(source, NO_TRIAL)
    passed = Outcome(pose, twist, status.astype(jnp.int8), depth, source)
    failed = Outcome(state.origin, still, decision.reason, depth, none)
    stopped = Outcome(state.pose, state.twist, record.status, state.overlap, state.source)
    outcome = tree_where(stops, stopped, tree_where(accepted, passed, failed))

    # the next trial: where it starts, and how large its part is
    continues = compute_once(accepted & ~ends, state.done)
    restarts = (ends & ~stops) | decision.abandons
    jams = (state.part == 1) & hand_stops(record.status)
    again = decision.joins | decision.braces
    smaller = jnp.where(again, state.part, jnp.where(jams, EVENT_PART, state.part / 2))
    larger = jnp.where(state.halved | ~speed.allowed_in_double, state.part, 2 * state.part)
    following = PushState(
        pose=tree_where(ends, outcome.pose, tree_where(continues, pose, state.pose)),
        origin=tree_where(ends, outcome.pose, state.origin),
        step=jnp.where(ends, jnp.where(stops, steps, state.step + 1), state.step),
        done=jnp.where(restarts, 0.0, jnp.where(accepted, done, state.done)),
        part=jnp.where(restarts, 1.0, jnp.where(accepted, jnp.minimum(larger, 1 - done), smaller)),
        halved=jnp.where(again, state.halved, ~(restarts | accepted | jams)),
        whole_step_jams=(state.whole_step_jams | jams) & ~(ends | restarts),
        urgency=state.urgency,
        braced=decision.braces | (state.braced & decision.joins),
        swaps=jnp.where(decision.joins, state.swaps + 1, 0).astype(jnp.int8),
        overlap=jnp.where(accepted | (ends & ~stops), depth, state.overlap),
        stop_status=jnp.where(stops, record.status, state.stop_status).astype(jnp.int8),
        abandon_status=jnp.where(decision.abandons, decision.reason, 0).astype(jnp.int8),
        failed=jnp.where(ends, fails, state.failed),
        twist=tree_where(ends, still, tree_where(continues, twist, state.twist)),
        source=jnp.where(ends, NO_TRIAL, jnp.where(continues, source, state.source)),
        guess=None if state.guess is None else tree_where(accepted & moves, last_stage.solution.best, state.guess),
    )
    following = jax.tree.map(lambda new, old: jnp.where(ongoing, new, old), following, state)
    return following, StepEnd(ends, state.step, outcome)
