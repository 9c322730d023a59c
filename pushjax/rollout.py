"""Pushes and grasps: one step, and a path of them.

Time does not matter to quasi-static motion, so a step is a displacement of the hand. Within it (body frame, after
turning the hand's displacement by the slider's angle):

1. the hand travels freely until a finger meets the slider (exactly, see `contacts`); the rest of the step pushes;
2. predict: solve the contacts as they are then, and move the slider half of that;
3. correct: solve the contacts as seen from halfway, with the halfway angle, and move the slider by that.

This is the midpoint rule: second order within a mode and, with one finger, across changes of mode too, because the
motion is continuous. The gaps at the beginning are part of the contact problem in both: a second finger that arrives
within the step has no separate event (first order there), an overlap is pushed out within one step, and what the rule
leaves does not add up (the paper's open problem 2: Zhou et al. 2017, section VII).

The slider is moved so that its contact point (of several, their middle weighted by force) goes exactly where the
contact problem says, in the world, and the rest turns about it. Where a finger sticks, slip is then zero to rounding,
not to the order of the scheme; and so is that of a hand that pushes flat and straight.

Where no motion satisfies every contact the hand has jammed: it stops at the beginning of that step, for good.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pushjax._autodiff import keep_found
from pushjax._checks import Numeric, as_float, common_dtype, concrete, finite, non_negative, shaped, traced
from pushjax._vec import Scalar, Vec2, Vec3, select, settle, turn
from pushjax.contacts import DEEPEST_OVERLAP, FAR, Placement, Touch, choose, count, meet, overlap, places, taken
from pushjax.hands import Finger, Hand, Pad, checked_path
from pushjax.limit_surface import Form, LimitSurface
from pushjax.shapes import Outline, Shape
from pushjax.solve import Contact, ContactSolver, SeveralMotion, StickingSolver
from pushjax.solve.contacts import ground, motion_under
from pushjax.status import ContactMode, Status

# A finger holds a jammed slider if it is nearer than this, in units of the length, or than the hand goes in four steps:
# a jam is found before the last gap is closed, and the slider swings faster than the fingers close.
HOLDING = 1e-4


class Slider(eqx.Module):
    """What is pushed: its outline and how it slides, both in its body frame."""

    shape: Shape
    surface: LimitSurface


class Step(eqx.Module):
    """One step of a push.

    pose: (3,), world, after the step. twist: (3,), the slider's over the step, and wrench: (3,), force: (contacts, 2)
    along normal and tangent (N, on H = 1), mode: (contacts,) are those of the contact halfway, in the body frame
    halfway; zero and SEPARATED where nothing pushes. The pose after is that before moved by the twist to the second
    order (the contact point goes straight), not its exponential. status: `Status`.
    """

    pose: Float[Array, "3"]
    twist: Float[Array, "3"]
    wrench: Float[Array, "3"]
    force: Float[Array, "contacts 2"]
    mode: Int[Array, "contacts"]
    status: Int[Array, ""]


class Trajectory(eqx.Module):
    """A push, step by step; fields as in `Step`, with a leading axis of steps (pose: steps + 1, the start included).

    configuration: where the hand really was: the path, up to a jam. There the hand stops, and status says JAMMED, or
    GRASPED if every finger holds the slider, at this step and every one after it; nothing moves any more.
    """

    pose: Float[Array, "steps+1 3"]
    configuration: Float[Array, "steps+1 dof"]
    twist: Float[Array, "steps 3"]
    wrench: Float[Array, "steps 3"]
    force: Float[Array, "steps contacts 2"]
    mode: Int[Array, "steps contacts"]
    status: Int[Array, "steps"]

    @property
    def failed(self) -> Bool[Array, "steps"]:
        """Steps whose status is a failure (`Status.failed`); there the slider was left where it was."""
        return jnp.isin(self.status, jnp.array([s for s in Status if s.failed], self.status.dtype))

    @property
    def stopped(self) -> Int[Array, ""]:
        """Index of the step at which the hand jammed or grasped, or -1."""
        return _first(_stops(self.status))

    @property
    def first_failure(self) -> Int[Array, ""]:
        """Index of the first failed step, or -1."""
        return _first(self.failed)


def _first(steps: Bool[Array, "... steps"]) -> Int[Array, "..."]:
    """Index of the first step that is True, or -1."""
    return jnp.where(jnp.any(steps, axis=-1), jnp.argmax(steps, axis=-1), -1)


class _Record(NamedTuple):
    """A step's outcome in scalars: what the scan stacks."""

    pose: Vec3
    twist: Vec3
    wrench: Vec3
    force: tuple[Vec2, ...]
    mode: tuple[Int[Array, ""], ...]
    status: Int[Array, ""]


