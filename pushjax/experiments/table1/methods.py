"""Two ways to predict the pushes that were not learned from: each gives final poses, (pushes, 3), the friction it found
and how many steps failed.

wrench_twist  the surface fitted to measured forces and motions, the friction by a grid: the paper's.
identified    friction, surface, centre of pressure, and where tip and object really were, from final poses, in which
              the two touch, starting from that surface. What overlap is left at the start is taken to be none.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.datasets.mit_pushes import MitPushes
from pushjax.experiments._tables import final_poses
from pushjax.experiments.table1.conditions import MODELS, outline, straight

FRICTIONS = np.linspace(0.0, 0.6, 31)
IDENTIFY_STEPS = 25  # at most: derivatives are for the fit, whose answer does not change with more
# Pushes to learn from, and to test with: at most so many, filled up to so many.
LEARNED, TESTED = 128, 304
# How far what is not known may be from what it is taken for: the surface (degrees of freedom), the centre of pressure,
# the outline, the tip against the world in which the tracker sees the object, and the object against what is tracked,
# m. Chosen on abs.
DOF, CENTER, INSET, OFFSET, MARKER = 10.0, 0.015, 0.001, 0.002, 0.001
NO_ROOM = 1e-6  # for what is not to be found
UNKNOWNS: dict[str, Any] = {
    "dof": DOF,
    "center": CENTER,
    "inset": INSET,
    "offset": OFFSET,
    "marker": MARKER,
    "overlap": NO_ROOM,
}


class Predicted(NamedTuple):
    final: np.ndarray
    friction: float
    failed: int
    found: pj.Identified | None


class Setting(NamedTuple):
    """learned, tested: as arrays, filled up; coarse: what was learned from, in few steps. surface: from forces."""

    learned: pj.Pushes
    coarse: pj.Pushes
    tested: pj.Pushes
    shape: pj.Shape
    hand: pj.Hand
    surface: pj.LimitSurface
    length: float

    @staticmethod
    def of(log: MitPushes, model: str, steps: int) -> "Setting":
        rows = np.flatnonzero(log.learned & log.whole.valid)
        dtype = jnp.result_type(float)
        pairs = jnp.asarray(log.wrench, dtype), jnp.asarray(log.twist, dtype)
        return Setting(
            straight(log, log.whole, rows, steps, LEARNED),
            straight(log, log.whole, rows, min(steps, IDENTIFY_STEPS), LEARNED),
            straight(log, log.middle, np.arange(len(log.middle)), steps, TESTED),
            outline(log),
            pj.Hand.finger(log.tip_radius),
            pj.fit_limit_surface(*pairs, log.length, degree=MODELS[model]),
            log.length,
        )

    @property
    def slider(self) -> pj.Slider:
        return pj.Slider(self.shape, self.surface)


def wrench_twist(setting: Setting) -> Predicted:
    learned, tested = setting.learned, setting.tested
    on_grid, _ = final_poses(setting.slider, setting.hand, learned, jnp.asarray(FRICTIONS, learned.path.dtype))
    errors = pj.deviation(on_grid, learned.end[None], setting.length)
    best = FRICTIONS[int(np.argmin(np.asarray(errors @ learned.weight)))]
    final, failed = final_poses(setting.slider, setting.hand, tested, jnp.asarray([best], learned.path.dtype))
    return Predicted(own(final[0], tested), float(best), int(own(failed[0], tested).sum()), None)


def identified(setting: Setting) -> Predicted:
    found = fitted(setting.coarse, setting, pj.Unknowns((0.0, 1.0), **UNKNOWNS))
    predicted = found.predict(setting.tested, setting.slider, setting.hand)
    failed = own(predicted.failed, setting.tested)
    return Predicted(own(predicted.pose[:, -1], setting.tested), float(found.friction), int(failed.sum()), found)


def fitted(pushes: pj.Pushes, setting: Setting, unknowns: pj.Unknowns, overlap: float = 0.0) -> pj.Identified:
    """What the pushes tell, if the finger touches at the end of most. overlap: the share of it, at the start, that
    pushes. Pushes to learn from are whole, from the touch on, and tell nothing of it: it is said, not found."""
    found = pj.identify(pushes, setting.slider, setting.hand, unknowns, length=setting.length, touching=True)
    places = jnp.asarray([label.startswith("overlap") for label in found.labels])
    none = jnp.where(places, 1 - overlap, found.z).astype(found.z.dtype)
    return eqx.tree_at(lambda f: (f.z, f.prior.unknowns.overlap), found, (none, jnp.ones_like(found.sigma)))


METHODS = {"wrench_twist": wrench_twist, "identified": identified}


def own(values, pushes: pj.Pushes) -> np.ndarray:
    """Without what only fills up."""
    return np.asarray(values, np.float64)[np.asarray(pushes.weight) > 0]
