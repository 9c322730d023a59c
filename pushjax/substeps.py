"""A path of steps, of which those that are too long are divided.

A step is too long where its answer leaves a finger in the slider: the slider turned so far that another of its corners
came to touch, or slid past the end of what a finger rests on, which no contact seen at the beginning can tell. Such a
step is taken back and tried again by half, down to a part of `SMALLEST`. A part that succeeds is followed by one of
twice the size, or, right after a failure, first by one of its own size. Before a part is halved, a place that the
answer violates and that was not solved for joins the contact problem (`working_set`), and it is solved again. Where the
smallest part fails, the step is NOT_CONVERGED, and the slider stays where it began.

Every push of a batch goes at its own pace: each round of one loop is the next trial of every push, of whichever step it
has come to. So a push that divides its steps holds up the others only at the end, and no trial is made for who has
ended. Trials that are taken back leave nothing in a derivative, which is that of the parts that were accepted.

A jam is proved to first order: within a long step the slider may turn out of it. So a whole step that jams is divided
too, its first part being of `CONFIRMED`. If a part of that size jams, the hand stops where that part began; if all of
its parts move, so does the step.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._autodiff import keep_found
from pushjax._vec import Scalar, Vec3, select, settle
from pushjax.advance import Grip, Record, advance, deepest, holding, tolerated
from pushjax.contacts import count
from pushjax.limit_surface import Form
from pushjax.shapes import Outline
from pushjax.solve import ContactSolver, StickingSolver
from pushjax.status import Status
from pushjax.working_set import LOADED, Urgency, likeliest

SMALLEST = 1 / 256  # of a step
CONFIRMED = 1 / 16  # of a step that jams as a whole: the part that has to jam, too
# Trials of a path, per step and in all, after which what is left of it is NOT_CONVERGED: a grasp of a slider of many
# corners takes one and a tenth a step.
TRIALS_A_STEP, TRIALS = 4, 64
SWAPS = 3  # of the working set, before a part is divided
# A place that is not solved for may be violated by so much, as a share of what is tolerated of the whole.
MISSED = 0.01


class Trial(NamedTuple):
    """A push under way, and what is tried next.

    pose: now. origin: at the beginning of the step. step: its index, past the last one once the push has ended. done:
    the share of it that is done, and part: the one that is tried next. halved: whether it is as large as it is because
    twice that failed. jammed: whether the step as a whole jams. urgency: of each contact, and swaps: how often the
    working set of this part has changed. overlap: the deepest now. stopped: the status that stopped the hand, or zero.
    given_up: the status of a step that is given up, or zero. failed: whether the step before was. so_far: of the parts
    that are done.
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
    so_far: Record


def divided(
    outline: Outline,
    steps: int,
    grips_at: Callable[[Int[Array, ""], Array], tuple[Grip, ...]],
    solver: ContactSolver | StickingSolver | None,
    pose: Vec3,
    grounded: Callable[[Int[Array, ""], Vec3], tuple[Form, Array]],
) -> tuple[Record, Scalar]:
    """The record of every step, stacked, and the share of its last step that the hand did, if it was stopped. grips_at:
    the fingers over a step, by its index and their friction."""
    first = jnp.zeros((), jnp.int32)
    form, mu = grounded(first, pose)
    grips = grips_at(first, mu)
    most = TRIALS_A_STEP * steps + TRIALS
    overlap = deepest(outline, grips, pose, 0.0)
    zero, one = jnp.zeros_like(pose.x), jnp.ones_like(pose.x)
    none, no = jnp.zeros((), jnp.int8), jnp.zeros((), bool)
    urgency = likeliest([count(grip.finger, outline) for grip in grips], pose.x)
    nothing = _nothing(form, outline, grips, solver, pose, urgency)
    begin = Trial(pose, pose, first, zero, one, no, no, urgency, none, overlap, none, none, no, nothing)

    def next_trial(trial: Trial) -> tuple[Trial, tuple[Record, Bool[Array, ""], Int[Array, ""]]]:
        form, mu = grounded(trial.step, trial.origin)
        grips = grips_at(trial.step, mu)
        reach, tolerance = holding(grips, form.length), tolerated(grips, form.length)
        part = tuple(grip.part(trial.done, trial.part) for grip in grips)
        ongoing = trial.step < steps
        record, missed = advance(form, outline, part, solver, trial.pose, trial.overlap, reach, trial.urgency, ongoing)
        following, found = _judged(trial, record, missed, outline, part, tolerance, steps)
        if missed is not None and urgency is not None:
            following = following._replace(urgency=jnp.where(following.swaps > 0, missed, urgency))
        return following, found

    def skipped(trial: Trial):
        return trial, (nothing, jnp.zeros((), bool), trial.step)

    def round_(trial: Trial, _):
        left = eqxi.unvmap_any(trial.step < steps)
        return jax.lax.cond(left, next_trial, skipped, trial)

    # Only poses, and what searches found, are kept for reverse mode, and a step is worked out again there: writing out
    # everything a step computes, and reading it back, took twice as long as computing it again.
    round_ = jax.checkpoint(round_, prevent_cse=False, policy=keep_found)
    last, (records, ends, step) = jax.lax.scan(round_, begin, length=most)
    # which round ended each step; a step that none has is as the last one left it
    at = jnp.full(steps, most).at[jnp.where(ends, step, steps)].set(jnp.arange(most), mode="drop")
    status = jnp.where(last.stopped != 0, last.stopped, Status.NOT_CONVERGED).astype(jnp.int8)
    rest = nothing._replace(pose=last.pose, status=status, overlap=last.overlap)
    return jax.tree.map(lambda rows, row: jnp.concatenate([rows, row[None]])[at], records, rest), last.done


