"""Rollout of a path whose steps are divided where they are too long.

A step is too long if its result leaves a finger inside the slider. This happens if the slider turned so far that
another of its corners came to touch, or if it slid past the end of what a finger rests on; no contact that is detected
at the start shows either. Such a step is undone and tried again with half the size, down to a part of `SMALLEST`. A
part that succeeds is followed by one of twice the size, or, right after a failure, first by one of the same size.
Before a part is halved, a place that the result violates and that was not in the contact problem joins the problem
(`working_set`), which is then solved again. If the smallest part fails, the step is NOT_CONVERGED, and the slider stays
where the step began.

Each push of a batch advances at its own pace: a round of the one loop is the next trial of every push, in whichever
step that push is. So a push that divides its steps delays the others only at the end, and no trial is made for a push
that has ended. Trials that are undone do not contribute to derivatives, which are those of the accepted parts.

A jam is proved to first order only: within a long step the slider may turn out of it. So a whole step that jams is
divided, too, and its first part has the size `CONFIRMED`. If a part of that size jams, the hand stops where that part
began. If all parts move, so does the step.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._internal.autodiff import keep_found
from pushjax._internal.xla import compute_once, decide, tree_where
from pushjax._math.vec import Scalar, Vec3
from pushjax.contact.scaled_problem import ContactSolver
from pushjax.contact.status import Status
from pushjax.contact.sticking import StickingSolver
from pushjax.friction.limit_surface import Form
from pushjax.geometry.shape import Outline
from pushjax.simulation.detection import num_contacts
from pushjax.simulation.finger_motion import FingerMotion, allowed_penetration, holding_distance, max_penetration
from pushjax.simulation.step import ScalarStep, step_in_scalars
from pushjax.simulation.working_set import LOADED, Urgency, likeliest

SMALLEST = 1 / 256  # of a step
CONFIRMED = 1 / 16  # of a step that jams as a whole: size of the part that has to jam, too
# A path of n steps has TRIALS_A_STEP * n + TRIALS trials. What is left of it after that is NOT_CONVERGED. A grasp of a
# slider with many corners takes 1.1 trials per step.
TRIALS_A_STEP, TRIALS = 4, 64
SWAPS = 3  # changes of the working set before a part is divided
# A place that is not in the contact problem may be violated by this much, as a fraction of the tolerance for the whole.
MISSED = 0.01


class Trial(NamedTuple):
    """State of a push, and what is tried next.

    Attributes:
        pose: Current pose.
        origin: Pose at the start of the step.
        step: Index of the step; past the last one once the push has ended.
        done: Fraction of the step that is done.
        part: Fraction of the step that is tried next.
        halved: Whether the part has its size because a part of twice that size failed.
        jammed: Whether the step as a whole jams.
        urgency: Urgency of each contact; None if all are solved together.
        swaps: How often the working set of this part has changed.
        overlap: Current depth of the deepest finger, m.
        stopped: Status that stopped the hand, or zero.
        given_up: Status of a step that is given up, or zero.
        failed: Whether the previous step failed.
        so_far: Record of the parts of the step that are done.
    """

    pose: Vec3
    origin: Vec3
    step: Int[Array, ""]
    done: Scalar
    part: Scalar
    halved: Bool[Array, ""]
    jammed: Bool[Array, ""]
    urgency: Urgency | None
    swaps: Int[Array, ""]
    overlap: Scalar
    stopped: Int[Array, ""]
    given_up: Int[Array, ""]
    failed: Bool[Array, ""]
    so_far: ScalarStep


def divided(
    outline: Outline,
    steps: int,
    grips_at: Callable[[Int[Array, ""], Array], tuple[FingerMotion, ...]],
    solver: ContactSolver | StickingSolver | None,
    pose: Vec3,
    friction_at: Callable[[Int[Array, ""], Vec3], tuple[Form, Array]],
) -> tuple[ScalarStep, Scalar]:
    """Roll out a path, dividing steps where necessary.

    Args:
        outline: The slider's outline.
        steps: Number of steps of the path.
        grips_at: Function that gives the motion of the fingers over a step, from its index and the friction of each
            finger.
        solver: Solver of contact problems; None for the default.
        pose: Pose of the slider at the start, world.
        friction_at: Function that gives limit surface and friction of a step, from its index and the pose before it.

    Returns:
        The stacked records of all steps, and the fraction of its last step that the hand did, if it was stopped.
    """
    first = jnp.zeros((), jnp.int32)
    form, mu = friction_at(first, pose)
    grips = grips_at(first, mu)
    most = TRIALS_A_STEP * steps + TRIALS
    overlap = max_penetration(outline, grips, pose, 0.0)
    zero, one = jnp.zeros_like(pose.x), jnp.ones_like(pose.x)
    none, no = jnp.zeros((), jnp.int8), jnp.zeros((), bool)
    urgency = likeliest([num_contacts(grip.finger, outline) for grip in grips], pose.x)
    nothing = _nothing(form, outline, grips, solver, pose, urgency)
    begin = Trial(pose, pose, first, zero, one, no, no, urgency, none, overlap, none, none, no, nothing)

    def next_trial(trial: Trial) -> tuple[Trial, tuple[ScalarStep, Bool[Array, ""], Int[Array, ""]]]:
        form, mu = friction_at(trial.step, trial.origin)
        grips = grips_at(trial.step, mu)
        reach, tolerance = holding_distance(grips, form.length), allowed_penetration(grips, form.length)
        part = tuple(grip.part(trial.done, trial.part) for grip in grips)
        ongoing = trial.step < steps
        record, missed = step_in_scalars(
            form, outline, part, solver, trial.pose, trial.overlap, reach, trial.urgency, ongoing
        )
        following, found = _judged(trial, record, missed, outline, part, tolerance, steps)
        if missed is not None and urgency is not None:
            following = following._replace(urgency=jnp.where(following.swaps > 0, missed, urgency))
        return following, found

    def skipped(trial: Trial):
        return trial, (nothing, jnp.zeros((), bool), trial.step)

    def round_(trial: Trial, _):
        left = eqxi.unvmap_any(trial.step < steps)
        return jax.lax.cond(left, next_trial, skipped, trial)

    # Reverse mode keeps only poses and what searches found, and computes a step again: writing everything that a step
    # computes to memory and reading it back took twice as long.
    round_ = jax.checkpoint(round_, prevent_cse=False, policy=keep_found)
    last, (records, ends, step) = jax.lax.scan(round_, begin, length=most)
    return _records_of_steps(records, ends, step, steps, last, nothing), last.done


def _records_of_steps(
    records: ScalarStep,
    ends: Bool[Array, " rounds"],
    step: Int[Array, " rounds"],
    steps: int,
    last: Trial,
    nothing: ScalarStep,
) -> ScalarStep:
    """For each step, the record of the round that ended it, or what the last round left if no round ended it.

    Args:
        records: Record of each round.
        ends: Whether each round ended its step.
        step: Index of the step of each round.
        steps: Number of steps.
        last: State after the last round.
        nothing: Record of a step in which nothing pushes.
    """
    most = len(ends)
    at = jnp.full(steps, most).at[jnp.where(ends, step, steps)].set(jnp.arange(most), mode="drop")
    status = jnp.where(last.stopped != 0, last.stopped, Status.NOT_CONVERGED).astype(jnp.int8)
    rest = nothing._replace(pose=last.pose, status=status, overlap=last.overlap)
    return jax.tree.map(lambda rows, row: jnp.concatenate([rows, row[None]])[at], records, rest)


class Outcome(NamedTuple):
    """What follows from a trial: one of these, or else a smaller part is tried next.

    Attributes:
        accepted: The part is done.
        joins: A place that the result violates joins the contact problem, and the same part is tried again.
        stops: The hand stops where the part began.
        abandons: The step is given up. The next trial is of the whole step, to find the overlap of a slider that stays.
        fails: The step ends with the status `reason`.
        reason: Status of a step that fails or is given up.
    """

    accepted: Bool[Array, ""]
    joins: Bool[Array, ""]
    stops: Bool[Array, ""]
    abandons: Bool[Array, ""]
    fails: Bool[Array, ""]
    reason: Int[Array, ""]


def _outcome(trial: Trial, record: ScalarStep, missed: Urgency | None, depth: Scalar, tolerance: Scalar) -> Outcome:
    """Decide what follows from a trial.

    Args:
        trial: The state before the trial.
        record: Result of the trial.
        missed: Urgency of each contact after the trial; None if all are solved together.
        depth: Depth of the deepest finger after the trial, m.
        tolerance: How much deeper a finger may be after a whole step, m.
    """
    fails = trial.given_up != 0
    goes = (record.status == Status.MOVING) | (record.status == Status.FREE)
    # overlaps do not accumulate, for the next part pushes them out: so the smallest part may leave as much as a whole
    # step
    share = jnp.where(trial.part < 2 * SMALLEST, 1.0, trial.part)
    clear = depth <= jnp.maximum(trial.overlap, share * tolerance)
    # In a step that is divided for another reason, only the smallest part can confirm a jam, because a slider that
    # squirts out turns far in one step.
    smallest = jnp.where(trial.jammed, CONFIRMED, SMALLEST)
    # if the slider was left behind in the previous step, the step is not tried in parts again
    final = (trial.part < 2 * smallest) | trial.failed
    stops = final & stopping(record.status) & ~fails
    joins = jnp.zeros((), bool)
    if missed is not None:
        worst = jnp.max(jnp.where(missed < LOADED, missed, -jnp.inf))
        joins = goes & ~fails & (trial.swaps < SWAPS) & (worst > MISSED * trial.part * tolerance)
    accepted, stops, joins = compute_once((goes & clear & ~fails & ~joins, stops, joins), trial.pose.x)
    hopeless = (trial.part / 2 < SMALLEST) | trial.failed | (record.status >= Status.OVERLAPPING)
    abandons = hopeless & ~accepted & ~stops & ~fails & ~joins
    # If nothing moved and the trial took the hand to the end of the step, its overlap is known and no further trial is
    # needed.
    at_once = abandons & ~goes & (trial.part == 1)
    reason = jnp.where(goes, Status.NOT_CONVERGED, record.status)
    reason = jnp.where(fails, trial.given_up, reason).astype(jnp.int8)
    return Outcome(accepted, joins, stops, abandons & ~at_once, decide(fails | at_once, trial.pose.x), reason)


def _judged(
    trial: Trial,
    record: ScalarStep,
    missed: Urgency | None,
    outline: Outline,
    part: tuple[FingerMotion, ...],
    tolerance: Scalar,
    steps: int,
):
    """Return the next state; and, of the step, the record, whether it ended with this trial, and the index."""
    ongoing = trial.step < steps
    pose = tree_where(decide(trial.given_up != 0, trial.pose.x), trial.origin, record.pose)
    depth = max_penetration(outline, part, pose, 1.0)
    outcome = _outcome(trial, record, missed, depth, tolerance)
    accepted, stops, fails = outcome.accepted, outcome.stops, outcome.fails

    moves = decide(record.status == Status.MOVING, pose.x)
    so_far = tree_where(moves, record, trial.so_far)
    so_far = so_far._replace(twist=trial.so_far.twist + record.twist, pose=pose, overlap=depth)
    so_far = so_far._replace(status=jnp.where(moves, record.status, trial.so_far.status))
    done = trial.done + trial.part
    ends = ongoing & (fails | stops | (accepted & (done >= 1)))
    failed = _still(record, trial.origin)._replace(status=outcome.reason, overlap=depth)
    held = trial.so_far._replace(pose=trial.pose, status=record.status, overlap=trial.overlap)
    ended = tree_where(stops, held, tree_where(accepted, so_far, failed))

    # the next trial: where it starts, and how large its part is
    onward = decide(accepted & ~ends, pose.x)
    anew = (ends & ~stops) | outcome.abandons
    jams = (trial.part == 1) & stopping(record.status)
    smaller = jnp.where(outcome.joins, trial.part, jnp.where(jams, CONFIRMED, trial.part / 2))
    larger = jnp.where(trial.halved, trial.part, 2 * trial.part)
    following = Trial(
        pose=tree_where(ends, ended.pose, tree_where(onward, pose, trial.pose)),
        origin=tree_where(ends, ended.pose, trial.origin),
        step=jnp.where(ends, jnp.where(stops, steps, trial.step + 1), trial.step),
        done=jnp.where(anew, 0.0, jnp.where(accepted, done, trial.done)),
        part=jnp.where(anew, 1.0, jnp.where(accepted, jnp.minimum(larger, 1 - done), smaller)),
        halved=jnp.where(outcome.joins, trial.halved, ~(anew | accepted | jams)),
        jammed=(trial.jammed | jams) & ~(ends | anew),
        urgency=trial.urgency,
        swaps=jnp.where(outcome.joins, trial.swaps + 1, 0).astype(jnp.int8),
        overlap=jnp.where(ends, ended.overlap, jnp.where(accepted, depth, trial.overlap)),
        stopped=jnp.where(stops, record.status, trial.stopped).astype(jnp.int8),
        given_up=jnp.where(outcome.abandons, outcome.reason, 0).astype(jnp.int8),
        failed=jnp.where(ends, fails, trial.failed),
        so_far=tree_where(ends, _still(record, ended.pose), tree_where(onward, so_far, trial.so_far)),
    )
    following = jax.tree.map(lambda new, old: jnp.where(ongoing, new, old), following, trial)
    return following, (ended, ends, trial.step)


def stopping(status: Array) -> Bool[Array, "..."]:
    """Whether the hand stops for good."""
    return (status == Status.JAMMED) | (status == Status.GRASPED)


def _still(record: ScalarStep, pose: Vec3) -> ScalarStep:
    """Record of a slider that stays at `pose` while nothing pushes."""
    rest = jax.tree.map(jnp.zeros_like, record)
    return rest._replace(pose=pose, status=jnp.full_like(record.status, Status.FREE))


def _nothing(form, outline, grips, solver, pose, urgency) -> ScalarStep:
    """Record of a step in which nothing pushes, in the shapes and dtypes that `step_in_scalars` gives."""
    shapes = jax.eval_shape(lambda: step_in_scalars(form, outline, grips, solver, pose, pose.x, pose.x, urgency)[0])
    blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    return _still(blank, pose)
