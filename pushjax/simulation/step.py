"""One step of all fingers, or a part of one, in scalars.

A step has three phases (body frame, after the hand's displacement is rotated by the slider's angle):

1. free motion: the hand travels until a finger meets the slider (exactly, see `detection`), and the rest of the step
   pushes;
2. predictor: solve the contacts as they are then, and move the slider by half of that motion;
3. corrector: solve the contacts as they are halfway, with the angle halfway, and move the slider by that motion.

This is the midpoint rule. It is of second order within a mode. With one finger it is of second order across changes of
mode, too, because the motion is continuous. In the contact problem, predictor and corrector both use the gaps from the
start of the step. So a second finger that arrives within the step has no separate event and is treated to first order
only; an overlap is removed within one step; and position errors of the rule do not accumulate (the paper's open problem
2: Zhou et al. 2017, section VII).

The contact point of the slider moves in the world exactly as the contact problem says, and the rest of the slider turns
about it. With several contacts this point is the mean of the contact points, weighted by normal force. So where a
finger sticks, its slip is zero to roundoff, not only to the order of the scheme. The same holds for a hand that pushes
flat and straight.

If the hand may touch in more places than are solved together (`working_set`), the most urgent places are solved.

All this holds for contacts that were detected before the step, and for rotations that are small compared with the
angles of the outline's corners. Whether the result is valid is judged afterwards, by the depth of every finger in the
slider (`max_penetration`), which is computed from the whole outline. `substeps` divides a step that is too long.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._internal.xla import compute_once, decide, map_items, tree_where
from pushjax._math.vec import Scalar, Vec2, Vec3, cos_sin
from pushjax.contact.contact_plane import Contact
from pushjax.contact.problem import solve_in_scalars
from pushjax.contact.scaled_problem import ContactSolver, ScalarSolution
from pushjax.contact.status import ContactMode, Status
from pushjax.contact.sticking import StickingSolver
from pushjax.friction.limit_surface import Form
from pushjax.geometry.shape import Outline
from pushjax.simulation.detection import (
    MAX_PENETRATION,
    OUT_OF_REACH,
    Candidate,
    FingerPose,
    contact_candidates,
    num_contacts,
    penetration_depth,
    select_contacts,
    selected_candidates,
    time_of_impact,
    track_contacts,
)
from pushjax.simulation.hand import Finger, Hand, Pad
from pushjax.simulation.working_set import Urgency, WorkingSet, together, violated

# rad. If a step, or a part of one, turns the slider farther than this, its result is rejected: contacts are detected at
# the start of the step, and nothing checks what the slider passes on the way.
MAX_ROTATION_PER_STEP = 0.5
# A jam is a grasp if every finger is nearer to the slider than this, in units of the length, or than four times the
# hand's displacement in the step. The margin is needed because a jam is detected before the last gap is closed, and
# because the slider swings faster than the fingers close.
GRASP_GAP = 1e-4
# After a step a finger may be this deep in the slider, as a fraction of the largest displacement of the fingers in the
# step, if it was not deeper before: the midpoint rule leaves that much at a corner. The floor is in units of the length
# and allows for roundoff.
TOLERATED, FLOOR = 0.1, 1e-5


class ScalarStep(NamedTuple):
    """Result of a step in scalars, which the scan stacks; fields as in `Step`.

    Attributes:
        pose: Pose of the slider after the step, world.
        twist: Twist of the slider over the step, body frame.
        wrench: Wrench on the slider, normalized, body frame.
        force: Force of each contact along normal and tangent, N.
        mode: `ContactMode` of each contact.
        status: `Status` of the step.
        overlap: Depth of the deepest finger at the end of the step, m; zero until it has been judged.
    """

    pose: Vec3
    twist: Vec3
    wrench: Vec3
    force: tuple[Vec2, ...]
    mode: tuple[Int[Array, ""], ...]
    status: Int[Array, ""]
    overlap: Scalar


class BodyFrame(NamedTuple):
    """A pose with the unit vector of its angle, which is kept because sines cost as much as a contact.

    Attributes:
        pose: Pose of the slider, world.
        angle: The unit vector (cos, sin) of the pose's angle.
    """

    pose: Vec3
    angle: Vec2

    @staticmethod
    def at(pose: Vec3) -> "BodyFrame":
        """A pose, with the unit vector computed."""
        return BodyFrame(pose, compute_once(cos_sin(pose.z), pose.x))

    def local(self, world: Vec2) -> Vec2:
        """A world point in the body frame."""
        return (world - self.pose.xy).unrotate(self.angle)

    def moved(self, contact: Vec2, motion: Vec3, seen: Vec2) -> "BodyFrame":
        """The pose after a body twist that moves a point of the slider in a straight line.

        Args:
            contact: The point, body frame, m.
            motion: The twist.
            seen: Unit vector of the angle of the frame in which the twist is given; it rotates the twist to the world.
        """
        straight = (motion.xy + contact.perp().scale(motion.z)).rotate(seen)
        theta = self.pose.z + motion.z
        angle = compute_once(cos_sin(theta), self.pose.x)
        swing = contact.rotate(angle) - contact.rotate(self.angle)
        return BodyFrame(Vec3(self.pose.x + straight.x - swing.x, self.pose.y + straight.y - swing.y, theta), angle)


class FingerMotion(NamedTuple):
    """Motion of one finger over a step, and its friction.

    Attributes:
        finger: The finger.
        friction: Coefficient of friction mu between finger and slider.
        center: Center of the finger at the start, world, m.
        path: Displacement of the center, world, m.
        angle: Angle at the start, world, rad; None if the finger never turns.
        turning: Change of the angle, rad; None if the finger never turns.
    """

    finger: Finger
    friction: Scalar
    center: Vec2
    path: Vec2
    angle: Scalar | None
    turning: Scalar | None

    def seen(self, slider: BodyFrame, share: Scalar) -> FingerPose:
        """Pose of the finger in the slider's frame after the fraction `share` of the step."""
        center = slider.local(self.center + self.path.scale(share))
        if not isinstance(self.finger, Pad):  # a disk looks the same at any angle
            return FingerPose(center, None)
        if self.angle is None or self.turning is None:
            raise ValueError("hand: pads need kinematics that give poses (x, y, theta), not centers")
        return FingerPose(
            center, compute_once(cos_sin(self.angle + share * self.turning), center.x).unrotate(slider.angle)
        )

    def part(self, begin: Scalar, size: Scalar) -> "FingerMotion":
        """The part of the step that starts at the fraction `begin` and has the size `size`."""
        angle, turning = self.angle, self.turning
        if angle is not None and turning is not None:
            angle, turning = angle + begin * turning, size * turning
        center = self.center + self.path.scale(begin)
        return FingerMotion(self.finger, self.friction, center, self.path.scale(size), angle, turning)

    def motion(self, slider: BodyFrame, point: Vec2, center: Vec2, rest: Scalar, first: Bool[Array, ""]) -> Vec2:
        """Displacement of the finger's material at a point of the slider, slider's frame, m.

        Args:
            slider: Pose of the slider.
            point: The point of the slider, slider's frame, m.
            center: Center of the finger, slider's frame, m.
            rest: Fraction of the step that is left; the displacement is the one in that last fraction.
            first: True in the predictor stage, which is evaluated at the start of that fraction and not halfway. A
                turning hand then starts along the tangent of its arc. The chord of the arc would move two fingers
                toward each other on what they hold, and cause a jam.
        """
        straight = self.path.scale(rest).unrotate(slider.angle)
        if self.turning is None:
            return straight
        straight = straight.unrotate(cos_sin(jnp.where(first, rest * self.turning / 2, 0.0)))
        # the chord of a rotation about the center; seen from halfway through the turn it is exact
        return straight + (point - center).perp().scale(2 * jnp.sin(rest * self.turning / 2))


