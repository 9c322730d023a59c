"""The result of identification: estimates and their posterior distribution."""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from scipy.special import ndtri

from pushjax._internal.checks import ArrayLike
from pushjax._internal.files import load_json, save_json, to_list
from pushjax.friction.limit_surface import LimitSurface
from pushjax.identification import uncertainty
from pushjax.identification.model import Scene, apply_inset, correct_path, limit_surfaces, predict_pushes
from pushjax.identification.prior import Layout, Prior, PriorFeet, PriorSurface
from pushjax.identification.pushes import Pushes
from pushjax.identification.unknowns import NORMAL_PRIORS, Parameters, Unknowns, known_parameters
from pushjax.simulation.hand import Hand
from pushjax.simulation.slider import Slider
from pushjax.simulation.trajectory import Trajectory

FORMAT, VERSION = "pushjax identified", 2
FLAGS = ("one_condition", "robust", "contact_at_end")
ARRAYS = ("z", "precision", "sigma", "direction_sigma", "gap_sigma", "residual", "information", "loss", "length")
# Unknowns that slider, hand and path can represent.
CORRECTABLE = ("friction", "surface", "pressure_center", "inset", "overshoot", "lag_distance", "hand_offset")
LOGISTIC_VARIANCE = np.pi**2 / 3  # of z if the friction is uniform in its range