def _world(record: _Record, length: Scalar) -> Step:
    """Arrays of a record; also of a stacked one, whose scalars have an axis of steps."""
    wrench = (record.wrench.x, record.wrench.y, record.wrench.z * length)
    return Step(
        pose=jnp.stack(record.pose, axis=-1),
        twist=jnp.stack(record.twist, axis=-1),
        wrench=jnp.stack(wrench, axis=-1),
        force=jnp.stack([jnp.stack(force, axis=-1) for force in record.force], axis=-2),
        mode=jnp.stack(record.mode, axis=-1),
        status=record.status,
    )


class _Placed(NamedTuple):
    """A pose, and the unit vector of its angle: sines cost as much as a contact."""

    pose: Vec3
    angle: Vec2

    @staticmethod
    def at(pose: Vec3) -> "_Placed":
        return _Placed(pose, settle(turn(pose.z), pose.x))

    def local(self, world: Vec2) -> Vec2:
        """A world point in the body frame."""
        return (world - self.pose.xy).unrotate(self.angle)

    def moved(self, contact: Vec2, motion: Vec3, seen: Vec2) -> "_Placed":
        """After the body twist `motion`; the slider's point `contact` goes straight, the twist turned by `seen`."""
        straight = (motion.xy + contact.perp().scale(motion.z)).rotate(seen)
        theta = self.pose.z + motion.z
        angle = settle(turn(theta), self.pose.x)
        swing = contact.rotate(angle) - contact.rotate(self.angle)
        return _Placed(Vec3(self.pose.x + straight.x - swing.x, self.pose.y + straight.y - swing.y, theta), angle)


class _Grip(NamedTuple):
    """A hand's finger over one step: from where to where (world), and its friction. angle, turning: None if it never
    turns."""

    finger: Finger
    friction: Scalar
    center: Vec2
    path: Vec2
    angle: Scalar | None
    turning: Scalar | None

    def seen(self, slider: _Placed, share: Scalar) -> Placement:
        """Where the finger is, in the slider's frame, after a share of its step."""
        center = slider.local(self.center + self.path.scale(share))
        if not isinstance(self.finger, Pad):  # a disc looks the same at any angle
            return Placement(center, None)
        if self.angle is None or self.turning is None:
            raise ValueError("hand: pads need kinematics that give poses (x, y, theta), not centres")
        return Placement(center, settle(turn(self.angle + share * self.turning), center.x).unrotate(slider.angle))

    def motion(self, slider: _Placed, point: Vec2, center: Vec2, rest: Scalar) -> Vec2:
        """How far the finger's material at the slider's `point` goes in the last `rest` of its step, slider's frame."""
        straight = self.path.scale(rest).unrotate(slider.angle)
        if self.turning is None:
            return straight
        # the chord of a turn about the centre; at half of it, exact
        return straight + (point - center).perp().scale(2 * jnp.sin(rest * self.turning / 2))


