"""What was found, and how well it is known."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray
from scipy.stats import norm

from pushjax._programs import quickly_compiled
from pushjax.hands import Hand
from pushjax.identify.model import Body, moved, smaller, trajectories
from pushjax.identify.pushes import Pushes
from pushjax.identify.unknowns import Physical, Prior
from pushjax.limit_surface import Ellipsoid, LimitSurface, Quartic
from pushjax.rollout import Slider, Trajectory

if TYPE_CHECKING:
    from pushjax.identify.uncertainty import Profile

APPLIED = ("friction", "surface", "center", "inset", "end", "lag", "offset")
LOGISTIC_VARIANCE = np.pi**2 / 3


class Identified(eqx.Module):
    """The most probable values of what was unknown, with a normal distribution about them (Laplace's).

    z: (size,), those values as `prior` writes them; precision: (size, size), the inverse of their covariance. prior:
    what turns them into physics. sigma: m, the standard deviation of each of x, y and length * theta of a measured
    pose about its prediction; direction: that of each part of a unit vector along the motion under a measured wrench,
    zero if there was none; gap: m, that of a gap at a push's end, zero unless `touching`. residual: (..., pushes, 3),
    predicted less measured final pose, in x, y, length * theta, m. information: (..., pushes, size), what each push
    adds to the diagonal of the precision. loss: what was minimised, twice the negative logarithm of the posterior's
    density, up to a constant. length: m, the metric's. steps: of the optimiser. status: MOVING, or NOT_CONVERGED.
    robust, touching: as `identify` was told.

    All properties have a leading axis of conditions if the pushes had one; what conditions share is repeated.
    """

    z: Float[Array, "size"]
    precision: Float[Array, "size size"]
    prior: Prior
    sigma: Float[Array, ""]
    direction: Float[Array, ""]
    gap: Float[Array, ""]
    residual: Float[Array, "*conditions pushes 3"]
    information: Float[Array, "*conditions pushes size"]
    loss: Float[Array, ""]
    length: Float[Array, ""]
    steps: Int[Array, ""]
    status: Int[Array, ""]
    single: bool = eqx.field(static=True)
    robust: float | None = eqx.field(static=True)
    touching: bool = eqx.field(static=True, default=False)

    @property
    def physical(self) -> Physical:
        """Everything a push depends on, as arrays."""
        return self._own(self.prior.physical(self.z))

    @property
    def friction(self) -> Float[Array, "*conditions"]:
        """mu."""
        return self.physical.friction

    @property
    def surface(self) -> LimitSurface:
        """The limit surface, centre of pressure included; with conditions, its arrays have them in front."""
        return self._own(surfaces(self.prior, self.prior.physical(self.z)))

    @property
    def covariance(self) -> Float[Array, "size size"]:
        """Of z."""
        return jnp.linalg.inv(self.precision)

    @property
    def labels(self) -> tuple[str, ...]:
        """A name for each number of z."""
        return self.prior.layout.labels

    @property
    def determined(self) -> dict[str, float]:
        """Of each number of z, by its label, how much of what was not known before is known now: 1 less its variance
        over that of the prior (of a friction: evenly spread over its range). Near zero: the pushes do not tell."""
        before = np.where(self.prior.layout.flat_prior > 0, 1.0, LOGISTIC_VARIANCE)
        share = 1 - np.diagonal(np.asarray(self.covariance, float)) / before
        return dict(zip(self.labels, np.clip(share, 0, 1).tolist(), strict=True))

    def told_by(self, name: str) -> Float[Array, "*conditions pushes"]:
        """Each push's share of what all pushes tell about `name` (friction, surface, ...)."""
        if name not in self.prior.layout.names:
            raise ValueError(f"name must be one of {', '.join(self.prior.layout.names)}; got {name!r}")
        index = self.prior.layout.index[:, self.prior.layout.local[name]]
        places = np.unique(index)
        each = jnp.sum(self.information[..., places], axis=-1)
        total = jnp.sum(each)
        return each / jnp.where(total > 0, total, 1.0)

    def save(self, path: str | Path) -> None:
        """Write everything to a JSON file that `load` reads back to the same bits."""
        from pushjax.identify.files import save

        save(self, path)

    @staticmethod
    def load(path: str | Path) -> "Identified":
        """Read what `save` wrote. Raises ValueError for a file that holds something else."""
        from pushjax.identify.files import load

        return load(path)

    def draws(self, key: PRNGKeyArray, n: int) -> Physical:
        """`n` values from the distribution, each as likely as the next; fields as in `physical`, with (n,) in front."""
        return jax.vmap(lambda z: self._own(self.prior.physical(z)))(self._draws(key, n))

    def _draws(self, key: PRNGKeyArray, n: int) -> Float[Array, "n size"]:
        upper = jnp.linalg.cholesky(self.precision).T
        normal = jax.random.normal(key, (len(self.z), n), self.z.dtype)
        return self.z[None] + jax.scipy.linalg.solve_triangular(upper, normal, lower=False).T

    def interval(self, level: float = 0.9) -> dict[str, tuple[Array, Array]]:
        """The lowest and highest value of everything that was unknown but the surface, by its name, that
        hold a share `level` of the distribution; arrays like the estimates.

        Each is that of its own number of z, so that a friction stays in its range.
        """
        if not 0 < level < 1:
            raise ValueError(f"level must be between 0 and 1; got {level!r}")
        reach = float(norm.ppf(0.5 + level / 2)) * jnp.sqrt(jnp.diagonal(self.covariance))
        low, high = (self._own(self.prior.physical(self.z + sign * reach)) for sign in (-1, 1))
        names = [name for name in self.prior.layout.names if name != "surface"]
        return {name: (getattr(low, name), getattr(high, name)) for name in names}

    def profile(self, pushes: Pushes, slider: Slider, hand: Hand, label: str, **options: Any) -> "Profile":
        """How much worse all pushes are explained with one of `labels` held: see `uncertainty.profile`."""
        from pushjax.identify.uncertainty import profile

        return profile(self, pushes, slider, hand, label, **options)

    def bootstrap(self, key: PRNGKeyArray, pushes: Pushes, slider: Slider, hand: Hand, n: int) -> Physical:
        """What would have been found of `n` sets of pushes drawn from these with replacement, with (n,) in front: see
        `uncertainty.bootstrap`."""
        from pushjax.identify.uncertainty import bootstrap

        return bootstrap(key, self, pushes, slider, hand, n)[0]

    def applied(self, slider: Slider, hand: Hand, path: Array) -> tuple[Slider, Hand, Array]:
        """Slider, hand and path as they really are, to roll out with. path: (steps + 1, dof).

        Raises ValueError for what was found of several conditions, or if something was asked for that
        these three cannot tell, such as a table.
        """
        if not self.single:
            raise ValueError("applied is for what was found of one condition; of several there is `predict`")
        more = [name for name in self.prior.layout.names if name not in APPLIED]
        if more:
            raise ValueError(f"applied cannot tell of {', '.join(more)}; for what was found of them there is `predict`")
        own = self.physical
        shape, hand = smaller(slider.shape, hand, own.inset)
        return Slider(shape, self.surface), hand, moved(path, own.end, own.lag, own.offset)

    def predict(self, pushes: Pushes, slider: Slider, hand: Hand) -> Trajectory:
        """These or other pushes, of the same conditions, rolled out; every array with axes (..., pushes) in front.
        slider: its outline counts, hand: as it was said to be."""
        theta = self.prior.physical(self.z)
        body = Body(slider.shape, hand, self.prior.origin)
        each = _trajectories(theta, surfaces(self.prior, theta), body, pushes.as_conditions())
        return self._own(each)

    def _own(self, several: Any) -> Any:
        return jax.tree.map(lambda leaf: leaf[0], several) if self.single else several


_trajectories = quickly_compiled(trajectories)


def surfaces(prior: Prior, theta: Physical) -> LimitSurface:
    """With a leading axis of conditions."""
    kind = Quartic if prior.mean.lower.shape[1] > 1 else Ellipsoid
    return jax.vmap(kind)(theta.surface, prior.mean.length)
