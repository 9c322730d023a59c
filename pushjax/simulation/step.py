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

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from pushjax._internal.xla import compute_once, decide, map_items, tree_where
from pushjax._math.vec import Scalar, Vec2, Vec3
from pushjax.contact.contact_plane import Contact
from pushjax.contact.problem import solve_in_scalars
from pushjax.contact.scaled_problem import ContactSolver, ScalarSolution
from pushjax.contact.status import ContactMode, Status
from pushjax.contact.sticking import StickingSolver
from pushjax.friction.limit_surface import Form
from pushjax.geometry.shape import Outline
from pushjax.simulation.contact_selection import select_contacts, selected_candidates, track_contacts
from pushjax.simulation.detection import (
    MAX_PENETRATION,
    OUT_OF_REACH,
    Candidate,
    contact_candidates,
    num_contacts,
    time_of_impact,
)
from pushjax.simulation.finger_motion import BodyFrame, FingerMotion
from pushjax.simulation.working_set import Urgency, WorkingSet, together, violated

# rad. If a step, or a part of one, turns the slider farther than this, its result is rejected: contacts are detected at
# the start of the step, and nothing checks what the slider passes on the way.
MAX_ROTATION_PER_STEP = 0.5


class ScalarStep(NamedTuple):
    """Result of a step in scalars, which the scan stacks; fields as in `Step`.

    Attributes:
        pose: Pose of the slider after the step, world.
        twist: Twist of the slider over the step, body frame.
        wrench: Wrench on the slider, normalized, body frame.
        force: Force of each contact along normal and tangent, N.
        contact_point: Point of each contact, body frame, m; an array, because nothing computes with it.
        contact_normal: Inward unit normal of each contact, body frame; an array, too.
        mode: `ContactMode` of each contact.
        status: `Status` of the step.
        overlap: Depth of the deepest finger at the end of the step, m; zero until it has been judged.
    """

    pose: Vec3
    twist: Vec3
    wrench: Vec3
    force: tuple[Vec2, ...]
    contact_point: Float[Array, "contacts 2"]
    contact_normal: Float[Array, "contacts 2"]
    mode: tuple[Int[Array, ""], ...]
    status: Int[Array, ""]
    overlap: Scalar


class Stage(NamedTuple):
    """What the predictor passes to the corrector, and what the corrector leaves.

    Attributes:
        twist: Twist of the slider over the step.
        point: Point of the slider that moves in a straight line, body frame, m.
        angle: Unit vector of the angle of the frame in which the twist is given.
        status: `Status` so far.
        begun: For each finger, its contacts as they were at the start of the step.
        chosen: For each finger, the index of each of its contacts among the places where it may touch.
        holds: Whether every finger is near enough to hold a jammed slider.
    """

    twist: Vec3
    point: Vec2
    angle: Vec2
    status: Int[Array, ""]
    begun: tuple[tuple[Candidate, ...], ...]
    chosen: tuple[tuple[Int[Array, ""] | int, ...], ...]
    holds: Bool[Array, ""]

    @staticmethod
    def before(start: BodyFrame, counts: list[int]) -> "Stage":
        """What the predictor starts from: no motion yet, and no contacts selected.

        Args:
            start: Pose of the slider at the start.
            counts: Number of contacts of each finger.
        """
        zero = jnp.zeros_like(start.pose.x)
        still, nowhere = Vec3(zero, zero, zero), Candidate(zero, Vec2(zero, zero), Vec2(zero, zero))
        none = tuple((jnp.zeros((), jnp.int32),) * n for n in counts)
        begun = tuple((nowhere,) * n for n in counts)
        return Stage(still, Vec2(zero, zero), start.angle, jnp.zeros((), jnp.int8), begun, none, jnp.zeros((), bool))


class FingerContacts(NamedTuple):
    """The contacts of one finger in a stage.

    Attributes:
        contacts: The contacts as they are now, with the gaps of the start of the step.
        chosen: Index of each among the places where the finger may touch.
        begun: Each as it was at the start of the step.
        near: Whether one of them is near enough to hold a jammed slider.
    """

    contacts: tuple[Contact, ...]
    chosen: tuple[Int[Array, ""], ...]
    begun: tuple[Candidate, ...]
    near: Bool[Array, ""]


