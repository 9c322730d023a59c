"""Rollout of a hand with one contact, whose steps are not divided: a step that is too long is NOT_CONVERGED.

This is a round finger on a convex outline, or a pad on a disk.
"""

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array

from pushjax._internal.autodiff import save_search_results
from pushjax._internal.xla import compute_once, skippable, tree_where
from pushjax._math.vec import Vec3
from pushjax.contact.status import Status
from pushjax.simulation.finger_motion import allowed_penetration, max_displacement, max_penetration
from pushjax.simulation.step import StepRecord, compute_step
from pushjax.simulation.substeps import PreparedPush


def simulate_in_whole_steps(push: PreparedPush, start: Vec3) -> StepRecord:
    """Return the records of all steps of a hand with one contact."""

    def body(before: tuple[Vec3, Array], step: Array):
        pose, depth = before
        form, mu = push.friction_at(step, pose)
        motions = push.motions_at(step, mu)
        # one contact holds nothing
        record, *_ = compute_step(form, push.outline, motions, push.solver, pose, depth, jnp.zeros_like(pose.x))
        allowed = jnp.maximum(depth, allowed_penetration(max_displacement(motions), form.length))
        depth = max_penetration(push.outline, motions, record.pose, 1.0)
        is_solved = (record.status == Status.MOVING) | (record.status == Status.FREE)
        is_too_long = compute_once(is_solved & (depth > allowed), pose.x)
        depth_at_rest = jax.lax.cond(
            eqxi.unvmap_any(is_too_long), lambda: max_penetration(push.outline, motions, pose, 1.0), lambda: depth
        )
        pose, depth = tree_where(is_too_long, (pose, depth_at_rest), (record.pose, depth))
        return (pose, depth), (record._replace(pose=pose, overlap=depth), is_too_long)

    first = jnp.zeros((), jnp.int32)
    motions = push.motions_at(first, push.friction_at(first, start)[1])
    before = start, max_penetration(push.outline, motions, start, 0.0)
    if push.num_steps is not None:
        body = skippable(lambda _, step: step < push.num_steps, body, before, first)
    body = jax.checkpoint(body, prevent_cse=False, policy=save_search_results)
    _, (records, is_too_long) = jax.lax.scan(body, before, jnp.arange(push.steps, dtype=jnp.int32))
    failed = jax.tree.map(jnp.zeros_like, records)._replace(pose=records.pose, overlap=records.overlap)
    failed = failed._replace(status=jnp.full_like(records.status, Status.NOT_CONVERGED))
    return jax.vmap(tree_where)(is_too_long, failed, records)