class Identified(eqx.Module):
    """Most probable values of the unknowns, with a normal approximation of the posterior about them (Laplace's method).

    All properties have a leading axis of conditions if the pushes had one. Values that conditions share are repeated.

    Attributes:
        z: (size,) most probable values, in the coordinates of `prior`.
        precision: (size, size) inverse covariance of z.
        prior: Prior of the unknowns; it converts z to physical parameters.
        sigma: Standard deviation in m of each of x, y and length * theta of a measured pose about its prediction.
        direction_sigma: Standard deviation of each component of the unit vector along the motion under a measured
            wrench; zero if no wrench was recorded.
        gap_sigma: Standard deviation in m of the gap at the end of a push; zero unless `contact_at_end`.
        residual: (..., pushes, 3) predicted less measured final pose, in x, y and length * theta, m.
        information: (..., pushes, size) contribution of each push to the diagonal of the precision.
        loss: The minimized loss: twice the negative log posterior density, up to a constant.
        length: Length of the metric, m.
        steps: Number of steps of the optimizer.
        converged: Whether the optimizer converged.
        one_condition: Whether the pushes had no axis of conditions.
        robust: As given to `identify`.
        contact_at_end: As given to `identify`.
    """

    z: Float[Array, "size"]
    precision: Float[Array, "size size"]
    prior: Prior
    sigma: Float[Array, ""]
    direction_sigma: Float[Array, ""]
    gap_sigma: Float[Array, ""]
    residual: Float[Array, "*conditions pushes 3"]
    information: Float[Array, "*conditions pushes size"]
    loss: Float[Array, ""]
    length: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]
    one_condition: bool = eqx.field(static=True)
    robust: float | None = eqx.field(static=True)
    contact_at_end: bool = eqx.field(static=True, default=False)

    @property
    def parameters(self) -> Parameters:
        """All parameters that a push depends on, as arrays."""
        return self._drop_condition_axis(self.prior.parameters(self.z))

    @property
    def friction(self) -> Float[Array, "*conditions"]:
        """Friction coefficient mu between the fingers and the slider."""
        return self.parameters.friction

    @property
    def surface(self) -> LimitSurface:
        """Limit surface, center of pressure included; with conditions, its arrays have a leading axis of conditions."""
        return self._drop_condition_axis(limit_surfaces(self.prior, self.prior.parameters(self.z)))

    @property
    def covariance(self) -> Float[Array, "size size"]:
        """Covariance of z, (size, size)."""
        return jnp.linalg.inv(self.precision)

    @property
    def labels(self) -> tuple[str, ...]:
        """Label of each number of z."""
        return self.prior.layout.labels

    @property
    def variance_reduction(self) -> dict[str, float]:
        """Reduction of the variance of each number of z, by label: 1 - posterior variance / prior variance.

        The prior variance of a friction is that of the uniform distribution over its range. Near zero, the pushes do
        not determine the number.
        """
        prior_variance = np.where(self.prior.layout.has_normal_prior > 0, 1.0, LOGISTIC_VARIANCE)
        reduction = 1 - np.diagonal(np.asarray(self.covariance, float)) / prior_variance
        return dict(zip(self.labels, np.clip(reduction, 0, 1).tolist(), strict=True))

    def information_share(self, name: str) -> Float[Array, "*conditions pushes"]:
        """Return the fraction of the total information about `name` that each push contributes.

        Args:
            name: Name of an unknown (friction, surface, ...).

        Returns:
            (..., pushes) fractions that add up to one over all conditions and pushes.

        Raises:
            ValueError: If `name` was not identified.
        """
        if name not in self.prior.layout.names:
            raise ValueError(f"name must be one of {', '.join(self.prior.layout.names)}; got {name!r}")
        layout = self.prior.layout
        positions = np.unique(layout.positions[:, layout.slices[name]])
        per_push = jnp.sum(self.information[..., positions], axis=-1)
        total = jnp.sum(per_push)
        return per_push / jnp.where(total > 0, total, 1.0)

    def with_known(self, **known: ArrayLike) -> "Identified":
        """Return this result with other values of parameters that were not estimated.

        Args:
            **known: Values by name, as in the argument `known` of `identify`.

        Raises:
            ValueError: If a name is not that of a parameter or was estimated, or if a value is not finite or has the
                wrong shape.
        """
        prior = self.prior
        values = known_parameters(known, prior.unknowns, prior.layout.conditions, self.z.dtype)
        return eqx.tree_at(lambda found: found.prior.known, self, prior.known | values)

    def save(self, path: str | Path) -> None:
        """Write everything to a JSON file that `load` reads back to the same bits."""
        save_json(path, FORMAT, VERSION, self.z.dtype, to_record(self))

    @staticmethod
    def load(path: str | Path) -> "Identified":
        """Read a file that `save` wrote.

        Raises:
            ValueError: If the file holds something else.
        """
        return load_json(path, "an identification file", FORMAT, VERSION, from_record)

    def sample(self, key: PRNGKeyArray, n: int) -> Parameters:
        """Sample `n` values from the posterior distribution.

        Args:
            key: PRNG key.
            n: Number of samples.

        Returns:
            Independent samples; fields as in `parameters`, with a leading axis (n,).
        """
        normal = jax.random.normal(key, (len(self.z), n), self.z.dtype)
        upper = jnp.linalg.cholesky(self.precision).T
        z = self.z[None] + jax.scipy.linalg.solve_triangular(upper, normal, lower=False).T
        return self._samples(z)

    def interval(self, level: float = 0.9) -> dict[str, tuple[Array, Array]]:
        """Return an interval for each unknown except the surface.

        Each interval is that of its own number of z, so that a friction stays in its range.

        Args:
            level: Probability that each interval contains.

        Returns:
            Lowest and highest value by name; arrays shaped like the estimates.

        Raises:
            ValueError: If `level` is not between 0 and 1.
        """
        if not 0 < level < 1:
            raise ValueError(f"level must be between 0 and 1; got {level!r}")
        reach = float(ndtri(0.5 + level / 2)) * jnp.sqrt(jnp.diagonal(self.covariance))
        low, high = (self._drop_condition_axis(self.prior.parameters(self.z + sign * reach)) for sign in (-1, 1))
        names = [name for name in self.prior.layout.names if name != "surface"]
        return {name: (getattr(low, name), getattr(high, name)) for name in names}

    def profile(
        self,
        pushes: Pushes,
        slider: Slider,
        hand: Hand,
        label: str,
        *,
        points: int = uncertainty.POINTS,
        reach: float = uncertainty.REACH,
    ) -> uncertainty.Profile:
        """Compute how much worse all pushes are explained if one number of z is held at other values.

        Args:
            pushes: Pushes, as given to `identify`.
            slider: Slider, as given to `identify`.
            hand: Hand, as given to `identify`.
            label: One of `labels`, except those of the surface.
            points: Number of values on either side of the estimate.
            reach: Distance from the estimate to the outermost values, in standard deviations.

        Returns:
            The profile, with 2 * points + 1 values, and more where it is flat or steep. A side on which a friction is
                at an end of its range has none.

        Raises:
            ValueError: If `label` is another label.
        """
        return uncertainty.profile(self, pushes, slider, hand, label, points, reach)

    def bootstrap(self, key: PRNGKeyArray, pushes: Pushes, slider: Slider, hand: Hand, n: int) -> Parameters:
        """Identify from `n` bootstrap samples of the pushes of each condition, each from this estimate.

        Args:
            key: PRNG key.
            pushes: Pushes, as given to `identify`.
            slider: Slider, as given to `identify`.
            hand: Hand, as given to `identify`.
            n: Number of samples.

        Returns:
            The estimates, with a leading axis (n,).

        Raises:
            ValueError: If all pushes of a condition have weight zero.
        """
        return self._samples(uncertainty.bootstrap(key, self, pushes, slider, hand, n))

    def corrected(self, slider: Slider, hand: Hand, path: Array) -> tuple[Slider, Hand, Array]:
        """Return slider, hand and path as they really are, for use in rollouts.

        Args:
            slider: Slider, as given to `identify`.
            hand: Hand, as given to `identify`.
            path: (steps + 1, dof) path of the hand as logged.

        Returns:
            Slider, hand and path with the identified surface and calibration.

        Raises:
            ValueError: If several conditions were identified, or if a parameter was identified or known that slider,
                hand and path cannot represent, such as the table.
        """
        if not self.one_condition:
            raise ValueError("corrected is for what was found of one condition; of several there is `predict`")
        names = (*self.prior.layout.names, *self.prior.known)
        uncorrectable = [name for name in names if name not in CORRECTABLE]
        if uncorrectable:
            raise ValueError(
                f"corrected cannot represent {', '.join(uncorrectable)}; for what was found of them there is `predict`"
            )
        parameters = self.parameters
        shape, hand = apply_inset(slider.shape, hand, parameters.inset)
        path = correct_path(path, parameters.overshoot, parameters.lag_distance, parameters.hand_offset)
        return Slider(shape, self.surface), hand, path

    def predict(self, pushes: Pushes, slider: Slider, hand: Hand) -> Trajectory:
        """Predict these or other pushes of the same conditions.

        Args:
            pushes: Pushes of the same conditions.
            slider: Slider; only its outline is used.
            hand: Hand, as given to `identify`.

        Returns:
            Trajectories; every array has leading axes (..., pushes).
        """
        parameters = self.prior.parameters(self.z)
        surfaces, scene = limit_surfaces(self.prior, parameters), Scene(slider.shape, hand, self.prior.origin)
        return self._drop_condition_axis(predict_pushes(parameters, surfaces, scene, pushes.as_conditions()))

    def _samples(self, z: Float[Array, "n size"]) -> Parameters:
        """Return the parameters of several z."""
        return jax.vmap(lambda one: self._drop_condition_axis(self.prior.parameters(one)))(z)

    def _drop_condition_axis(self, tree: Any) -> Any:
        """Drop the axis of conditions if the pushes had none."""
        return jax.tree.map(lambda leaf: leaf[0], tree) if self.one_condition else tree


