"""A push without invalid numbers, ready to be simulated."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array

from pushjax._math.vec import Vec3
from pushjax.contact.scaled_problem import ContactSolver
from pushjax.contact.sticking import StickingSolver
from pushjax.friction.limit_surface import Form
from pushjax.geometry.shape import Shape
from pushjax.simulation.domain import MAX_FRICTION, are_valid, poses_are_moderate, replace_invalid, valid_path
from pushjax.simulation.finger_motion import finger_motions, fixture_motions, unstack_finger_poses
from pushjax.simulation.fixtures import Fixtures
from pushjax.simulation.hand import Hand
from pushjax.simulation.substeps import PreparedPush

# Called as `friction_at(step, pose)` with the index of a step and the pose of the slider before it. Returns H of the
# limit surface, and the coefficient of friction mu of each finger.
FrictionAt = Callable[[Array, Vec3], tuple[Form, Array]]


def prepared_push(
    shape: Shape,
    hand: Hand,
    path: Array,
    pose: Array,
    solver: ContactSolver | StickingSolver | None,
    friction_at: FrictionAt,
    fixtures: Fixtures = (),
) -> tuple[PreparedPush, Array]:
    """Return what a rollout needs of a push, and its first pose, (3,), both without invalid numbers (`domain`)."""
    length = friction_at(jnp.zeros((), jnp.int32), Vec3.of(jnp.zeros_like(pose)))[0].length
    shape_valid, hand_valid, fixtures_valid, pose_valid = (
        are_valid((shape,), length),
        are_valid(hand.fingers, length),
        are_valid(fixtures, length),
        poses_are_moderate(pose, length),
    )
    poses, row_valid = valid_path(hand, path, length)
    row_valid &= shape_valid & hand_valid & fixtures_valid & pose_valid
    shape, hand, fixtures = (
        replace_invalid(bodies, valid, length)
        for bodies, valid in ((shape, shape_valid), (hand, hand_valid), (fixtures, fixtures_valid))
    )

    def rows_at(step: Array, rows: Array) -> tuple[Array, Array]:
        return tuple(jax.lax.dynamic_index_in_dim(rows, step + k, keepdims=False) for k in (0, 1))

    def motions_at(step: Array, mu: Array):
        (before, after), (valid_before, valid_after) = rows_at(step, poses), rows_at(step, row_valid)
        before, after = jnp.where(valid_before, before, after), jnp.where(valid_after, after, before)
        return finger_motions(hand, mu, unstack_finger_poses(before), unstack_finger_poses(after))

    def friction_if_valid(step: Array, pose: Vec3) -> tuple[Form, Array]:
        form, mu = friction_at(step, pose)
        valid_before, valid_after = rows_at(step, row_valid)
        return form, jnp.where(valid_before & valid_after & (mu <= MAX_FRICTION), mu, jnp.nan)

    push = PreparedPush(
        shape.outline(), len(path) - 1, motions_at, solver, friction_if_valid, fixture_motions(fixtures)
    )
    return push, jnp.where(pose_valid, pose, 0.0)
