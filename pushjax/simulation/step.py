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

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pushjax._internal.xla import compute_once, map_items, tree_where
from pushjax._math.vec import Scalar, Vec2, Vec3
from pushjax.contact.contact_plane import Contact
from pushjax.contact.problem import ContactSolution, solve_problem
from pushjax.contact.scaled_problem import ContactSolver, EdgeSet
from pushjax.contact.status import ContactMode, Status
from pushjax.contact.sticking import StickingSolver
from pushjax.friction.limit_surface import Form
from pushjax.geometry.shape import Outline
from pushjax.simulation.candidate import Features, Touches, joined
from pushjax.simulation.detection import num_contacts, pair_of
from pushjax.simulation.finger_motion import DEPTH_FLOOR, TOUCHING, BodyFrame, FingerMotion
from pushjax.simulation.fixtures import Wall
from pushjax.simulation.impact import time_of_impact
from pushjax.simulation.pair import MAX_PENETRATION
from pushjax.simulation.working_set import LOADED, Urgency, WorkingSet, num_solved_together, violations

# If a step, or a part of one, turns the slider farther than this, rad, or if a finger slips on it farther than this, in
# units of the limit surface's length, the result is rejected: contacts are detected at the start of the step, and
# nothing checks what the slider passes on the way.
MAX_ROTATION_PER_STEP, MAX_SLIP_PER_STEP = 0.5, 1.0


class StepRecord(NamedTuple):
    """Result of a step, which the scan stacks; fields as in `Step`."""

    pose: Vec3  # of the slider after the step, world
    twist: Vec3  # body frame
    wrench: Vec3  # normalized, body frame
    force: Vec2  # of each contact along normal and tangent, N
    contact_point: Vec2  # of each contact, body frame, m
    contact_normal: Vec2  # of each contact, inward, of unit length, body frame
    mode: Int[Array, "contacts"]  # `ContactMode` of each contact
    status: Int[Array, ""]  # `Status`
    overlap: Scalar  # depth of the deepest finger or fixture at the end, m; zero until it is computed


class Stage(NamedTuple):
    """What the predictor passes to the corrector, and what the corrector leaves."""

    solution: ContactSolution
    middle: Vec2  # point of the slider that moves in a straight line, body frame, m
    angle: Vec2  # unit vector of the angle of the frame in which the solution is given
    point: Vec2  # of each contact, body frame, m; like the normals without derivatives
    normal: Vec2  # of each contact
    at_start: tuple[Touches, ...]  # for each finger, its contacts at the start of the step
    holds: Bool[Array, ""]  # whether all of several fingers, and no fixture, are near enough to hold a jammed slider
    is_long: Bool[Array, ""]  # whether a stage turned the slider, or let a finger slip, too far for one step
    slides_off: Bool[Array, ""]  # whether a force acts at a contact that has slid past the end of its edge
    urgency: Urgency | None  # by which contacts are selected; None if all are solved together
    urgency_after: Urgency | None

    @staticmethod
    def before(start: BodyFrame, counts: list[int], urgency: Urgency | None, guess: EdgeSet | None) -> "Stage":
        """Return what the predictor starts from: no motion yet, and no contacts found."""
        zero, no = jnp.zeros_like(start.pose.x), jnp.zeros((), bool)
        rows = [jnp.zeros(count, zero.dtype) for count in counts]
        nowhere = tuple(Touches(row, Vec2(row, row), Vec2(row, row), row > 0) for row in rows)
        all_rows = jnp.concatenate(rows)
        still, columns = Vec3(zero, zero, zero), Vec2(all_rows, all_rows)
        mode, moving = jnp.zeros(all_rows.size, jnp.int8), jnp.zeros((), jnp.int8)  # SEPARATED and MOVING are 0
        solution = ContactSolution(still, still, columns, mode, moving, zero, no, guess)
        return Stage(
            solution=solution,
            middle=Vec2(zero, zero),
            angle=start.angle,
            point=columns,
            normal=columns,
            at_start=nowhere,
            holds=no,
            is_long=no,
            slides_off=no,
            urgency=urgency,
            urgency_after=urgency,
        )