def step_in_scalars(
    form: Form,
    outline: Outline,
    grips: tuple[FingerMotion, ...],
    solver: ContactSolver | StickingSolver | None,
    pose: Vec3,
    before: Scalar,
    reach: Scalar,
    urgency: Urgency | None = None,
    ongoing: Bool[Array, ""] | bool = True,
) -> tuple[ScalarStep, Urgency | None]:
    """Compute one step of all fingers, or a part of one; see the header of this module for the scheme.

    Args:
        form: Limit surface in scalars.
        outline: The slider's outline.
        grips: Motion of each finger over the step.
        solver: Solver of contact problems; None for the default.
        pose: Pose of the slider at the start, world.
        before: Depth of the deepest finger at the start, m.
        reach: Distance within which a finger holds a jammed slider, m.
        urgency: Urgency of each contact (see `working_set`); None if all are solved together.
        ongoing: False where no result is needed; no contact problem is solved then.

    Returns:
        The record of the step, and the urgency of each contact after it (None if `urgency` is None).
    """
    start = BodyFrame.at(pose)
    begin = jnp.ones_like(pose.x)

    def first_contact(grip: FingerMotion) -> Scalar:
        at, path = compute_once((grip.seen(start, jnp.zeros_like(pose.x)), grip.path.unrotate(start.angle)), pose.x)
        return time_of_impact(grip.finger, outline, at, path, form.length)

    for met in map_items(first_contact, grips):
        begin = jnp.minimum(begin, met)
    begin = compute_once(begin, pose.x)
    rest = 1 - begin
    counts = [num_contacts(grip.finger, outline) for grip in grips]
    zero = jnp.zeros_like(pose.x)
    working = WorkingSet.most_urgent(urgency, together(counts))
    on = (jnp.asarray(ongoing),) * together(counts)

    def stage(carry, share):
        """Solve the contacts as they are after the fraction `share` of the previous stage's motion."""
        twist, point, angle, status, begun, chosen, _ = carry
        there = start.moved(point, twist.scale(share), angle)
        first = share == 0

        def contacts_of(gripped: tuple[FingerMotion, tuple[Int[Array, ""], ...], tuple[Candidate, ...]]):
            grip, chosen, begun = gripped
            at = compute_once(grip.seen(there, begin + rest * share), pose.x)
            path = grip.path.unrotate(there.angle)
            touches = compute_once(contact_candidates(grip.finger, outline, at, path, form.length), pose.x)
            nearest = select_contacts(touches, form.length, outline, path.scale(rest))
            same = track_contacts(touches, chosen, begun, grip.finger, outline)
            mine = tuple(jnp.where(first, new, old) for new, old in zip(nearest, same, strict=True))
            each, fresh, near = [], [], jnp.zeros((), bool)
            for touch, before in zip(selected_candidates(touches, mine), begun, strict=True):
                before = tree_where(first, touch, before)
                # a corner that has passed the end of an edge by now keeps its contact from the start of the step
                touch = tree_where(decide(touch.distance > OUT_OF_REACH / 2, pose.x), before, touch)
                # both stages use the gap from the start of the step, so that position errors of the rule do not
                # accumulate
                gap = before.distance
                motion = grip.motion(there, touch.point, at.center, rest, first)
                each.append(compute_once(Contact(touch.point, touch.normal, motion, grip.friction, gap), pose.x))
                near |= gap <= reach
                fresh.append(before)
            return tuple(each), mine, tuple(fresh), near

        found = map_items(contacts_of, tuple(zip(grips, chosen, begun, strict=True)))
        made, picked, fresh, near = zip(*found, strict=True)
        each, holds = sum(made, ()), jnp.ones((), bool)
        for one in near:
            holds &= one
        motion = solve_in_scalars(form, working.of(each), on, solver, margin=False)
        motion = working.spread(motion, len(each))
        missed = None if urgency is None else violated(each, motion.twist, motion.force)
        # a failed predictor must show in the status, whatever the corrector makes of it
        status = jnp.where(status == Status.MOVING, motion.status, jnp.maximum(status, motion.status))
        where = _force_weighted_point(each, motion.force)
        return (motion.twist, where, there.angle, status, fresh, picked, holds), (motion, missed)

    unmoved = (Vec3(zero, zero, zero), Vec2(zero, zero), start.angle, jnp.zeros((), jnp.int8))
    none = tuple((jnp.zeros((), jnp.int32),) * n for n in counts)
    nowhere = Candidate(zero, Vec2(zero, zero), Vec2(zero, zero))
    carry = (*unmoved, tuple((nowhere,) * n for n in counts), none, jnp.zeros((), bool))
    carry, answers = jax.lax.scan(stage, carry, jnp.array([0.0, 0.5], zero.dtype))
    twist, point, angle, status, _, _, holds = carry
    motion, missed = jax.tree.map(lambda leaf: leaf[-1], answers)
    moved = start.moved(point, twist, angle).pose
    status = jnp.where((status == Status.JAMMED) & holds, Status.GRASPED, status)
    too_far = (status == Status.MOVING) & (jnp.abs(twist.z) > MAX_ROTATION_PER_STEP)
    status = jnp.where(too_far, Status.NOT_CONVERGED, status)
    overlapping = (before > MAX_PENETRATION * form.length) & (status != Status.INVALID)
    status = jnp.where(overlapping, Status.OVERLAPPING, status).astype(jnp.int8)
    return _keep_pose_unless_moving(motion, moved, pose, status), missed


