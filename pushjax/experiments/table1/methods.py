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
from pushjax.datasets import Recordings
from pushjax.experiments._tables import MODELS, Prediction, deviation_mm, final_poses
from pushjax.experiments.table1.conditions import outline, padded_pushes
from pushjax.experiments.table1.groups import group, training_pushes

FRICTIONS = np.linspace(0.0, 0.6, 31)
# Largest number of steps per push in the identification, which takes derivatives. More steps give the same answer.
IDENTIFY_STEPS = 25
# Largest numbers of pushes to learn from and to test with; arrays are padded to them.
TRAINING_SIZE, TEST_SIZE = 128, 304
# Priors, as in `pj.Unknowns`: degrees of freedom of the surface, and standard deviations in m. All values were chosen
# on the surface abs.
UNKNOWNS: dict[str, Any] = {
    "surface_dof": 10.0,
    "pressure_center": 0.015,
    "inset": 0.001,
    "hand_offset": 0.002,
    "frame_offset": 0.001,
}


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
    def of(log: Recordings, model: str, steps: int) -> "ConditionData":
        """Prepare the data of one object for a model, with `steps` steps of each push."""
        assert log.length is not None  # known for every object of the data set
        assert log.tip_radius is not None
        training, test = training_pushes(log), group(log, "middle")
        last = max(push.index for push in group(log, "whole").pushes)
        dtype = jnp.result_type(float)
        wrench, twist = (
            jnp.asarray(np.concatenate([getattr(push, name) for push in training.pushes]), dtype)
            for name in ("wrench", "twist")
        )
        return ConditionData(
            padded_pushes(training, last, steps, TRAINING_SIZE),
            padded_pushes(training, last, min(steps, IDENTIFY_STEPS), TRAINING_SIZE),
            padded_pushes(test, last, steps, TEST_SIZE),
            outline(log),
            pj.Hand.finger(log.tip_radius),
            pj.fit_limit_surface(wrench, twist, log.length, degree=MODELS[model]),
            log.length,
        )

    @property
    def slider(self) -> pj.Slider:
        """The object with the fitted surface."""
        return pj.Slider(self.shape, self.surface)


def wrench_twist(condition: ConditionData) -> Prediction:
    """Predict with the fitted surface and the friction that is best for the training pushes, on a grid."""
    training, test = condition.training, condition.test
    on_grid, *_ = final_poses(condition.slider, condition.hand, training, jnp.asarray(FRICTIONS, training.path.dtype))
    errors = pj.deviation(on_grid, training.end[None], condition.length)
    best = FRICTIONS[int(np.argmin(np.asarray(errors @ training.weight)))]
    final, failed, _ = final_poses(condition.slider, condition.hand, test, jnp.asarray([best], training.path.dtype))
    return _prediction(condition, final[0], best, failed[0], None)


def identified(condition: ConditionData) -> Prediction:
    """Predict with everything that is identified from the final poses of the training pushes."""
    found = fitted(condition.coarse, condition, pj.Unknowns((0.0, 1.0), **UNKNOWNS))
    predicted = found.predict(condition.test, condition.slider, condition.hand)
    return _prediction(condition, predicted.pose[:, -1], found.friction, predicted.failed, found)


def _prediction(condition: ConditionData, final, friction, failed, found: pj.Identified | None) -> Prediction:
    """Return the prediction of the test pushes, from arrays that are padded to `TEST_SIZE`."""
    final, failed, end = (without_padding(values, condition.test) for values in (final, failed, condition.test.end))
    errors = deviation_mm(final, end, condition.length)
    return Prediction(errors, np.asarray(friction, float), int(failed.sum()), found)


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
