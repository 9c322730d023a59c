"""One step of all fingers, or a part of one, in scalars.

A step has three phases. They are computed in the slider's body frame, to which the motion of the hand is rotated.

1. free motion: the hand travels until a finger meets the slider (see `impact`), and the rest of the step pushes;
2. predictor: solve the contacts as they are then, and move the slider by half of that motion;
3. corrector: solve the contacts as they are halfway, with the angle halfway, and move the slider by that motion.

This is the midpoint rule. It is of second order within a mode. With one finger it is of second order across changes of
mode, too, because the motion is continuous. In the contact problem, predictor and corrector both use the gaps from the
start of the step. So an overlap is removed within one step, and position errors of the rule do not accumulate (open
problem 2 of Zhou et al. 2017, section VII). A second finger that arrives within the step has no event of its own and is
treated to first order only.

The contact point of the slider moves in the world exactly as the contact problem says, and the rest of the slider turns
about it. With several contacts this point is the mean of the contact points, weighted by normal force. So where a
finger sticks, its slip is zero to roundoff, not only to the order of the scheme. The same holds for a hand that pushes
flat and straight.

If the hand has more contacts than are solved together (`working_set`), the most urgent ones are solved.

All this holds for contacts that were detected before the step, and for rotations that are small compared with the
angles of the outline's corners. `max_penetration` checks the result: it computes the depth of every finger in the
slider from the whole outline. `substeps` divides a step that is too long.
"""

import functools
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from pushjax._internal.xla import compute_once, decide, map_items, tree_where
from pushjax._math.vec import Scalar, Vec2, Vec3
from pushjax.contact.contact_plane import Contact
from pushjax.contact.problem import ScalarSolution, solve_in_scalars
from pushjax.contact.scaled_problem import ContactSolver, EdgeSet
from pushjax.contact.status import ContactMode, Status
from pushjax.contact.sticking import StickingSolver
from pushjax.friction.limit_surface import Form
from pushjax.geometry.shape import Outline
from pushjax.simulation.candidate import OUT_OF_REACH, Candidate
from pushjax.simulation.contact_selection import select_contacts, selected_candidates, track_contacts
from pushjax.simulation.detection import MAX_PENETRATION, contact_candidates, num_contacts
from pushjax.simulation.finger_motion import DEPTH_FLOOR, TOUCHING, BodyFrame, FingerMotion
from pushjax.simulation.fixtures import Wall
from pushjax.simulation.impact import time_of_impact
from pushjax.simulation.working_set import Urgency, WorkingSet, num_solved_together, violations

# If a step, or a part of one, turns the slider farther than this, rad, or if a finger slips on it farther than this, in
# units of the limit surface's length, the result is rejected: contacts are detected at the start of the step, and
# nothing checks what the slider passes on the way.
MAX_ROTATION_PER_STEP, MAX_SLIP_PER_STEP = 0.5, 1.0


class ScalarStep(NamedTuple):
    """Result of a step in scalars, which the scan stacks; fields as in `Step`."""

    pose: Vec3  # of the slider after the step, world
    twist: Vec3  # body frame
    wrench: Vec3  # normalized, body frame
    force: tuple[Vec2, ...]  # of each contact along normal and tangent, N
    contact_point: Float[Array, "contacts 2"]  # body frame, m; an array, because nothing computes with it
    contact_normal: Float[Array, "contacts 2"]  # inward, of unit length, body frame
    mode: tuple[Int[Array, ""], ...]  # `ContactMode` of each contact
    status: Int[Array, ""]  # `Status`
    overlap: Scalar  # depth of the deepest finger at the end, m; zero until it is computed


class Stage(NamedTuple):
    """What the predictor passes to the corrector, and what the corrector leaves."""

    twist: Vec3  # of the slider over the step
    point: Vec2  # of the slider that moves in a straight line, body frame, m
    angle: Vec2  # unit vector of the angle of the frame in which the twist is given
    status: Int[Array, ""]  # `Status` so far
    at_start: tuple[tuple[Candidate, ...], ...]  # for each finger, its contacts at the start of the step
    chosen: tuple[tuple[Int[Array, ""] | int, ...], ...]  # index of each finger's contacts among its candidates
    holds: Bool[Array, ""]  # whether all of several fingers, and no fixture, are near enough to hold a jammed slider
    urgency: Urgency | None  # None without fixtures, and if all contacts are solved together
    guess: EdgeSet | None  # cone edges that carried the force last; None with one contact

    @staticmethod
    def before(start: BodyFrame, counts: list[int], urgency: Urgency | None, guess: EdgeSet | None) -> "Stage":
        """Return what the predictor starts from: no motion yet, and no contacts selected."""
        zero = jnp.zeros_like(start.pose.x)
        still, nowhere = Vec3(zero, zero, zero), Candidate(zero, Vec2(zero, zero), Vec2(zero, zero))
        none = tuple((jnp.zeros((), jnp.int32),) * n for n in counts)
        at_start = tuple((nowhere,) * n for n in counts)
        moving, no = jnp.zeros((), jnp.int8), jnp.zeros((), bool)  # MOVING is 0
        return Stage(still, Vec2(zero, zero), start.angle, moving, at_start, none, no, urgency, guess)


