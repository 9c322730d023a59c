"""The unknowns of identification, their prior, and their coordinates z.

The entries of the vector z are independent a priori and have variance one. The exception is the friction, of which only
the range is known. So the prior term of the loss is |z|^2, and steps are well scaled. Conditions may share any of the
unknowns.

friction    mu = low + (high - low) logistic(z).
surface     H(F) = sum_k (F' L_k L_k' F)^(d/2), L_k = L0_k (1 + E_k). L0_k belongs to the mean surface. E_k is lower
            triangular, with variance 1 / m below the diagonal and 1 / (2 m) on it. To first order, for many degrees of
            freedom m, this is the distribution from which `FrictionModel` draws ("sum_of_squares"), with the same
            meaning of dof. H is always convex.
center      center of pressure c, about which the torque of the surface is taken: H(fx, fy, tau - c x f).
the rest    see `Unknowns`: entries of z times their standard deviation.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pushjax._internal.checks import ArrayLike, as_float, check_finite, check_positive, concrete
from pushjax.friction.ellipsoid import Ellipsoid
from pushjax.friction.limit_surface import LimitSurface
from pushjax.friction.quartic import Quartic
from pushjax.friction.random import dof_of_terms
from pushjax.friction.sum_of_squares import TERMS, decompose, squared_quadratics, triangles

SIZES = {"friction": 1, "center": 2, "inset": 1, "end": 1, "lag": 1, "offset": 2, "marker": 3, "overlap": 1}
SIZES |= {"grain": 2, "slope": 2, "curvature": 3, "drift": 1}  # the size of `side` is `Unknowns.sides`
NAMES = ("friction", "surface", *(name for name in SIZES if name != "friction"), "side")
SPREADS = tuple(name for name in NAMES if name not in ("friction", "surface"))
CALIBRATION = ("inset", "end", "lag", "offset", "marker", "overlap")
TABLE = ("grain", "slope", "curvature")
SIDES = 4


class Unknowns(eqx.Module):
    """What `identify` estimates, and the prior of each unknown. None: known, not estimated.

    If the friction or the surface is known, it is the one given to `identify`. Any other known parameter is zero.
    `friction` is a range and `dof` a number of degrees of freedom. From `center` to `side`, each field is the standard
    deviation, in the unit named, of a normal prior about zero. Their default is None.

    Attributes:
        friction: (2,) lowest and highest value of mu. Default: (0, 1).
        dof: Degrees of freedom, which say how well the limit surface is known: those of a `FrictionModel` whose samples
            are about as far from the mean as the true surface may be. Default: 50.
        center: m, center of pressure in x and y (body frame), relative to that of the mean surface.
        inset: m, by how much the outline (or, if it is not a polygon, a finger) is smaller than given.
        end: m, distance that the hand went on after the end of its path, straight ahead.
        lag: m, distance by which the hand lags its logged position during the whole push (speed times delay).
        offset: m, displacement of the hand in x and y, in the world frame in which the slider is tracked.
        marker: m, pose of the slider's body frame in the tracked frame: x, y, and its angle times the surface's length.
        overlap: Fraction of the apparent initial penetration of a round finger that is a measurement error. 0: the
            penetration is real, and all of it pushes the slider. 1: the whole path is shifted outwards until finger and
            slider just touch.
        grain: Anisotropy of the table friction; see `Table`.
        slope: 1/m, slope of the table friction about the mean start position of the pushes; see `Table`.
        curvature: 1/m^2, curvature of the table friction about that position; see `Table`.
        drift: Increase of the logarithm of the hand's friction from `Pushes.age` zero to one.
        side: Difference of the logarithm of the hand's friction on each side of the slider (`Pushes.side`).
        sides: Number of sides of the slider. Default: 4.
        shared: Names of the unknowns that all conditions share. Default: `inset`, `end`, `lag`, `offset`, `marker` and
            `overlap`.

    Raises:
        ValueError: If `friction` is not a range of non-negative numbers, if another prior is not a positive finite
            scalar, if `sides` is less than one, if a name in `shared` is unknown, or if everything is None.
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
        friction: ArrayLike | None = (0.0, 1.0),
        *,
        dof: ArrayLike | None = 50.0,
        center: ArrayLike | None = None,
        inset: ArrayLike | None = None,
        end: ArrayLike | None = None,
        lag: ArrayLike | None = None,
        offset: ArrayLike | None = None,
        marker: ArrayLike | None = None,
        overlap: ArrayLike | None = None,
        grain: ArrayLike | None = None,
        slope: ArrayLike | None = None,
        curvature: ArrayLike | None = None,
        drift: ArrayLike | None = None,
        side: ArrayLike | None = None,
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
                check_finite(name, value)
                check_positive(name, value)
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
        """Names of the parameters that are estimated."""
        known = {name: getattr(self, "dof" if name == "surface" else name) for name in NAMES}
        return tuple(name for name in NAMES if known[name] is not None)


