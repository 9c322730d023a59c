"""A recorded motion held against the contact law, and against the motions that satisfy it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import nnls

import pushjax as pj
from pushjax.datasets.pushes import rotation
from pushjax.datasets.three_finger import ThreeFingerLog
from pushjax.experiments.three_finger.runs import CHUNK, slider_of
from pushjax.status import Status
from pushjax.verify import ProblemBatch, violations

# m: what counts as touching, in recordings that drift by as much; and a drift that is worth a name.
TOUCHING, DRIFTED = 2e-5, 1e-4
# A recorded motion, from two samples of float32 poses: what is zero (of the fingers' speed); and how far its wrench may
# be from one that the fingers can exert, and its twist from ours, before they are another.
ZERO, BROKEN, OTHER = 0.02, 0.1, 0.05
CLEAN = 1e-6  # violations, relative, of an answer of ours that counts as one


class Contact(NamedTuple):
    """Fingers and outline, (..., 3) each: gap, m; the slider's point and inward normal (..., 3, 2), body; and the
    direction, body, in which the finger moves as the hand closes."""

    gap: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    closing: np.ndarray


def touching(log: ThreeFingerLog, pose: np.ndarray, distance: np.ndarray) -> Contact:
    """Where the fingers are to the object, for poses (..., 3) and d (...)."""
    angle = log.hand[2] + np.pi / 2 + 2 * np.pi / 3 * np.array([0.0, -1.0, 1.0])
    out = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    turn = np.swapaxes(rotation(pose[..., 2]), -1, -2)  # world to body
    center = np.einsum("...ij,...kj->...ki", turn, log.hand[:2] + distance[..., None, None] * out - pose[..., None, :2])
    closing = -np.einsum("...ij,kj->...ki", turn, out)
    v, edge = log.vertices, np.roll(log.vertices, -1, axis=0) - log.vertices
    share = np.clip(np.einsum("...kvi,vi->...kv", center[..., None, :] - v, edge) / np.sum(edge**2, axis=1), 0, 1)
    points = v + share[..., None] * edge
    away = np.linalg.norm(center[..., None, :] - points, axis=-1)
    nearest = np.argmin(away, axis=-1)[..., None]
    point = np.take_along_axis(points, nearest[..., None], axis=-2)[..., 0, :]
    outward = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
    inside = np.all(np.einsum("...kvi,vi->...kv", center[..., None, :] - v, outward) < 0, axis=-1)
    gap = np.where(inside, -1.0, 1.0) * np.take_along_axis(away, nearest, axis=-1)[..., 0]
    normal = (point - center) / gap[..., None]
    return Contact(gap - log.radius, point, normal, closing)


@jax.jit
def _motions(surface, contacts):
    return jax.vmap(lambda c: pj.solve_contacts(surface, c))(contacts)


class Answers(NamedTuple):
    """Contact problems at recorded states, and our motions there. clean: MOVING, and every condition holds. cancel:
    (n,) how much of the fingers' normal force is left in the net force."""

    problem: ProblemBatch
    twist: np.ndarray
    clean: np.ndarray
    unique: np.ndarray
    cancel: np.ndarray


def motions_at(
    log: ThreeFingerLog, pose: np.ndarray, distance: np.ndarray, step: np.ndarray, friction: float
) -> Answers:
    """Ours, as the hand closes by `step` (n,) m, at poses (n, 3) and d (n,); fingers nearer than `TOUCHING` touch."""
    surface, seen, n = slider_of(log).surface, touching(log, pose, distance), len(pose)
    take = np.minimum(np.arange(-(-n // CHUNK) * CHUNK), n - 1)
    fields = (seen.point, seen.normal, seen.closing * step[:, None, None], np.full((n, 3), friction))
    fields = (*fields, np.zeros((n, 3)), np.abs(seen.gap) < TOUCHING)
    parts, contacts = [], jax.vmap(pj.Contacts)(*(jnp.asarray(f[take]) for f in fields))
    for begin in range(0, len(take), CHUNK):
        batch = jax.tree.map(lambda leaf, b=begin: leaf[b : b + CHUNK], contacts)
        parts.append(jax.tree.map(np.asarray, _motions(surface, batch)))
    motion = jax.tree.map(lambda *leaves: np.concatenate(leaves)[:n], *parts)
    problem = ProblemBatch.of(surface, jax.tree.map(lambda leaf: leaf[:n], contacts))
    worst = violations(problem, motion.twist, motion.force, motion.wrench).worst()
    clean = (motion.status == Status.MOVING) & (worst < CLEAN)
    total = np.maximum(motion.force[..., 0].sum(axis=1), 1e-300)
    return Answers(problem, motion.twist, clean, motion.unique, np.hypot(*motion.wrench[:, :2].T) / total)


def law_residual(log: ThreeFingerLog, problem: ProblemBatch, twist: np.ndarray) -> np.ndarray:
    """(n,): how far, relatively, the wrench that the limit surface asks for twists (n, 3) is from what the fingers
    can exert: along the cone's one edge where they slide, between both where they stick, not at all where they part."""
    wrench = np.asarray(jax.vmap(slider_of(log).surface.inverse)(jnp.asarray(twist)).wrench)
    scale = np.array([1.0, 1.0, log.length])
    wrench = wrench / scale
    slip = np.einsum("nmij,nj->nmi", problem.rows(), twist * scale) - problem.approach()
    slip = slip / problem.speed()[:, None, None]
    residual = np.ones(len(twist))
    for k, (rows, w) in enumerate(zip(problem.rows(), slip, strict=True)):
        edges = []
        for i in np.flatnonzero(problem.active[k] & (w[:, 0] < ZERO)):
            signs = (1, -1) if abs(w[i, 1]) < ZERO else (1,) if w[i, 1] < 0 else (-1,)
            edges += [rows[i, 0] + sign * problem.friction[k, i] * rows[i, 1] for sign in signs]
        size = np.linalg.norm(wrench[k])
        if edges and size > 0:
            residual[k] = nnls(np.array(edges).T, wrench[k] / size)[1]
    return residual
