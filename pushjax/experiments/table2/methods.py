"""Three ways to predict the test pushes, which are not used for training.

ideal         A method of the paper. The surface is that of the known support. The friction is found on a grid.
wrench_twist  The other method of the paper. The surface is fitted to the forces measured during the pushes. The
              friction is found on a grid.
identified    Friction, surface, and how far the hand really went are identified from the final poses alone, by
              `pushjax.identification`.
"""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.datasets import Recordings
from pushjax.experiments._tables import MODELS, Prediction, deviation_mm, final_poses
from pushjax.experiments.table2.conditions import Geometry, outline, recorded

FRICTIONS = np.linspace(0.0, 0.8, 41)
# Share of the pushes that is used for training: the paper's, but half for `wrench_twist`. A push gives one pair of
# wrench and twist, and a quartic has fifteen coefficients.
TRAIN_SHARE = {"ideal": 0.4, "wrench_twist": 0.5, "identified": 0.4}
# Largest number of steps per push in the identification, which takes derivatives. More steps give the same answer.
IDENTIFY_STEPS = 40
# Priors, as in `pj.Unknowns`: degrees of freedom of the surface, and standard deviations in m. The supports are known
# to about a millimeter, the geometry of the robot less well.
UNKNOWNS: dict[str, Any] = {"surface_dof": 200.0, "inset": 0.002, "overshoot": 0.001}
Part = Callable[[str], AbstractContextManager[None]]  # from the description of a part of the work to its context


class ConditionData(NamedTuple):
    """One condition as all methods take it."""

    log: Recordings  # the pushes as logged, with their forces
    pushes: pj.Pushes  # the same as arrays
    surface: pj.LimitSurface  # of the known support
    train: np.ndarray  # (splits, pushes), True for training pushes


def ideal(condition: ConditionData, geometry: Geometry) -> Prediction:
    """Predict one condition with the surface of the known support, and the best friction on a grid."""
    grid = _deviations_on_grid(condition, condition.surface, geometry)
    return _choose_friction([grid] * len(condition.train), condition.train)


def wrench_twist(condition: ConditionData, model: str, geometry: Geometry) -> Prediction:
    """Predict one condition with a surface fitted to measured forces, and the best friction on a grid."""
    length = condition.surface.length
    wrench, twist = (
        jnp.asarray(np.concatenate([getattr(push, name) for push in condition.log.pushes]), length.dtype)
        for name in ("wrench", "twist")
    )
    surfaces = (
        pj.fit_limit_surface(wrench[trains], twist[trains], length, degree=MODELS[model]) for trains in condition.train
    )
    grids = [_deviations_on_grid(condition, surface, geometry) for surface in surfaces]
    return _choose_friction(grids, condition.train)


def identified(conditions: Sequence[ConditionData], geometry: Geometry, part: Part) -> list[Prediction]:
    """Predict conditions with what is identified from the final poses of all of them at once, split by split."""
    # The conditions share the geometry of the robot. The means of the prior are `geometry` and the known surfaces.
    first = conditions[0]
    fine = pj.Pushes.conditions([condition.pushes for condition in conditions])
    steps = min(fine.path.shape[-2] - 1, IDENTIFY_STEPS)
    pushes = pj.Pushes.conditions([recorded(condition.log, geometry, steps) for condition in conditions])
    surfaces = jax.tree.map(lambda *each: jnp.stack(each), *(condition.surface for condition in conditions))
    slider = pj.Slider(outline(first.log, geometry), surfaces)
    unknowns = pj.Unknowns((0.0, 1.0), **UNKNOWNS)
    hand, length = pj.Hand.finger(geometry.radius), first.log.length
    counts = [condition.train.shape[1] for condition in conditions]
    errors, friction, failed = [], [], np.zeros(fine.weight.shape, int)
    for split in range(len(first.train)):
        weight = np.zeros(pushes.weight.shape)
        for row, (condition, count) in enumerate(zip(conditions, counts, strict=True)):
            weight[row, :count] = condition.train[split]
        with part(f"split {split + 1} of {len(first.train)}"):
            found = pj.identify(pushes.weighted(weight), slider, hand, unknowns, length=length)
            predicted = found.predict(fine, slider, hand)
            errors.append(deviation_mm(predicted.pose[..., -1, :], fine.end, length))
            failed += np.asarray(predicted.failed).sum(axis=2)
            friction.append(np.asarray(found.friction))
    return [
        Prediction(np.stack([e[k, :count] for e in errors]), np.stack(friction)[:, k], int(failed[k, :count].sum()))
        for k, count in enumerate(counts)
    ]


def _deviations_on_grid(
    condition: ConditionData, surface: pj.LimitSurface, geometry: Geometry
) -> tuple[np.ndarray, np.ndarray]:
    """Return the deviation in mm and the number of failed steps of each push at each friction, (frictions, pushes)."""
    log, pushes = condition.log, condition.pushes
    slider, hand = pj.Slider(outline(log, geometry), surface), pj.Hand.finger(geometry.radius)
    final, failed, _ = final_poses(slider, hand, pushes, jnp.asarray(FRICTIONS, pushes.path.dtype))
    return deviation_mm(final, pushes.end[None], log.length), np.asarray(failed)


def _choose_friction(grids: Sequence[tuple[np.ndarray, np.ndarray]], train: np.ndarray) -> Prediction:
    """Choose for each split, from its `_deviations_on_grid`, the friction that is best for its training pushes."""
    best = [int(np.argmin(errors[:, trains].mean(axis=1))) for (errors, _), trains in zip(grids, train, strict=True)]
    chosen = [(errors[row], failed[row]) for (errors, failed), row in zip(grids, best, strict=True)]
    errors, failed = map(np.stack, zip(*chosen, strict=True))
    return Prediction(errors, FRICTIONS[best], int(failed.sum()))
