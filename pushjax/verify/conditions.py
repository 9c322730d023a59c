"""Whether given answers satisfy every condition of a contact problem."""

from typing import NamedTuple

import numpy as np

from pushjax.verify.batch import ProblemBatch

CLEAN = 1e-8  # the most violation of an answer that counts as one


class Violations(NamedTuple):
    """The largest violation of each condition, (N,), zero where it holds; infinite where the answer is not finite.

    Lengths are relative to `ProblemBatch.speed`, forces to the sum of the normal forces, angles are sines.
    penetration: of w_n + gap below zero. complementarity: the smaller of separation and force. negative: normal force
    below zero. cone: tangential force beyond mu f_n. friction: the smaller of slip and distance from the edge of the
    cone that opposes it. inactive: force at a contact that is padding. flow: angle between twist and grad H(F), F the
    wrench (where it is not given the contacts' sum, in which large forces may have cancelled), one
    where the power is not positive or only one of twist and force is zero. wrench: the one given less the contacts'
    sum. level: how far its size is from H = 1; zero for a slider that stays.
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
        """(N,): the largest of all."""
        return np.max(self, axis=0)


def violations(
    batch: ProblemBatch, twist: np.ndarray, force: np.ndarray, wrench: np.ndarray | None = None
) -> Violations:
    """How far answers are from satisfying every condition of the module's header.

    twist: (N, 3), m, m, rad. force: (N, m, 2), along normal and tangent. wrench: (N, 3), N and N m; without it the
    forces are taken up to scale, and neither it nor the level is judged.
    """
    twist, force = np.asarray(twist, np.float64), np.asarray(force, np.float64)
    one = np.ones_like(batch.length)
    scale = np.stack([one, one, batch.length], axis=1)
    v, rows, on = twist * scale, batch.rows(), batch.active
    slip = (np.einsum("nmij,nj->nmi", rows, v) - batch.approach()) / batch.speed()[:, None, None]
    total = np.where(on, np.abs(force[..., 0]), 0.0).sum(axis=1)
    total = np.where(total > 0, total, np.abs(force).max(axis=(1, 2), initial=0.0))
    f = force / np.where(total > 0, total, 1.0)[:, None, None]
    limit = batch.friction * np.maximum(f[..., 0], 0.0)
    opposing = np.where(slip[..., 1] < 0, limit, -limit)
    applied = np.where(on[..., None], f, 0.0)
    summed = np.einsum("nmi,nmij->nj", applied, rows)

    def largest(each: np.ndarray, where: np.ndarray = on) -> np.ndarray:
        return np.where(where, each, 0.0).max(axis=1, initial=0.0)

    wrong, off, given = np.zeros(len(batch)), np.zeros(len(batch)), summed
    if wrench is not None:
        given = np.asarray(wrench, np.float64) / scale
        moving = (total > 0) | given.any(axis=1)
        wrong = np.linalg.norm(given / np.where(total > 0, total, 1.0)[:, None] - summed, axis=1)
        off = np.where(moving, np.abs(level(batch, given) - 1), 0.0)
    parts = Violations(
        penetration=largest(np.maximum(-slip[..., 0], 0.0)),
        complementarity=largest(np.minimum(np.maximum(slip[..., 0], 0.0), np.abs(f[..., 0]))),
        negative=largest(np.maximum(-f[..., 0], 0.0)),
        cone=largest(np.maximum(np.abs(f[..., 1]) - limit, 0.0)),
        friction=largest(np.minimum(np.abs(slip[..., 1]), np.abs(f[..., 1] - opposing))),
        inactive=largest(np.abs(f).max(axis=2), ~on),
        flow=_flow_error(batch, v, given),
        wrench=wrong,
        level=off,
    )
    finite = np.isfinite(twist).all(axis=1) & np.isfinite(force).all(axis=(1, 2))
    return Violations(*(np.where(finite & np.isfinite(part), part, np.inf) for part in parts))


def level(batch: ProblemBatch, wrench: np.ndarray) -> np.ndarray:
    """H^(1 / degree): homogeneous of degree one."""
    largest = np.abs(wrench).max(axis=1)
    unit = wrench / np.where(largest > 0, largest, 1.0)[:, None]
    return largest * np.maximum(batch.value(unit), 0.0) ** (1 / batch.degree)


def _flow_error(batch: ProblemBatch, v: np.ndarray, wrench: np.ndarray) -> np.ndarray:
    """Sine of the angle between the normalised twist and grad H of the wrench."""
    size = np.linalg.norm(wrench, axis=1)
    g = batch.gradient(wrench / np.where(size > 0, size, 1.0)[:, None])
    lengths = np.linalg.norm(g, axis=1) * np.linalg.norm(v, axis=1)
    sine = np.linalg.norm(np.cross(g, v), axis=1) / np.where(lengths > 0, lengths, 1.0)
    sine = np.where((lengths > 0) & (np.einsum("ni,ni->n", g, v) > 0), sine, 1.0)
    return np.where((size == 0) & ~v.any(axis=1), 0.0, sine)


def closing(batch: ProblemBatch) -> np.ndarray:
    """(N,): how much the most violated contact would be by a slider that stays, over `speed`; at most zero if FREE."""
    return np.where(batch.active, batch.approach()[..., 0], -np.inf).max(axis=1, initial=-np.inf) / batch.speed()
