"""Search for any solution of a contact problem, by a method that is independent of the solvers."""

from typing import NamedTuple

import numpy as np

from pushjax._math.arrays import ENTRIES, FULL
from pushjax.testing.batch import ProblemBatch, products
from pushjax.testing.condition_violations import CLEAN, level, violations

# Number of starts that are followed together, so that their numbers stay in the processor's cache.
CHUNK = 4000
# Parameters of the descents. MOST_STEPS: largest number of steps. STALLED: a descent ends if nine steps do not reduce
# |residual|^2 below this factor of its value. DAMPING: range of the initial damping, as powers of ten. RHO_SPREAD:
# standard deviation of log(rho) between starts. MODE_SHARE: fraction of starts that begin with a guess of the modes.
MOST_STEPS, STALLED, DAMPING, RHO_SPREAD, MODE_SHARE = 120, 0.97, (-8.0, -2.0), 1.0, 0.8


class SearchResult(NamedTuple):
    """The result of `search`. Twist, force and wrench are those of the first solution found, or zero without one.

    Attributes:
        found: Whether a solution without a violation above CLEAN was found, (N,).
        twist: Twists, (N, 3), in m, m, rad.
        force: Contact forces along normal and tangent, (N, m, 2), in N.
        wrench: Wrenches on H = 1, (N, 3), in N and N m.
        tried: Number of starts that were followed to their end, (N,).
        reached: Number of these starts that ended at a solution, (N,).
    """

    found: np.ndarray
    twist: np.ndarray
    force: np.ndarray
    wrench: np.ndarray
    tried: np.ndarray
    reached: np.ndarray