def _range(friction: ArrayLike) -> Array:
    """Return the range of the friction as a checked array."""
    low_high = as_float(friction)
    if low_high.shape != (2,):
        raise ValueError(f"friction has shape {low_high.shape}; expected (2,), lowest and highest")
    check_finite("friction", low_high)
    known = concrete(low_high)
    if known is not None and not 0 <= known[0] < known[1]:
        raise ValueError(f"friction must be (lowest, highest), not negative; got ({known[0]:g}, {known[1]:g})")
    return low_high


class Parameters(NamedTuple):
    """Physical parameters on which the pushes of a condition depend.

    Fields from `marker` on are None if they are not estimated.

    Attributes:
        friction: Friction coefficient mu.
        surface: Coefficients of the limit surface about the origin of the body frame: (15,) of a quartic, or (3, 3) of
            an ellipsoid.
        center: (2,) m, center of pressure relative to that of the mean surface; `surface` already includes it.
        inset: m, by how much the outline or the finger is smaller than given.
        end: m, distance that the hand went on after the end of its path.
        lag: m, distance by which the hand lags its logged position.
        offset: (2,) m, displacement of the hand, world.
        marker: (3,) pose of the slider's body frame in the tracked frame, m and rad.
        overlap: Fraction of the initial penetration that is a measurement error.
        grain: (2,) anisotropy of the table friction.
        slope: (2,) slope of the table friction, 1/m.
        curvature: (3,) curvature of the table friction, 1/m^2.
        drift: Increase of log(mu) from the first push to the last.
        side: (sides,) difference of log(mu) on each side.
    """

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
    """Positions of the unknowns in the vector z.

    Attributes:
        names: Names of the unknowns.
        sizes: How many numbers each has.
        shared: Names that all conditions share.
        conditions: Number of conditions.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    sizes: tuple[int, ...] = eqx.field(static=True)
    shared: tuple[str, ...] = eqx.field(static=True)
    conditions: int = eqx.field(static=True)

    @staticmethod
    def of(unknowns: Unknowns, degree: int, conditions: int) -> "Layout":
        """Return the layout for surfaces of degree 2 or 4."""
        sizes = SIZES | {"surface": 6 * (TERMS if degree == 4 else 1), "side": unknowns.sides}
        names = unknowns.names
        return Layout(names, tuple(sizes[name] for name in names), unknowns.shared, conditions)

    @property
    def local(self) -> dict[str, slice]:
        """Slice of each unknown in the numbers of one condition."""
        ends = np.cumsum((0, *self.sizes))
        return {name: slice(int(a), int(b)) for name, a, b in zip(self.names, ends[:-1], ends[1:], strict=True)}

    @property
    def index(self) -> np.ndarray:
        """(conditions, local) positions in z of the numbers of each condition."""
        columns, used = [], 0
        for name, size in zip(self.names, self.sizes, strict=True):
            many = 1 if name in self.shared else self.conditions
            own = used + np.arange(many * size).reshape(many, size)
            columns.append(np.broadcast_to(own, (self.conditions, size)))
            used += many * size
        return np.concatenate(columns, axis=1)

    @property
    def size(self) -> int:
        """Number of entries of z."""
        return int(self.index.max()) + 1

    @property
    def labels(self) -> tuple[str, ...]:
        """A label for every entry of z."""
        names = [""] * self.size
        for condition, row in enumerate(self.index):
            for name, part in self.local.items():
                for k, place in enumerate(row[part]):
                    where = f"[{condition}]" if self.conditions > 1 and name not in self.shared else ""
                    names[place] = f"{name}{where}" + (f".{k}" if part.stop - part.start > 1 else "")
        return tuple(names)

    @property
    def flat_prior(self) -> np.ndarray:
        """(size,) 1 for entries of z whose square is in the loss, 0 for frictions."""
        counts = np.ones(self.size)
        if "friction" in self.names:
            counts[self.index[:, self.local["friction"]]] = 0
        return counts


class PriorSurface(eqx.Module):
    """The mean limit surface of every condition, from which identification starts.

    Attributes:
        lower: (conditions, terms, 3, 3) factors L0_k.
        spread: (conditions,) standard deviation of an entry of E_k below the diagonal; zero if the surface is known.
        length: (conditions,) length of the surface, m.
    """

    lower: Float[Array, "conditions terms 3 3"]
    spread: Float[Array, "conditions"]
    length: Float[Array, "conditions"]

    @staticmethod
    def of(surface: LimitSurface, dof: Array | None) -> "PriorSurface":
        """Return the mean for surfaces with a leading axis of conditions."""
        lower = jax.vmap(_lower)(surface)
        if dof is None:
            return PriorSurface(lower, jnp.zeros_like(surface.length), surface.length)
        n = jnp.asarray(dof, lower.dtype)
        m = jax.vmap(lambda one: dof_of_terms(one, n))(lower) if isinstance(surface, Quartic) else n
        return PriorSurface(lower, jnp.broadcast_to(1 / jnp.sqrt(m), surface.length.shape), surface.length)


def _lower(surface: LimitSurface) -> Array:
    """Return the factors L_k of a surface, (terms, 3, 3)."""
    if isinstance(surface, Quartic):
        return decompose(surface.coefficients).lower
    if isinstance(surface, Ellipsoid):
        return jnp.linalg.cholesky(surface.A)[None]
    raise TypeError(f"surface: expected an Ellipsoid or a Quartic; got a {type(surface).__name__}")


class Prior(eqx.Module):
    """Prior of the unknowns: everything that converts z to physical parameters.

    Attributes:
        unknowns: What is estimated, and its prior.
        friction: (conditions,) friction, used if it is known.
        mean: Mean surfaces, with a leading axis of conditions.
        origin: (2,) world, m, reference point of the table friction.
        layout: Positions of the unknowns in z.
    """

    unknowns: Unknowns
    friction: Float[Array, "conditions"]
    mean: PriorSurface
    origin: Float[Array, "2"]
    layout: Layout = eqx.field(static=True)

    @staticmethod
    def of(unknowns: Unknowns, surface: LimitSurface, friction: Array, origin: Array) -> "Prior":
        """Return the prior for surfaces with a leading axis of conditions."""
        conditions = surface.length.shape[0]
        layout = Layout.of(unknowns, surface.degree, conditions)
        known = jnp.broadcast_to(friction, (conditions,)).astype(surface.length.dtype)
        return Prior(unknowns, known, PriorSurface.of(surface, unknowns.dof), origin, layout)

    def physical(self, z: Float[Array, "size"]) -> Parameters:
        """Return the physical parameters of every condition."""
        each = jax.vmap(lambda *own: _physical(own[0], self.layout, self.unknowns, *own[1:]))
        return each(z[self.layout.index], self.friction, self.mean)

    def factors(self, z: Float[Array, "size"]) -> Float[Array, "conditions terms 3 3"]:
        """Return the lower triangular factors L_k of every condition's surface."""
        each = jax.vmap(lambda own, mean: _factors(_parts(own, self.layout), self.unknowns, mean))
        whole = each(z[self.layout.index], self.mean)
        return jnp.swapaxes(jnp.linalg.qr(jnp.swapaxes(whole, -1, -2), mode="r"), -1, -2)

    @property
    def start(self) -> Float[Array, "size"]:
        """The prior mean of z, which is zero."""
        return jnp.zeros(self.layout.size, self.friction.dtype)