def to_record(found: Identified) -> dict[str, Any]:
    """Return the result as a dictionary of numbers and lists, for a JSON file."""
    unknowns, mean = found.prior.unknowns, found.prior.mean_surface
    record: dict[str, Any] = {name: getattr(found, name) for name in FLAGS}
    record |= {"steps": int(found.steps), "converged": bool(found.converged), "labels": found.labels}
    record |= {name: to_list(getattr(found, name)) for name in ARRAYS}
    record["unknowns"] = {
        name: to_list(getattr(unknowns, name)) for name in ("friction", "surface_dof", *NORMAL_PRIORS)
    }
    record |= {"sides": unknowns.sides, "shared": unknowns.shared, "origin": to_list(found.prior.origin)}
    record["known"] = {name: to_list(value) for name, value in found.prior.known.items()}
    record["mean_surface"] = {name: to_list(value) for name, value in vars(mean).items()}
    # The estimates are for people who read the file. `from_record` computes them again.
    estimates = found.parameters._asdict()
    record["estimates"] = {name: to_list(value) for name, value in estimates.items() if value is not None}
    return record


def from_record(record: dict[str, Any], dtype: Any) -> Identified:
    """Return the result that `to_record` wrote, in a floating dtype."""

    def array(value: Any) -> Any:
        return None if value is None else jnp.asarray(value, dtype)

    priors = {name: array(value) for name, value in record["unknowns"].items()}
    unknowns = Unknowns(priors.pop("friction"), **priors, sides=record["sides"], shared=tuple(record["shared"]))
    kind = PriorFeet if "limit" in record["mean_surface"] else PriorSurface
    mean = kind(**{name: array(value) for name, value in record["mean_surface"].items()})
    layout = Layout.of(unknowns, mean.entries, len(mean.length))
    known = {name: array(value) for name, value in record["known"].items()}
    prior = Prior(unknowns, known, mean, array(record["origin"]), layout)
    arrays = {name: array(record[name]) for name in ARRAYS}
    if arrays["z"].shape != (layout.size,) or arrays["precision"].shape != (layout.size, layout.size):
        raise ValueError(f"its z has shape {arrays['z'].shape}; what it says was unknown has ({layout.size},)")
    return Identified(
        **arrays,
        **{name: record[name] for name in FLAGS},
        prior=prior,
        steps=jnp.asarray(record["steps"], jnp.int32),
        converged=jnp.asarray(record["converged"], bool),
    )
