"""A path of steps, of which those that are too long are divided.

A step is too long where its answer leaves a finger in the slider: the slider turned so far that another of its corners
came to touch, or slid past the end of what a finger rests on, which no contact seen at the beginning can tell. Such a
step is taken back and tried again by half, down to a part of `SMALLEST`; parts that succeed are followed by ones of
twice the size. Where the smallest part fails, the step is NOT_CONVERGED, and the slider stays where it began.

Every push of a batch goes at its own pace: each round of one loop is the next trial of every push, of whichever step it
has come to. So a push that divides its steps holds up the others only at the end, and no trial is made for who has
ended. Trials that are taken back leave nothing in a derivative, which is that of the parts that were accepted.
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
from pushjax.limit_surface import Form
from pushjax.shapes import Outline
from pushjax.solve import ContactSolver, StickingSolver
from pushjax.status import Status

SMALLEST = 1 / 256  # of a step
# Trials of a path, per step and in all, after which what is left of it is NOT_CONVERGED: a grasp of a slider of many
# corners takes one and a tenth a step.
TRIALS_A_STEP, TRIALS = 2, 48


class Trial(NamedTuple):
    """A push under way, and what is tried next.

    pose: now. origin: at the beginning of the step. step: its index, past the last one once the push has ended. done:
    the share of it that is done, and part: the one that is tried next. overlap: the deepest now, and before: at the
    beginning of the step. stopped: the status that stopped the hand, or zero. given_up: the status of a step that is
    given up, or zero. failed: whether the step before was. so_far: of the parts that are done.
    """

    pose: Vec3
    origin: Vec3
    step: Int[Array, ""]
    done: Scalar
    part: Scalar
    overlap: Scalar
    before: Scalar
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
    nothing = _nothing(form, outline, grips, solver, pose)
    zero, one, none = jnp.zeros_like(pose.x), jnp.ones_like(pose.x), jnp.zeros((), jnp.int8)
    begin = Trial(pose, pose, first, zero, one, overlap, overlap, none, none, jnp.zeros((), bool), nothing)

    def next_trial(trial: Trial) -> tuple[Trial, tuple[Record, Bool[Array, ""], Int[Array, ""]]]:
        form, mu = grounded(trial.step, trial.origin)
        grips = grips_at(trial.step, mu)
        reach, tolerance = holding(grips, form.length), tolerated(grips, form.length)
        part = tuple(grip.part(trial.done, trial.part) for grip in grips)
        record = advance(form, outline, part, solver, trial.pose, trial.overlap, reach)
        return _judged(trial, record, outline, part, tolerance, steps)

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


def _judged(trial: Trial, record: Record, outline: Outline, part: tuple[Grip, ...], tolerance: Scalar, steps: int):
    """The trial after, the record of the step, whether it has ended with this one, and its index."""
    gives_up = settle(trial.given_up != 0, trial.pose.x)
    pose = select(gives_up, trial.origin, record.pose)
    depth = deepest(outline, part, pose, 1.0)
    # in a step that is divided, a jam is found to its smallest part: what squirts turns far in one step
    final = (trial.part == 1) | (trial.part < 2 * SMALLEST)
    stops = final & stopping(record.status)
    goes = (record.status == Status.MOVING) | (record.status == Status.FREE)
    clear = depth <= jnp.maximum(trial.before, trial.part * tolerance)
    accepted, stops = settle((goes & clear & ~gives_up, stops & ~gives_up), pose.x)
    ongoing = trial.step < steps

    moves = settle(record.status == Status.MOVING, pose.x)
    so_far = select(moves, record, trial.so_far)
    so_far = so_far._replace(twist=trial.so_far.twist + record.twist, pose=pose, overlap=depth)
    so_far = so_far._replace(status=jnp.where(moves, record.status, trial.so_far.status))

    done = trial.done + trial.part
    smaller = trial.part / 2
    # a slider that was left behind in the step before is not tried by parts again
    hopeless = (smaller < SMALLEST) | trial.failed | (record.status >= Status.OVERLAPPING)
    reason = jnp.where(goes, Status.NOT_CONVERGED, record.status)
    given_up = jnp.where(hopeless & ~accepted & ~stops & ~gives_up, reason, 0)
    # where nothing has moved, and the hand was at the step's end, no more need be looked at
    at_once = (given_up != 0) & ~goes & (trial.part == 1)
    gives_up = settle(gives_up | at_once, pose.x)
    given_up = jnp.where(at_once, 0, given_up).astype(jnp.int8)
    reason = jnp.where(at_once, reason, trial.given_up).astype(jnp.int8)
    ends = ongoing & (gives_up | stops | (accepted & (done >= 1)))
    nothing = _still(record, trial.origin)
    status = jnp.where(gives_up, reason, record.status).astype(jnp.int8)
    ended = nothing._replace(status=status, overlap=depth)
    ended = select(settle(accepted, pose.x), so_far, ended)
    # the hand stops where this part began
    held = trial.so_far._replace(pose=trial.pose, status=status, overlap=trial.overlap)
    ended = select(stops, held, ended)

    stopped = jnp.where(stops, record.status, trial.stopped).astype(jnp.int8)
    onward = settle(accepted & ~ends, pose.x)
    anew = (ends & ~stops) | (given_up != 0)
    following = Trial(
        pose=select(ends, ended.pose, select(onward, pose, trial.pose)),
        origin=select(ends, ended.pose, trial.origin),
        step=jnp.where(ends, jnp.where(stops, steps, trial.step + 1), trial.step),
        done=jnp.where(anew, 0.0, jnp.where(accepted, done, trial.done)),
        part=jnp.where(anew, 1.0, jnp.where(accepted, jnp.minimum(2 * trial.part, 1 - done), smaller)),
        overlap=jnp.where(ends, ended.overlap, jnp.where(accepted, depth, trial.overlap)),
        before=jnp.where(ends, ended.overlap, trial.before),
        stopped=stopped,
        given_up=given_up,
        failed=jnp.where(ends, gives_up, trial.failed),
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


def _nothing(form, outline, grips, solver, pose) -> Record:
    shapes = jax.eval_shape(lambda: advance(form, outline, grips, solver, pose, pose.x, pose.x))
    blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    return _still(blank, pose)