class Outcome(NamedTuple):
    """What a trial leads to: one of these, or else a smaller part is tried next.

    accepted: the part is done. joins: a place that the answer violates joins the contact problem, for the same part.
    stops: the hand stops where the part began. abandons: the step is given up; the next trial is of the whole step, for
    the overlap of a slider that stays. fails: the step ends so, with the status `reason`.
    """

    accepted: Bool[Array, ""]
    joins: Bool[Array, ""]
    stops: Bool[Array, ""]
    abandons: Bool[Array, ""]
    fails: Bool[Array, ""]
    reason: Int[Array, ""]


def _outcome(trial: Trial, record: Record, missed: Urgency | None, depth: Scalar, tolerance: Scalar) -> Outcome:
    """tolerance: how much deeper a finger may be after a whole step, m."""
    fails = trial.given_up != 0
    goes = (record.status == Status.MOVING) | (record.status == Status.FREE)
    # overlaps do not add up, for the next part pushes them out: so the smallest part may leave as much as a whole step
    share = jnp.where(trial.part < 2 * SMALLEST, 1.0, trial.part)
    clear = depth <= jnp.maximum(trial.overlap, share * tolerance)
    # in a step that is divided, a jam is found to its smallest part: what squirts turns far in one step
    smallest = jnp.where(trial.jammed, CONFIRMED, SMALLEST)
    # a slider that was left behind in the step before is not tried by parts again
    final = (trial.part < 2 * smallest) | trial.failed
    stops = final & stopping(record.status) & ~fails
    joins = jnp.zeros((), bool)
    if missed is not None:
        worst = jnp.max(jnp.where(missed < LOADED, missed, -jnp.inf))
        joins = goes & ~fails & (trial.swaps < SWAPS) & (worst > MISSED * trial.part * tolerance)
    accepted, stops, joins = settle((goes & clear & ~fails & ~joins, stops, joins), trial.pose.x)
    hopeless = (trial.part / 2 < SMALLEST) | trial.failed | (record.status >= Status.OVERLAPPING)
    abandons = hopeless & ~accepted & ~stops & ~fails & ~joins
    # where nothing has moved, and the hand was at the step's end, no more need be looked at
    at_once = abandons & ~goes & (trial.part == 1)
    reason = jnp.where(goes, Status.NOT_CONVERGED, record.status)
    reason = jnp.where(fails, trial.given_up, reason).astype(jnp.int8)
    return Outcome(accepted, joins, stops, abandons & ~at_once, settle(fails | at_once, trial.pose.x), reason)


def _judged(
    trial: Trial,
    record: Record,
    missed: Urgency | None,
    outline: Outline,
    part: tuple[Grip, ...],
    tolerance: Scalar,
    steps: int,
):
    """The trial after, the record of the step, whether it has ended with this one, and its index."""
    ongoing = trial.step < steps
    pose = select(settle(trial.given_up != 0, trial.pose.x), trial.origin, record.pose)
    depth = deepest(outline, part, pose, 1.0)
    outcome = _outcome(trial, record, missed, depth, tolerance)
    accepted, stops, fails = outcome.accepted, outcome.stops, outcome.fails

    moves = settle(record.status == Status.MOVING, pose.x)
    so_far = select(moves, record, trial.so_far)
    so_far = so_far._replace(twist=trial.so_far.twist + record.twist, pose=pose, overlap=depth)
    so_far = so_far._replace(status=jnp.where(moves, record.status, trial.so_far.status))
    done = trial.done + trial.part
    ends = ongoing & (fails | stops | (accepted & (done >= 1)))
    failed = _still(record, trial.origin)._replace(status=outcome.reason, overlap=depth)
    held = trial.so_far._replace(pose=trial.pose, status=record.status, overlap=trial.overlap)
    ended = select(stops, held, select(accepted, so_far, failed))

    # from where, and how large a part
    onward = settle(accepted & ~ends, pose.x)
    anew = (ends & ~stops) | outcome.abandons
    jams = (trial.part == 1) & stopping(record.status)
    smaller = jnp.where(outcome.joins, trial.part, jnp.where(jams, CONFIRMED, trial.part / 2))
    larger = jnp.where(trial.halved, trial.part, 2 * trial.part)
    following = Trial(
        pose=select(ends, ended.pose, select(onward, pose, trial.pose)),
        origin=select(ends, ended.pose, trial.origin),
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
        so_far=select(ends, _still(record, ended.pose), select(onward, so_far, trial.so_far)),
    )
    following = jax.tree.map(lambda new, old: jnp.where(ongoing, new, old), following, trial)
    return following, (ended, ends, trial.step)


def stopping(status: Array) -> Bool[Array, "..."]:
    """Whether the hand stops for good."""
    return (status == Status.JAMMED) | (status == Status.GRASPED)


def _still(record: Record, pose: Vec3) -> Record:
    """Of a slider that stays, and nothing pushes."""
    rest = jax.tree.map(jnp.zeros_like, record)
    return rest._replace(pose=pose, status=jnp.full_like(record.status, Status.FREE))


def _nothing(form, outline, grips, solver, pose, urgency) -> Record:
    shapes = jax.eval_shape(lambda: advance(form, outline, grips, solver, pose, pose.x, pose.x, urgency)[0])
    blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    return _still(blank, pose)
