"""Looking for any answer at all to a contact problem, by a method of its own."""

from typing import NamedTuple

import numpy as np

from pushjax.verify.batch import ProblemBatch, products
from pushjax.verify.conditions import CLEAN, level, violations

# Starts followed together: their numbers stay in the processor's cache.
CHUNK = 4000
# Of the search's descents: the most steps; a fall of |residual|^2 in nine steps that is none; the range of the damping
# at the start (powers of ten); the spread of rho between starts; the share of starts that take a guess at the modes.
MOST_STEPS, STALLED, DAMPING, RHO_SPREAD, MODE_SHARE = 120, 0.97, (-8.0, -2.0), 1.0, 0.8
# A symmetric matrix's entries, and where they stand in it.
UPPER = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
FULL = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])


class Searched(NamedTuple):
    """What `search` found.

    found: (N,), whether an answer with no violation above CLEAN. twist: (N, 3), m, m, rad; force: (N, m, 2) and
    wrench: (N, 3), on H = 1, N and N m: of the first such answer; zero where there is none. tried, reached: (N,), how
    many starts were followed to their end, and how many of these came to an answer.
    """

    found: np.ndarray
    twist: np.ndarray
    force: np.ndarray
    wrench: np.ndarray
    tried: np.ndarray
    reached: np.ndarray


