"""One step of several sliders that touch each other, or a part of one.

The scheme is that of one slider (`step`): free motion, predictor and corrector. Each slider has its own frame. Where
two sliders meet, the second one is to the first like a finger whose motion is not known. All contacts are solved
together (`sliders_solving`).
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pushjax._internal.jit import quick_jit
from pushjax._internal.xla import compute_once, map_items
from pushjax._math.vec import Scalar, Vec2, Vec3
from pushjax.contact.contact_plane import Contact
from pushjax.contact.sliders_solving import SlidersSolution, Start, Touching, solve_touching
from pushjax.contact.status import ContactMode, Status
from pushjax.friction.limit_surface import Form
from pushjax.geometry.disk import Disk
from pushjax.geometry.polygon import Polygon
from pushjax.geometry.shape import Outline, Shape
from pushjax.simulation.candidate import Features, Touches, joined
from pushjax.simulation.detection import num_contacts
from pushjax.simulation.finger_motion import BodyFrame, FingerMotion, max_penetration
from pushjax.simulation.fixtures import Wall
from pushjax.simulation.hand import Finger, Pad, RoundFinger
from pushjax.simulation.impact import time_of_impact
from pushjax.simulation.step import (
    MAX_ROTATION_PER_STEP,
    MAX_SLIP_PER_STEP,
    PushingPart,
    StepRecord,
    keep_pose_unless_moving,
    roundoff_of,
    status_of,
)


class Body(NamedTuple):
    """A slider: its outline, itself as a finger that pushes others, and its friction with each slider."""

    outline: Outline
    finger: Finger | None  # None for a smooth slider that is no disk, which cannot push another one of these
    center: Vec2  # of the finger, in the frame of the slider, m
    friction: Scalar  # with each slider, (sliders,)

    @staticmethod
    def of(shape: Shape, friction: Array) -> "Body":
        """A slider of this shape."""
        zero = jnp.zeros_like(jax.tree.leaves(shape)[0].ravel()[0])
        finger, center = None, Vec2(zero, zero)
        if isinstance(shape, Disk):
            finger, center = RoundFinger(shape.radius), Vec2.of(shape.center)
        elif isinstance(shape, Polygon):
            finger = Pad(shape)
        return Body(shape.outline(), finger, center, friction)

    @property
    def rank(self) -> int:
        """Where several sliders meet, the one of the lowest rank is best as a finger."""
        return 2 if self.finger is None else int(not self.outline.is_convex)

    def as_finger(self, frame: BodyFrame, other: int) -> FingerMotion:
        """Return the slider as a finger of another one that stays where it is."""
        assert self.finger is not None
        zero = jnp.zeros_like(frame.pose.x)
        center = frame.pose.xy + self.center.rotate(frame.angle)
        return FingerMotion(self.finger, self.friction[other], center, Vec2(zero, zero), frame.pose.z, zero)


class Meeting(NamedTuple):
    """A slider, and what it may meet: a finger or a fixture, or another slider."""

    slider: int
    body: FingerMotion | None  # None for a slider
    other: int | None  # None for a finger or a fixture
    is_fixture: bool

    def finger_of(self, bodies: tuple[Body, ...]) -> Finger | Wall:
        """Return the shape of what the slider meets."""
        finger = bodies[self.other].finger if self.other is not None else self.body and self.body.finger
        assert finger is not None
        return finger

    def found_at(self, frames: tuple[BodyFrame, ...], bodies: tuple[Body, ...]) -> FingerMotion:
        """Return what the slider meets, while the sliders are at these frames."""
        if self.other is None:
            assert self.body is not None
            return self.body
        return bodies[self.other].as_finger(frames[self.other], self.slider)


class SlidersStage(NamedTuple):
    """What the predictor passes to the corrector, and what the corrector leaves; as `Stage` for each slider."""

    solution: SlidersSolution
    middle: tuple[Vec2, ...]
    angle: tuple[Vec2, ...]
    point: Vec2  # of each contact, in the frame of its first slider
    normal: Vec2
    at_start: tuple[Touches, ...]  # of each meeting
    holds: Bool[Array, ""]
    is_long: Bool[Array, ""]
    slides_off: Bool[Array, ""]
    urgency_after: None = None  # all contacts are solved together


def meetings_of(
    bodies: tuple[Body, ...], motions: tuple[FingerMotion, ...], fixtures: tuple[FingerMotion, ...]
) -> list[Meeting]:
    """Return everything that may meet, the fingers of all sliders first, then fixtures, then sliders."""
    count = len(bodies)
    meetings = [Meeting(i, motion, None, False) for i in range(count) for motion in motions]
    meetings += [Meeting(i, fixture, None, True) for i in range(count) for fixture in fixtures]
    for i in range(count):
        for j in range(i):
            # a smooth outline has to be the first, and fewer contacts are found if a disk or a convex one is second
            first, second = (j, i) if bodies[j].rank > bodies[i].rank else (i, j)
            meetings.append(Meeting(first, None, second, True))
    return meetings


def contact_counts(bodies: tuple[Body, ...], meetings: list[Meeting]) -> list[int]:
    """Return the number of contacts of each meeting."""
    return [num_contacts(m.finger_of(bodies), bodies[m.slider].outline) for m in meetings]


def depths_of_sliders(
    bodies: tuple[Body, ...], meetings: list[Meeting], pose: Vec3, fraction: float
) -> Float[Array, "meetings"]:
    """Return the depth of each finger, fixture or slider in a slider after `fraction` of the step, m."""
    poses = tuple(Vec3(pose.x[i], pose.y[i], pose.z[i]) for i in range(len(bodies)))
    frames = tuple(BodyFrame.at(each) for each in poses)
    items = tuple(
        (
            bodies[m.slider].outline,
            (m.found_at(frames, bodies),),
            poses[m.slider],
            jnp.full_like(pose.x[0], 0.0 if m.other is not None else fraction),
        )
        for m in meetings
    )
    return jnp.stack(map_items(lambda item: max_penetration(*item), items))


@quick_jit
def mutual_overlaps(shapes: tuple[Shape, ...], poses: Array) -> Array:
    """Return the depth of each pair of sliders in each other, m, for each of many poses (pushes, sliders, 3), world."""
    bodies = _without_friction(shapes, poses.dtype)
    pairs = meetings_of(bodies, (), ())

    return jax.vmap(lambda pose: depths_of_sliders(bodies, pairs, Vec3.of(pose.T), 0.0))(poses)


def mutual_depth(shapes: tuple[Shape, ...], pose: Vec3) -> Scalar:
    """Return the depth of the two sliders that are deepest in each other, m; negative where all are apart."""
    bodies = _without_friction(shapes, pose.x.dtype)
    return jnp.max(depths_of_sliders(bodies, meetings_of(bodies, (), ()), pose, 0.0))


def _without_friction(shapes: tuple[Shape, ...], dtype: Any) -> tuple[Body, ...]:
    return tuple(Body.of(shape, jnp.zeros(len(shapes), dtype)) for shape in shapes)


class _PushingPart(NamedTuple):
    """The part of a step in which the fingers push, after the free motion; as `PushingPart` for each slider."""

    forms: tuple[Form, ...]
    bodies: tuple[Body, ...]
    meetings: list[Meeting]
    starts: tuple[BodyFrame, ...]
    parts: list[PushingPart]  # of each slider
    features: tuple[Features, ...]  # of each meeting
    sizes: list[int]  # contacts of each meeting
    num_fingers: int
    ongoing: Bool[Array, ""] | bool

    def stage(self, before: SlidersStage, fraction: Scalar) -> tuple[SlidersStage, None]:
        """Solve the contacts as they are after `fraction` of the previous stage's motion: 0 predicts, 0.5 corrects."""
        meetings, bodies = self.meetings, self.bodies
        frames = self.moved(before, fraction)
        roundoff = roundoff_of(np.array([m.is_fixture for m in meetings]), fraction)
        items = tuple(
            (self.parts[m.slider], frames[m.slider], m.found_at(frames, bodies), *of_meeting)
            for m, *of_meeting in zip(meetings, roundoff, self.features, before.at_start, strict=True)
        )
        found = map_items(lambda item: item[0].contacts_of(item[1], fraction, *item[2:]), items)
        contacts, at_start, near, past = zip(*found, strict=True)
        contact, exists = joined(*contacts), joined(*at_start).exists
        point, normal = joined(*[_in_second(m, each, frames) for m, each in zip(meetings, contacts, strict=True)])
        works = before.solution.status <= Status.FREE  # else the step has failed, and the corrector solves nothing
        pairs = tuple(
            pair for m, size in zip(meetings, self.sizes, strict=True) for pair in [(m.slider, m.other)] * size
        )
        touching = Touching(contact, point, normal, pairs, exists & self.ongoing & works)
        solution = solve_touching(self.forms, touching, before.solution.best)
        is_long = (solution.status <= Status.FREE) & self._moves_too_far(solution, contact, exists)
        return SlidersStage(
            solution=solution._replace(status=jnp.where(works, solution.status, before.solution.status)),
            middle=tuple(_middle(i, pairs, contact.point, point, solution.force.x) for i in range(len(bodies))),
            angle=tuple(frame.angle for frame in frames),
            point=jax.lax.stop_gradient(contact.point),
            normal=jax.lax.stop_gradient(contact.normal),
            at_start=at_start,
            holds=_holds(meetings, near, self.num_fingers),
            is_long=before.is_long | is_long,
            slides_off=jnp.any(jnp.concatenate(past) & (solution.force.x > 0)),
        ), None

    def moved(self, stage: SlidersStage, fraction: Scalar | float) -> tuple[BodyFrame, ...]:
        """Return the frames after a fraction of the motion of a stage."""
        twist = stage.solution.twist.scale(jnp.asarray(fraction, stage.solution.twist.x.dtype))
        each = zip(self.starts, stage.middle, zip(*twist, strict=True), stage.angle, strict=True)
        return tuple(start.moved(middle, Vec3(*twist), angle) for start, middle, twist, angle in each)

    def _moves_too_far(
        self, solution: SlidersSolution, contact: Contact, exists: Bool[Array, "contacts"]
    ) -> Bool[Array, ""]:
        """Return whether a slider turns, or slips at a contact that is not on a wall, too far for one step."""
        slip = jax.lax.stop_gradient(Vec2(solution.slip.x - contact.gap, solution.slip.y))
        ends = [m.body is None or not isinstance(m.body.finger, Wall) for m in self.meetings]
        counted = exists & jnp.asarray([end for end, size in zip(ends, self.sizes, strict=True) for _ in range(size)])
        slips = jnp.any(counted & (slip.dot(slip) > (MAX_SLIP_PER_STEP * shortest(self.forms)) ** 2))
        return slips | jnp.any(jnp.abs(solution.twist.z) > MAX_ROTATION_PER_STEP)


