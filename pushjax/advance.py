"""One step of all fingers, or a part of one, in scalars.

Within it (body frame, after turning the hand's displacement by the slider's angle):

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

Where the hand may touch in more places than are solved together (`working_set`), those are the most urgent.

All of that is true of contacts that were seen before the step, and of angles that are small against the outline's
corners. Whether the answer is one is judged afterwards, by the depth of every finger in the slider (`deepest`), from
the whole outline. `substeps` divides a step that is too long.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._vec import Scalar, Vec2, Vec3, each_of, select, settle, turn
from pushjax.contacts import DEEPEST_OVERLAP, FAR, Placement, Touch, choose, count, meet, overlap, places, still, taken
from pushjax.hands import Finger, Hand, Pad
from pushjax.limit_surface import Form
from pushjax.shapes import Outline
from pushjax.solve import Contact, ContactSolver, SeveralMotion, StickingSolver
from pushjax.solve.contacts import motion_under
from pushjax.status import ContactMode, Status
from pushjax.working_set import Urgency, WorkingSet, together, violated

# rad: a step, or a part of one, that turns the slider farther is not an answer: what touches it, and where, was seen at
# its start, and what it passes on the way is not looked at.
FARTHEST_TURN = 0.5
# A finger holds a jammed slider if it is nearer than this, in units of the length, or than the hand goes in four steps:
# a jam is found before the last gap is closed, and the slider swings faster than the fingers close.
HOLDING = 1e-4
# After a step a finger may be this deep in the slider, as a share of how far the fingers go in it, if it was not deeper
# before: the midpoint rule leaves that much at a corner. The floor is in units of the length, for rounding.
TOLERATED, FLOOR = 0.1, 1e-5


class Record(NamedTuple):
    """A step's outcome in scalars: what the scan stacks. overlap: the deepest at its end, m; zero until judged."""

    pose: Vec3
    twist: Vec3
    wrench: Vec3
    force: tuple[Vec2, ...]
    mode: tuple[Int[Array, ""], ...]
    status: Int[Array, ""]
    overlap: Scalar


class Placed(NamedTuple):
    """A pose, and the unit vector of its angle: sines cost as much as a contact."""

    pose: Vec3
    angle: Vec2

    @staticmethod
    def at(pose: Vec3) -> "Placed":
        return Placed(pose, settle(turn(pose.z), pose.x))

    def local(self, world: Vec2) -> Vec2:
        """A world point in the body frame."""
        return (world - self.pose.xy).unrotate(self.angle)

    def moved(self, contact: Vec2, motion: Vec3, seen: Vec2) -> "Placed":
        """After the body twist `motion`; the slider's point `contact` goes straight, the twist turned by `seen`."""
        straight = (motion.xy + contact.perp().scale(motion.z)).rotate(seen)
        theta = self.pose.z + motion.z
        angle = settle(turn(theta), self.pose.x)
        swing = contact.rotate(angle) - contact.rotate(self.angle)
        return Placed(Vec3(self.pose.x + straight.x - swing.x, self.pose.y + straight.y - swing.y, theta), angle)


class Grip(NamedTuple):
    """A hand's finger over one step: from where to where (world), and its friction. angle, turning: None if it never
    turns."""

    finger: Finger
    friction: Scalar
    center: Vec2
    path: Vec2
    angle: Scalar | None
    turning: Scalar | None

    def seen(self, slider: Placed, share: Scalar) -> Placement:
        """Where the finger is, in the slider's frame, after a share of its step."""
        center = slider.local(self.center + self.path.scale(share))
        if not isinstance(self.finger, Pad):  # a disc looks the same at any angle
            return Placement(center, None)
        if self.angle is None or self.turning is None:
            raise ValueError("hand: pads need kinematics that give poses (x, y, theta), not centres")
        return Placement(center, settle(turn(self.angle + share * self.turning), center.x).unrotate(slider.angle))

    def part(self, begin: Scalar, size: Scalar) -> "Grip":
        """That part of the step."""
        angle, turning = self.angle, self.turning
        if angle is not None and turning is not None:
            angle, turning = angle + begin * turning, size * turning
        center = self.center + self.path.scale(begin)
        return Grip(self.finger, self.friction, center, self.path.scale(size), angle, turning)

    def motion(self, slider: Placed, point: Vec2, center: Vec2, rest: Scalar, first: Bool[Array, ""]) -> Vec2:
        """How far the finger's material at the slider's `point` goes in the last `rest` of its step, slider's frame.

        first: seen from the beginning of that rest, not from halfway. Then a turning hand sets out along the tangent
        of its arc; its chord would close two fingers on what they hold, and jam.
        """
        straight = self.path.scale(rest).unrotate(slider.angle)
        if self.turning is None:
            return straight
        straight = straight.unrotate(turn(jnp.where(first, rest * self.turning / 2, 0.0)))
        # the chord of a turn about the centre; at half of it, exact
        return straight + (point - center).perp().scale(2 * jnp.sin(rest * self.turning / 2))


