"""Motion of fingers over a step, relative to the slider, and how deep the fingers are in the slider."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._internal.xla import compute_once, map_items
from pushjax._math.vec import Scalar, Vec2, Vec3, cos_sin, sinc, wrap_to_pi
from pushjax.geometry.shape import Outline
from pushjax.simulation.candidate import FingerPose
from pushjax.simulation.detection import pair_of
from pushjax.simulation.fixtures import Fixtures, Wall
from pushjax.simulation.hand import Finger, Hand, Pad, RoundFinger

# A jam is a grasp if every finger is nearer to the slider than this, in units of the limit surface's length, or than
# four times the largest displacement of a finger in the part of the step that jams. The margin is needed because a jam
# is detected before the last gap is closed, and because the slider swings faster than the fingers close.
GRASP_GAP = 1e-4
# After a step a finger may be this deep in the slider, as a fraction of the largest displacement of the fingers in the
# step, if it was not deeper before: the midpoint rule leaves that much at a corner. The floor is in units of the length
# and allows for roundoff.
DEPTH_PER_DISPLACEMENT, DEPTH_FLOOR = 0.1, 1e-5
# Keyed by the bytes of a float; in units of the length. A finger that is nearer or less deep than this just touches.
TOUCHING = {4: 3e-6, 8: 1e-10}


class BodyFrame(NamedTuple):
    """Pose of the slider in the world, with the unit vector of its angle."""

    pose: Vec3
    angle: Vec2  # (cos, sin); kept, because a sine costs as much as solving a contact

    @staticmethod
    def at(pose: Vec3) -> "BodyFrame":
        """Return a pose with the unit vector of its angle."""
        return BodyFrame(pose, compute_once(cos_sin(pose.z), pose.x))

    def local(self, world: Vec2) -> Vec2:
        """Return a world point in the body frame."""
        return (world - self.pose.xy).unrotate(self.angle)

    def moved(self, contact: Vec2, twist: Vec3, frame_angle: Vec2) -> "BodyFrame":
        """Return the pose after a body twist (m, rad) that moves the slider's point `contact` in a straight line."""
        # `frame_angle` is the angle of the body frame in which the twist is given
        displacement = (twist.xy + contact.perp().scale(twist.z)).rotate(frame_angle)
        # Displacements are chords. So is the turn: 2 asin(z / 2) is the angle whose chord it is.
        square = twist.z * twist.z
        series = 1 + 9 / 80 * square * (1 + 25 / 168 * square * (1 + 49 / 288 * square))
        theta = self.pose.z + twist.z * (1 + square / 24 * series)
        angle = compute_once(cos_sin(theta), self.pose.x)
        lever_change = contact.rotate(angle) - contact.rotate(self.angle)
        x, y = self.pose.x + displacement.x - lever_change.x, self.pose.y + displacement.y - lever_change.y
        return BodyFrame(Vec3(x, y, theta), angle)


class FingerMotion(NamedTuple):
    """Motion of one finger over a step, in the world, and its friction; a fixture is a finger that stays in place."""

    finger: Finger | Wall
    friction: Scalar  # coefficient of friction mu between finger and slider
    center: Vec2  # at the start, m
    path: Vec2  # displacement of the center, m
    angle: Scalar | None  # at the start, rad; None if the finger never turns
    turning: Scalar | None  # change of the angle, rad; None if the finger never turns

    def pose_in_slider(self, slider: BodyFrame, fraction: Scalar) -> FingerPose:
        """Return the pose of the finger in the slider's frame when `fraction` of the step is done."""
        center = slider.local(self.center + self._chord(jnp.zeros_like(fraction), fraction))
        if isinstance(self.finger, Wall):
            return FingerPose(center, Vec2.of(self.finger.normal).unrotate(slider.angle))
        if not isinstance(self.finger, Pad):  # a disk looks the same at any angle
            return FingerPose(center, Vec2(jnp.ones_like(center.x), jnp.zeros_like(center.x)))
        if self.angle is None or self.turning is None:
            raise ValueError("hand: pads need kinematics that give poses (x, y, theta), not centers")
        return FingerPose(
            center, compute_once(cos_sin(self.angle + fraction * self.turning), center.x).unrotate(slider.angle)
        )

    def part(self, begin: Scalar, size: Scalar) -> "FingerMotion":
        """Return the motion in the part of the step that starts at the fraction `begin` and has the size `size`."""
        angle, turning = self.angle, self.turning
        if angle is not None and turning is not None:
            angle, turning = angle + begin * turning, size * turning
        center = self.center + self._chord(jnp.zeros_like(begin), begin)
        return FingerMotion(self.finger, self.friction, center, self._chord(begin, size), angle, turning)

    def _chord(self, begin: Scalar, size: Scalar) -> Vec2:
        """Return the center's displacement in the part that starts at `begin` and has the size `size`, world, m."""
        if self.turning is None:
            return self.path.scale(size)
        # A finger that turns goes around a fixed point, as a rigid body would. So the motion within a step does not
        # depend on which point of the finger is its center.
        half = self.turning / 2
        direction = cos_sin((2 * begin + size - 1) * half)
        return self.path.rotate(direction).scale(size * sinc(size * half) / sinc(half))

    def moves(self) -> Bool[Array, ""]:
        """Return whether the finger does not stay as it is, which is True also for a motion that is NaN."""
        moves = (self.path.x != 0) | (self.path.y != 0)
        return moves if self.turning is None else moves | (self.turning != 0)

    def largest_displacement(self) -> Scalar:
        """Return the largest displacement of a point of the finger over the step, m; a bound for a round finger."""
        center = jnp.sqrt(self.path.dot(self.path))
        if self.turning is None or isinstance(self.finger, Wall):
            return center
        if isinstance(self.finger, RoundFinger):
            return center + jnp.abs(2 * jnp.sin(self.turning / 2)) * self.finger.radius
        chords = self._corner_chords(self.finger)
        return jnp.sqrt(jnp.max(chords.dot(chords)))

    def arc_length(self) -> Scalar:
        """Return the longest way of a point of the finger over the step, m, without the turn of a round finger."""
        if self.turning is None:
            return jnp.sqrt(self.path.dot(self.path))
        chords = self._corner_chords(self.finger) if isinstance(self.finger, Pad) else self.path
        return jnp.sqrt(jnp.max(chords.dot(chords))) / sinc(self.turning / 2)

    def _corner_chords(self, pad: Pad) -> Vec2:
        """Return the displacement of each corner of a pad over the step, world, m."""
        assert self.angle is not None
        assert self.turning is not None
        corner = Vec2.of(pad.shape.vertices.T)
        turned = corner.rotate(cos_sin(self.angle + self.turning)) - corner.rotate(cos_sin(self.angle))
        return Vec2(self.path.x + turned.x, self.path.y + turned.y)

    def material_displacement(
        self, slider: BodyFrame, point: Vec2, center: Vec2, remaining: Scalar, in_predictor: Bool[Array, ""]
    ) -> Vec2:
        """Return how far the finger's material at `point` moves in the last fraction `remaining`, slider's frame, m."""
        translation = self._chord(1 - remaining, remaining).unrotate(slider.angle)
        if self.turning is None:
            return translation
        # The predictor stage evaluates the start of that fraction, not its middle. A turning hand then starts along the
        # tangent of its arc. The chord would move two fingers toward each other on the object between them: a jam.
        translation = translation.unrotate(cos_sin(jnp.where(in_predictor, remaining * self.turning / 2, 0.0)))
        # the chord of a rotation about the center, which is exact in the frame halfway through the turn
        return translation + (point - center).perp().scale(2 * jnp.sin(remaining * self.turning / 2))


