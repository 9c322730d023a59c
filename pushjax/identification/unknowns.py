"""The unknowns of identification, and the physical parameters that they stand for."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from pushjax._internal.checks import ArrayLike, as_float, check_finite, checked_array, concrete


class _Unknown(NamedTuple):
    """One unknown of identification."""

    size: int  # number of its scalars; 0 if that depends on the slider
    unit: str = ""
    kind: str = ""  # "calibration" (of robot and tracker), "table" (its uneven friction), or "" for neither


UNKNOWNS = {
    "friction": _Unknown(1),
    "surface": _Unknown(0),  # the limit surface, whose prior is `Unknowns.surface_dof`
    "pressure_center": _Unknown(2, "m"),
    "inset": _Unknown(1, "m", "calibration"),
    "overshoot": _Unknown(1, "m", "calibration"),
    "lag_distance": _Unknown(1, "m", "calibration"),
    "hand_offset": _Unknown(2, "m", "calibration"),
    "frame_offset": _Unknown(3, "m", "calibration"),
    "overlap": _Unknown(1, "", "calibration"),
    "anisotropy": _Unknown(2, "", "table"),
    "log_gradient": _Unknown(2, "1/m", "table"),
    "log_hessian": _Unknown(3, "1/m^2", "table"),
    "friction_drift": _Unknown(1),
    "friction_by_side": _Unknown(0),
}
NAMES = tuple(UNKNOWNS)  # in the order of their entries in z
SIZES = {name: each.size for name, each in UNKNOWNS.items()}
NORMAL_PRIORS = tuple(name for name in NAMES if name not in ("friction", "surface"))
LENGTHS = tuple(name for name, each in UNKNOWNS.items() if each.unit == "m")
CALIBRATION, TABLE = (
    tuple(name for name, each in UNKNOWNS.items() if each.kind == kind) for kind in ("calibration", "table")
)


def _prior(value: ArrayLike | None) -> Array | None:
    """Return the prior of an unknown as an array, or None for a parameter that is not estimated."""
    return None if value is None else as_float(value)


class Unknowns(eqx.Module):
    """What `identify` estimates, and the prior of each unknown. A parameter whose prior is None is not estimated.

    Such a parameter is known: friction and surface are those given to `identify`. Any other parameter is zero, or has
    the value in the argument `known` of `identify`.

    `friction` is a range and `surface_dof` a number of degrees of freedom. From `pressure_center` to
    `friction_by_side`, each field is the standard deviation, in the unit named, of a normal prior about zero. Their
    default is None. Distances along the path of a hand include its opening, and its turns at 0.05 m/rad.

    Attributes:
        friction: (2,) lowest and highest value of mu. Default: (0, 1).
        surface_dof: Degrees of freedom, which say how well the limit surface is known: those of a `FrictionModel` whose
            samples are about as far from the mean as the true surface may be. Default: 50.
        pressure_center: m, center of pressure in x and y (body frame), relative to that of the mean surface.
        inset: m, by how much the outline (or, if it is not a polygon, a finger) is smaller than given.
        overshoot: m, distance that the hand went on after the end of its path, straight ahead.
        lag_distance: m, distance by which the hand lags its logged position during the whole push (speed times delay).
        hand_offset: m, displacement of the hand in x and y, in the world frame in which the slider is tracked.
        frame_offset: m, pose of the slider's body frame in the tracked frame: x, y, and its angle times the surface's
            length.
        overlap: Fraction of the apparent initial penetration of a round finger that is a measurement error. 0: the
            penetration is real, and all of it pushes the slider. 1: the whole path is shifted outwards until finger and
            slider just touch.
        anisotropy: Dependence of the table friction on direction; see `Table`.
        log_gradient: 1/m, gradient of the logarithm of the table friction, at the mean start position of the pushes;
            see `Table`.
        log_hessian: 1/m^2, second derivatives (xx, yy, xy) of the logarithm of the table friction; see `Table`.
        friction_drift: Increase of the logarithm of the hand's friction from `Pushes.age` zero to one.
        friction_by_side: Difference of the logarithm of the hand's friction on each side of the slider (`Pushes.side`).
        sides: Number of sides of the slider. Default: 4.
        shared: Names of the unknowns that all conditions share. Default: `inset`, `overshoot`, `lag_distance`,
            `hand_offset`, `frame_offset` and `overlap`.

    Raises:
        ValueError: If `friction` is not a range of non-negative numbers, if another prior is not a positive finite
            scalar, if `sides` is less than one, if a name in `shared` is unknown, or if everything is None.
    """

    friction: Float[Array, "2"] | None = eqx.field(default=(0.0, 1.0), converter=_prior)
    surface_dof: Float[Array, ""] | None = eqx.field(default=50.0, converter=_prior, kw_only=True)
    pressure_center: Float[Array, ""] | None = eqx.field(default=None, converter=_prior, kw_only=True)
    inset: Float[Array, ""] | None = eqx.field(default=None, converter=_prior, kw_only=True)
    overshoot: Float[Array, ""] | None = eqx.field(default=None, converter=_prior, kw_only=True)
    lag_distance: Float[Array, ""] | None = eqx.field(default=None, converter=_prior, kw_only=True)
    hand_offset: Float[Array, ""] | None = eqx.field(default=None, converter=_prior, kw_only=True)
    frame_offset: Float[Array, ""] | None = eqx.field(default=None, converter=_prior, kw_only=True)
    overlap: Float[Array, ""] | None = eqx.field(default=None, converter=_prior, kw_only=True)
    anisotropy: Float[Array, ""] | None = eqx.field(default=None, converter=_prior, kw_only=True)
    log_gradient: Float[Array, ""] | None = eqx.field(default=None, converter=_prior, kw_only=True)
    log_hessian: Float[Array, ""] | None = eqx.field(default=None, converter=_prior, kw_only=True)
    friction_drift: Float[Array, ""] | None = eqx.field(default=None, converter=_prior, kw_only=True)
    friction_by_side: Float[Array, ""] | None = eqx.field(default=None, converter=_prior, kw_only=True)
    sides: int = eqx.field(default=4, static=True, kw_only=True)
    shared: tuple[str, ...] = eqx.field(default=CALIBRATION, converter=tuple, static=True, kw_only=True)

    def __check_init__(self):
        if self.friction is not None:
            low_high = concrete(checked_array("friction", self.friction, (2,)))
            if low_high is not None and not 0 <= low_high[0] < low_high[1]:
                low, high = low_high
                raise ValueError(f"friction must be (lowest, highest), not negative; got ({low:g}, {high:g})")
        for name in ("surface_dof", *NORMAL_PRIORS):
            prior = getattr(self, name)
            if prior is not None:
                checked_array(name, prior, (), positive=True)
        if self.sides < 1:
            raise ValueError(f"sides must be at least 1; got {self.sides}")
        unknown = [name for name in self.shared if name not in NAMES]
        if unknown:
            raise ValueError(f"shared: {unknown[0]!r} is not one of {', '.join(NAMES)}")
        if not self.names:
            raise ValueError(f"give a prior for at least one of friction, surface_dof, {', '.join(NORMAL_PRIORS)}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that are estimated."""
        return tuple(name for name in NAMES if getattr(self, "surface_dof" if name == "surface" else name) is not None)