class FingerContacts(NamedTuple):
    """The contacts of one finger in a stage."""

    contacts: tuple[Contact, ...]  # as they are now, with the gaps of the start of the step
    chosen: tuple[Int[Array, ""], ...]  # index of each among the candidates
    at_start: tuple[Candidate, ...]  # as they were at the start of the step
    is_near: Bool[Array, ""]  # whether one is near enough to hold a jammed slider


class PushingPart(NamedTuple):
    """The part of a step in which the fingers push, after the free motion."""

    outline: Outline
    length: Scalar  # of the limit surface, m
    start: BodyFrame  # pose of the slider at the start
    begin: Scalar  # fraction of the step after which a finger first touches
    rest: Scalar  # fraction of the step that is left then
    reach: Scalar  # distance within which a finger holds a jammed slider, m

    def contacts_of(
        self,
        frame: BodyFrame,  # pose of the slider in this stage
        fraction: Scalar,  # of the pushing part that is done in this stage
        in_predictor: Bool[Array, ""],
        is_fixture: bool,
        finger_motion: FingerMotion,
        chosen: tuple[Int[Array, ""] | int, ...],  # among the candidates; not used in the predictor
        at_start: tuple[Candidate, ...],  # not used in the predictor
    ) -> FingerContacts:
        """Return the contacts of one finger, or of one fixture, in a stage."""
        x = self.start.pose.x
        finger_pose = compute_once(finger_motion.pose_in_slider(frame, self.begin + self.rest * fraction), x)

        def displacement_at(point: Vec2) -> Vec2:
            return finger_motion.material_displacement(frame, point, finger_pose.center, self.rest, in_predictor)

        candidates = compute_once(
            contact_candidates(finger_motion.finger, self.outline, finger_pose, displacement_at, self.length), x
        )
        selected = select_contacts(candidates, finger_motion.finger, self.length, self.outline, displacement_at)
        tracked = track_contacts(candidates, chosen, at_start, finger_motion.finger, self.outline)
        indices = tuple(jnp.where(in_predictor, new, old) for new, old in zip(selected, tracked, strict=True))
        contacts, originals, is_near = [], [], jnp.zeros((), bool)
        for candidate, original in zip(selected_candidates(candidates, indices), at_start, strict=True):
            original = tree_where(in_predictor, candidate, original)
            # a corner that has passed the end of an edge by now keeps its contact from the start of the step
            candidate = tree_where(decide(candidate.distance > OUT_OF_REACH / 2, x), original, candidate)
            # both stages use the gap from the start of the step, so that position errors of the rule do not accumulate
            gap = _gap(original.distance, (DEPTH_FLOOR if is_fixture else TOUCHING[x.dtype.itemsize]) * self.length)
            displacement = displacement_at(candidate.point)
            contacts.append(
                compute_once(Contact(candidate.point, candidate.normal, displacement, finger_motion.friction, gap), x)
            )
            is_near |= gap <= self.reach
            originals.append(original)
        return FingerContacts(tuple(contacts), indices, tuple(originals), is_near)

    def contacts_of_all(
        self,
        frame: BodyFrame,
        fraction: Scalar,
        carry: Stage,
        motions: tuple[FingerMotion, ...],
        fixtures: tuple[FingerMotion, ...],
    ) -> tuple[FingerContacts, ...]:
        """Return the contacts of each finger and fixture in a stage."""
        known = tuple(zip(carry.chosen, carry.at_start, strict=True))
        found = ()
        for bodies, is_fixture in ((motions, False), (fixtures, True)):
            items = tuple((body, *known[len(found) + k]) for k, body in enumerate(bodies))
            contacts_of = partial(self.contacts_of, frame, fraction, fraction == 0, is_fixture)
            if items:
                found += map_items(lambda item, contacts_of=contacts_of: contacts_of(*item), items)
        return found