def search(batch: ProblemBatch, starts: int = 50, seed: int = 0, portions: tuple[int, ...] = (2, 8)) -> Searched:
    """Looks for any answer at all, from `starts` random starts a problem.

    From each start the conditions, as smooth equations (`_Equations`), are solved by Levenberg and Marquardt's method;
    what comes out is judged by `violations`. Starts are taken in `portions`, then all the rest; a problem with an
    answer leaves after each. One that stays is answered at once, by zero. Finding nothing proves nothing, but says
    more the more starts there were. Different batches or portions draw different starts from one seed.
    """
    n, m = batch.friction.shape
    batch, order = batch.gathered()  # time goes with the square of the number of contacts, padding or not
    rng = np.random.default_rng(seed)
    twist, force, wrench = np.zeros((n, 3)), np.zeros((*order.shape, 2)), np.zeros((n, 3))
    still = violations(batch, twist, force).worst() <= CLEAN
    result = Searched(still, twist, force, wrench, np.zeros(n, int), np.zeros(n, int))
    done = 0
    for portion in (*portions, starts):
        portion = min(portion, starts - done)
        done += portion
        left = np.flatnonzero(~result.found)
        size = max(CHUNK // max(portion, 1), 1)
        for begin in range(0, len(left) if portion else 0, size):
            where = left[begin : begin + size]
            with np.errstate(all="ignore"):  # a start may run off to infinity; it is judged with the others
                answers = _follow(batch.take(where), portion, rng)
            for field, values in zip(result, answers, strict=True):
                field[where] += values
    every = np.zeros((n, m, 2))
    every[np.arange(n)[:, None], order] = result.force
    return result._replace(force=every)


def _follow(batch: ProblemBatch, starts: int, rng: np.random.Generator) -> Searched:
    """Follows `starts` starts of each problem."""
    n = len(batch)
    equations = _Equations(batch, np.repeat(np.arange(n), starts), rng)
    y = equations.start(rng)
    y = equations.follow_modes(y, rng)
    y = equations.descend(y, 10 ** rng.uniform(*DAMPING, y.shape[1]))
    twist, force, wrench = equations.answer(y, batch)
    clean = violations(batch.take(equations.problem), twist, force, wrench).worst() <= CLEAN
    clean = clean.reshape(n, starts)
    first = np.arange(n) * starts + clean.argmax(axis=1)
    found = np.asarray(clean.any(axis=1))
    twist, force, wrench = (
        np.where(found.reshape(-1, *[1] * (a.ndim - 1)), a[first], 0.0) for a in (twist, force, wrench)
    )
    return Searched(found, twist, force, wrench, np.full(n, starts), clean.sum(axis=1))


class _Equations:
    """The conditions as 2 m smooth equations in the 2 m forces, for many starts at once; starts are the last axis.

    H is scaled such that its mean Hessian over the sphere has the trace 3, lengths to the problem's speed, and twists
    to V = grad H(F), so that the forces' size is an unknown too: f = y / rho, rho being about the change of w_n by f_n.
    With phi(a, b) = a + b - |(a, b)| (Fischer 1992), zero where 0 <= a _|_ b >= 0, a contact's equations are

        phi(f_n, w_n + gap) = 0,      phi(mu f_n + f_t, -phi(mu f_n - f_t, -w_t)) = 0,

    the second for a box whose size depends on f_n (Billups 1995). rho is varied at random between starts: it changes
    where a descent ends that does not end in an answer, and so gives starts that fail together another chance.
    """

    def __init__(self, batch: ProblemBatch, problem: np.ndarray, rng: np.random.Generator):
        n, m = batch.friction.shape
        on = batch.active
        table = batch.hessian_table()
        mean = table.mean(axis=3) if batch.degree == 2 else table[..., :3].mean(axis=3)
        size = np.trace(mean, axis1=1, axis2=2) / 3
        mean = mean / size[:, None, None]
        rows = np.where(on[..., None, None], batch.rows(), 0.0)
        ahead = np.where(on[..., None], batch.approach() / batch.speed()[:, None, None], -1.0)
        rho = np.where(on, np.einsum("nmi,nij,nmj->nm", rows[:, :, 0], mean, rows[:, :, 0]), 1.0)
        upper = np.stack([table[:, i, j] for i, j in UPPER], axis=1) / size[:, None, None]
        flat = rows.reshape(n, 2 * m, 3)

        def each(array: np.ndarray) -> np.ndarray:
            return np.moveaxis(array, 0, -1)[..., problem]

        self.degree, self.problem = batch.degree, problem
        self.table = each(upper)  # (6, q, B)
        self.rows = each(flat)  # (2 m, 3, B)
        self.ahead = each(ahead.reshape(n, 2 * m))  # (2 m, B)
        self.friction = each(np.where(on, batch.friction, 0.0))  # (m, B)
        self.active = each(on)  # (m, B)
        spread = np.exp(RHO_SPREAD * rng.normal(size=len(problem)))
        self.rho = np.repeat(each(rho), 2, axis=0) * spread  # (2 m, B)
        # forces whose wrench is about the one of a given twist
        self.resisting = np.linalg.pinv(np.swapaxes(flat, 1, 2)) @ np.linalg.inv(mean)

    def take(self, keep: np.ndarray) -> "_Equations":
        part = object.__new__(_Equations)
        part.degree = self.degree
        for name in ("problem", "table", "rows", "ahead", "friction", "active", "rho"):
            setattr(part, name, getattr(self, name)[..., keep])
        return part

    def flow(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Wrench (3, B), hess H (3, 3, B) and the twist grad H (3, B)."""
        wrench = np.einsum("ib,ijb->jb", y / self.rho, self.rows)
        upper = self.table[:, 0] if self.degree == 2 else np.einsum("ijb,jb->ib", self.table, products(wrench, 4))
        hessian = upper[FULL]
        return wrench, hessian, np.einsum("ijb,jb->ib", hessian, wrench) / (self.degree - 1)

    def slips(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """w (2 m, B), its normal part with the gap, and its derivative by y (2 m, 2 m, B)."""
        _, hessian, twist = self.flow(y)
        slip = np.einsum("ijb,jb->ib", self.rows, twist) - self.ahead
        through = np.einsum("ijb,kjb->ikb", hessian, self.rows)
        return slip, np.einsum("kjb,jib->kib", self.rows, through) / self.rho

    def residual(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The equations' left sides (2 m, B) and their derivative (2 m, 2 m, B)."""
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
        """Random forces in the cones, half of them such that some contacts' normal motion is about right.

        The other half resists a random twist: on an ill-conditioned surface random forces hardly ever do.
        """
        m, count = self.friction.shape
        pushes = np.where((rng.random((m, count)) < 0.6) & self.active, rng.exponential(size=(m, count)), 0.0)
        side = rng.uniform(-1, 1, (m, count))
        side = np.where(rng.random((m, count)) < 0.5, np.sign(side), side)
        force = _interleave(pushes, side * self.friction * pushes)
        twist = self.flow(force * self.rho)[2]
        motion = np.einsum("ijb,jb->ib", self.rows[0::2], twist)
        wanted, given = (motion * self.ahead[0::2] * pushes).sum(axis=0), (motion**2 * pushes).sum(axis=0)
        unit = 1 / np.maximum(np.linalg.norm(twist, axis=0), 1e-6)  # the factor that makes the twist one
        factor = wanted / np.where(given > 0, given, 1.0)
        force *= np.where(factor > 1e-3 * unit, np.minimum(factor, 10 * unit), unit) ** (1 / (self.degree - 1))

        other = np.einsum("bij,jb->ib", self.resisting[self.problem], rng.normal(size=(3, count)))
        other *= np.where(other[0::2].sum(axis=0) < 0, -1.0, 1.0)
        force = np.where(rng.random(count) < 0.5, self.in_cone(other), force)
        return force * self.rho * 10 ** (0.3 * rng.normal(size=count))

    def in_cone(self, force: np.ndarray) -> np.ndarray:
        """The forces, clipped to the friction cones."""
        normal = np.maximum(force[0::2], 0.0)
        limit = self.friction * normal
        return _interleave(normal, np.clip(force[1::2], -limit, limit))

    def follow_modes(self, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Most starts take a few steps towards a random choice of modes first; no matter whether it has an answer.

        The choice is of one to three edges of cones (what an answer can do with, wrenches being in three dimensions):
        the contact sticks if both of its edges are chosen.
        """
        count = y.shape[1]
        drawn = rng.random(y.shape) + np.repeat(2.0 * ~self.active, 2, axis=0)
        rank = drawn.argsort(axis=0).argsort(axis=0)
        chosen = rank < rng.choice([1, 2, 3], p=[0.1, 0.3, 0.6], size=count)
        left, right = chosen[0::2] & self.active, chosen[1::2] & self.active
        apart, stick = ~(left | right), left & right
        slope = self.friction * np.where(left, 1.0, -1.0)
        damping = 10 ** rng.uniform(-13, -6, count)
        n = np.arange(0, len(y), 2)
        end = y
        for _ in range(4 if self.degree == 2 else 8):
            slip, by_y = self.slips(end)
            normal, tangent = end[0::2], end[1::2]
            value = _interleave(
                np.where(apart, normal, slip[0::2]),
                np.where(stick, slip[1::2], tangent - np.where(apart, 0.0, slope) * normal),
            )
            by_y *= _interleave(~apart, stick)[:, None]
            by_y[n, n] += apart
            by_y[n + 1, n] -= np.where(apart | stick, 0.0, slope)
            by_y[n + 1, n + 1] += ~stick
            end = end - _damped_step(value, by_y, damping)
        taken = (rng.random(count) < MODE_SHARE) & np.isfinite(end).all(axis=0)
        return np.where(taken, end, y)

    def descend(self, y: np.ndarray, damping: np.ndarray) -> np.ndarray:
        """Levenberg and Marquardt's method on |residual|^2, until that is zero or hardly falls any more."""
        equations, end, index = self, y.copy(), np.arange(y.shape[1])
        value, by_y = equations.residual(y)
        merit = (value**2).sum(axis=0)
        earlier = merit
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
            if k % 3:
                continue
            finished = ~(merit > 1e-26)
            if k % 9 == 0:
                finished |= ~(merit < STALLED * earlier)
                earlier = merit
            if k < MOST_STEPS and finished.mean() < 0.1:
                continue
            end[:, index] = y
            index, equations = index[~finished], equations.take(~finished)
            y, value, by_y, merit, damping, earlier = (
                a[..., ~finished] for a in (y, value, by_y, merit, damping, earlier)
            )
            if not len(index):
                break
        return end

    def answer(self, y: np.ndarray, batch: ProblemBatch) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Twist (B, 3), force (B, m, 2) and wrench (B, 3) in the units of `batch`, the wrench on H = 1."""
        force = self.in_cone(y / self.rho)
        wrench, _, twist = self.flow(force * self.rho)
        part = batch.take(self.problem)
        size = level(part, wrench.T)
        size = np.where(size > 0, size, 1.0)[:, None]
        one = np.ones_like(part.length)
        arms = np.stack([one, one, part.length], axis=1)
        return (
            twist.T * part.speed()[:, None] / arms,
            force.T.reshape(*part.friction.shape, 2) / size[..., None],
            wrench.T * arms / size,
        )


def _fischer_burmeister(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """a + b - |(a, b)| and its derivatives; at the corner one of its generalised ones."""
    size = np.sqrt(a * a + b * b) + np.finfo(float).tiny
    return a + b - size, 1 - a / size, 1 - b / size


def _interleave(normal: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """(2 m, B) of twice (m, B): each contact's normal entry, then its tangential one."""
    return np.stack([normal, tangent], axis=1).reshape(-1, *normal.shape[1:])


def _damped_step(value: np.ndarray, by_y: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """(J'J + damping)^-1 J' value for each of the last axis, by elimination."""
    r = np.einsum("kib,kb->ib", by_y, value)
    n, a = len(r), np.empty_like(by_y)
    for i in range(n):
        a[i, i:] = np.einsum("kb,kjb->jb", by_y[:, i], by_y[:, i:])
        a[i:, i] = a[i, i:]
    a[np.arange(n), np.arange(n)] += damping
    for k in range(n):
        inverse = 1 / a[k, k]
        below = a[k + 1 :, k] * inverse
        a[k + 1 :, k + 1 :] -= below[:, None] * a[k, k + 1 :]
        r[k + 1 :] -= below * r[k]
        a[k, k + 1 :] *= inverse
        r[k] *= inverse
    for k in range(n - 2, -1, -1):
        r[k] -= (a[k, k + 1 :] * r[k + 1 :]).sum(axis=0)
    return r