def advance(
    form: Form,
    outline: Outline,
    grips: tuple[Grip, ...],
    solver: ContactSolver | StickingSolver | None,
    pose: Vec3,
    before: Scalar,
    reach: Scalar,
    urgency: Urgency | None = None,
    ongoing: Bool[Array, ""] | bool = True,
) -> tuple[Record, Urgency | None]:
    """One step of all fingers, or a part of one, and how urgent each contact is after it. before: the deepest overlap
    at its beginning. reach: m, how near a finger holds what is jammed. urgency: see `working_set`. ongoing: False where
    nothing is asked for: no contact problem is solved then."""
    start = Placed.at(pose)
    begin = jnp.ones_like(pose.x)

    def first_contact(grip: Grip) -> Scalar:
        at, path = settle((grip.seen(start, jnp.zeros_like(pose.x)), grip.path.unrotate(start.angle)), pose.x)
        return meet(grip.finger, outline, at, path, form.length)

    for met in each_of(first_contact, grips):
        begin = jnp.minimum(begin, met)
    begin = settle(begin, pose.x)
    rest = 1 - begin
    counts = [count(grip.finger, outline) for grip in grips]
    zero = jnp.zeros_like(pose.x)
    working = WorkingSet.most_urgent(urgency, together(counts))
    on = (jnp.asarray(ongoing),) * together(counts)

    def stage(carry, share):
        """Solve the contacts as they are when `share` of the last stage's motion is done."""
        twist, point, angle, status, begun, chosen, _ = carry
        there = start.moved(point, twist.scale(share), angle)
        first = share == 0

        def contacts_of(gripped: tuple[Grip, tuple[Int[Array, ""], ...], tuple[Touch, ...]]):
            grip, chosen, begun = gripped
            at = settle(grip.seen(there, begin + rest * share), pose.x)
            path = grip.path.unrotate(there.angle)
            touches = settle(places(grip.finger, outline, at, path, form.length), pose.x)
            nearest = choose(touches, form.length, outline, path.scale(rest))
            same = still(touches, chosen, begun, grip.finger, outline)
            mine = tuple(jnp.where(first, new, old) for new, old in zip(nearest, same, strict=True))
            each, fresh, near = [], [], jnp.zeros((), bool)
            for touch, before in zip(taken(touches, mine), begun, strict=True):
                before = select(first, touch, before)
                # a corner that has passed the end of an edge by now still counts as it began
                touch = select(settle(touch.distance > FAR / 2, pose.x), before, touch)
                # the gap is that at the beginning, for both stages: what the rule leaves then does not add up
                gap = before.distance
                motion = grip.motion(there, touch.point, at.center, rest, first)
                each.append(settle(Contact(touch.point, touch.normal, motion, grip.friction, gap), pose.x))
                near |= gap <= reach
                fresh.append(before)
            return tuple(each), mine, tuple(fresh), near

        found = each_of(contacts_of, tuple(zip(grips, chosen, begun, strict=True)))
        made, picked, fresh, near = zip(*found, strict=True)
        each, holds = sum(made, ()), jnp.ones((), bool)
        for one in near:
            holds &= one
        motion = motion_under(form, working.of(each), on, solver, margin=False)
        motion = working.spread(motion, len(each))
        missed = None if urgency is None else violated(each, motion.twist, motion.force)
        # A failed prediction must show, whatever the correction made of it
        status = jnp.where(status == Status.MOVING, motion.status, jnp.maximum(status, motion.status))
        where = _center(each, motion.force)
        return (motion.twist, where, there.angle, status, fresh, picked, holds), (motion, missed)

    unmoved = (Vec3(zero, zero, zero), Vec2(zero, zero), start.angle, jnp.zeros((), jnp.int8))
    none = tuple((jnp.zeros((), jnp.int32),) * n for n in counts)
    nowhere = Touch(zero, Vec2(zero, zero), Vec2(zero, zero))
    carry = (*unmoved, tuple((nowhere,) * n for n in counts), none, jnp.zeros((), bool))
    carry, answers = jax.lax.scan(stage, carry, jnp.array([0.0, 0.5], zero.dtype))
    twist, point, angle, status, _, _, holds = carry
    motion, missed = jax.tree.map(lambda leaf: leaf[-1], answers)
    moved = start.moved(point, twist, angle).pose
    status = jnp.where((status == Status.JAMMED) & holds, Status.GRASPED, status)
    too_far = (status == Status.MOVING) & (jnp.abs(twist.z) > FARTHEST_TURN)
    status = jnp.where(too_far, Status.NOT_CONVERGED, status)
    overlapping = (before > DEEPEST_OVERLAP * form.length) & (status != Status.INVALID)
    status = jnp.where(overlapping, Status.OVERLAPPING, status).astype(jnp.int8)
    return _guarded(motion, moved, pose, status), missed


