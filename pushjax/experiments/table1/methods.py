"""Two ways to predict the test pushes, which are not used for training.

wrench_twist  The method of the paper. The surface is fitted to measured forces and motions. The friction is found on a
              grid.
identified    Friction, surface, center of pressure, and the true positions of tip and object are identified from the
              final poses of the training pushes. Tip and object are assumed to touch in most of these poses. The search
              starts from the surface of `wrench_twist`. If the corrected positions still overlap at the start of a
              push, the overlap is assumed to be a measurement error.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.datasets.mit_pushes import MitPushes
from pushjax.experiments._tables import final_poses
from pushjax.experiments.table1.conditions import MODELS, outline, padded_pushes

FRICTIONS = np.linspace(0.0, 0.6, 31)
# Largest number of steps per push in the identification, which takes derivatives. More steps give the same answer.
IDENTIFY_STEPS = 25
# Largest numbers of pushes to learn from and to test with; arrays are padded to them.
TRAINING_SIZE, TEST_SIZE = 128, 304
# Priors, as in `pj.Unknowns`: degrees of freedom of the surface, and standard deviations in m. All values were chosen
# on the surface abs.
SURFACE_DOF, PRESSURE_CENTER, INSET, HAND_OFFSET, FRAME_OFFSET = 10.0, 0.015, 0.001, 0.002, 0.001
UNKNOWNS: dict[str, Any] = {
    "surface_dof": SURFACE_DOF,
    "pressure_center": PRESSURE_CENTER,
    "inset": INSET,
    "hand_offset": HAND_OFFSET,
    "frame_offset": FRAME_OFFSET,
}


class Prediction(NamedTuple):
    """Predictions of the test pushes."""

    final: np.ndarray  # (pushes, 3), final poses, world, m and rad
    friction: float  # identified coefficient of friction
    failed: int  # number of failed steps
    found: pj.Identified | None  # None if the method identifies nothing else


class ConditionData(NamedTuple):
    """One object on one surface as both methods take it, with pushes as padded arrays."""

    training: pj.Pushes
    coarse: pj.Pushes  # training pushes in at most `IDENTIFY_STEPS` steps
    test: pj.Pushes
    shape: pj.Shape
    hand: pj.Hand
    surface: pj.LimitSurface  # fitted to measured forces and motions
    length: float  # characteristic length of the deviations, m

    @staticmethod
    def of(log: MitPushes, model: str, steps: int) -> "ConditionData":
        """Prepare the data of one object for a model, with `steps` steps of each push."""
        rows = np.flatnonzero(log.is_training & log.whole.valid)
        dtype = jnp.result_type(float)
        pairs = jnp.asarray(log.wrench, dtype), jnp.asarray(log.twist, dtype)
        return ConditionData(
            padded_pushes(log, log.whole, rows, steps, TRAINING_SIZE),
            padded_pushes(log, log.whole, rows, min(steps, IDENTIFY_STEPS), TRAINING_SIZE),
            padded_pushes(log, log.middle, np.arange(len(log.middle)), steps, TEST_SIZE),
            outline(log),
            pj.Hand.finger(log.tip_radius),
            pj.fit_limit_surface(*pairs, log.length, degree=MODELS[model]),
            log.length,
        )

    @property
    def slider(self) -> pj.Slider:
        """The object with the fitted surface."""
        return pj.Slider(self.shape, self.surface)


def wrench_twist(condition: ConditionData) -> Prediction:
    """Predict with the fitted surface and the friction that is best for the training pushes, on a grid."""
    training, test = condition.training, condition.test
    on_grid, _ = final_poses(condition.slider, condition.hand, training, jnp.asarray(FRICTIONS, training.path.dtype))
    errors = pj.deviation(on_grid, training.end[None], condition.length)
    best = FRICTIONS[int(np.argmin(np.asarray(errors @ training.weight)))]
    final, failed = final_poses(condition.slider, condition.hand, test, jnp.asarray([best], training.path.dtype))
    final, failed = (without_padding(values[0], test) for values in (final, failed))
    return Prediction(final, float(best), int(failed.sum()), None)


def identified(condition: ConditionData) -> Prediction:
    """Predict with everything that is identified from the final poses of the training pushes."""
    found = fitted(condition.coarse, condition, pj.Unknowns((0.0, 1.0), **UNKNOWNS))
    predicted = found.predict(condition.test, condition.slider, condition.hand)
    final, failed = (without_padding(values, condition.test) for values in (predicted.pose[:, -1], predicted.failed))
    return Prediction(final, float(found.friction), int(failed.sum()), found)


def fitted(pushes: pj.Pushes, condition: ConditionData, unknowns: pj.Unknowns, overlap: float = 1.0) -> pj.Identified:
    """Identify the unknowns, assuming that the finger touches the object at the end of most pushes."""
    found = pj.identify(
        pushes, condition.slider, condition.hand, unknowns, length=condition.length, contact_at_end=True
    )
    # Tip and object may overlap at the start of a push to predict. The part `overlap` of it is a measurement error; the
    # rest is real and pushes the object. The part is imposed, not estimated: the training pushes are whole, from the
    # touch on, so they carry no information about it.
    return found.with_known(overlap=overlap)


METHODS = {"wrench_twist": wrench_twist, "identified": identified}


def without_padding(values, pushes: pj.Pushes) -> np.ndarray:
    """Return the rows of `values` that belong to pushes, without those of the padding, as float64."""
    return np.asarray(values, np.float64)[np.asarray(pushes.weight) > 0]