def shortest(forms: tuple[Form, ...]) -> Scalar:
    """Return the shortest length of limit surfaces, m."""
    return functools.reduce(jnp.minimum, [form.length for form in forms])


def compute_sliders_step(
    forms: tuple[Form, ...],
    bodies: tuple[Body, ...],
    motions: tuple[FingerMotion, ...],
    fixtures: tuple[FingerMotion, ...],
    pose: Vec3,  # of the sliders at the start, world, (sliders,) each
    overlap_before: Scalar,  # depth of the deepest body at the start, m
    reach: Scalar,  # distance within which a finger holds jammed sliders, m
    guess: Start,
    ongoing: Bool[Array, ""] | bool = True,
) -> tuple[StepRecord, SlidersStage]:
    """Compute one step of all fingers, or a part of one: its record, and the last stage."""
    meetings = meetings_of(bodies, motions, fixtures)
    starts = tuple(BodyFrame.at(Vec3(*each)) for each in zip(*pose, strict=True))
    each = tuple((body.outline, start, form.length) for body, start, form in zip(bodies, starts, forms, strict=True))
    instants = map_items(lambda item: time_of_impact(motions, *item), each)
    begin = compute_once(jnp.min(jnp.stack(instants)), overlap_before)
    parts = [PushingPart(outline, length, start, begin, 1 - begin, reach) for outline, start, length in each]
    items = tuple((parts[m.slider], m.found_at(starts, bodies)) for m in meetings)
    features = map_items(lambda item: item[0].features_of(item[1]), items)
    sizes = contact_counts(bodies, meetings)
    part = _PushingPart(forms, bodies, meetings, starts, parts, features, sizes, len(motions), ongoing)
    before = _before(starts, sizes, guess, overlap_before)
    last, _ = jax.lax.scan(part.stage, before, jnp.array([0.0, 0.5], overlap_before.dtype))
    moved = jax.tree.map(lambda *entries: jnp.stack(entries), *(frame.pose for frame in part.moved(last, 1.0)))
    # a slider that rests keeps its pose bit for bit
    moved = jax.tree.map(lambda new, old: jnp.where(last.solution.rests, old, new), moved, pose)
    status = status_of(last, motions, fixtures, overlap_before, shortest(forms))
    return keep_pose_unless_moving(last, moved, pose, status), last


