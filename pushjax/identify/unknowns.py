"""What is to be found, what is known of it beforehand, and how it is written as one vector.

The vector z is of numbers that are, beforehand, independent and of variance one (but for the friction, of which nothing
is known but its range): so the prior is |z|^2, and steps are well scaled. Conditions may share any of them.

friction    mu = low + (high - low) logistic(z).
surface     H(F) = sum_k (F' L_k L_k' F)^(d/2), L_k = L0_k (1 + E_k), L0_k of the mean surface and E_k lower triangular,
            of variance 1 / m below the diagonal and 1 / (2 m) on it: to first order, for many degrees of freedom m, the
            distribution from which `FrictionModel` draws ("terms"), with the same meaning of dof. Always convex.
center      where the surface's wrenches turn about: H(fx, fy, tau - c x f).
the rest    see `Unknowns`: numbers times their standard deviation.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax._checks import Numeric, as_float, concrete, finite, positive
from pushjax.friction_model import dof_of_terms
from pushjax.limit_surface import Ellipsoid, LimitSurface, Quartic
from pushjax.limit_surface.sums import TERMS, split, squared_quadratics, triangles

SIZES = {"friction": 1, "center": 2, "inset": 1, "end": 1, "lag": 1, "offset": 2, "marker": 3, "overlap": 1}
SIZES |= {"grain": 2, "slope": 2, "curvature": 3, "drift": 1}  # a side's is as many as there are
NAMES = ("friction", "surface", *(name for name in SIZES if name != "friction"), "side")
SPREADS = tuple(name for name in NAMES if name not in ("friction", "surface"))
CALIBRATION = ("inset", "end", "lag", "offset", "marker", "overlap")
TABLE = ("grain", "slope", "curvature")
SIDES = 4


class Unknowns(eqx.Module):
    """What `identify` is to find, each with what is known beforehand; None is known, and stays as it is.

    friction: (lowest, highest) that mu may be. dof: how well the limit surface is known: that of a `FrictionModel`
    whose draws are about as far from the mean as the true surface may be. The rest are standard deviations, m where
    nothing else is said:

    center: of the centre of pressure, from where the mean surface has it, x and y. inset: by how much the outline (or a
    finger) is smaller than it is said to be. end: how far the hand went on after its path ends, straight ahead. lag:
    how far the hand was, all along, behind where its path says it is (speed times delay). offset: of the hand against
    the world in which the slider is seen, x and y. marker: of the slider's frame against the one that is tracked, x and
    y in the latter, and its angle times the surface's length. overlap: which share (a number) of the overlap that a
    round finger seems to start with is no overlap: the hand is out by so much, all along; at zero all of it pushes.
    grain, slope (1/m), curvature (1/m^2): of the table, see `Table`; about the mean of where pushes start. drift: by
    how much the friction with the hand rose from `Pushes.age` zero to one; side: by how much it differs on each of
    `sides` sides of the slider, `Pushes.side`; both of its logarithm.

    shared: names of those that all conditions have in common.
    """

    friction: Float[Array, "2"] | None
    dof: Float[Array, ""] | None
    center: Float[Array, ""] | None
    inset: Float[Array, ""] | None
    end: Float[Array, ""] | None
    lag: Float[Array, ""] | None
    offset: Float[Array, ""] | None
    marker: Float[Array, ""] | None
    overlap: Float[Array, ""] | None
    grain: Float[Array, ""] | None
    slope: Float[Array, ""] | None
    curvature: Float[Array, ""] | None
    drift: Float[Array, ""] | None
    side: Float[Array, ""] | None
    sides: int = eqx.field(static=True)
    shared: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        friction: Numeric | None = (0.0, 1.0),
        *,
        dof: Numeric | None = 50.0,
        center: Numeric | None = None,
        inset: Numeric | None = None,
        end: Numeric | None = None,
        lag: Numeric | None = None,
        offset: Numeric | None = None,
        marker: Numeric | None = None,
        overlap: Numeric | None = None,
        grain: Numeric | None = None,
        slope: Numeric | None = None,
        curvature: Numeric | None = None,
        drift: Numeric | None = None,
        side: Numeric | None = None,
        sides: int = SIDES,
        shared: tuple[str, ...] = CALIBRATION,
    ):
        self.friction = None if friction is None else _range(friction)
        spreads = {"dof": dof, "center": center, "inset": inset, "end": end, "lag": lag, "offset": offset}
        spreads |= {"marker": marker, "overlap": overlap, "grain": grain, "slope": slope, "curvature": curvature}
        spreads |= {"drift": drift, "side": side}
        for name, value in spreads.items():
            if value is not None:
                value = as_float(value)
                if value.shape != ():
                    raise ValueError(f"{name} has shape {value.shape}; expected a scalar, or None for what is known")
                finite(name, value)
                positive(name, value)
            setattr(self, name, value)
        if sides < 1:
            raise ValueError(f"sides must be at least 1; got {sides}")
        self.sides = sides
        wrong = [name for name in shared if name not in NAMES]
        if wrong:
            raise ValueError(f"shared: {wrong[0]!r} is not one of {', '.join(NAMES)}")
        self.shared = tuple(shared)
        if not self.names:
            raise ValueError(f"friction, dof, {', '.join(SPREADS)}: all None, nothing is to be found")

    @property
    def names(self) -> tuple[str, ...]:
        """Of what is to be found."""
        known = {name: getattr(self, "dof" if name == "surface" else name) for name in NAMES}
        return tuple(name for name in NAMES if known[name] is not None)


def _range(friction: Numeric) -> Array:
    low_high = as_float(friction)
    if low_high.shape != (2,):
        raise ValueError(f"friction has shape {low_high.shape}; expected (2,), lowest and highest")
    finite("friction", low_high)
    known = concrete(low_high)
    if known is not None and not 0 <= known[0] < known[1]:
        raise ValueError(f"friction must be (lowest, highest), not negative; got ({known[0]:g}, {known[1]:g})")
    return low_high


class Physical(NamedTuple):
    """What a condition's pushes depend on. surface: coefficients, (15,) of a quartic or (3, 3), about the body's
    origin. center: of pressure, against that of the mean; the surface has it already. From marker on: None unless they
    were asked for."""

    friction: Float[Array, ""]
    surface: Float[Array, "..."]
    center: Float[Array, "2"]
    inset: Float[Array, ""]
    end: Float[Array, ""]
    lag: Float[Array, ""]
    offset: Float[Array, "2"]
    marker: Float[Array, "3"] | None = None
    overlap: Float[Array, ""] | None = None
    grain: Float[Array, "2"] | None = None
    slope: Float[Array, "2"] | None = None
    curvature: Float[Array, "3"] | None = None
    drift: Float[Array, ""] | None = None
    side: Float[Array, "sides"] | None = None


class Layout(eqx.Module):
    """Where everything is in the vector. index: (conditions, local), of each condition's numbers in it."""

    names: tuple[str, ...] = eqx.field(static=True)
    sizes: tuple[int, ...] = eqx.field(static=True)
    shared: tuple[str, ...] = eqx.field(static=True)
    conditions: int = eqx.field(static=True)

    @staticmethod
    def of(unknowns: Unknowns, degree: int, conditions: int) -> "Layout":
        sizes = SIZES | {"surface": 6 * (TERMS if degree == 4 else 1), "side": unknowns.sides}
        names = unknowns.names
        return Layout(names, tuple(sizes[name] for name in names), unknowns.shared, conditions)

    @property
    def local(self) -> dict[str, slice]:
        ends = np.cumsum((0, *self.sizes))
        return {name: slice(int(a), int(b)) for name, a, b in zip(self.names, ends[:-1], ends[1:], strict=True)}

    @property
    def index(self) -> np.ndarray:
        columns, used = [], 0
        for name, size in zip(self.names, self.sizes, strict=True):
            many = 1 if name in self.shared else self.conditions
            own = used + np.arange(many * size).reshape(many, size)
            columns.append(np.broadcast_to(own, (self.conditions, size)))
            used += many * size
        return np.concatenate(columns, axis=1)

    @property
    def size(self) -> int:
        return int(self.index.max()) + 1

    @property
    def labels(self) -> tuple[str, ...]:
        """A name for every number of the vector."""
        names = [""] * self.size
        for condition, row in enumerate(self.index):
            for name, part in self.local.items():
                for k, place in enumerate(row[part]):
                    where = f"[{condition}]" if self.conditions > 1 and name not in self.shared else ""
                    names[place] = f"{name}{where}" + (f".{k}" if part.stop - part.start > 1 else "")
        return tuple(names)

    @property
    def flat_prior(self) -> np.ndarray:
        """(size,), 1 where |z|^2 counts, 0 of frictions."""
        counts = np.ones(self.size)
        if "friction" in self.names:
            counts[self.index[:, self.local["friction"]]] = 0
        return counts


