"""Three ways to predict the pushes that were not learned from. Each gives the deviation of every push, in mm, under
every split: (splits, pushes); what friction it found, (splits,); and how many steps failed.

ideal         the surface of the known support, the friction by a grid (the paper's).
wrench_twist  the surface fitted to the forces measured on the way, the friction by a grid (the paper's other way).
identified    friction, surface and how far the hand really went from the final poses alone: `pushjax.identify`.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.datasets import PushLog
from pushjax.experiments._tables import final_poses
from pushjax.experiments.table2.conditions import MODELS, Geometry, outline, recorded

FRICTIONS = np.linspace(0.0, 0.8, 41)
# Of the pushes, to learn from. A quartic has fifteen coefficients, a push gives one pair.
TRAIN_SHARE = {"ideal": 0.4, "wrench_twist": 0.5, "identified": 0.4}
IDENTIFY_STEPS = 40  # at most: derivatives are for the fit, whose answer does not change with more
# The supports are known to a millimetre or so, the robot's set-up less well.
DOF, INSET, END = 200.0, 0.002, 0.001


class Predicted(NamedTuple):
    errors: np.ndarray
    friction: np.ndarray
    failed: int


def ideal(
    log: PushLog, pushes: pj.Pushes, surface: pj.LimitSurface, train: np.ndarray, geometry: Geometry
) -> Predicted:
    errors, failed = _on_grid(log, pushes, surface, geometry)
    return _best(np.broadcast_to(errors, (len(train), *errors.shape)), train, failed)


def wrench_twist(
    log: PushLog, pushes: pj.Pushes, length: jax.Array, model: str, train: np.ndarray, geometry: Geometry
) -> Predicted:
    """length: of the surfaces, m."""
    wrench, twist = (jnp.asarray(pairs, length.dtype) for pairs in log.wrench_twist_pairs())
    errors, failed = [], 0
    for mine in train:
        surface = pj.fit_limit_surface(wrench[mine], twist[mine], length, degree=MODELS[model])
        each, wrong = _on_grid(log, pushes, surface, geometry)
        errors.append(each)
        failed += int(wrong.sum())
    return _best(np.stack(errors), train, np.asarray(failed))


def identified(
    logs: list[PushLog],
    recordings: list[pj.Pushes],
    surfaces: list[pj.LimitSurface],
    train: list[np.ndarray],
    geometry: Geometry,
    done: Callable[[], None],
) -> list[Predicted]:
    """All conditions at once: they share the robot, whose geometry is not taken as given. `done` is called after each
    split."""
    fine = pj.Pushes.conditions(recordings)
    steps = min(fine.path.shape[-2] - 1, IDENTIFY_STEPS)
    pushes = pj.Pushes.conditions([recorded(log, geometry, steps) for log in logs])
    slider = pj.Slider(outline(logs[0], geometry), jax.tree.map(lambda *each: jnp.stack(each), *surfaces))
    unknowns = pj.Unknowns((0.0, 1.0), dof=DOF, inset=INSET, end=END)
    hand, length = pj.Hand.finger(geometry.radius), logs[0].length
    errors, friction, failed = [], [], np.zeros(len(logs), int)
    for split in range(len(train[0])):
        weight = np.zeros(pushes.weight.shape)
        for condition, chosen in enumerate(train):
            weight[condition, : chosen.shape[1]] = chosen[split]
        found = pj.identify(pushes.weighted(weight), slider, hand, unknowns, length=length)
        predicted = found.predict(fine, slider, hand)
        errors.append(1e3 * np.asarray(pj.deviation(predicted.pose[..., -1, :], fine.end, length), np.float64))
        failed += np.asarray(predicted.failed).sum(axis=(1, 2))
        friction.append(np.asarray(found.friction))
        done()
    return [
        Predicted(np.stack([e[k, : train[k].shape[1]] for e in errors]), np.stack(friction)[:, k], int(failed[k]))
        for k in range(len(logs))
    ]


def _on_grid(
    log: PushLog, pushes: pj.Pushes, surface: pj.LimitSurface, geometry: Geometry
) -> tuple[np.ndarray, np.ndarray]:
    """Deviation in mm of every push at every friction, (frictions, pushes), and how many steps failed of each."""
    slider = pj.Slider(outline(log, geometry), surface)
    hand = pj.Hand.finger(geometry.radius)
    final, failed = final_poses(slider, hand, pushes, jnp.asarray(FRICTIONS, pushes.path.dtype))
    return 1e3 * np.asarray(pj.deviation(final, pushes.end[None], log.length), np.float64), np.asarray(failed)


def _best(errors: np.ndarray, train: np.ndarray, failed: np.ndarray) -> Predicted:
    """Of each split's errors (frictions, pushes) those at the friction that is best on what it learns from."""
    best = [int(np.argmin(e[:, mine].mean(axis=1))) for e, mine in zip(errors, train, strict=True)]
    chosen = np.stack([e[b] for e, b in zip(errors, best, strict=True)])
    return Predicted(chosen, FRICTIONS[best], int(failed.sum()))