def _before(starts: tuple[BodyFrame, ...], sizes: list[int], guess: Start, like: Scalar) -> SlidersStage:
    """Return what the predictor starts from: no motion yet, and no contacts found."""
    zero, no, total = jnp.zeros_like(like), jnp.zeros((), bool), sum(sizes)
    rows = [jnp.zeros(size, zero.dtype) for size in sizes]
    nowhere = tuple(Touches(row, Vec2(row, row), Vec2(row, row), row > 0) for row in rows)
    of_sliders, of_contacts = jnp.zeros(len(starts), zero.dtype), jnp.zeros(total, zero.dtype)
    still, columns = Vec3(of_sliders, of_sliders, of_sliders), Vec2(of_contacts, of_contacts)
    mode, moving = jnp.full(total, ContactMode.SEPARATED, jnp.int8), jnp.full((), Status.MOVING, jnp.int8)
    solution = SlidersSolution(still, still, columns, columns, mode, of_sliders == 0, moving, guess)
    middle = tuple(Vec2(zero, zero) for _ in starts)
    angle = tuple(start.angle for start in starts)
    return SlidersStage(solution, middle, angle, columns, columns, nowhere, no, no, no)


def _in_second(meeting: Meeting, contact: Contact, frames: tuple[BodyFrame, ...]) -> tuple[Vec2, Vec2]:
    """Return points and normals of contacts in the frame of the second slider; as they are if there is none."""
    if meeting.other is None:
        return contact.point, contact.normal
    first, second = frames[meeting.slider], frames[meeting.other]
    place = Vec2(first.pose.x, first.pose.y) + contact.point.rotate(first.angle)
    return second.local(place), contact.normal.rotate(first.angle).unrotate(second.angle)