class BodyContacts(NamedTuple):
    """The contacts of one finger or fixture in a stage."""

    contacts: Contact  # as they are now, with the gaps of the start of the step
    at_start: Touches  # as they were at the start of the step
    is_near: Bool[Array, ""]  # whether one is near enough to hold a jammed slider
    is_past: Bool[Array, "contacts"]  # whether it has slid past the end of its edge


class PushingPart(NamedTuple):
    """The part of a step in which the fingers push, after the free motion."""

    outline: Outline
    length: Scalar  # of the limit surface, m
    start: BodyFrame  # pose of the slider at the start
    begin: Scalar  # fraction of the step after which a finger first touches
    rest: Scalar  # fraction of the step that is left then
    reach: Scalar  # distance within which a finger holds a jammed slider, m

    def features_of(self, body: FingerMotion) -> Features:
        """Return what meets at the contacts of one finger or fixture, found at the start."""
        part, body = jax.lax.stop_gradient((self, body))
        pose = compute_once(body.pose_in_slider(part.start, part.begin), part.start.pose.x)

        def displacement_at(point: Vec2) -> Vec2:
            return body.material_displacement(part.start, point, pose.center, part.rest, jnp.ones((), bool))

        return pair_of(body.finger, part.outline).features(
            body.finger, part.outline, pose, displacement_at, part.length
        )

    def contacts_of(
        self,
        frame: BodyFrame,  # pose of the slider in this stage
        fraction: Scalar,  # of the pushing part that is done in this stage: zero in the predictor
        body: FingerMotion,
        roundoff: Scalar,  # depth in which a body just touches, in units of the surface's length
        features: Features,
        at_start: Touches,  # not used in the predictor
    ) -> BodyContacts:
        """Return the contacts of one finger, or of one fixture, in a stage."""
        x, in_predictor = self.start.pose.x, fraction == 0
        pose = compute_once(body.pose_in_slider(frame, self.begin + self.rest * fraction), x)
        pair = pair_of(body.finger, self.outline)
        touches = compute_once(pair.touches(body.finger, self.outline, pose, features), x)
        at_start = tree_where(in_predictor, touches, at_start)
        # what touches nothing any more keeps its contact from the start of the step
        touches = pair.matched(touches, at_start)
        is_past = at_start.exists & ~touches.exists
        touches = tree_where(touches.exists, touches, at_start)
        # both stages use the gap from the start of the step, so that position errors of the rule do not accumulate
        gap = _gap(at_start.distance, roundoff * self.length)
        displacement = body.material_displacement(frame, touches.point, pose.center, self.rest, in_predictor)
        displacement, friction = jax.tree.map(
            lambda entry: jnp.broadcast_to(entry, gap.shape), (displacement, body.friction)
        )
        contacts = compute_once(Contact(touches.point, touches.normal, displacement, friction, gap), x)
        is_near = jnp.any(at_start.exists & (gap <= self.reach))
        return BodyContacts(contacts, at_start, is_near, is_past)

    def contacts_of_all(
        self, frame: BodyFrame, fraction: Scalar, bodies: tuple[FingerMotion, ...], *others: Any
    ) -> tuple[BodyContacts, ...]:
        """Return the contacts of all bodies, in loops over similar ones; the other arguments have an entry for each."""
        items = tuple(zip(bodies, *others, strict=True))
        return map_items(lambda item: self.contacts_of(frame, fraction, *item), items)


def roundoff_of(is_fixture: np.ndarray, like: Scalar) -> Float[Array, "bodies"]:
    """Return the depth in which each body, a finger or a fixture, just touches, in units of the surface's length."""
    return jnp.asarray(np.where(is_fixture, DEPTH_FLOOR, TOUCHING[like.dtype.itemsize]), like.dtype)


