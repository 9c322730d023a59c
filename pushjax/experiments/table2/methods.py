"""Three ways to predict the pushes that were not learned from.

ideal         The surface of the known support, with the friction found on a grid: the paper's.
wrench_twist  The surface fitted to the forces measured during the pushes, with the friction found on a grid: the other
              way of the paper.
identified    Friction, surface, and how far the hand really went, identified from the final poses alone:
              `pushjax.identification`.
"""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.datasets import Recordings
from pushjax.experiments._tables import MODELS, Prediction, deviation_mm, final_poses
from pushjax.experiments.table2.conditions import Geometry, outline, recorded

FRICTIONS = np.linspace(0.0, 0.8, 41)
# Share of the pushes to learn from. A quartic has fifteen coefficients, and a push gives one pair.
TRAIN_SHARE = {"ideal": 0.4, "wrench_twist": 0.5, "identified": 0.4}
Part = Callable[[str], AbstractContextManager[None]]  # from a description of the work to the context of doing it
IDENTIFY_STEPS = 40  # at most: the fit, which takes derivatives, gives the same answer with more
# Priors: the supports are known to about a millimeter, the robot's condition less well.
SURFACE_DOF, INSET, OVERSHOOT = 200.0, 0.002, 0.001


class ConditionData(NamedTuple):
    """One condition as the methods take it."""

    log: Recordings  # the pushes as logged, with their forces
    pushes: pj.Pushes  # the same as arrays
    surface: pj.LimitSurface  # of the known support
    train: np.ndarray  # (splits, pushes), True for training pushes


def ideal(condition: ConditionData, geometry: Geometry) -> Prediction:
    """Predict one condition with the known surface and the friction that is best for the training pushes, on a grid.

    Args:
        condition: The condition.
        geometry: Where the finger really was.
    """
    errors, failed = _deviations_on_grid(condition, condition.surface, geometry)
    return _choose_friction(np.broadcast_to(errors, (len(condition.train), *errors.shape)), condition.train, failed)


def wrench_twist(condition: ConditionData, model: str, geometry: Geometry) -> Prediction:
    """Predict one condition with a surface fitted to measured forces, and the best friction on a grid.

    Args:
        condition: The condition. The fitted surfaces have the characteristic length of its surface.
        model: "quartic" or "ellipsoid".
        geometry: Where the finger really was.
    """
    length = condition.surface.length
    pushes = condition.log.pushes
    wrench, twist = (
        jnp.asarray(np.concatenate([getattr(push, name) for push in pushes]), length.dtype)
        for name in ("wrench", "twist")
    )
    errors, failed = [], 0
    for trains in condition.train:
        surface = pj.fit_limit_surface(wrench[trains], twist[trains], length, degree=MODELS[model])
        split_errors, split_failed = _deviations_on_grid(condition, surface, geometry)
        errors.append(split_errors)
        failed += int(split_failed.sum())
    return _choose_friction(np.stack(errors), condition.train, np.asarray(failed))


def identified(conditions: Sequence[ConditionData], geometry: Geometry, part: Part) -> list[Prediction]:
    """Predict conditions with what is identified from the final poses of all of them at once.

    The conditions share the robot, whose geometry is not taken as given. The surface of each condition is the mean of
    its prior.

    Args:
        conditions: The conditions.
        geometry: Where the finger is assumed to have been, as the mean of the prior.
        part: Context in which each split is computed.

    Returns:
        One prediction per condition.
    """
    first = conditions[0]
    fine = pj.Pushes.conditions([condition.pushes for condition in conditions])
    steps = min(fine.path.shape[-2] - 1, IDENTIFY_STEPS)
    pushes = pj.Pushes.conditions([recorded(condition.log, geometry, steps) for condition in conditions])
    surfaces = jax.tree.map(lambda *each: jnp.stack(each), *(condition.surface for condition in conditions))
    slider = pj.Slider(outline(first.log, geometry), surfaces)
    unknowns = pj.Unknowns((0.0, 1.0), surface_dof=SURFACE_DOF, inset=INSET, overshoot=OVERSHOOT)
    hand, length = pj.Hand.finger(geometry.radius), first.log.length
    counts = [condition.train.shape[1] for condition in conditions]
    errors, friction, failed = [], [], np.zeros(len(conditions), int)
    for split in range(len(first.train)):
        weight = np.zeros(pushes.weight.shape)
        for row, (condition, count) in enumerate(zip(conditions, counts, strict=True)):
            weight[row, :count] = condition.train[split]
        with part(f"split {split + 1} of {len(first.train)}"):
            found = pj.identify(pushes.weighted(weight), slider, hand, unknowns, length=length)
            predicted = found.predict(fine, slider, hand)
            errors.append(deviation_mm(predicted.pose[..., -1, :], fine.end, length))
            failed += np.asarray(predicted.failed).sum(axis=(1, 2))
            friction.append(np.asarray(found.friction))
    return [
        Prediction(np.stack([e[k, :count] for e in errors]), np.stack(friction)[:, k], int(failed[k]))
        for k, count in enumerate(counts)
    ]


def _deviations_on_grid(
    condition: ConditionData, surface: pj.LimitSurface, geometry: Geometry
) -> tuple[np.ndarray, np.ndarray]:
    """Return every push's deviation in mm and number of failed steps at every friction, (frictions, pushes)."""
    log, pushes = condition.log, condition.pushes
    slider = pj.Slider(outline(log, geometry), surface)
    hand = pj.Hand.finger(geometry.radius)
    final, failed, _ = final_poses(slider, hand, pushes, jnp.asarray(FRICTIONS, pushes.path.dtype))
    return deviation_mm(final, pushes.end[None], log.length), np.asarray(failed)


def _choose_friction(errors: np.ndarray, train: np.ndarray, failed: np.ndarray) -> Prediction:
    """Choose for each split's errors (frictions, pushes) the friction that is best for its training pushes."""
    best = [
        int(np.argmin(split_errors[:, trains].mean(axis=1))) for split_errors, trains in zip(errors, train, strict=True)
    ]
    chosen = np.stack([split_errors[row] for split_errors, row in zip(errors, best, strict=True)])
    return Prediction(chosen, FRICTIONS[best], int(failed.sum()))