class Mean(eqx.Module):
    """The surface that identification starts from, of every condition. lower: (conditions, terms, 3, 3), its L0_k.
    spread: what a number of E_k is multiplied with, below the diagonal, in each condition."""

    lower: Float[Array, "conditions terms 3 3"]
    spread: Float[Array, "conditions"]
    length: Float[Array, "conditions"]

    @staticmethod
    def of(surface: LimitSurface, dof: Array | None) -> "Mean":
        """surface: with a leading axis of conditions."""
        lower = jax.vmap(_lower)(surface)
        if dof is None:
            return Mean(lower, jnp.zeros_like(surface.length), surface.length)
        n = jnp.asarray(dof, lower.dtype)
        m = jax.vmap(lambda one: dof_of_terms(one, n))(lower) if isinstance(surface, Quartic) else n
        return Mean(lower, jnp.broadcast_to(1 / jnp.sqrt(m), surface.length.shape), surface.length)


def _lower(surface: LimitSurface) -> Array:
    if isinstance(surface, Quartic):
        return split(surface.coefficients).lower
    if isinstance(surface, Ellipsoid):
        return jnp.linalg.cholesky(surface.A)[None]
    raise TypeError(f"surface: expected an Ellipsoid or a Quartic; got a {type(surface).__name__}")