def _parts(z: Array, layout: Layout) -> dict[str, Any]:
    """Split the numbers of one condition by name."""
    return {name: z[where] for name, where in layout.local.items()}


def _scaled(part: dict[str, Any], unknowns: Unknowns, name: str, dtype: Any) -> Array:
    """Return entries of z times their standard deviation; zeros for what is known."""
    spread = getattr(unknowns, name)
    return jnp.zeros(SIZES[name], dtype) if spread is None else spread.astype(dtype) * part[name]


def _factors(part: dict[str, Any], unknowns: Unknowns, mean: PriorSurface) -> Float[Array, "terms 3 3"]:
    """Return L_k of the surface, with P_k = L_k L_k'; not triangular if the center of pressure is an unknown."""
    lower = mean.lower
    if "surface" in part:
        lower = lower + mean.spread * lower @ _perturbation(part["surface"].reshape(-1, 6))
    if "center" in part:
        cx, cy = _scaled(part, unknowns, "center", lower.dtype) / mean.length
        row = jnp.stack([cy, -cx, jnp.ones_like(cx)])
        shift = jnp.eye(3, dtype=lower.dtype).at[2].set(row)  # maps F to F with tau about the center of pressure
        lower = shift.T[None] @ lower
    return lower


def _physical(z: Array, layout: Layout, unknowns: Unknowns, friction: Array, mean: PriorSurface) -> Parameters:
    """Return the physical parameters of one condition.

    Args:
        z: (local,) numbers of the condition.
        layout: Positions of the unknowns.
        unknowns: What is estimated, and its prior.
        friction: Friction of the condition, used if it is known.
        mean: Mean surface of the condition.
    """
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
    asked = [name for name in Parameters._field_defaults if name in part]
    more = {name: _scaled(part, unknowns, name, z.dtype) for name in asked}
    if "marker" in more:
        more["marker"] = more["marker"].at[2].divide(mean.length)
    more |= {name: more[name][0] for name in ("overlap", "drift") if name in more}
    return Parameters(mu, surface, center, inset, end, lag, offset, **more)


def _perturbation(e: Float[Array, "terms 6"]) -> Float[Array, "terms 3 3"]:
    """Return E_k in units of its standard deviation below the diagonal, from its six numbers."""
    rows, columns = np.tril_indices(3)
    size = np.where(rows == columns, np.sqrt(0.5), 1.0)
    return triangles(e * jnp.asarray(size, e.dtype)[None])
