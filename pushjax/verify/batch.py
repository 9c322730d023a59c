"""A batch of contact problems as plain arrays, and the polynomials of their surfaces."""

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from pushjax.limit_surface import Ellipsoid, LimitSurface, Quartic

if TYPE_CHECKING:
    from pushjax.solve.contacts import Contacts

MONOMIALS = "xxxx yyyy zzzz xxxy xxxz xyyy yyyz xzzz yzzz xxyy xxzz yyzz xxyz xyyz xyzz".split()
SECOND = "xx yy zz xy xz yz".split()


def _second_derivatives() -> np.ndarray:
    """(15, 3, 3, 6): hess of each monomial, in coefficients of the six products of two coordinates."""
    table = np.zeros((15, 3, 3, 6))
    for k, monomial in enumerate(MONOMIALS):
        for i, j in np.ndindex(3, 3):
            first = monomial.count("xyz"[i])
            rest = monomial.replace("xyz"[i], "", 1)
            factor = first * rest.count("xyz"[j])
            if factor:
                table[k, i, j, SECOND.index(rest.replace("xyz"[j], "", 1))] = factor
    return table


HESSIANS = _second_derivatives()


@dataclass(frozen=True)
class ProblemBatch:
    """N contact problems of m contacts each, all on surfaces of one degree. Body frame, m; float64.

    coefficients: (N, 3, 3), the A of H = F' A F, for degree 2; (N, 15), in the order of `Quartic`, for degree 4.
    length: (N,). point, normal (inward, unit), displacement: (N, m, 2). friction, gap, active: (N, m).
    """

    degree: int
    coefficients: np.ndarray
    length: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    displacement: np.ndarray
    friction: np.ndarray
    gap: np.ndarray
    active: np.ndarray

    @staticmethod
    def of(surface: LimitSurface, contacts: "Contacts") -> "ProblemBatch":
        """The batch of a `Contacts` and a surface whose arrays have a leading axis; a surface without one is shared."""
        if isinstance(surface, Ellipsoid):
            coefficients = np.asarray(surface.A, np.float64)
        elif isinstance(surface, Quartic):
            coefficients = np.asarray(surface.coefficients, np.float64)
        else:
            raise TypeError(f"surface must be an Ellipsoid or a Quartic; got {type(surface).__name__}")
        own = {2: 2, 4: 1}[surface.degree]
        names = ("point", "normal", "displacement", "friction", "gap")
        arrays = {name: np.asarray(getattr(contacts, name), np.float64) for name in names}
        active = np.asarray(contacts.active, bool)
        n = len(active)
        # padding may hold anything, NaN too
        arrays = {k: np.where(active.reshape(*active.shape, *[1] * (a.ndim - 2)), a, 0.0) for k, a in arrays.items()}
        return ProblemBatch(
            surface.degree,
            np.broadcast_to(coefficients, (n, *coefficients.shape[coefficients.ndim - own :])),
            np.broadcast_to(np.asarray(surface.length, np.float64), (n,)),
            **arrays,
            active=active,
        )

    def __len__(self) -> int:
        return len(self.point)

    def take(self, index: Any) -> "ProblemBatch":
        """The problems at `index`: integers, a slice or a mask over N."""
        return ProblemBatch(self.degree, *(getattr(self, f.name)[index] for f in fields(self)[1:]))

    def gathered(self) -> tuple["ProblemBatch", np.ndarray]:
        """Active contacts first, and as many columns as the most there are; and which (N, fewer) contacts they are."""
        most = max(int(self.active.sum(axis=1).max(initial=0)), 1)
        order = np.argsort(~self.active, axis=1, kind="stable")[:, :most]
        row = np.arange(len(self))[:, None]
        parts = {f.name: getattr(self, f.name)[row, order] for f in fields(self)[3:]}
        return ProblemBatch(self.degree, self.coefficients, self.length, **parts), order

    def speed(self) -> np.ndarray:
        """(N,), m: the unit of displacement, max |displacement| + |gap| over the active contacts.

        Both move a contact's condition by as much; with neither, nothing moves, and the unit is one.
        """
        each = np.linalg.norm(self.displacement, axis=2) + np.abs(self.gap)
        largest = np.where(self.active, each, 0.0).max(axis=1, initial=0.0)
        return np.where(largest > 0, largest, 1.0)

    def rows(self) -> np.ndarray:
        """(N, m, 2, 3): a_n and a_t of every contact."""
        tangent = np.stack([-self.normal[..., 1], self.normal[..., 0]], axis=2)
        direction = np.stack([self.normal, tangent], axis=2)
        x, y = self.point[..., None, 0], self.point[..., None, 1]
        arm = (x * direction[..., 1] - y * direction[..., 0]) / self.length[:, None, None]
        return np.concatenate([direction, arm[..., None]], axis=3)

    def approach(self) -> np.ndarray:
        """(N, m, 2), m: what the contact point must do along (n, t) to stay with its pusher, the gap taken off."""
        tangent = np.stack([-self.normal[..., 1], self.normal[..., 0]], axis=2)
        along = np.einsum("nmi,nmi->nm", self.displacement, self.normal) - self.gap
        return np.stack([along, np.einsum("nmi,nmi->nm", self.displacement, tangent)], axis=2)

    def hessian_table(self) -> np.ndarray:
        """(N, 3, 3, q): hess H(F) is this times the q products of F's coordinates (degree 2: times one)."""
        if self.degree == 2:
            return (self.coefficients + np.swapaxes(self.coefficients, 1, 2))[..., None]
        return np.einsum("nk,kijq->nijq", self.coefficients, HESSIANS)

    def gradient(self, wrench: np.ndarray) -> np.ndarray:
        """grad H of normalised wrenches (N, 3)."""
        hessian = np.einsum("nijq,nq->nij", self.hessian_table(), products(wrench.T, self.degree).T)
        return np.einsum("nij,nj->ni", hessian, wrench) / (self.degree - 1)  # Euler's identity

    def value(self, wrench: np.ndarray) -> np.ndarray:
        """H of normalised wrenches (N, 3)."""
        return np.einsum("ni,ni->n", wrench, self.gradient(wrench)) / self.degree


def products(f: np.ndarray, degree: int) -> np.ndarray:
    """What a Hessian is linear in: (q, …) for wrenches (3, …)."""
    x, y, z = f
    return np.ones((1, *x.shape)) if degree == 2 else np.stack([x * x, y * y, z * z, x * y, x * z, y * z])