def _advance(
    form: Form, outline: Outline, grips: tuple[_Grip, ...], solver: ContactSolver | StickingSolver | None, pose: Vec3
) -> _Record:
    """One step of all fingers."""
    start = _Placed.at(pose)
    begin, overlapping = jnp.ones_like(pose.x), jnp.zeros((), bool)
    for grip in grips:
        at, path = settle((grip.seen(start, jnp.zeros_like(pose.x)), grip.path.unrotate(start.angle)), pose.x)
        met = meet(grip.finger, outline, at, path, form.length)
        begin, overlapping = jnp.minimum(begin, met.start), overlapping | met.overlapping
    begin = settle(begin, pose.x)
    rest = 1 - begin
    counts = [count(grip.finger, outline) for grip in grips]
    contacts = sum(counts)
    zero = jnp.zeros_like(pose.x)
    on = (jnp.ones((), bool),) * contacts
    reach = HOLDING * form.length
    for grip in grips:
        reach = jnp.maximum(reach, jax.lax.stop_gradient(4 * (jnp.abs(grip.path.x) + jnp.abs(grip.path.y))))

    def stage(carry, share):
        """Solve the contacts as they are when `share` of the last stage's motion is done."""
        twist, point, angle, status, begun, chosen, _ = carry
        there = start.moved(point, twist.scale(share), angle)
        first = share == 0
        each, fresh, picked, holds = [], [], [], jnp.ones((), bool)
        for k, grip in enumerate(grips):
            at = grip.seen(there, begin + rest * share)
            touches = settle(places(grip.finger, outline, at, form.length), pose.x)
            mine = tuple(
                jnp.where(first, new, old) for new, old in zip(choose(touches, form.length), chosen[k], strict=True)
            )
            picked.append(mine)
            near = jnp.zeros((), bool)
            for touch in taken(touches, mine):
                before = select(first, touch, begun[len(each)])
                # a corner that has passed the end of an edge by now still counts as it began
                touch = select(settle(touch.distance > FAR / 2, pose.x), before, touch)
                # the gap is that at the beginning, for both stages: what the rule leaves then does not add up
                gap = before.distance
                motion = grip.motion(there, touch.point, at.center, rest)
                contact = Contact(touch.point, touch.normal, motion, grip.friction, gap)
                near |= gap <= reach
                each.append(contact)
                fresh.append(before)
            holds &= near
        motion = motion_under(form, tuple(each), on, solver)
        # A failed prediction must show, whatever the correction made of it
        status = jnp.where(status == Status.MOVING, motion.status, jnp.maximum(status, motion.status))
        where = _center(tuple(each), motion.force)
        return (motion.twist, where, there.angle, status, tuple(fresh), tuple(picked), holds), motion

    still = (Vec3(zero, zero, zero), Vec2(zero, zero), start.angle, jnp.zeros((), jnp.int8))
    none = tuple((jnp.zeros((), jnp.int32),) * n for n in counts)
    nowhere = Touch(zero, Vec2(zero, zero), Vec2(zero, zero))
    carry = (*still, (nowhere,) * contacts, none, jnp.zeros((), bool))
    carry, motions = jax.lax.scan(stage, carry, jnp.array([0.0, 0.5], zero.dtype))
    twist, point, angle, status, _, _, holds = carry
    motion: SeveralMotion = jax.tree.map(lambda leaf: leaf[-1], motions)
    moved = start.moved(point, twist, angle).pose
    status = jnp.where((status == Status.JAMMED) & holds, Status.GRASPED, status)
    status = jnp.where(overlapping & (status != Status.INVALID), Status.OVERLAPPING, status).astype(jnp.int8)
    return _guarded(motion, moved, pose, status)


def _center(contacts: tuple[Contact, ...], forces: tuple[Vec2, ...]) -> Vec2:
    """The middle of the contact points, weighted by normal force: the point of the slider that goes straight."""
    if len(contacts) == 1:
        return contacts[0].point
    total, middle = jnp.zeros_like(forces[0].x), Vec2(*(0 * x for x in contacts[0].point))
    for contact, force in zip(contacts, forces, strict=True):
        weight = jax.lax.stop_gradient(force.x)
        total, middle = total + weight, middle + contact.point.scale(weight)
    return middle.scale(1 / jnp.where(total > 0, total, 1.0))


def _grips(hand: Hand, friction: Array, before: tuple, after: tuple) -> tuple[_Grip, ...]:
    """The fingers over a step, from the numbers of their poses at its ends."""
    grips = []
    for k, finger in enumerate(hand.fingers):
        a, b = before[k], after[k]
        angle, turning = (a[2], b[2] - a[2]) if len(a) == 3 else (None, None)
        center = Vec2(a[0], a[1])
        grips.append(_Grip(finger, friction[k], center, Vec2(b[0], b[1]) - center, angle, turning))
    return tuple(grips)