def compute_step(
    form: Form,
    outline: Outline,
    motions: tuple[FingerMotion, ...],
    solver: ContactSolver | StickingSolver | None,
    pose: Vec3,  # of the slider at the start, world
    overlap_before: Scalar,  # depth of the deepest finger or fixture at the start, m
    reach: Scalar,  # distance within which a finger holds a jammed slider, m
    *,
    urgency: Urgency | None = None,  # of each contact (`working_set`); None if all are solved together
    ongoing: Bool[Array, ""] | bool = True,  # where False, no contact problem is solved, and the result has no meaning
    fixtures: tuple[FingerMotion, ...] = (),  # as fingers that stay where they are
    is_first_try: Bool[Array, ""] | bool = True,  # True where `urgency` has no meaning yet
    guess: EdgeSet | None = None,  # cone edges that carried the force last
) -> tuple[StepRecord, Stage]:
    """Compute one step of all fingers, or a part of one: its record, and the last stage."""
    start = BodyFrame.at(pose)
    begin = compute_once(time_of_impact(motions, outline, start, form.length), pose.x)
    part = PushingPart(outline, form.length, start, begin, 1 - begin, reach)
    bodies = motions + fixtures
    features, counts = map_items(part.features_of, bodies), [num_contacts(body.finger, outline) for body in bodies]
    size, has_end = num_solved_together(counts), _has_end(bodies, counts)
    roundoff = roundoff_of(np.arange(len(bodies)) >= len(motions), pose.x)

    def stage(before: Stage, fraction: Scalar) -> tuple[Stage, None]:
        """Solve the contacts as they are after `fraction` of the previous stage's motion: 0 predicts, 0.5 corrects."""
        frame = start.moved(before.middle, before.solution.twist.scale(fraction), before.angle)
        found = part.contacts_of_all(frame, fraction, bodies, roundoff, features, before.at_start)
        contacts, at_start, near, past = zip(*found, strict=True)
        contacts, active = joined(*contacts), joined(*at_start).exists
        used_urgency, guess = before.urgency, before.solution.best
        if fixtures and used_urgency is not None:
            # in the first try, contacts are selected by how far the step would press them into a slider at rest
            pressed = jax.lax.stop_gradient(jnp.where(active, contacts.approach().x, -LOADED))
            used_urgency = jnp.where((fraction == 0) & is_first_try, pressed, used_urgency)
        working = WorkingSet.most_urgent(used_urgency, size)
        works = before.solution.status <= Status.FREE  # else the step has failed, and the corrector solves nothing
        chosen = *working.select(contacts, active & ongoing & works), solver
        solution = working.spread(solve_problem(form, *chosen, None if guess is None else working.local(guess)))
        if guess is not None and solution.best is not None:
            solution = solution._replace(best=tree_where(solution.best.exists(), solution.best, guess))
        is_long = before.is_long | _turns_or_slips_too_far(contacts, active & has_end, solution, form.length)
        return Stage(
            solution=solution._replace(status=jnp.where(works, solution.status, before.solution.status)),
            middle=_force_weighted_point(contacts, solution.force),
            angle=frame.angle,
            point=jax.lax.stop_gradient(contacts.point),
            normal=jax.lax.stop_gradient(contacts.normal),
            at_start=at_start,
            holds=_holds(near, len(motions)),
            is_long=is_long,
            slides_off=jnp.any(jnp.concatenate(past) & (solution.force.x > 0)),
            urgency=used_urgency,
            urgency_after=None if urgency is None else violations(contacts, active, solution),
        ), None

    before = Stage.before(start, counts, urgency, guess)
    last, _ = jax.lax.scan(stage, before, jnp.array([0.0, 0.5], pose.x.dtype))
    status = status_of(last, motions, fixtures, overlap_before, form.length)
    moved = start.moved(last.middle, last.solution.twist, last.angle).pose
    return keep_pose_unless_moving(last, moved, pose, status), last


def _holds(near: tuple[Bool[Array, ""], ...], num_fingers: int) -> Bool[Array, ""]:
    """Return whether all of several fingers, and no fixture, are near enough to hold a jammed slider."""
    holds = jnp.asarray(num_fingers > 1)
    for k, is_near in enumerate(near):
        holds &= is_near if k < num_fingers else ~is_near
    return holds


