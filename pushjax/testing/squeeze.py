"""The squeeze power, which is positive if the hand can press through the slider; only then is a jam possible."""

from itertools import combinations

import numpy as np
from scipy.optimize import linprog

from pushjax.testing.batch import ProblemBatch

# The determinant of three unit wrenches is zero up to roundoff if it is at most SINGULAR. If it exceeds REGULAR, the
# relative weights of balanced forces are exact to SHARE.
SINGULAR, REGULAR = 1e-13, 1e-6
SHARE = 1e-10


def squeeze_power(batch: ProblemBatch) -> np.ndarray:
    """Return the largest work of the pushers on contact forces that balance each other, per newton of normal force.

    It is max sum f . displacement - sum f_n gap over forces in the friction cones with no resultant wrench and with
    sum f_n = 1. If it is not positive, the problem has a solution (existence theorem of copositive complementarity
    problems). If it is positive, the problem may or may not have one. It is zero up to roundoff for pushers that move
    as one rigid body, because they do no work on balanced forces.

    Each problem takes one linear program, with forces that balance to 1e-10.

    Args:
        batch: The problems.

    Returns:
        The squeeze power, (N,), in m; -inf where no forces balance each other.

    Raises:
        RuntimeError: If a linear program cannot be solved.
    """
    wrenches, powers = _edges(batch)
    best = np.full(len(batch), -np.inf)
    for k, on in enumerate(np.repeat(batch.active, 2, axis=1)):
        if not on.any():
            continue
        unit = np.abs(powers[k, on]).max() or 1.0
        # If forces barely balance, the simplex method may fail to decide whether they do.
        for method in ("highs", "highs-ipm"):
            result = linprog(
                -powers[k, on] / unit,
                A_eq=np.vstack([wrenches[k, on].T, np.ones(on.sum())]),
                b_eq=[0, 0, 0, 1],
                method=method,
                options={"primal_feasibility_tolerance": SHARE, "dual_feasibility_tolerance": SHARE},
            )
            if result.status == 0:
                best[k] = -result.fun * unit
            if result.status in (0, 2):
                break
        else:
            raise RuntimeError(f"linear program {k}: {result.message}")
    return best


def squeeze_power_enumerated(batch: ProblemBatch) -> np.ndarray:
    """Return the squeeze power (N,), m, of a large batch, as the largest over all basic solutions."""
    # Four edges whose wrenches span the space balance in only one way: the weight of each edge is the determinant of
    # the other three. `squeeze_power` solves the problems in which four edges nearly lie in one plane, or in which no
    # four edges span the space (for example without friction anywhere).
    wrenches, powers = _edges(batch)
    on = np.repeat(batch.active, 2, axis=1)
    n, edges = on.shape
    best = np.full(n, -np.inf)
    lengths = np.linalg.norm(wrenches, axis=2, keepdims=True)
    lengths = np.where(lengths > 0, lengths, 1.0)
    # For unit wrenches, a small determinant means degeneracy whatever the moment arms. The weights are scaled back
    # below.
    w = wrenches / lengths
    triple: dict[tuple[int, ...], np.ndarray] = {
        (i, j, k): np.einsum("ni,ni->n", w[:, i], np.cross(w[:, j], w[:, k]))
        for i, j, k in combinations(range(edges), 3)
    }
    spanning, doubtful = np.zeros(n, bool), np.zeros(n, bool)
    for four in combinations(range(edges), 4):
        shares = [(-1) ** k * triple[four[:k] + four[k + 1 :]] for k in range(4)]
        share = np.stack(shares, axis=1)
        size = np.where(on[:, four].all(axis=1), np.abs(share).max(axis=1), 0.0)
        regular = size > REGULAR
        spanning |= regular
        doubtful |= ~regular & (size > SINGULAR)
        share = share / lengths[:, four, 0]
        share *= np.where(share.sum(axis=1) < 0, -1.0, 1.0)[:, None]
        share /= np.where(regular, np.abs(share).sum(axis=1), 1.0)[:, None]
        balanced = regular & (share >= -SHARE).all(axis=1)
        share = np.maximum(share, 0.0)
        total = np.where(balanced, share.sum(axis=1), 1.0)
        power = (share * powers[:, four]).sum(axis=1) / total
        best = np.where(balanced, np.maximum(best, power), best)
    # The forces of a single contact cannot balance each other.
    rest = (doubtful | ~spanning) & (batch.active.sum(axis=1) > 1)
    if rest.any():
        best[rest] = squeeze_power(batch.take(rest))
    return best


def _edges(batch: ProblemBatch) -> tuple[np.ndarray, np.ndarray]:
    """Return the normalized wrench (N, 2 m, 3) and the power (N, 2 m), in m, of each friction-cone edge."""
    # Both are at unit normal force. The power is f . displacement - f_n gap.
    rows, motion = batch.rows(), batch.approach()
    signed_friction = batch.friction[..., None] * np.array([1.0, -1.0])
    wrench = rows[:, :, None, 0] + signed_friction[..., None] * rows[:, :, None, 1]
    power = motion[..., None, 0] + signed_friction * motion[..., None, 1]
    n = len(batch)
    return wrench.reshape(n, -1, 3), power.reshape(n, -1)