def _guarded(motion: SeveralMotion, moved: Vec3, pose: Vec3, status: Int[Array, ""]) -> _Record:
    """The record of a step; without motion the slider stays, untouched by arithmetic that might have failed."""
    finite_pose = jnp.isfinite(moved.x + moved.y + moved.z)
    moves = settle((status == Status.MOVING) & finite_pose, pose.x)
    status = jnp.where((status == Status.MOVING) & ~finite_pose, Status.INVALID, status).astype(jnp.int8)

    def kept(moving):
        return jax.tree.map(lambda entry: jnp.where(moves, entry, 0.0), moving)

    return _Record(
        select(moves, moved, pose),
        kept(motion.twist),
        kept(motion.wrench),
        kept(motion.force),
        tuple(jnp.where(moves, mode, ContactMode.SEPARATED).astype(jnp.int8) for mode in motion.mode),
        status,
    )


def _arguments(slider: Slider, hand: Hand, pose: Numeric, friction: Numeric, *paths: Numeric):
    """Everything in one floating dtype, and checked as far as values are known."""
    dtype = common_dtype(slider, hand, pose, friction, *paths)
    start, mu = as_float(pose, dtype), as_float(friction, dtype)
    shaped("pose", start, (3,))
    finite("pose", start)
    fingers = len(hand.fingers)
    if mu.shape not in ((), (fingers,)):
        raise ValueError(f"friction has shape {mu.shape}; expected a scalar or ({fingers},), one per finger")
    finite("friction", mu)
    non_negative("friction", mu)
    cast = jax.tree.map(lambda leaf: leaf.astype(dtype), (slider, hand))
    return *cast, start, jnp.broadcast_to(mu, (fingers,)), dtype


def _check_start(slider: Slider, hand: Hand, pose: Array, configuration: Array) -> None:
    if traced((slider, hand, pose, configuration)):
        return
    overlap = float(_overlap(slider, hand, pose, configuration))
    allowed = DEEPEST_OVERLAP * float(slider.surface.length)
    if overlap > allowed:
        raise ValueError(
            f"path starts with the hand inside the slider: a finger overlaps it by {1e3 * overlap:.3g} mm; at most "
            f"{1e3 * allowed:.3g} mm ({DEEPEST_OVERLAP:g} of the surface's length) is pushed out"
        )


@eqx.filter_jit
def _overlap(slider: Slider, hand: Hand, pose: Array, configuration: Array) -> Scalar:
    """By how much the deepest finger overlaps the slider, m."""
    where = _columns(hand.poses(configuration))
    grips = _grips(hand, jnp.zeros(len(hand.fingers), pose.dtype), where, where)
    start, outline = _Placed.at(Vec3.of(pose)), slider.shape.outline()
    deepest = jnp.full_like(pose[0], -jnp.inf)
    for grip in grips:
        deepest = jnp.maximum(deepest, overlap(grip.finger, outline, grip.seen(start, jnp.zeros_like(pose[0]))))
    return deepest


def _check_opening(hand: Hand, path: Array) -> None:
    least, known = hand.least, concrete(path)
    if least is None or known is None or traced(least):
        return
    narrow = np.flatnonzero(np.atleast_2d(known)[:, -1] < float(least))
    if narrow.size:
        raise ValueError(
            f"path closes the hand on itself: d is {np.atleast_2d(known)[narrow[0], -1]:.6g} m at index {narrow[0]}; "
            f"with these fingers it must be at least {float(least):.6g} m"
        )


def _columns(poses: Array) -> tuple[tuple[Array, ...], ...]:
    """The numbers of each finger's pose, from (fingers, width), or with an axis of steps in front."""
    return tuple(tuple(poses[..., k, i] for i in range(poses.shape[-1])) for k in range(poses.shape[-2]))


def step(
    slider: Slider,
    hand: Hand,
    q0: Numeric,
    q1: Numeric,
    *,
    pose: Numeric,
    friction: Numeric,
    solver: ContactSolver | StickingSolver | None = None,
) -> Step:
    """Move the hand from configuration `q0` (dof,) to `q1` (dof,), world, m: the one step that `rollout` scans.

    pose: (3,), the slider's, world. friction: mu between fingers and slider, a scalar or (fingers,).

    Raises ValueError for arguments of the wrong shape, not finite, or a negative friction, where they are not traced;
    where they are, and for a finger that is inside the slider, the step's status says so.
    """
    slider, hand, start, mu, dtype = _arguments(slider, hand, pose, friction, q0, q1)
    ends = as_float(q0, dtype), as_float(q1, dtype)
    for name, q in zip(("q0", "q1"), ends, strict=True):
        shaped(name, q, (hand.dof,))
        finite(name, q)
        _check_opening(hand, q)
    return _step(slider, hand, *ends, start, mu, solver)