def _center(contacts: tuple[Contact, ...], forces: tuple[Vec2, ...]) -> Vec2:
    """The middle of the contact points, weighted by normal force: the point of the slider that goes straight."""
    if len(contacts) == 1:
        return contacts[0].point
    total, middle = jnp.zeros_like(forces[0].x), Vec2(*(0 * x for x in contacts[0].point))
    for contact, force in zip(contacts, forces, strict=True):
        total, middle = total + force.x, middle + contact.point.scale(force.x)
    return middle.scale(1 / jnp.where(total > 0, total, 1.0))


def grips_of(hand: Hand, friction: Array, before: tuple, after: tuple) -> tuple[Grip, ...]:
    """The fingers over a step, from the numbers of their poses at its ends."""
    grips = []
    for k, finger in enumerate(hand.fingers):
        a, b = before[k], after[k]
        angle, turning = (a[2], _shortest(b[2] - a[2])) if len(a) == 3 else (None, None)
        center = Vec2(a[0], a[1])
        grips.append(Grip(finger, friction[k], center, Vec2(b[0], b[1]) - center, angle, turning))
    return tuple(grips)


def _shortest(angle: Scalar) -> Scalar:
    """The same turn, by half a revolution at most: recorded angles may jump from pi to -pi."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def _guarded(motion: SeveralMotion, moved: Vec3, pose: Vec3, status: Int[Array, ""]) -> Record:
    """The record of a step; without motion the slider stays, untouched by arithmetic that might have failed."""
    finite_pose = jnp.isfinite(moved.x + moved.y + moved.z)
    moves = settle((status == Status.MOVING) & finite_pose, pose.x)
    status = jnp.where((status == Status.MOVING) & ~finite_pose, Status.INVALID, status).astype(jnp.int8)

    def kept(moving):
        return jax.tree.map(lambda entry: jnp.where(moves, entry, 0.0), moving)

    return Record(
        select(moves, moved, pose),
        kept(motion.twist),
        kept(motion.wrench),
        kept(motion.force),
        tuple(jnp.where(moves, mode, ContactMode.SEPARATED).astype(jnp.int8) for mode in motion.mode),
        status,
        jnp.zeros_like(pose.x),
    )


def columns(poses: Array) -> tuple[tuple[Array, ...], ...]:
    """The numbers of each finger's pose, from (fingers, width), or with an axis of steps in front."""
    return tuple(tuple(poses[..., k, i] for i in range(poses.shape[-1])) for k in range(poses.shape[-2]))


def deepest(outline: Outline, grips: tuple[Grip, ...], pose: Vec3, share: float) -> Scalar:
    """By how much the deepest finger overlaps the slider after a share of the step, m; negative where all are apart.
    A constant to every derivative."""
    outline, grips, pose = jax.lax.stop_gradient((outline, grips, pose))
    there = Placed.at(pose)

    def of(grip: Grip) -> Scalar:
        return overlap(grip.finger, outline, settle(grip.seen(there, jnp.full_like(pose.x, share)), pose.x))

    return functools.reduce(jnp.maximum, each_of(of, grips))


def farthest(grips: tuple[Grip, ...]) -> Scalar:
    """How far the finger that goes farthest goes, m, straight."""
    paths = jax.lax.stop_gradient([grip.path for grip in grips])
    return jnp.sqrt(functools.reduce(jnp.maximum, [path.dot(path) for path in paths]))


def holding(grips: tuple[Grip, ...], length: Scalar) -> Scalar:
    """How near a finger holds what is jammed, m."""
    return jnp.maximum(HOLDING * length, 4 * farthest(grips))


def tolerated(grips: tuple[Grip, ...], length: Scalar) -> Scalar:
    """How deep a finger may be in the slider after a step, m, if it was not deeper before."""
    return jnp.maximum(FLOOR * length, TOLERATED * farthest(grips))
