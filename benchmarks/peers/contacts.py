"""Contact problems solved by scipy: the friction complementarity problem as equations, and a general root finder.

scipy has no solver for complementarity problems. The problem is therefore written as equations for the forces
(f_n, f_t) of each contact. The twist is V = grad H(sum of J'f), whose scale is free. The equations are

    f_n = max(0, f_n - g),    f_t = clip(f_t - w_t, -mu f_n, mu f_n),

where g is the gap that V leaves and w_t is the slip. MINPACK's hybrid method, with the Jacobian given, finds a root
from most starts. It cannot distinguish a jam from a bad start, so a problem is given up after `STARTS` starts.
"""

import time
from typing import NamedTuple

import numpy as np

from benchmarks.peers.fits import gram

STARTS = 10
RESIDUAL = 1e-9  # relative to the largest displacement
# (9, 9, 15): maps products of two entries of F to second derivatives of a quartic, one matrix per coefficient
CURVATURE = np.stack([gram(unit, 4).reshape(9, 9) for unit in np.eye(15)], axis=-1)


class Solved(NamedTuple):
    """Solutions of a batch of contact problems."""

    twist: np.ndarray  # (n, 3), body frame; NaN where no solution was found
    processor: float  # CPU time of all problems together, s

    @property
    def found(self) -> np.ndarray:
        """Whether a solution was found, (n,)."""
        return np.isfinite(self.twist[:, 0])


def solve(coefficients, length, contacts, starts: int = STARTS, seed: int = 0) -> Solved:
    """Solve a batch of contact problems, one after another, each from at most `starts` random starts."""
    # coefficients: of quartics, (n, 15); length: (n,), m; contacts: batched `pj.Contacts`, all active
    rng = np.random.default_rng(seed)
    busy = time.process_time()
    problems = without_units(coefficients, length, contacts)
    twist = np.full((len(problems), 3), np.nan)
    for k, problem in enumerate(problems):
        found = problem.root(rng, starts)
        if found is not None:
            twist[k] = found
    return Solved(twist, time.process_time() - busy)


def without_units(coefficients, length, contacts) -> list["Problem"]:
    """Return the problems of a batch, with arguments as in `solve`."""
    parts = [np.asarray(part, float) for part in (contacts.point, contacts.normal, contacts.displacement)]
    for scalar in (contacts.friction, contacts.gap):
        parts.append(np.broadcast_to(np.asarray(scalar, float), parts[0].shape[:2]))
    each = zip(np.asarray(coefficients, float), np.asarray(length, float), *parts, strict=True)
    return [Problem(*part) for part in each]


class Problem:
    """One contact problem without units: displacements scaled to one, torques divided by the length."""

    def __init__(self, coefficients, length, point, normal, displacement, friction, gap):
        self.size = max(np.abs(displacement).max(), np.abs(gap).max(), 1e-12)
        tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
        axes = np.stack([normal, tangent], axis=1)  # (contacts, 2, 2)
        arm = (point[:, None, 0] * axes[:, :, 1] - point[:, None, 1] * axes[:, :, 0]) / length
        # each row is the wrench of a unit force: first all normals, then all tangents
        self.rows = np.concatenate([axes, arm[:, :, None]], axis=2).transpose(1, 0, 2).reshape(-1, 3)
        away = np.einsum("cax,cx->ac", axes, displacement) / self.size
        self.away = np.concatenate([away[0] - gap / self.size, away[1]])
        self.friction, self.length, self.m = friction, length, len(normal)
        self.curvature = CURVATURE @ coefficients

    def twist(self, force):
        """Return the scaled twist, (3,), and its derivative by the forces, (3, 2 contacts)."""
        # The forces, (2 contacts,), are first all normal, then all tangential ones. H is homogeneous of degree 4, so
        # its gradient is its Hessian times F / 3.
        wrench = force @ self.rows
        hessian = (self.curvature @ np.outer(wrench, wrench).ravel()).reshape(3, 3)
        return hessian @ wrench / 3, hessian @ self.rows.T

    def residual(self, force):
        """Return the residual of the equations, (2 contacts,), and its Jacobian, for forces as in `twist`."""
        m = self.m
        v, by_force = self.twist(force)
        motion, slope = self.rows @ v - self.away, self.rows @ by_force
        gaps, normal, tangential = motion[:m], force[:m], force[m:]
        presses = normal - gaps > 0
        limit = self.friction * normal
        sought = tangential - motion[m:]
        sticks = np.abs(sought) < limit
        side = np.sign(sought)
        left = np.concatenate([np.where(presses, gaps, normal), tangential - np.where(sticks, sought, side * limit)])
        one = np.eye(2 * m)
        upper = np.where(presses[:, None], slope[:m], one[:m])
        sliding = one[m:] - (side * self.friction)[:, None] * one[:m]
        return left, np.concatenate([upper, np.where(sticks[:, None], slope[m:], sliding)])

    def root(self, rng, starts: int):
        """Return the twist, (3,), in SI units, of a solution found from random starts, or None if there is none."""
        from scipy.optimize import root

        for _ in range(starts):
            begin = np.concatenate([rng.uniform(0.1, 1.0, self.m), np.zeros(self.m)])
            begin *= 1 / max(np.linalg.norm(self.twist(begin)[0]), 1e-9) ** (1 / 3)
            found = root(self.residual, begin, jac=True, method="hybr", options={"xtol": 1e-12})
            force = found.x
            if np.abs(self.residual(force)[0]).max() < RESIDUAL and force[: self.m].min() > -RESIDUAL:
                v = self.twist(force)[0] * self.size
                return np.array([v[0], v[1], v[2] / self.length])
        return None