@eqx.filter_jit
def _step(slider, hand, q0, q1, pose, friction, solver) -> Step:
    outline = slider.shape.outline()
    form, mu = ground(slider.surface, friction)
    grips = _grips(hand, mu, _columns(hand.poses(q0)), _columns(hand.poses(q1)))
    return _world(_advance(form, outline, grips, solver, Vec3.of(pose)), form.length)


def rollout(
    slider: Slider,
    hand: Hand,
    path: Numeric,
    *,
    pose: Numeric,
    friction: Numeric,
    solver: ContactSolver | StickingSolver | None = None,
) -> Trajectory:
    """Push the slider along a path of hand configurations.

    path: (steps + 1, dof), world, m (`line`, `resample` or any recording); the step's size sets the accuracy. pose:
    (3,), the slider's at the start, world, m and rad. friction: mu between fingers and slider, a scalar or (fingers,).
    There is no other state: a push goes on with `rollout(..., rest_of_path, pose=push.pose[-1])`.

    Differentiable, forward and reverse, in slider, hand, path, pose and friction. Batches come from `vmap`.

    Raises ValueError for arguments of the wrong shape, not finite, a negative friction, or a finger that starts inside
    the slider by more than a fifth of the surface's length (less is pushed out in the first step), where they are not
    traced; where they are, `status` says so at every step, and `first_failure` where.

    Source: Zhou et al. 2017, section IV.A, and open problem 2 of section VII; this module's header has the scheme.
    """
    slider, hand, start, mu, dtype = _arguments(slider, hand, pose, friction, path)
    p = checked_path(path, hand.dof, dtype)
    _check_opening(hand, p)
    _check_start(slider, hand, start, p[0])
    return _rollout(slider, hand, p, start, mu, solver)


@eqx.filter_jit
def _rollout(slider, hand, path, pose, friction, solver) -> Trajectory:
    outline = slider.shape.outline()
    form, mu = ground(slider.surface, friction)
    columns = _columns(hand.poses(path))
    one = sum(count(finger, outline) for finger in hand.fingers) == 1  # which cannot jam

    def body(carry, ends):
        pose, stopped = carry
        record = _advance(form, outline, _grips(hand, mu, *ends), solver, pose)
        if not one:
            record, stopped = _frozen(record, pose, stopped)
        return (record.pose, stopped), record

    ends = tuple(
        jax.tree.map(lambda column, cut=cut: column[cut], columns) for cut in (slice(None, -1), slice(1, None))
    )
    # Only poses, and what searches found, are kept for reverse mode, and a step is worked out again there: writing out
    # everything a step computes, and reading it back, took twice as long as computing it again.
    body = jax.checkpoint(body, prevent_cse=False, policy=keep_found)
    _, records = jax.lax.scan(body, (Vec3.of(pose), jnp.zeros((), jnp.int8)), ends)
    steps = _world(records, form.length)
    poses = jnp.concatenate([pose[None], steps.pose])
    stopped = _first(_stops(steps.status))
    reached = jnp.where(stopped >= 0, stopped, len(path) - 1)
    configuration = path[jnp.minimum(jnp.arange(len(path)), reached)]
    return Trajectory(poses, configuration, steps.twist, steps.wrench, steps.force, steps.mode, steps.status)


def _frozen(record: _Record, pose: Vec3, stopped: Int[Array, ""]) -> tuple[_Record, Int[Array, ""]]:
    """Once jammed, nothing moves any more: the hand is held where it is, and says why at every step."""
    held = settle(stopped != 0, pose.x)

    def still(value):
        return jax.tree.map(lambda entry: jnp.where(held, jnp.zeros((), entry.dtype), entry), value)

    status = jnp.where(held, stopped, record.status)
    stopped = jnp.where(_stops(status), status, 0).astype(jnp.int8)
    rest = still((record.twist, record.wrench, record.force, record.mode))
    twist, wrench, force, mode = rest
    return _Record(select(held, pose, record.pose), twist, wrench, force, mode, status), stopped


def _stops(status: Array) -> Array:
    return (status == Status.JAMMED) | (status == Status.GRASPED)