def step_in_scalars(
    form: Form,
    outline: Outline,
    motions: tuple[FingerMotion, ...],
    solver: ContactSolver | StickingSolver | None,
    pose: Vec3,  # of the slider at the start, world
    overlap_before: Scalar,  # depth of the deepest finger at the start, m
    reach: Scalar,  # distance within which a finger holds a jammed slider, m
    urgency: Urgency | None = None,  # of each contact (`working_set`); None if all are solved together
    ongoing: Bool[Array, ""] | bool = True,  # where False, no contact problem is solved, and the result has no meaning
    fixtures: tuple[FingerMotion, ...] = (),  # as fingers that stay where they are
    is_first_try: Bool[Array, ""] | bool = True,  # True where `urgency` has no meaning yet
    guess: EdgeSet | None = None,  # cone edges that carried the force last, which are tried first
) -> tuple[ScalarStep, Urgency | None, EdgeSet | None]:
    """Compute one step of all fingers, or a part of one: its record, the urgency after it, and the next guess."""
    start = BodyFrame.at(pose)
    begin = _first_contact(motions, outline, start, form.length)
    part = PushingPart(outline, form.length, start, begin, 1 - begin, reach)
    counts = [num_contacts(motion.finger, outline) for motion in motions + fixtures]
    size, active = num_solved_together(counts), jnp.asarray(ongoing)
    given_set = WorkingSet.most_urgent(urgency, size)

    def stage(carry: Stage, fraction: Scalar):
        """Solve the contacts as they are after `fraction` of the previous stage's motion: 0 predicts, 0.5 corrects."""
        frame = start.moved(carry.point, carry.twist.scale(fraction), carry.angle)
        in_predictor = fraction == 0
        by_finger, chosen, at_start, near = zip(
            *part.contacts_of_all(frame, fraction, carry, motions, fixtures), strict=True
        )
        contacts, holds = sum(by_finger, ()), jnp.asarray(len(motions) > 1)
        for k, is_near in enumerate(near):
            holds &= is_near if k < len(motions) else ~is_near
        used_urgency = carry.urgency
        if used_urgency is not None:
            # in the first try, contacts are selected by how far the step would press them into a slider at rest
            pressed = jax.lax.stop_gradient(jnp.stack([contact.approach().x for contact in contacts]))
            used_urgency = jnp.where(in_predictor & is_first_try, pressed, used_urgency)
        working = given_set if used_urgency is None else WorkingSet.most_urgent(used_urgency, size)
        tried = None if carry.guess is None else working.local(carry.guess)
        solution = solve_in_scalars(form, working.select(contacts), (active,) * size, solver, tried)
        solution = working.spread(solution, len(contacts))
        best = (
            solution.best if solution.best is None else tree_where(solution.best.exists(), solution.best, carry.guess)
        )
        urgency_after = None if urgency is None else violations(contacts, solution.twist, solution.force)
        # a failed predictor must show in the status, whatever the corrector makes of it
        status = jnp.where(carry.status <= Status.FREE, solution.status, jnp.maximum(carry.status, solution.status))
        straight_point = _force_weighted_point(contacts, solution.force)
        next_stage = Stage(
            solution.twist, straight_point, frame.angle, status, at_start, chosen, holds, used_urgency, best
        )
        is_long = _turns_or_slips_too_far(motions + fixtures, by_finger, solution, form.length)
        return next_stage, (solution, _points_and_normals(contacts), urgency_after, is_long)

    before = Stage.before(start, counts, urgency if fixtures else None, guess)
    carry, outputs = jax.lax.scan(stage, before, jnp.array([0.0, 0.5], pose.x.dtype))
    solution, points_and_normals, urgency_after, _ = jax.tree.map(lambda leaf: leaf[-1], outputs)
    moved_pose = start.moved(carry.point, carry.twist, carry.angle).pose
    moves = jax.tree.reduce(jnp.logical_or, [motion.moves() for motion in motions])
    status = _status(carry, moves, jnp.any(outputs[-1]), overlap_before, form.length)
    return _keep_pose_unless_moving(solution, points_and_normals, moved_pose, pose, status), urgency_after, carry.guess


def _status(
    last_stage: Stage, moves: Bool[Array, ""], is_long: Bool[Array, ""], depth: Scalar, length: Scalar
) -> Int[Array, ""]:
    """Status of a step, given the depth of the deepest finger at its start, m."""
    status = jnp.where((last_stage.status == Status.JAMMED) & last_stage.holds, Status.GRASPED, last_stage.status)
    status = jnp.where((status <= Status.FREE) & is_long, Status.NOT_CONVERGED, status)
    # a hand that rests changes nothing, and proves nothing
    status = jnp.where(moves | (status == Status.INVALID), status, Status.FREE)
    overlapping = (depth > MAX_PENETRATION * length) & (status != Status.INVALID)
    return jnp.where(overlapping, Status.OVERLAPPING, status).astype(jnp.int8)


