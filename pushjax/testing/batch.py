"""A batch of contact problems as NumPy arrays, and the polynomials of their limit surfaces."""

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from pushjax._math.arrays import ENTRIES
from pushjax.friction.ellipsoid import Ellipsoid
from pushjax.friction.limit_surface import LimitSurface
from pushjax.friction.quartic import MONOMIALS, Quartic

if TYPE_CHECKING:
    from pushjax.contact.problem import Contacts

# Shape (15, 3, 3, 6): of each monomial of a quartic, the Hessian as coefficients of the six products of coordinates.
_UNITS = np.eye(3, dtype=int)
_POWERS = MONOMIALS[:, None, None] - _UNITS[:, None] - _UNITS  # left by the two derivatives
_IS_PRODUCT = np.stack([(_POWERS == _UNITS[i] + _UNITS[j]).all(axis=3) for i, j in ENTRIES], axis=3)
HESSIANS = (MONOMIALS[:, :, None] * (MONOMIALS[:, None] - _UNITS))[..., None] * _IS_PRODUCT.astype(float)


@dataclass(frozen=True)
class ProblemBatch:
    """N contact problems of m contacts each, on limit surfaces of one degree. Body frame, float64.

    Attributes:
        degree: Degree of the limit surfaces, 2 or 4.
        coefficients: For degree 2 the matrices A of H = F' A F, (N, 3, 3). For degree 4 the coefficients in the order
            of `Quartic`, (N, 15).
        length: Characteristic lengths of the limit surfaces, (N,), in m.
        point: Contact points, (N, m, 2), in m.
        normal: Inward unit normals, (N, m, 2).
        displacement: Displacements of the pushers, (N, m, 2), in m.
        friction: Friction coefficients mu, (N, m).
        gap: Gaps, (N, m), in m.
        active: Which contacts exist, (N, m); the others are padding.
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
        """Return the batch of problems given by a limit surface and contacts with a leading batch axis.

        Args:
            surface: An `Ellipsoid` or a `Quartic`. If its arrays have no batch axis, all problems share it.
            contacts: A `Contacts` whose arrays have a leading axis of N problems.

        Raises:
            TypeError: If the surface is of another type.
        """
        if isinstance(surface, Ellipsoid):
            coefficients = np.asarray(surface.A, np.float64)
        elif isinstance(surface, Quartic):
            coefficients = np.asarray(surface.coefficients, np.float64)
        else:
            raise TypeError(f"surface must be an Ellipsoid or a Quartic; got {type(surface).__name__}")
        surface_ndim = {2: 2, 4: 1}[surface.degree]
        names = ("point", "normal", "displacement", "friction", "gap")
        arrays = {name: np.asarray(getattr(contacts, name), np.float64) for name in names}
        active = np.asarray(contacts.active, bool)
        n = len(active)
        # Padding may hold any numbers, NaN included.
        arrays = {k: np.where(active.reshape(*active.shape, *[1] * (a.ndim - 2)), a, 0.0) for k, a in arrays.items()}
        return ProblemBatch(
            surface.degree,
            np.broadcast_to(coefficients, (n, *coefficients.shape[coefficients.ndim - surface_ndim :])),
            np.broadcast_to(np.asarray(surface.length, np.float64), (n,)),
            **arrays,
            active=active,
        )

    def __len__(self) -> int:
        return len(self.point)

    def take(self, index: Any) -> "ProblemBatch":
        """Return the problems at `index`: integers, a slice, or a mask over N."""
        return ProblemBatch(self.degree, *(getattr(self, f.name)[index] for f in fields(self)[1:]))

    def gathered(self) -> tuple["ProblemBatch", np.ndarray]:
        """Return the batch with its active contacts in front, and their indices (N, contacts) in this batch."""
        max_active = max(int(self.active.sum(axis=1).max(initial=0)), 1)
        # The problem with the most active contacts determines the number of columns.
        order = np.argsort(~self.active, axis=1, kind="stable")[:, :max_active]
        row = np.arange(len(self))[:, None]
        gathered_fields = {f.name: getattr(self, f.name)[row, order] for f in fields(self)[3:]}
        return ProblemBatch(self.degree, self.coefficients, self.length, **gathered_fields), order

    def speed(self) -> np.ndarray:
        """Return the unit of displacement, max(|displacement| + |gap|) over active contacts, (N,), in m."""
        # It is a length, because a displacement belongs to one time step, whose duration does not matter. A
        # displacement and a gap of the same size shift a contact's condition equally.
        each = np.linalg.norm(self.displacement, axis=2) + np.abs(self.gap)
        largest = np.where(self.active, each, 0.0).max(axis=1, initial=0.0)
        return np.where(largest > 0, largest, 1.0)  # if nothing moves, the unit is one

    def rows(self) -> np.ndarray:
        """Return the contact Jacobian: the rows a_n and a_t of every contact, (N, m, 2, 3); see `pushjax.testing`."""
        tangent = np.stack([-self.normal[..., 1], self.normal[..., 0]], axis=2)
        direction = np.stack([self.normal, tangent], axis=2)
        x, y = self.point[..., None, 0], self.point[..., None, 1]
        torque = (x * direction[..., 1] - y * direction[..., 0]) / self.length[:, None, None]
        return np.concatenate([direction, torque[..., None]], axis=3)

    def approach(self) -> np.ndarray:
        """Return the motion along (n, t) that keeps contact points with their pushers, less the gap, (N, m, 2), m."""
        along = np.einsum("nmij,nmj->nmi", self.rows()[..., :2], self.displacement)
        return along - np.stack([self.gap, np.zeros_like(self.gap)], axis=2)

    def hessian_table(self) -> np.ndarray:
        """Return the coefficients (N, 3, 3, q) of the Hessian of H, which is linear in the q `products`."""
        # The products are those of two coordinates of F; for degree 2, the constant one.
        if self.degree == 2:
            return (self.coefficients + np.swapaxes(self.coefficients, 1, 2))[..., None]
        return np.einsum("nk,kijq->nijq", self.coefficients, HESSIANS)

    def gradient(self, wrench: np.ndarray) -> np.ndarray:
        """Return grad H, (N, 3), at normalized wrenches (N, 3)."""
        hessian = np.einsum("nijq,nq->nij", self.hessian_table(), products(wrench.T, self.degree).T)
        return np.einsum("nij,nj->ni", hessian, wrench) / (self.degree - 1)  # Euler's identity

    def value(self, wrench: np.ndarray) -> np.ndarray:
        """Return H, (N,), at normalized wrenches (N, 3)."""
        return np.einsum("ni,ni->n", wrench, self.gradient(wrench)) / self.degree


def products(f: np.ndarray, degree: int) -> np.ndarray:
    """Return the q monomials in which the Hessian of H is linear, (q, …), at wrenches (3, …)."""
    x, y, z = f
    return np.ones((1, *x.shape)) if degree == 2 else np.stack([x * x, y * y, z * z, x * y, x * z, y * z])