class PushingPart(NamedTuple):
    """The part of a step in which the fingers push, after the free motion.

    Attributes:
        outline: The slider's outline.
        length: Characteristic length of the limit surface, m.
        start: Pose of the slider at the start.
        begin: Fraction of the step after which a finger first touches.
        rest: Fraction of the step that is left then.
        reach: Distance within which a finger holds a jammed slider, m.
    """

    outline: Outline
    length: Scalar
    start: BodyFrame
    begin: Scalar
    rest: Scalar
    reach: Scalar

    def contacts_of(
        self,
        there: BodyFrame,
        share: Scalar,
        first: Bool[Array, ""],
        grip: FingerMotion,
        chosen: tuple[Int[Array, ""] | int, ...],
        begun: tuple[Candidate, ...],
    ) -> FingerContacts:
        """Contacts of one finger in a stage.

        Args:
            there: Pose of the slider in this stage.
            share: Fraction of the pushing part that is done in this stage.
            first: True in the predictor.
            grip: Motion of the finger over the step.
            chosen: Index of each contact among the places where the finger may touch; not used in the predictor.
            begun: The contacts as they were at the start of the step; not used in the predictor.
        """
        x = self.start.pose.x
        at = compute_once(grip.seen(there, self.begin + self.rest * share), x)
        path = grip.path.unrotate(there.angle)
        touches = compute_once(contact_candidates(grip.finger, self.outline, at, path, self.length), x)
        nearest = select_contacts(touches, self.length, self.outline, path.scale(self.rest))
        same = track_contacts(touches, chosen, begun, grip.finger, self.outline)
        mine = tuple(jnp.where(first, new, old) for new, old in zip(nearest, same, strict=True))
        each, fresh, near = [], [], jnp.zeros((), bool)
        for touch, before in zip(selected_candidates(touches, mine), begun, strict=True):
            before = tree_where(first, touch, before)
            # a corner that has passed the end of an edge by now keeps its contact from the start of the step
            touch = tree_where(decide(touch.distance > OUT_OF_REACH / 2, x), before, touch)
            # both stages use the gap from the start of the step, so that position errors of the rule do not accumulate
            gap = before.distance
            motion = grip.motion(there, touch.point, at.center, self.rest, first)
            each.append(compute_once(Contact(touch.point, touch.normal, motion, grip.friction, gap), x))
            near |= gap <= self.reach
            fresh.append(before)
        return FingerContacts(tuple(each), mine, tuple(fresh), near)


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
    begin = _first_contact(grips, outline, start, form.length)
    part = PushingPart(outline, form.length, start, begin, 1 - begin, reach)
    counts = [num_contacts(grip.finger, outline) for grip in grips]
    working = WorkingSet.most_urgent(urgency, together(counts))
    on = (jnp.asarray(ongoing),) * together(counts)

    def stage(carry: Stage, share: Scalar):
        """Solve the contacts as they are after the fraction `share` of the previous stage's motion."""
        there = start.moved(carry.point, carry.twist.scale(share), carry.angle)
        first = share == 0
        found = map_items(
            lambda gripped: part.contacts_of(there, share, first, *gripped),
            tuple(zip(grips, carry.chosen, carry.begun, strict=True)),
        )
        contacts, chosen, begun, near = zip(*found, strict=True)
        each, holds = sum(contacts, ()), jnp.ones((), bool)
        for one in near:
            holds &= one
        motion = solve_in_scalars(form, working.of(each), on, solver, margin=False)
        motion = working.spread(motion, len(each))
        missed = None if urgency is None else violated(each, motion.twist, motion.force)
        # a failed predictor must show in the status, whatever the corrector makes of it
        status = jnp.where(carry.status == Status.MOVING, motion.status, jnp.maximum(carry.status, motion.status))
        where = _force_weighted_point(each, motion.force)
        following = Stage(motion.twist, where, there.angle, status, begun, chosen, holds)
        return following, (motion, _points_and_normals(each), missed)

    carry, answers = jax.lax.scan(stage, Stage.before(start, counts), jnp.array([0.0, 0.5], pose.x.dtype))
    motion, places, missed = jax.tree.map(lambda leaf: leaf[-1], answers)
    moved = start.moved(carry.point, carry.twist, carry.angle).pose
    return _keep_pose_unless_moving(motion, places, moved, pose, _status(carry, before, form.length)), missed


def _status(after: Stage, before: Scalar, length: Scalar) -> Int[Array, ""]:
    """Status of a step.

    Args:
        after: What the corrector left.
        before: Depth of the deepest finger at the start of the step, m.
        length: Characteristic length of the limit surface, m.
    """
    status = jnp.where((after.status == Status.JAMMED) & after.holds, Status.GRASPED, after.status)
    too_far = (status == Status.MOVING) & (jnp.abs(after.twist.z) > MAX_ROTATION_PER_STEP)
    status = jnp.where(too_far, Status.NOT_CONVERGED, status)
    overlapping = (before > MAX_PENETRATION * length) & (status != Status.INVALID)
    return jnp.where(overlapping, Status.OVERLAPPING, status).astype(jnp.int8)


def _first_contact(grips: tuple[FingerMotion, ...], outline: Outline, start: BodyFrame, length: Scalar) -> Scalar:
    """Fraction of the step after which a finger first touches a slider at rest, or one if none does."""
    begin = jnp.ones_like(start.pose.x)

    def of(grip: FingerMotion) -> Scalar:
        at, path = compute_once(
            (grip.seen(start, jnp.zeros_like(start.pose.x)), grip.path.unrotate(start.angle)), start.pose.x
        )
        return time_of_impact(grip.finger, outline, at, path, length)

    for met in map_items(of, grips):
        begin = jnp.minimum(begin, met)
    return compute_once(begin, start.pose.x)


def _points_and_normals(contacts: tuple[Contact, ...]) -> tuple[Array, Array]:
    """Points and inward normals of contacts, both (contacts, 2), body frame. Not differentiated."""
    point = jnp.stack([contact.point.array() for contact in contacts])
    normal = jnp.stack([contact.normal.array() for contact in contacts])
    return jax.lax.stop_gradient((point, normal))


def _force_weighted_point(contacts: tuple[Contact, ...], forces: tuple[Vec2, ...]) -> Vec2:
    """Mean of the contact points, weighted by normal force: the point of the slider that moves in a straight line."""
    if len(contacts) == 1:
        return contacts[0].point
    total, middle = jnp.zeros_like(forces[0].x), Vec2(*(0 * x for x in contacts[0].point))
    for contact, force in zip(contacts, forces, strict=True):
        total, middle = total + force.x, middle + contact.point.scale(force.x)
    return middle.scale(1 / jnp.where(total > 0, total, 1.0))


def _keep_pose_unless_moving(
    motion: ScalarSolution, places: tuple[Array, Array], moved: Vec3, pose: Vec3, status: Int[Array, ""]
) -> ScalarStep:
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
        kept(places[0]),
        kept(places[1]),
        tuple(jnp.where(moves, mode, ContactMode.SEPARATED).astype(jnp.int8) for mode in motion.mode),
        status,
        jnp.zeros_like(pose.x),
    )
