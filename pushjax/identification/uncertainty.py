"""Uncertainty of estimates without the assumption of a normal posterior: profiles and the bootstrap."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from scipy.special import ndtri

from pushjax._internal.jit import jit
from pushjax.identification.fit import Fit, fit
from pushjax.identification.model import Problem, Scene, limit_surfaces
from pushjax.identification.pushes import Pushes
from pushjax.simulation.hand import Hand
from pushjax.simulation.slider import Slider

if TYPE_CHECKING:
    from pushjax.identification.result import Identified

POINTS, REACH = 3, 2.7  # points of a profile on each side of the estimate, and its half-width in standard deviations
# A profile ends where a friction is within 0.25 % of its range from an end of it: pushes that do not determine a
# friction leave its z with a standard deviation of hundreds.
MAX_FRICTION_Z = 6.0
DROP_AT_90 = ndtri(0.95) ** 2 / 2  # of the log posterior density, at the ends of an interval of 90 %
# Each side of a profile is extended (at most EXTENSIONS times, doubling the distance) until the drop is reached, and
# refined (at most REFINEMENTS points) where the first point overshoots by more than STEEP.
EXTENSIONS, STEEP, REFINEMENTS = 8, 3.0, 6
TOLERANCE = 1e-3  # tolerance of z, whose numbers have a prior standard deviation of one


class Profile(NamedTuple):
    """How much worse the pushes are explained if one number is held at other values.

    Attributes:
        label: Label of that number of z.
        value: (points,) values at which it is held, in the unit that `Parameters` gives.
        log_posterior_drop: (points,) decrease of the log posterior density (half the loss, negative) from its maximum.
            All other unknowns are optimized. A 90 % interval is where it is below 1.35.
        normal: (points,) the same decrease if the posterior were normal in z.
    """

    label: str
    value: np.ndarray
    log_posterior_drop: np.ndarray
    normal: np.ndarray


def profile(
    found: "Identified",
    pushes: Pushes,
    slider: Slider,
    hand: Hand,
    label: str,
    points: int,
    reach: float,
) -> Profile:
    """Compute the profile of one number of z; see `Identified.profile`."""
    positions = scalar_positions(found)
    if label not in positions:
        raise ValueError(f"label must be one of {', '.join(positions)}; got {label!r}")
    position = positions[label]
    pushes, problem = _pushes_and_problem(found, pushes, slider, hand)
    covariance = found.covariance
    std = float(np.sqrt(np.asarray(covariance)[position, position]))
    # The direction in which all other entries would move if the posterior were normal.
    direction = covariance[position] / covariance[position, position] * std
    frozen, sigma = jnp.arange(len(found.z)) == position, _sigma_by_kind(found)

    def refit(near: _ProfilePoint, distance: float) -> _ProfilePoint:
        z = near.z + (distance - near.distance) * direction
        fitted = _refit(problem, pushes, z, sigma, frozen, found.robust)
        return _ProfilePoint(distance, fitted.z, float(fitted.loss))

    estimate = refit(_ProfilePoint(0.0, found.z, 0.0), 0.0)
    computed = [estimate]
    for sign in (-1, 1):
        limit = np.inf
        if label.partition("[")[0] == "friction":
            limit = (MAX_FRICTION_Z - sign * float(found.z[position])) / std
        extent = min(reach, limit)
        if extent > 0:
            distances = [sign * extent * k / points for k in range(1, points + 1)]
            computed += _profile_side(refit, estimate, distances, limit)
    computed.sort(key=lambda point: point.distance)
    distance, loss = np.array([point.distance for point in computed]), np.array([point.loss for point in computed])
    values = np.array([_physical_value(found, point.z, label) for point in computed])
    return Profile(label, values, (loss - loss.min()) / 2, distance**2 / 2)


class _ProfilePoint(NamedTuple):
    """A fit with one number of z held fixed."""

    distance: float  # of that number from its estimate, in standard deviations
    z: Float[Array, "size"]  # after the fit
    loss: float


def _profile_side(
    # fits with the number held at a distance, starting from a point nearby
    refit: Callable[[_ProfilePoint, float], _ProfilePoint],
    estimate: _ProfilePoint,
    distances: Sequence[float],  # from the estimate outward; more are added where the profile is flat or steep
    limit: float,  # largest distance
) -> list[_ProfilePoint]:
    """Return the points of a profile on one side of the estimate."""

    def drop(point: _ProfilePoint) -> float:
        return (point.loss - estimate.loss) / 2

    side = [estimate]
    for distance in distances:
        side.append(refit(side[-1], distance))
    for _ in range(EXTENSIONS):
        last = side[-1]
        if drop(last) > DROP_AT_90 or abs(last.distance) >= limit:
            break
        side.append(refit(last, float(np.sign(last.distance)) * min(2 * abs(last.distance), limit)))
    for _ in range(REFINEMENTS):
        above = next((k for k, point in enumerate(side) if drop(point) > DROP_AT_90), None)
        if above is None or drop(side[above]) <= STEEP * DROP_AT_90:
            break
        side.insert(above, refit(side[above - 1], (side[above - 1].distance + side[above].distance) / 2))
    return side[1:]


def bootstrap(
    key: PRNGKeyArray, found: "Identified", pushes: Pushes, slider: Slider, hand: Hand, n: int
) -> Float[Array, "n size"]:
    """Return the estimates of z from `n` bootstrap samples of the pushes of each condition."""
    # All samples are fitted at once, each from the estimate of all pushes.
    pushes, problem = _pushes_and_problem(found, pushes, slider, hand)
    weights = np.asarray(pushes.weight)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel().tolist())
    has_weight = weights > 0
    empty = np.flatnonzero(~has_weight.any(axis=1))
    if empty.size:
        raise ValueError(f"pushes: condition {empty[0]} has no push with a weight to sample")
    counts = np.stack([[rng.multinomial(row.sum(), row / row.sum()) for row in has_weight] for _ in range(n)])
    resampled = jnp.asarray(counts * weights, found.z.dtype)
    return _refitted(problem, pushes, found.z, _sigma_by_kind(found), resampled, found.robust)


@jit
def _refitted(problem: Problem, pushes: Pushes, start, sigma, weights, robust: float | None):
    """Fit z to each row of `weights`, with sigma fixed."""
    frozen = jnp.zeros(start.shape, bool)
    return jax.vmap(lambda weight: _refit(problem, pushes.weighted(weight), start, sigma, frozen, robust).z)(weights)


def _refit(problem: Problem, pushes: Pushes, start: Array, sigma: Array, frozen: Array, robust: float | None) -> Fit:
    """Fit those entries of z that are not frozen, with sigma fixed."""
    given, tolerance = jnp.ones(3, bool), jnp.asarray(TOLERANCE, start.dtype)
    return fit(problem, pushes, start, sigma, given, frozen, jnp.asarray(1), tolerance, robust=robust)


def scalar_positions(found: "Identified") -> dict[str, int]:
    """Return the position in z of every number that is not part of the surface, by label."""
    return {label: k for k, label in enumerate(found.labels) if not label.startswith("surface")}


def normal_interval(
    found: "Identified",
    label: str,  # one of `found.labels`, except those of the surface
    level: float = 0.9,  # probability that the interval contains
) -> tuple[float, float]:
    """Return the interval of one number, in its own unit, from the covariance of z."""
    position = scalar_positions(found)[label]
    reach = float(ndtri(0.5 + level / 2) * np.sqrt(np.asarray(found.covariance)[position, position]))
    low, high = (_physical_value(found, found.z.at[position].add(sign * reach), label) for sign in (-1, 1))
    return low, high


def profile_interval(profile: Profile, level: float = 0.9) -> tuple[float, float]:
    """Compute the interval of a profile.

    Args:
        profile: A profile.
        level: Probability that the interval contains.

    Returns:
        The values between which the log posterior density drops less than at the ends of the interval of a normal
            distribution. If the profile does not drop so far on one side, its outermost value on that side.
    """
    drop, limit = profile.log_posterior_drop, ndtri(0.5 + level / 2) ** 2 / 2
    top = int(np.argmin(drop))
    sides = (slice(top, None, -1), slice(top, None))
    low, high = (float(np.interp(limit, np.maximum.accumulate(drop[side]), profile.value[side])) for side in sides)
    return low, high


def _pushes_and_problem(found: "Identified", pushes: Pushes, slider: Slider, hand: Hand) -> tuple[Pushes, Problem]:
    """Return pushes with a leading axis of conditions, and the problem of the fit, in the dtype of `found`."""
    dtype = found.z.dtype
    pushes, slider, hand = jax.tree.map(lambda leaf: leaf.astype(dtype), (pushes, slider, hand))
    surface = limit_surfaces(found.prior, found.prior.parameters(found.z))
    scene = Scene(slider.shape, hand, found.prior.origin)
    return pushes.as_conditions(), Problem(scene, surface, found.prior, found.length, found.contact_at_end)


def _sigma_by_kind(found: "Identified") -> Array:
    """Return the estimated sigma (3,) of poses, directions and gaps; 1 for kinds that were not recorded."""
    return jnp.stack(
        [found.sigma, *(jnp.where(each > 0, each, 1.0) for each in (found.direction_sigma, found.gap_sigma))]
    )


def _physical_value(found: "Identified", z: Array, label: str) -> float:
    """Return the physical value of an entry of z in its own unit, by label ("friction[1]", "pressure_center.0")."""
    name, _, part = label.partition(".")
    name, _, condition = name.partition("[")
    value = np.asarray(getattr(found.prior.parameters(z), name))[int(condition.rstrip("]") or 0) if condition else 0]
    return float(value[int(part)] if part else value)