def _middle(slider: int, pairs: tuple[tuple[int, int | None], ...], first: Vec2, second: Vec2, force: Scalar) -> Vec2:
    """Return the mean of the contact points of a slider, weighted by normal force, in its frame, m."""
    is_first = jnp.asarray([pair[0] == slider for pair in pairs])
    is_second = jnp.asarray([pair[1] == slider for pair in pairs])
    point = jax.tree.map(lambda a, b: jnp.where(is_first, a, b), first, second)
    weight = jnp.where(is_first | is_second, force, 0.0)
    total = jnp.sum(weight)
    share = weight / jnp.where(total > 0, total, 1.0)
    return Vec2(jnp.sum(share * point.x), jnp.sum(share * point.y))


def _holds(meetings: list[Meeting], near: tuple[Array, ...], count: int) -> Bool[Array, ""]:
    """Return whether each of several fingers is near enough to a slider to hold jammed sliders, and no fixture is."""
    holds = jnp.asarray(count > 1)
    own = [is_near for m, is_near in zip(meetings, near, strict=True) if m.other is None and not m.is_fixture]
    for k in range(count):
        holds &= jnp.any(jnp.stack(own[k::count]))
    for m, is_near in zip(meetings, near, strict=True):
        if m.other is None and m.is_fixture:
            holds &= ~is_near
    return holds