def _turns_or_slips_too_far(
    motions: tuple[FingerMotion, ...],
    by_finger: tuple[tuple[Contact, ...], ...],
    solution: ScalarSolution,
    length: Scalar,
) -> Bool[Array, ""]:
    """Return whether the slider turns, or slips at a contact with a finger or a fixture, too far for one step."""
    by_finger, twist, length = jax.lax.stop_gradient((by_finger, solution.twist, length))
    squares = []
    for motion, contacts in zip(motions, by_finger, strict=True):
        for contact in () if isinstance(motion.finger, Wall) else contacts:  # a wall has no end to slip past
            slip = twist.xy + contact.point.perp().scale(twist.z) - contact.displacement
            squares.append(slip.dot(slip))
    slips = functools.reduce(jnp.maximum, squares) > (MAX_SLIP_PER_STEP * length) ** 2
    # what leaves its only contact meets nothing else
    solved = (solution.status == Status.MOVING) | ((solution.status == Status.FREE) & (len(solution.force) > 1))
    return solved & (slips | (jnp.abs(twist.z) > MAX_ROTATION_PER_STEP))


def _first_contact(motions: tuple[FingerMotion, ...], outline: Outline, start: BodyFrame, length: Scalar) -> Scalar:
    """Fraction of the step after which a finger first touches a slider at rest, or one if none does."""
    begin = jnp.ones_like(start.pose.x)

    for impact in map_items(lambda motion: time_of_impact(motion, outline, start, length), motions):
        begin = jnp.minimum(begin, impact)
    return compute_once(begin, start.pose.x)


def _gap(distance: Scalar, roundoff: Scalar) -> Scalar:
    """Gap of a contact, m: zero where a body touches within roundoff."""
    # The roundoff would move a slider on which nothing pushes, and would jam what a turning hand holds.
    rests = (distance < 0) & (distance > -roundoff)
    return distance + jax.lax.stop_gradient(jnp.where(rests, -distance, 0.0))


def _points_and_normals(contacts: tuple[Contact, ...]) -> tuple[Array, Array]:
    """Points, m, and inward normals of contacts, both (contacts, 2), body frame, without derivatives."""
    point = jnp.stack([contact.point.array() for contact in contacts])
    normal = jnp.stack([contact.normal.array() for contact in contacts])
    return jax.lax.stop_gradient((point, normal))


def _force_weighted_point(contacts: tuple[Contact, ...], forces: tuple[Vec2, ...]) -> Vec2:
    """Mean of the contact points, weighted by normal force: the point of the slider that moves in a straight line."""
    if len(contacts) == 1:
        return contacts[0].point
    total_force, weighted_sum = jnp.zeros_like(forces[0].x), Vec2(*(0 * x for x in contacts[0].point))
    for contact, force in zip(contacts, forces, strict=True):
        total_force, weighted_sum = total_force + force.x, weighted_sum + contact.point.scale(force.x)
    return weighted_sum.scale(1 / jnp.where(total_force > 0, total_force, 1.0))


def _keep_pose_unless_moving(
    solution: ScalarSolution,
    points_and_normals: tuple[Array, Array],
    moved_pose: Vec3,
    pose: Vec3,
    status: Int[Array, ""],
) -> ScalarStep:
    """Return the record of a step; a slider that does not move keeps its pose bit for bit."""
    # A motion that is not finite becomes the status INVALID, and the slider keeps its pose, too.
    finite_pose = jnp.isfinite(moved_pose.x + moved_pose.y + moved_pose.z)
    moves = decide((status == Status.MOVING) & finite_pose, pose.x)
    status = jnp.where((status == Status.MOVING) & ~finite_pose, Status.INVALID, status).astype(jnp.int8)

    def zero_unless_moving(values):
        return jax.tree.map(lambda entry: jnp.where(moves, entry, 0.0), values)

    return ScalarStep(
        tree_where(moves, moved_pose, pose),
        zero_unless_moving(solution.twist),
        zero_unless_moving(solution.wrench),
        zero_unless_moving(solution.force),
        zero_unless_moving(points_and_normals[0]),
        zero_unless_moving(points_and_normals[1]),
        tuple(jnp.where(moves, mode, ContactMode.SEPARATED).astype(jnp.int8) for mode in solution.mode),
        status,
        jnp.zeros_like(pose.x),
    )