def known_parameters(
    known: Mapping[str, ArrayLike], unknowns: Unknowns, conditions: int, dtype: Any
) -> dict[str, Array]:
    """Check the argument `known` of `identify`, and return its values with a leading axis of conditions."""
    values = {}
    for name, value in known.items():
        if name not in NORMAL_PRIORS:
            instead = {"friction": "; there is the argument friction", "surface": "; it is that of the slider"}
            raise ValueError(f"known: {name!r} is not one of {', '.join(NORMAL_PRIORS)}{instead.get(name, '')}")
        if name in unknowns.names:
            raise ValueError(f"known: {name!r} is also estimated; leave it out, or pass unknowns with {name}=None")
        shape = () if SIZES[name] == 1 else (SIZES[name] or unknowns.sides,)
        values[name] = per_condition(f"known[{name!r}]", value, shape, conditions, dtype)
    return values


def per_condition(name: str, value: ArrayLike, shape: tuple[int, ...], conditions: int, dtype: Any) -> Array:
    """Check a value of this shape for all conditions, or for each, and return it with a leading axis of conditions."""
    array = as_float(value, dtype, name)
    if array.shape not in (shape, (conditions, *shape)):
        expected = f"{shape}, or {(conditions, *shape)} with an axis of conditions"
        raise ValueError(f"{name} has shape {array.shape}; expected {expected}")
    check_finite(name, array)
    return jnp.broadcast_to(array, (conditions, *shape))


class Parameters(NamedTuple):
    """Physical parameters on which the pushes of a condition depend: the values of what `Unknowns` describes.

    Units are those of `Unknowns`, but the angle of `frame_offset` is in rad. `surface` is the limit surface about the
    origin of the body frame, as coefficients (15,) of a quartic or A (3, 3) of an ellipsoid. It already includes
    `pressure_center`. Fields from `frame_offset` on are None if they are neither estimated nor known.
    """

    friction: Float[Array, ""]
    surface: Float[Array, "..."]
    pressure_center: Float[Array, "2"]
    inset: Float[Array, ""]
    overshoot: Float[Array, ""]
    lag_distance: Float[Array, ""]
    hand_offset: Float[Array, "2"]
    frame_offset: Float[Array, "3"] | None = None
    overlap: Float[Array, ""] | None = None
    anisotropy: Float[Array, "2"] | None = None
    log_gradient: Float[Array, "2"] | None = None
    log_hessian: Float[Array, "3"] | None = None
    friction_drift: Float[Array, ""] | None = None
    friction_by_side: Float[Array, "sides"] | None = None
