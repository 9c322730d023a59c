"""The prior of the unknowns, and their coordinates z.

The entries of the vector z are independent a priori and have a standard normal distribution. The exception is the
friction, of which only the range is known. So the prior term of the loss is the sum of the squares of the other
entries, and steps are well scaled. Conditions may share any of the unknowns.

friction         mu = low + (high - low) logistic(z), uniform in its range if z is logistic.
surface          H(F) = sum_k (F' P_k F)^(d/2), P_k = L_k L_k', L_k = L0_k (1 + E_k). d is the degree: 2 for an
                 ellipsoid, which has one term, and 4 for a quartic. L0_k belongs to the mean surface. E_k is lower
                 triangular, with variance 1 / m below the diagonal and 1 / (2 m) on it. To first order, for many
                 degrees of freedom m, this is the distribution from which `FrictionModel` draws ("sum_of_squares"),
                 with the same meaning of dof. H is always convex. Of exact support points, the friction limit of each
                 is exp(e) times its mean, e with variance 2 / m.
pressure_center  center of pressure c, about which the torque of the surface is taken: H(fx, fy, tau - c x f).
the rest         see `Unknowns`: entries of z times their standard deviation.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax.friction.ellipsoid import Ellipsoid
from pushjax.friction.feet import Feet
from pushjax.friction.limit_surface import LimitSurface
from pushjax.friction.quartic import Quartic
from pushjax.friction.sum_of_squares import decompose, squared_quadratics, unpack_lower
from pushjax.friction.surface_distributions import dof_of_terms
from pushjax.identification.unknowns import SIZES, Parameters, Unknowns

# Parameters that are zero, rather than None, if they are neither estimated nor known.
ALWAYS_PRESENT = tuple(
    name for name in Parameters._fields if name not in ("friction", "surface", *Parameters._field_defaults)
)


class Layout(eqx.Module):
    """Positions of the unknowns in the vector z."""

    names: tuple[str, ...] = eqx.field(static=True)  # of the unknowns
    sizes: tuple[int, ...] = eqx.field(static=True)  # entries of each, per condition
    shared: tuple[str, ...] = eqx.field(static=True)  # names that all conditions share
    conditions: int = eqx.field(static=True)  # number of conditions

    @staticmethod
    def of(unknowns: Unknowns, surface_entries: int, conditions: int) -> "Layout":
        """Return the layout for surfaces with this number of entries."""
        sizes = SIZES | {"surface": surface_entries, "friction_by_side": unknowns.sides}
        names = unknowns.names
        return Layout(names, tuple(sizes[name] for name in names), unknowns.shared, conditions)

    @property
    def slices(self) -> dict[str, slice]:
        """Slice of each unknown among the entries of one condition."""
        ends = np.cumsum((0, *self.sizes))
        return {name: slice(int(a), int(b)) for name, a, b in zip(self.names, ends[:-1], ends[1:], strict=True)}

    @property
    def positions(self) -> np.ndarray:
        """(conditions, entries) positions in z of the entries of each condition; shared entries occur in every row."""
        columns, used = [], 0
        for name, size in zip(self.names, self.sizes, strict=True):
            copies = 1 if name in self.shared else self.conditions
            block = used + np.arange(copies * size).reshape(copies, size)
            columns.append(np.broadcast_to(block, (self.conditions, size)))
            used += copies * size
        return np.concatenate(columns, axis=1)

    @property
    def size(self) -> int:
        """Number of entries of z."""
        return int(self.positions.max()) + 1

    @property
    def labels(self) -> tuple[str, ...]:
        """A label for every entry of z: name, condition if not shared, and index, such as "hand_offset[1].0"."""
        labels = [""] * self.size
        for condition, row in enumerate(self.positions):
            for name, columns in self.slices.items():
                for k, position in enumerate(row[columns]):
                    where = f"[{condition}]" if self.conditions > 1 and name not in self.shared else ""
                    labels[position] = f"{name}{where}" + (f".{k}" if columns.stop - columns.start > 1 else "")
        return tuple(labels)

    @property
    def has_normal_prior(self) -> np.ndarray:
        """(size,) 1 for entries of z with a normal prior, whose square is in the loss; 0 for frictions."""
        normal = np.ones(self.size)
        if "friction" in self.names:
            normal[self.positions[:, self.slices["friction"]]] = 0
        return normal


class PriorSurface(eqx.Module):
    """The mean limit surface of every condition, from which identification starts."""

    factors: Float[Array, "conditions terms 3 3"]  # lower triangular factors L0_k
    # standard deviation of an entry of E_k below the diagonal; zero if the surface is known
    relative_std: Float[Array, "conditions"]
    length: Float[Array, "conditions"]  # m

    @property
    def entries(self) -> int:
        """Number of entries of z for each condition."""
        return 6 * self.factors.shape[1]

    def perturbed(self, entries: Array) -> Array:
        """The factors of one condition."""
        return self.factors + self.relative_std * self.factors @ _unit_perturbation(entries.reshape(-1, 6))

    @property
    def parameters(self) -> Array:
        """What `perturbed` changes."""
        return self.factors

    def coefficients(self, factors: Array) -> Array:
        """The coefficients of a limit surface of one condition."""
        gram = factors @ jnp.swapaxes(factors, 1, 2)
        return squared_quadratics(gram) if factors.shape[0] > 1 else gram[0]

    def surface(self, coefficients: Array) -> LimitSurface:
        """The limit surface of one condition."""
        return (Quartic if self.factors.shape[0] > 1 else Ellipsoid)(coefficients, self.length)

    @staticmethod
    def of(surface: LimitSurface, dof: Array | None) -> "PriorSurface":
        """Return the prior for mean surfaces with a leading axis of conditions; `dof` None: the surface is known."""
        factors = jax.vmap(_factors_of)(surface)
        if dof is None:
            return PriorSurface(factors, jnp.zeros_like(surface.length), surface.length)
        dof_array = jnp.asarray(dof, factors.dtype)
        term_dof = (
            jax.vmap(lambda one: dof_of_terms(one, dof_array))(factors) if isinstance(surface, Quartic) else dof_array
        )
        return PriorSurface(factors, jnp.broadcast_to(1 / jnp.sqrt(term_dof), surface.length.shape), surface.length)


class PriorFeet(eqx.Module):
    """The mean support points of every condition, from which identification starts."""

    point: Float[Array, "conditions points 2"]
    limit: Float[Array, "conditions points"]
    relative_std: Float[Array, "conditions"]  # of a limit; zero if they are known
    length: Float[Array, "conditions"]  # m

    @property
    def entries(self) -> int:
        """Number of entries of z for each condition."""
        return self.limit.shape[1]

    def perturbed(self, entries: Array) -> Array:
        """The friction limits of one condition."""
        return self.limit * jnp.exp(self.relative_std * entries)

    @property
    def parameters(self) -> Array:
        """What `perturbed` changes."""
        return self.limit

    def coefficients(self, limit: Array) -> Array:
        """As given: the friction limits are what is estimated."""
        return limit

    def surface(self, limit: Array) -> LimitSurface:
        """The limit surface of one condition."""
        return Feet(self.point, limit, self.length)

    @staticmethod
    def of(surface: Feet, dof: Array | None) -> "PriorFeet":
        """Return the prior for mean surfaces with a leading axis of conditions; `dof` None: the surface is known."""
        std = jnp.zeros((), surface.limit.dtype) if dof is None else jnp.sqrt(2 / dof).astype(surface.limit.dtype)
        return PriorFeet(surface.point, surface.limit, jnp.broadcast_to(std, surface.length.shape), surface.length)


def _factors_of(surface: LimitSurface) -> Array:
    """Return the factors L_k of a surface, (terms, 3, 3)."""
    if isinstance(surface, Quartic):
        return decompose(surface.coefficients).lower
    if isinstance(surface, Ellipsoid):
        return jnp.linalg.cholesky(surface.A)[None]
    raise TypeError(f"surface: expected an Ellipsoid, a Quartic or Feet; got a {type(surface).__name__}")


class Prior(eqx.Module):
    """Prior of the unknowns: everything that converts z to physical parameters."""

    unknowns: Unknowns
    # Known parameters by name, with a leading axis of conditions, in the units of `Parameters`. The friction is always
    # among them, and is used unless it is estimated.
    known: dict[str, Array]
    mean_surface: PriorSurface | PriorFeet  # with a leading axis of conditions
    origin: Float[Array, "2"]  # world, m, reference point of the table friction
    layout: Layout = eqx.field(static=True)

    @staticmethod
    def of(unknowns: Unknowns, surface: LimitSurface, known: dict[str, Array], origin: Array) -> "Prior":
        """Return the prior for surfaces and known parameters with a leading axis of conditions."""
        of = PriorFeet.of if isinstance(surface, Feet) else PriorSurface.of
        mean = of(surface, unknowns.surface_dof)  # pyright: ignore[reportArgumentType]
        if isinstance(mean, PriorFeet) and ("pressure_center" in unknowns.names or "pressure_center" in known):
            raise ValueError("pressure_center: of exact support points, the friction limits determine it; leave it out")
        return Prior(unknowns, known, mean, origin, Layout.of(unknowns, mean.entries, len(mean.length)))

    def parameters(self, z: Float[Array, "size"]) -> Parameters:
        """Return the physical parameters of every condition."""

        def of_condition(*condition) -> Parameters:
            values, factors = self._values_and_factors(*condition)
            surface = condition[-1].coefficients(factors)
            zeros = {name: jnp.zeros((SIZES[name],) if SIZES[name] > 1 else (), z.dtype) for name in ALWAYS_PRESENT}
            return Parameters(surface=surface, **(zeros | values))

        return jax.vmap(of_condition)(z[self.layout.positions], self.known, self.mean_surface)

    def factors(self, z: Float[Array, "size"]) -> Float[Array, "conditions terms 3 3"]:
        """Return the lower triangular factors L_k of every condition's surface, which is a polynomial."""
        conditions = z[self.layout.positions], self.known, self.mean_surface
        full = jax.vmap(lambda *condition: self._values_and_factors(*condition)[1])(*conditions)
        # an unknown center of pressure makes them full; the QR decomposition makes them triangular again
        return jnp.swapaxes(jnp.linalg.qr(jnp.swapaxes(full, -1, -2), mode="r"), -1, -2)

    def _values_and_factors(
        self, z: Array, known: dict[str, Array], mean: PriorSurface | PriorFeet
    ) -> tuple[dict[str, Array], Array]:
        """Return the parameters of one condition by name, and its surface: factors L_k that may be full, or limits."""
        values, factors = dict(known), mean.parameters
        for name, where in self.layout.slices.items():
            entries = z[where]
            if name == "surface":
                factors = mean.perturbed(entries)
                continue
            prior = getattr(self.unknowns, name).astype(z.dtype)
            if name == "friction":
                values[name] = prior[0] + (prior[1] - prior[0]) * jax.nn.sigmoid(entries[0])
                continue
            value = prior * entries
            if name == "frame_offset":
                value = value.at[2].divide(mean.length)
            values[name] = value[0] if SIZES[name] == 1 else value
        if "pressure_center" in values:
            cx, cy = values["pressure_center"] / mean.length
            row = jnp.stack([cy, -cx, jnp.ones_like(cx)])
            shift = jnp.eye(3, dtype=factors.dtype).at[2].set(row)  # maps F to F with tau about the center of pressure
            factors = shift.T[None] @ factors
        return values, factors

    @property
    def mean(self) -> Float[Array, "size"]:
        """The prior mean of z, which is zero."""
        return jnp.zeros(self.layout.size, self.origin.dtype)


def _unit_perturbation(entries: Float[Array, "terms 6"]) -> Float[Array, "terms 3 3"]:
    """Return E_k, in units of its standard deviation below the diagonal, from its six entries of z."""
    rows, columns = np.tril_indices(3)
    std = np.where(rows == columns, np.sqrt(0.5), 1.0)
    return unpack_lower(entries * jnp.asarray(std, entries.dtype)[None])