class Prior(eqx.Module):
    """What was known beforehand: all that turns z into physics. friction, mean: with a leading axis of conditions;
    friction: where it is known. origin: (2,), world, m, of what is known of the table."""

    unknowns: Unknowns
    friction: Float[Array, "conditions"]
    mean: Mean
    origin: Float[Array, "2"]
    layout: Layout = eqx.field(static=True)

    @staticmethod
    def of(unknowns: Unknowns, surface: LimitSurface, friction: Array, origin: Array) -> "Prior":
        """surface: with a leading axis of conditions."""
        conditions = surface.length.shape[0]
        layout = Layout.of(unknowns, surface.degree, conditions)
        known = jnp.broadcast_to(friction, (conditions,)).astype(surface.length.dtype)
        return Prior(unknowns, known, Mean.of(surface, unknowns.dof), origin, layout)

    def physical(self, z: Float[Array, "size"]) -> Physical:
        """Of every condition."""
        each = jax.vmap(lambda *own: _physical(own[0], self.layout, self.unknowns, *own[1:]))
        return each(z[self.layout.index], self.friction, self.mean)

    def factors(self, z: Float[Array, "size"]) -> Float[Array, "conditions terms 3 3"]:
        """The L_k, lower triangles, of every condition's surface."""
        each = jax.vmap(lambda own, mean: _factors(_parts(own, self.layout), self.unknowns, mean))
        whole = each(z[self.layout.index], self.mean)
        return jnp.swapaxes(jnp.linalg.qr(jnp.swapaxes(whole, -1, -2), mode="r"), -1, -2)

    @property
    def start(self) -> Float[Array, "size"]:
        """The mean of everything."""
        return jnp.zeros(self.layout.size, self.friction.dtype)


def _parts(z: Array, layout: Layout) -> dict[str, Any]:
    return {name: z[where] for name, where in layout.local.items()}


def _scaled(part: dict[str, Any], unknowns: Unknowns, name: str, dtype: Any) -> Array:
    """Numbers of z times their standard deviation; zeros for what is known."""
    spread = getattr(unknowns, name)
    return jnp.zeros(SIZES[name], dtype) if spread is None else spread.astype(dtype) * part[name]


def _factors(part: dict[str, Any], unknowns: Unknowns, mean: Mean) -> Float[Array, "terms 3 3"]:
    """Of the surface: P_k = L_k L_k', not triangular any more where there is a centre."""
    lower = mean.lower
    if "surface" in part:
        lower = lower + mean.spread * lower @ _perturbation(part["surface"].reshape(-1, 6))
    if "center" in part:
        cx, cy = _scaled(part, unknowns, "center", lower.dtype) / mean.length
        row = jnp.stack([cy, -cx, jnp.ones_like(cx)])
        shift = jnp.eye(3, dtype=lower.dtype).at[2].set(row)  # of F: tau about the centre
        lower = shift.T[None] @ lower
    return lower


def _physical(z: Array, layout: Layout, unknowns: Unknowns, friction: Array, mean: Mean) -> Physical:
    """One condition's: z (local,), `friction` where that is known, and `mean` of this condition."""
    part = _parts(z, layout)
    mu = friction
    if unknowns.friction is not None:
        low, high = unknowns.friction.astype(z.dtype)
        mu = low + (high - low) * jax.nn.sigmoid(part["friction"][0])
    lower = _factors(part, unknowns, mean)
    forms = lower @ jnp.swapaxes(lower, 1, 2)
    surface = squared_quadratics(forms) if lower.shape[0] > 1 else forms[0]

    def scaled(name: str) -> Array:
        return _scaled(part, unknowns, name, z.dtype)

    center, offset = scaled("center"), scaled("offset")
    inset, end, lag = (scaled(name)[0] for name in ("inset", "end", "lag"))
    asked = [name for name in Physical._field_defaults if name in part]
    more = {name: _scaled(part, unknowns, name, z.dtype) for name in asked}
    if "marker" in more:
        more["marker"] = more["marker"].at[2].divide(mean.length)
    more |= {name: more[name][0] for name in ("overlap", "drift") if name in more}
    return Physical(mu, surface, center, inset, end, lag, offset, **more)


def _perturbation(e: Float[Array, "terms 6"]) -> Float[Array, "terms 3 3"]:
    rows, columns = np.tril_indices(3)
    size = np.where(rows == columns, np.sqrt(0.5), 1.0)
    return triangles(e * jnp.asarray(size, e.dtype)[None])