def finger_motions(hand: Hand, friction: Array, before: tuple, after: tuple) -> tuple[FingerMotion, ...]:
    """Return the motion of each finger over a step, from its poses before and after (see `unstack_finger_poses`)."""
    motions = []
    for k, finger in enumerate(hand.fingers):
        start, end = before[k], after[k]
        angle, turning = (start[2], wrap_to_pi(end[2] - start[2])) if len(start) == 3 else (None, None)
        center = Vec2(start[0], start[1])
        motions.append(FingerMotion(finger, friction[k], center, Vec2(end[0], end[1]) - center, angle, turning))
    return tuple(motions)


def fixture_motions(fixtures: Fixtures) -> tuple[FingerMotion, ...]:
    """Return fixtures as fingers that stay where they are."""
    motions = []
    for fixture in fixtures:
        zero = jnp.zeros_like(fixture.friction)
        still = Vec2(zero, zero)
        if isinstance(fixture, Wall):
            motions.append(FingerMotion(fixture, fixture.friction, Vec2.of(fixture.point), still, None, None))
        else:
            angle, turning = (fixture.pose[2], zero) if isinstance(fixture.body, Pad) else (None, None)
            motions.append(FingerMotion(fixture.body, fixture.friction, fixture.center, still, angle, turning))
    return tuple(motions)


def unstack_finger_poses(poses: Array) -> tuple[tuple[Array, ...], ...]:
    """Return each finger's coordinates as scalars, or (steps,) arrays, from poses or centers (..., fingers, width)."""
    return tuple(
        tuple(poses[..., finger, coordinate] for coordinate in range(poses.shape[-1]))
        for finger in range(poses.shape[-2])
    )


def max_penetration(outline: Outline, motions: tuple[FingerMotion, ...], pose: Vec3, fraction: float) -> Scalar:
    """Return the depth of the deepest finger after `fraction` of the step, m; negative where all are apart."""
    outline, motions, pose = jax.lax.stop_gradient((outline, motions, pose))
    frame = BodyFrame.at(pose)

    def depth_of(motion: FingerMotion) -> Scalar:
        where = compute_once(motion.pose_in_slider(frame, jnp.full_like(pose.x, fraction)), pose.x)
        return -pair_of(motion.finger, outline).distance(motion.finger, outline, where)[0]

    return functools.reduce(jnp.maximum, map_items(depth_of, motions))


def max_displacement(motions: tuple[FingerMotion, ...]) -> Scalar:
    """Return the largest displacement of a point of a finger in the step, m, not differentiated."""
    motions = jax.lax.stop_gradient(motions)
    return functools.reduce(jnp.maximum, [motion.largest_displacement() for motion in motions])


def holding_distance(displacement: Scalar, length: Scalar) -> Scalar:
    """Return within which distance a finger holds a slider that jams in a part with this largest displacement, m."""
    return jnp.maximum(GRASP_GAP * length, 4 * displacement)


def allowed_penetration(displacement: Scalar, length: Scalar) -> Scalar:
    """Return how deep a finger may be in the slider after a step, m, unless it was deeper before."""
    return jnp.maximum(DEPTH_FLOOR * length, DEPTH_PER_DISPLACEMENT * displacement)