def status_of(
    last: Any,  # `Stage`, or that of several sliders
    motions: tuple[FingerMotion, ...],
    fixtures: tuple[FingerMotion, ...],
    depth: Scalar,
    length: Scalar,
) -> Int[Array, ""]:
    """Status of a step, given the depth of the deepest finger at its start, m."""
    status = last.solution.status
    status = jnp.where((status == Status.JAMMED) & last.holds, Status.GRASPED, status)
    status = jnp.where((status <= Status.FREE) & last.is_long, Status.NOT_CONVERGED, status)
    # friction that is not valid counts also where a body has no contact
    valid = jnp.all(jnp.stack([body.friction >= 0 for body in motions + fixtures]))
    status = jnp.where(valid, status, Status.INVALID)
    # a hand that rests changes nothing, and proves nothing
    moves = jax.tree.reduce(jnp.logical_or, [motion.moves() for motion in motions])
    status = jnp.where(moves | (status == Status.INVALID), status, Status.FREE)
    overlapping = (depth > MAX_PENETRATION * length) & (status != Status.INVALID)
    return jnp.where(overlapping, Status.OVERLAPPING, status).astype(jnp.int8)


def hand_stops(status: Array) -> Bool[Array, "..."]:
    """Return whether a step of this status stops the hand for good."""
    return (status == Status.JAMMED) | (status == Status.GRASPED)


def _has_end(bodies: tuple[FingerMotion, ...], counts: list[int]) -> Bool[Array, "contacts"]:
    """Return which contacts are on a body that can be slipped past: all but those on a wall."""
    return jnp.asarray(np.repeat([not isinstance(body.finger, Wall) for body in bodies], counts))


def _turns_or_slips_too_far(
    contacts: Contact, counted: Bool[Array, "contacts"], solution: ContactSolution, length: Scalar
) -> Bool[Array, ""]:
    """Return whether the slider turns, or slips at a contact that is counted, too far for one step."""
    contacts, twist, length = jax.lax.stop_gradient((contacts, solution.twist, length))
    slip = twist.xy + contacts.point.perp().scale(twist.z) - contacts.displacement
    slips = jnp.any(counted & (slip.dot(slip) > (MAX_SLIP_PER_STEP * length) ** 2))
    # what leaves its only contact meets nothing else
    solved = (solution.status == Status.MOVING) | ((solution.status == Status.FREE) & (counted.size > 1))
    return solved & (slips | (jnp.abs(twist.z) > MAX_ROTATION_PER_STEP))


def _gap(distance: Scalar, roundoff: Scalar) -> Scalar:
    """Gap of a contact, m: zero where a body touches within roundoff."""
    # The roundoff would move a slider on which nothing pushes, and would jam what a turning hand holds.
    rests = (distance < 0) & (distance > -roundoff)
    return distance + jax.lax.stop_gradient(jnp.where(rests, -distance, 0.0))


def _force_weighted_point(contacts: Contact, force: Vec2) -> Vec2:
    """Mean of the contact points, weighted by normal force: the point of the slider that moves in a straight line."""
    if force.x.size == 1:
        return Vec2(contacts.point.x[0], contacts.point.y[0])
    total = jnp.sum(force.x)
    share = force.x / jnp.where(total > 0, total, 1.0)
    return Vec2(jnp.sum(share * contacts.point.x), jnp.sum(share * contacts.point.y))


def keep_pose_unless_moving(last: Any, moved_pose: Vec3, pose: Vec3, status: Int[Array, ""]) -> StepRecord:
    """Return the record of a step; sliders keep their poses bit for bit unless the status is MOVING."""
    # A motion that is not finite becomes the status INVALID, and the slider keeps its pose, too.
    finite_pose, one = jnp.all(jnp.isfinite(moved_pose.x + moved_pose.y + moved_pose.z)), jnp.sum(pose.x)
    moves = compute_once((status == Status.MOVING) & finite_pose, one)
    status = jnp.where((status == Status.MOVING) & ~finite_pose, Status.INVALID, status).astype(jnp.int8)
    pose, solution = tree_where(moves, moved_pose, pose), last.solution
    vectors = solution.twist, solution.wrench, solution.force, last.point, last.normal
    twist, wrench, force, point, normal = jax.tree.map(lambda entry: jnp.where(moves, entry, 0.0), vectors)
    mode = jnp.where(moves, solution.mode, ContactMode.SEPARATED).astype(jnp.int8)
    return StepRecord(pose, twist, wrench, force, point, normal, mode, status, jnp.zeros_like(one))