def _force_weighted_point(contacts: tuple[Contact, ...], forces: tuple[Vec2, ...]) -> Vec2:
    """Mean of the contact points, weighted by normal force: the point of the slider that moves in a straight line."""
    if len(contacts) == 1:
        return contacts[0].point
    total, middle = jnp.zeros_like(forces[0].x), Vec2(*(0 * x for x in contacts[0].point))
    for contact, force in zip(contacts, forces, strict=True):
        total, middle = total + force.x, middle + contact.point.scale(force.x)
    return middle.scale(1 / jnp.where(total > 0, total, 1.0))


def finger_motions(hand: Hand, friction: Array, before: tuple, after: tuple) -> tuple[FingerMotion, ...]:
    """Motion of each finger over a step, from its poses before and after (see `unstack_finger_poses`)."""
    grips = []
    for k, finger in enumerate(hand.fingers):
        a, b = before[k], after[k]
        angle, turning = (a[2], _wrap_to_pi(b[2] - a[2])) if len(a) == 3 else (None, None)
        center = Vec2(a[0], a[1])
        grips.append(FingerMotion(finger, friction[k], center, Vec2(b[0], b[1]) - center, angle, turning))
    return tuple(grips)


def _wrap_to_pi(angle: Scalar) -> Scalar:
    """The same turn, reduced to at most half a revolution, because recorded angles may jump from pi to -pi."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def _keep_pose_unless_moving(motion: ScalarSolution, moved: Vec3, pose: Vec3, status: Int[Array, ""]) -> ScalarStep:
    """The record of a step, where a slider that does not move keeps its pose bit for bit.

    Without motion the pose is not touched by arithmetic that might have failed.
    """
    finite_pose = jnp.isfinite(moved.x + moved.y + moved.z)
    moves = decide((status == Status.MOVING) & finite_pose, pose.x)
    status = jnp.where((status == Status.MOVING) & ~finite_pose, Status.INVALID, status).astype(jnp.int8)

    def kept(moving):
        return jax.tree.map(lambda entry: jnp.where(moves, entry, 0.0), moving)

    return ScalarStep(
        tree_where(moves, moved, pose),
        kept(motion.twist),
        kept(motion.wrench),
        kept(motion.force),
        tuple(jnp.where(moves, mode, ContactMode.SEPARATED).astype(jnp.int8) for mode in motion.mode),
        status,
        jnp.zeros_like(pose.x),
    )


def unstack_finger_poses(poses: Array) -> tuple[tuple[Array, ...], ...]:
    """Numbers of each finger's pose, as a tuple for each finger.

    Args:
        poses: Poses or centers, (fingers, width), or with an axis of steps in front.
    """
    return tuple(tuple(poses[..., k, i] for i in range(poses.shape[-1])) for k in range(poses.shape[-2]))


def max_penetration(outline: Outline, grips: tuple[FingerMotion, ...], pose: Vec3, share: float) -> Scalar:
    """Depth of the deepest finger in the slider after a fraction of the step, m; negative where all are apart.

    Not differentiated.

    Args:
        outline: The slider's outline.
        grips: Motion of each finger over the step.
        pose: Pose of the slider, world.
        share: Fraction of the step that the fingers have done.
    """
    outline, grips, pose = jax.lax.stop_gradient((outline, grips, pose))
    there = BodyFrame.at(pose)

    def of(grip: FingerMotion) -> Scalar:
        return penetration_depth(
            grip.finger, outline, compute_once(grip.seen(there, jnp.full_like(pose.x, share)), pose.x)
        )

    return functools.reduce(jnp.maximum, map_items(of, grips))


def max_displacement(grips: tuple[FingerMotion, ...]) -> Scalar:
    """Largest displacement of a finger's center in the step, m, along a straight line. Not differentiated."""
    paths = jax.lax.stop_gradient([grip.path for grip in grips])
    return jnp.sqrt(functools.reduce(jnp.maximum, [path.dot(path) for path in paths]))


def holding_distance(grips: tuple[FingerMotion, ...], length: Scalar) -> Scalar:
    """Distance within which a finger holds a jammed slider, m."""
    return jnp.maximum(GRASP_GAP * length, 4 * max_displacement(grips))


def allowed_penetration(grips: tuple[FingerMotion, ...], length: Scalar) -> Scalar:
    """Largest depth of a finger in the slider after a step, m, unless it was deeper before."""
    return jnp.maximum(FLOOR * length, TOLERATED * max_displacement(grips))