def search(batch: ProblemBatch, starts: int = 50, seed: int = 0, portions: tuple[int, ...] = (2, 8)) -> SearchResult:
    """Search for any solution of each problem, from random starts.

    From each start the Levenberg-Marquardt method solves the conditions, written as equations. The result counts if it
    passes `violations`. Where the slider can stay, the solution is zero, and nothing is searched. If the search finds
    nothing, that proves nothing, but it is stronger evidence with more starts.

    Args:
        batch: The problems.
        starts: Number of random starts of each problem.
        seed: Seed of the starts. With other batches or portions, the same seed gives other starts.
        portions: Sizes of the first groups of starts; the last group has all the rest. After each group, problems that
            have a solution leave the search.

    Returns:
        The solutions found.
    """
    n, m = batch.friction.shape
    batch, order = batch.gathered()  # the time grows with the square of the number of contacts, padding included
    rng = np.random.default_rng(seed)
    twist, force, wrench = np.zeros((n, 3)), np.zeros((*order.shape, 2)), np.zeros((n, 3))
    still = violations(batch, twist, force).worst() <= CLEAN
    result = SearchResult(still, twist, force, wrench, np.zeros(n, int), np.zeros(n, int))
    done = 0
    for group_size in (*portions, starts):
        group_size = min(group_size, starts - done)
        done += group_size
        left = np.flatnonzero(~result.found)
        size = max(CHUNK // max(group_size, 1), 1)
        for begin in range(0, len(left) if group_size else 0, size):
            where = left[begin : begin + size]
            with np.errstate(all="ignore"):  # a start may diverge to infinity; `violations` then rejects it
                answers = _follow(batch.take(where), group_size, rng)
            for field, values in zip(result, answers, strict=True):
                field[where] += values
    all_forces = np.zeros((n, m, 2))
    all_forces[np.arange(n)[:, None], order] = result.force
    return result._replace(force=all_forces)


def _follow(batch: ProblemBatch, starts: int, rng: np.random.Generator) -> SearchResult:
    """Return the first solution of each problem that a number of random starts reaches."""
    n = len(batch)
    problem = np.repeat(np.arange(n), starts)
    equations, repeated = _Equations.of(batch).take(problem), batch.take(problem)
    equations = equations._replace(rho=equations.rho * np.exp(RHO_SPREAD * rng.normal(size=len(problem))))
    y = equations.start(rng)
    y = equations.follow_modes(y, rng)
    y = equations.descend(y, 10 ** rng.uniform(*DAMPING, y.shape[1]))
    twist, force, wrench = equations.answer(y, repeated)
    is_solution = violations(repeated, twist, force, wrench).worst() <= CLEAN
    is_solution = is_solution.reshape(n, starts)
    first = np.arange(n) * starts + is_solution.argmax(axis=1)
    found = np.asarray(is_solution.any(axis=1))
    twist, force, wrench = (
        np.where(found.reshape(-1, *[1] * (a.ndim - 1)), a[first], 0.0) for a in (twist, force, wrench)
    )
    return SearchResult(found, twist, force, wrench, np.full(n, starts), is_solution.sum(axis=1))


class _Equations(NamedTuple):
    """The conditions as 2 m equations in the 2 m force components, for B starts at once on the last axis."""

    # H is scaled so that its mean Hessian over the sphere has trace 3. Lengths are relative to the problem's speed. The
    # equation V = grad H(F) has no free factor, so the size of the forces is an unknown too. The unknowns are y, with
    # f = y / rho, where rho is about the derivative of w_n by f_n. With phi(a, b) = a + b - |(a, b)| (Fischer 1992),
    # which is zero where 0 <= a _|_ b >= 0 and smooth except at a = b = 0, the equations of a contact are
    #
    #     phi(f_n, w_n + gap) = 0,      phi(mu f_n + f_t, -phi(mu f_n - f_t, -w_t)) = 0.
    #
    # The second is for a box whose size depends on f_n (Billups 1995). rho varies at random between starts. It changes
    # where a descent ends that does not end at a solution, and so gives starts that fail together another chance.

    degree: int
    table: np.ndarray  # (6, q, B), of the Hessian
    rows: np.ndarray  # (2 m, 3, B)
    approach: np.ndarray  # (2 m, B)
    friction: np.ndarray  # (m, B)
    active: np.ndarray  # (m, B)
    rho: np.ndarray  # (2 m, B)
    resisting: np.ndarray  # (2 m, 3, B), maps a twist to forces whose wrench approximately causes it

    @staticmethod
    def of(batch: ProblemBatch) -> "_Equations":
        """Return the equations of each problem of the batch."""
        n, m = batch.friction.shape
        active = batch.active
        table = batch.hessian_table()
        mean = table.mean(axis=3) if batch.degree == 2 else table[..., :3].mean(axis=3)
        size = np.trace(mean, axis1=1, axis2=2) / 3
        mean = mean / size[:, None, None]
        rows = np.where(active[..., None, None], batch.rows(), 0.0)
        approach = np.where(active[..., None], batch.approach() / batch.speed()[:, None, None], -1.0)
        rho = np.where(active, np.einsum("nmi,nij,nmj->nm", rows[:, :, 0], mean, rows[:, :, 0]), 1.0)
        upper = np.stack([table[:, i, j] for i, j in ENTRIES], axis=1) / size[:, None, None]
        flat = rows.reshape(n, 2 * m, 3)
        resisting = np.linalg.pinv(np.swapaxes(flat, 1, 2)) @ np.linalg.inv(mean)
        friction = np.where(active, batch.friction, 0.0)
        arrays = upper, flat, approach.reshape(n, 2 * m), friction, active, np.repeat(rho, 2, axis=1), resisting
        return _Equations(batch.degree, *(np.moveaxis(array, 0, -1) for array in arrays))

    def take(self, index: np.ndarray) -> "_Equations":
        """Return the equations at indices, or by a mask, of the last axis."""
        return _Equations(self.degree, *(array[..., index] for array in self[1:]))

    def evaluate(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the wrench (3, B), the Hessian of H (3, 3, B) and the twist grad H (3, B)."""
        wrench = np.einsum("ib,ijb->jb", y / self.rho, self.rows)
        upper = self.table[:, 0] if self.degree == 2 else np.einsum("ijb,jb->ib", self.table, products(wrench, 4))
        hessian = upper[FULL]
        return wrench, hessian, np.einsum("ijb,jb->ib", hessian, wrench) / (self.degree - 1)

    def slips(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return w (2 m, B), with the gap added to its normal part, and its Jacobian by y (2 m, 2 m, B)."""
        _, hessian, twist = self.evaluate(y)
        slip = np.einsum("ijb,jb->ib", self.rows, twist) - self.approach
        twist_change = np.einsum("ijb,kjb->ikb", hessian, self.rows)
        return slip, np.einsum("kjb,jib->kib", self.rows, twist_change) / self.rho

    def residual(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the residual of the equations (2 m, B) and its Jacobian by y (2 m, 2 m, B)."""
        slip, by_y = self.slips(y)
        normal, tangent, limit = y[0::2], y[1::2], self.friction * y[0::2]
        value = np.empty_like(y)
        value[0::2], by_normal, by_gap = _fischer_burmeister(normal, slip[0::2])
        upper, by_upper, by_slip = _fischer_burmeister(limit - tangent, -slip[1::2])
        value[1::2], by_lower, by_rest = _fischer_burmeister(tangent + limit, -upper)
        by_y[0::2] *= by_gap[:, None]
        by_y[1::2] *= (by_rest * by_slip)[:, None]
        n = np.arange(0, len(y), 2)
        by_y[n, n] += by_normal
        by_y[n + 1, n] += self.friction * (by_lower - by_rest * by_upper)
        by_y[n + 1, n + 1] += by_lower + by_rest * by_upper
        return value, by_y

    def start(self, rng: np.random.Generator) -> np.ndarray:
        """Return random starts y (2 m, B), with forces in the friction cones."""
        m, count = self.friction.shape
        normal_force = np.where((rng.random((m, count)) < 0.6) & self.active, rng.exponential(size=(m, count)), 0.0)
        side = rng.uniform(-1, 1, (m, count))
        side = np.where(rng.random((m, count)) < 0.5, np.sign(side), side)
        force = _interleave(normal_force, side * self.friction * normal_force)
        # One half of the starts: forces whose size makes the normal motion of some contacts about right.
        twist = self.evaluate(force * self.rho)[2]
        motion = np.einsum("ijb,jb->ib", self.rows[0::2], twist)
        numerator, denominator = (
            (motion * self.approach[0::2] * normal_force).sum(axis=0),
            (motion**2 * normal_force).sum(axis=0),
        )
        unit_factor = 1 / np.maximum(np.linalg.norm(twist, axis=0), 1e-6)  # scales the twist to norm one
        factor = numerator / np.where(denominator > 0, denominator, 1.0)
        force *= np.where(factor > 1e-3 * unit_factor, np.minimum(factor, 10 * unit_factor), unit_factor) ** (
            1 / (self.degree - 1)
        )

        # The other half resist a random twist, because on an ill-conditioned surface random forces hardly ever do.
        resisting_force = np.einsum("ijb,jb->ib", self.resisting, rng.normal(size=(3, count)))
        resisting_force *= np.where(resisting_force[0::2].sum(axis=0) < 0, -1.0, 1.0)
        force = np.where(rng.random(count) < 0.5, self.in_cone(resisting_force), force)
        return force * self.rho * 10 ** (0.3 * rng.normal(size=count))

    def in_cone(self, force: np.ndarray) -> np.ndarray:
        """Return the forces clipped to the friction cones."""
        normal = np.maximum(force[0::2], 0.0)
        limit = self.friction * normal
        return _interleave(normal, np.clip(force[1::2], -limit, limit))

    def follow_modes(self, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return the starts after a few Newton steps of most of them toward a random choice of contact modes."""
        # The choice need not have a solution. It consists of one to three edges of friction cones, which are enough for
        # a solution because wrenches have three dimensions.
        count = y.shape[1]
        order_key = rng.random(y.shape) + np.repeat(2.0 * ~self.active, 2, axis=0)
        rank = order_key.argsort(axis=0).argsort(axis=0)
        chosen = rank < rng.choice([1, 2, 3], p=[0.1, 0.3, 0.6], size=count)
        left, right = chosen[0::2] & self.active, chosen[1::2] & self.active
        # A contact sticks if both of its edges are chosen.
        separates, sticks = ~(left | right), left & right
        slope = self.friction * np.where(left, 1.0, -1.0)
        damping = 10 ** rng.uniform(-13, -6, count)
        n = np.arange(0, len(y), 2)
        y_end = y
        for _ in range(4 if self.degree == 2 else 8):
            slip, by_y = self.slips(y_end)
            normal, tangent = y_end[0::2], y_end[1::2]
            value = _interleave(
                np.where(separates, normal, slip[0::2]),
                np.where(sticks, slip[1::2], tangent - np.where(separates, 0.0, slope) * normal),
            )
            by_y *= _interleave(~separates, sticks)[:, None]
            by_y[n, n] += separates
            by_y[n + 1, n] -= np.where(separates | sticks, 0.0, slope)
            by_y[n + 1, n + 1] += ~sticks
            y_end = y_end - _damped_step(value, by_y, damping)
        accepted = (rng.random(count) < MODE_SHARE) & np.isfinite(y_end).all(axis=0)
        return np.where(accepted, y_end, y)

    def descend(self, y: np.ndarray, damping: np.ndarray) -> np.ndarray:
        """Minimize |residual|^2 by the Levenberg-Marquardt method, until it is zero or hardly decreases any more."""
        equations, end, index = self, y.copy(), np.arange(y.shape[1])
        value, by_y = equations.residual(y)
        merit = (value**2).sum(axis=0)
        earlier_merit = merit
        for k in range(1, MOST_STEPS + 1):
            trial = y - _damped_step(value, by_y, damping)
            trial_value, trial_by_y = equations.residual(trial)
            trial_merit = (trial_value**2).sum(axis=0)
            better = trial_merit < merit
            damping = np.where(better, np.maximum(0.15 * damping, 1e-15), np.minimum(6 * damping, 1e12))
            y, value, by_y = (
                np.where(better, new, old) for new, old in ((trial, y), (trial_value, value), (trial_by_y, by_y))
            )
            merit = np.where(better, trial_merit, merit)
            if k % 3:  # looking for finished starts at every step would take longer than it saves
                continue
            finished = ~(merit > 1e-26)  # also where the merit is NaN
            if k % 9 == 0:
                finished |= ~(merit < STALLED * earlier_merit)
                earlier_merit = merit
            if k < MOST_STEPS and finished.mean() < 0.1:  # too few to copy all arrays for
                continue
            end[:, index] = y
            index, equations = index[~finished], equations.take(~finished)
            y, value, by_y, merit, damping, earlier_merit = (
                a[..., ~finished] for a in (y, value, by_y, merit, damping, earlier_merit)
            )
            if not len(index):
                break
        return end

    def answer(self, y: np.ndarray, batch: ProblemBatch) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return twist (B, 3), force (B, m, 2) and wrench (B, 3) in the units of `batch`, with the wrench on H = 1."""
        force = self.in_cone(y / self.rho)
        wrench, _, twist = self.evaluate(force * self.rho)
        size = level(batch, wrench.T)
        size = np.where(size > 0, size, 1.0)[:, None]
        one = np.ones_like(batch.length)
        scale = np.stack([one, one, batch.length], axis=1)
        return (
            twist.T * batch.speed()[:, None] / scale,
            force.T.reshape(*batch.friction.shape, 2) / size[..., None],
            wrench.T * scale / size,
        )


def _fischer_burmeister(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return phi(a, b) and its derivatives; at the corner, one of its generalized derivatives."""
    size = np.sqrt(a * a + b * b) + np.finfo(float).tiny
    return a + b - size, 1 - a / size, 1 - b / size


def _interleave(normal: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """Return two arrays (m, B) as one (2 m, B): each contact's normal entry, then its tangential entry."""
    return np.stack([normal, tangent], axis=1).reshape(-1, *normal.shape[1:])


def _damped_step(residual: np.ndarray, jacobian: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """Return the step (J'J + damping)^-1 J' residual for each entry of the last axis, by Gaussian elimination."""
    right_side = np.einsum("kib,kb->ib", jacobian, residual)
    n, matrix = len(right_side), np.empty_like(jacobian)
    for i in range(n):
        matrix[i, i:] = np.einsum("kb,kjb->jb", jacobian[:, i], jacobian[:, i:])
        matrix[i:, i] = matrix[i, i:]
    matrix[np.arange(n), np.arange(n)] += damping
    for k in range(n):
        inverse = 1 / matrix[k, k]
        below = matrix[k + 1 :, k] * inverse
        matrix[k + 1 :, k + 1 :] -= below[:, None] * matrix[k, k + 1 :]
        right_side[k + 1 :] -= below * right_side[k]
        matrix[k, k + 1 :] *= inverse
        right_side[k] *= inverse
    for k in range(n - 2, -1, -1):
        right_side[k] -= (matrix[k, k + 1 :] * right_side[k + 1 :]).sum(axis=0)
    return right_side
