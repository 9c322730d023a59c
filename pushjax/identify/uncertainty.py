"""How well something is known, without the assumption that the posterior is normal: profiles and the bootstrap."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from scipy.stats import norm

from pushjax._programs import compiled
from pushjax.hands import Hand
from pushjax.identify.engine import program
from pushjax.identify.fit import Effort, Held, fit
from pushjax.identify.identified import Identified, surfaces
from pushjax.identify.model import Setup
from pushjax.identify.pushes import Pushes
from pushjax.identify.unknowns import Physical
from pushjax.rollout import Slider

POINTS, REACH = 3, 2.7  # of a profile, on either side, and how many standard deviations it goes to
ENOUGH = 1e-3  # tolerance, of numbers whose prior deviation is one


class Profile(NamedTuple):
    """How much worse all pushes are explained with one number held.

    label: of that number of z. value: what is held, as one writes it (m; mu). rise: of half the loss, that is of the
    negative logarithm of the posterior, with everything else at its best; normal: what it would be if the posterior
    were normal in z. A 90 % interval is where it is below 1.35.
    """

    label: str
    value: np.ndarray
    rise: np.ndarray
    normal: np.ndarray


def profile(
    found: Identified,
    pushes: Pushes,
    slider: Slider,
    hand: Hand,
    label: str,
    *,
    points: int = POINTS,
    reach: float = REACH,
) -> Profile:
    """The profile of one of `found.labels`, of what is no part of the surface, on `points` values on either side.

    pushes, slider, hand: as `identify` was given them. Raises ValueError for another label.
    """
    names = scalars(found)
    if label not in names:
        raise ValueError(f"label must be one of {', '.join(names)}; got {label!r}")
    index = names[label]
    several, setup = _setup(found, pushes, slider, hand)
    deviation = float(np.sqrt(np.asarray(found.covariance)[index, index]))
    apart = reach * np.arange(-points, points + 1) / points
    order = [*range(points, -1, -1), *range(points + 1, 2 * points + 1)]  # outwards, each from the one before
    loss, values = np.zeros(len(apart)), np.zeros(len(apart))
    # where everything else would go, were the posterior normal
    along = found.covariance[index] / found.covariance[index, index] * deviation
    z, last = found.z, 0.0
    for k in order:
        if k in (points, points + 1):
            z, last = found.z, 0.0
        z, last = z + (apart[k] - last) * along, apart[k]
        held = Held(jnp.arange(len(z)) == index, z)
        effort = Effort.of(z.dtype, 1, ENOUGH)
        known = jnp.array([True, True, True])
        fitted = program(setup, several, z, _sigma(found), known, held, effort, robust=found.robust)
        z, loss[k] = fitted.z, float(fitted.loss)
        values[k] = _value(found, fitted.z, label)
    rise = (loss - loss.min()) / 2
    return Profile(label, values, rise, apart**2 / 2)


def bootstrap(
    key: PRNGKeyArray, found: Identified, pushes: Pushes, slider: Slider, hand: Hand, n: int
) -> tuple[Physical, Float[Array, "n size"]]:
    """What would have been found of `n` other sets of pushes, drawn from these with replacement, in each condition.

    Returns the estimates, with (n,) in front, and their z. All sets are fitted at once, from what was found of all
    pushes. pushes, slider, hand: as `identify` was given them.
    """
    several, setup = _setup(found, pushes, slider, hand)
    weights = np.asarray(several.weight)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel().tolist())
    there = weights > 0
    counts = np.stack([[rng.multinomial(row.sum(), row / row.sum()) for row in there] for _ in range(n)])
    z = _refitted(setup, several, found.z, _sigma(found), jnp.asarray(counts * weights, found.z.dtype), found.robust)
    return jax.vmap(lambda one: found._own(found.prior.physical(one)))(z), z


@compiled
def _refitted(setup: Setup, pushes: Pushes, start, sigma, weights, robust: float | None):
    held, known, once = Held.none(start), jnp.array([True, True, True]), Effort.of(start.dtype, 1, ENOUGH)

    def one(weight):
        return fit(setup, pushes.weighted(weight), start, sigma, robust, known, held, once).z

    return jax.vmap(one)(weights)


def scalars(found: Identified) -> dict[str, int]:
    """Where in z everything is that is no part of the surface, by label."""
    return {label: k for k, label in enumerate(found.labels) if not label.startswith("surface")}


def normal_interval(found: Identified, label: str, level: float = 0.9) -> tuple[float, float]:
    """One number's, from the covariance of z, as one writes it."""
    index = scalars(found)[label]
    reach = float(norm.ppf(0.5 + level / 2) * np.sqrt(np.asarray(found.covariance)[index, index]))
    low, high = (_value(found, found.z.at[index].add(sign * reach), label) for sign in (-1, 1))
    return low, high


def profile_interval(profile: Profile, level: float = 0.9) -> tuple[float, float]:
    """The values between which the rise is below that of a normal distribution's interval; those at the ends of the
    profile, if it does not rise so far."""
    least = int(np.argmin(profile.rise))
    limit = norm.ppf(0.5 + level / 2) ** 2 / 2
    ends = []
    for values, rise in (
        (profile.value[least::-1], profile.rise[least::-1]),
        (profile.value[least:], profile.rise[least:]),
    ):
        risen = np.maximum.accumulate(rise)
        ends.append(float(np.interp(limit, risen, values)))
    return ends[0], ends[1]


def _setup(found: Identified, pushes: Pushes, slider: Slider, hand: Hand) -> tuple[Pushes, Setup]:
    dtype = found.z.dtype
    pushes, slider, hand = jax.tree.map(lambda leaf: leaf.astype(dtype), (pushes, slider, hand))
    own = surfaces(found.prior, found.prior.physical(found.z))
    return pushes.as_conditions(), Setup(slider.shape, hand, own, found.prior, found.length, found.touching)


def _sigma(found: Identified) -> Array:
    return jnp.stack([found.sigma, *(jnp.where(each > 0, each, 1.0) for each in (found.direction, found.gap))])


def _value(found: Identified, z: Array, label: str) -> float:
    """In its own unit: of "friction[1]" or "center.0", say."""
    name, _, part = label.partition(".")
    name, _, condition = name.partition("[")
    value = np.asarray(getattr(found.prior.physical(z), name))[int(condition.rstrip("]") or 0) if condition else 0]
    return float(value[int(part)] if part else value)
