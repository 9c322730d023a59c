"""Whether the hand can press through the slider: what makes a jam possible."""

from itertools import combinations

import numpy as np
from scipy.optimize import linprog

from pushjax.verify.batch import ProblemBatch

# A determinant of unit wrenches: zero to rounding below the first; beyond the second it leaves the shares of a
# balanced load exact to SHARE.
SINGULAR, REGULAR = 1e-13, 1e-6
SHARE = 1e-10


def _edges(batch: ProblemBatch) -> tuple[np.ndarray, np.ndarray]:
    """Wrenches (N, 2 m, 3) of the cones' edges with unit normal force, and each one's power (N, 2 m), gap taken off."""
    rows, b = batch.rows(), batch.approach()
    slope = batch.friction[..., None] * np.array([1.0, -1.0])
    wrench = rows[:, :, None, 0] + slope[..., None] * rows[:, :, None, 1]
    power = b[..., None, 0] + slope * b[..., None, 1]
    n = len(batch)
    return wrench.reshape(n, -1, 3), power.reshape(n, -1)


def squeeze_power(batch: ProblemBatch) -> np.ndarray:
    """(N,), m: the most work the pushers can do on contact forces that balance each other, a newton of them in all.

    max sum f . displacement - sum f_n gap over forces in the friction cones with no resultant wrench and sum f_n = 1;
    -inf where there are none. A problem whose squeeze power is not positive has an answer (existence theorem of
    copositive complementarity problems); where it is positive there may be one or not. Pushers that move as one body
    do no work on balanced forces: zero, give or take rounding. By linear programming, one at a time; a load balances
    to 1e-10 (SHARE).
    """
    wrenches, powers = _edges(batch)
    best = np.full(len(batch), -np.inf)
    for k, on in enumerate(np.repeat(batch.active, 2, axis=1)):
        if not on.any():
            continue
        unit = np.abs(powers[k, on]).max() or 1.0
        for method in ("highs", "highs-ipm"):  # where loads hardly balance, the simplex may not know whether they do
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
    """`squeeze_power` for large batches: the best of all basic solutions.

    Four edges whose wrenches span space balance in one way: by their shares, the determinants of the other three. A
    problem with four that are nearly in one plane, or with none that span (no friction anywhere, say), goes to the
    linear program.
    """
    wrenches, powers = _edges(batch)
    on = np.repeat(batch.active, 2, axis=1)
    n, edges = on.shape
    best = np.full(n, -np.inf)
    lengths = np.linalg.norm(wrenches, axis=2, keepdims=True)
    lengths = np.where(lengths > 0, lengths, 1.0)
    w = wrenches / lengths  # so that a determinant near zero is degenerate whatever the arms; undone in the shares
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
    rest = (doubtful | ~spanning) & (batch.active.sum(axis=1) > 1)  # one contact cannot hold itself
    if rest.any():
        best[rest] = squeeze_power(batch.take(rest))
    return best
