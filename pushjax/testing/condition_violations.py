"""How far given solutions violate each condition of a contact problem."""

from typing import NamedTuple

import numpy as np

from pushjax.testing.batch import ProblemBatch

CLEAN = 1e-8  # the largest violation of what counts as a solution


class Violations(NamedTuple):
    """The largest violation of each condition in each problem, (N,).

    A violation is zero where the condition holds, and infinite where the solution is not finite. Lengths are relative
    to `ProblemBatch.speed`, forces are relative to the sum of the normal forces, and angles are given by their sines.

    Attributes:
        penetration: How far w_n + gap is below zero.
        complementarity: The smaller of separation and normal force.
        negative: How far the normal force is below zero.
        cone: Tangential force in excess of mu f_n.
        friction: The smaller of the slip and the distance of the force from the cone edge that opposes the slip.
        inactive: Force at a contact that is padding.
        flow: Angle between the twist and grad H(F), where F is the given wrench. Without a given wrench, F is the sum
            of the contacts' wrenches, in which large forces may have canceled. It is one where the power is not
            positive, or only one of twist and wrench is zero.
        wrench: Difference between the given wrench and the sum of the contacts' wrenches.
        level: Distance of the given wrench's size from H = 1. Zero for a slider that does not move.
    """

    penetration: np.ndarray
    complementarity: np.ndarray
    negative: np.ndarray
    cone: np.ndarray
    friction: np.ndarray
    inactive: np.ndarray
    flow: np.ndarray
    wrench: np.ndarray
    level: np.ndarray

    def worst(self) -> np.ndarray:
        """Return the largest of all violations in each problem, (N,)."""
        return np.max(self, axis=0)


def violations(
    batch: ProblemBatch, twist: np.ndarray, force: np.ndarray, wrench: np.ndarray | None = None
) -> Violations:
    """Measure how far solutions violate each condition in the header of `pushjax.testing`.

    Args:
        batch: The problems.
        twist: Twists (N, 3), in m, m, rad.
        force: Contact forces (N, m, 2) along normal and tangent, in N. Without `wrench` their scale does not matter.
        wrench: Wrenches (N, 3), in N and N m. Without them the fields `wrench` and `level` of the result are zero.

    Returns:
        The violations of each condition.
    """
    twist, force = np.asarray(twist, np.float64), np.asarray(force, np.float64)
    one = np.ones_like(batch.length)
    scale = np.stack([one, one, batch.length], axis=1)
    v, rows, active = twist * scale, batch.rows(), batch.active
    slip = (np.einsum("nmij,nj->nmi", rows, v) - batch.approach()) / batch.speed()[:, None, None]
    total = np.where(active, np.abs(force[..., 0]), 0.0).sum(axis=1)
    total = np.where(total > 0, total, np.abs(force).max(axis=(1, 2), initial=0.0))
    relative_force = force / np.where(total > 0, total, 1.0)[:, None, None]
    limit = batch.friction * np.maximum(relative_force[..., 0], 0.0)
    opposing = np.where(slip[..., 1] < 0, limit, -limit)
    active_force = np.where(active[..., None], relative_force, 0.0)
    summed = np.einsum("nmi,nmij->nj", active_force, rows)

    def largest(each: np.ndarray, where: np.ndarray = active) -> np.ndarray:
        return np.where(where, each, 0.0).max(axis=1, initial=0.0)

    wrench_error, level_error, relative_wrench = np.zeros(len(batch)), np.zeros(len(batch)), summed
    if wrench is not None:
        relative_wrench = np.asarray(wrench, np.float64) / scale
        moving = (total > 0) | relative_wrench.any(axis=1)
        wrench_error = np.linalg.norm(relative_wrench / np.where(total > 0, total, 1.0)[:, None] - summed, axis=1)
        level_error = np.where(moving, np.abs(level(batch, relative_wrench) - 1), 0.0)
    parts = Violations(
        penetration=largest(np.maximum(-slip[..., 0], 0.0)),
        complementarity=largest(np.minimum(np.maximum(slip[..., 0], 0.0), np.abs(relative_force[..., 0]))),
        negative=largest(np.maximum(-relative_force[..., 0], 0.0)),
        cone=largest(np.maximum(np.abs(relative_force[..., 1]) - limit, 0.0)),
        friction=largest(np.minimum(np.abs(slip[..., 1]), np.abs(relative_force[..., 1] - opposing))),
        inactive=largest(np.abs(relative_force).max(axis=2), ~active),
        flow=_flow_error(batch, v, relative_wrench),
        wrench=wrench_error,
        level=level_error,
    )
    finite = np.isfinite(twist).all(axis=1) & np.isfinite(force).all(axis=(1, 2))
    return Violations(*(np.where(finite & np.isfinite(part), part, np.inf) for part in parts))


def level(batch: ProblemBatch, wrench: np.ndarray) -> np.ndarray:
    """Return H^(1 / degree), (N,), homogeneous of degree one, at normalized wrenches (N, 3)."""
    largest = np.abs(wrench).max(axis=1)
    unit = wrench / np.where(largest > 0, largest, 1.0)[:, None]
    return largest * np.maximum(batch.value(unit), 0.0) ** (1 / batch.degree)


def _flow_error(batch: ProblemBatch, v: np.ndarray, wrench: np.ndarray) -> np.ndarray:
    """Return the sine of the angle between the normalized twist and grad H of the wrench, or one (see `Violations`)."""
    size = np.linalg.norm(wrench, axis=1)
    g = batch.gradient(wrench / np.where(size > 0, size, 1.0)[:, None])
    lengths = np.linalg.norm(g, axis=1) * np.linalg.norm(v, axis=1)
    sine = np.linalg.norm(np.cross(g, v), axis=1) / np.where(lengths > 0, lengths, 1.0)
    sine = np.where((lengths > 0) & (np.einsum("ni,ni->n", g, v) > 0), sine, 1.0)
    return np.where((size == 0) & ~v.any(axis=1), 0.0, sine)


def closing(batch: ProblemBatch) -> np.ndarray:
    """Return the largest violation of nonpenetration (N,) if the slider does not move, relative to `speed`."""
    # at most zero if the problem is FREE, and -inf without active contacts
    return np.where(batch.active, batch.approach()[..., 0], -np.inf).max(axis=1, initial=-np.inf) / batch.speed()
