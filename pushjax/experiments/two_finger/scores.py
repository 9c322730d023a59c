"""How good the predictions of the two-finger pushes are.

There are two scores: the deviation of the final pose, and how often prediction and measurement agree on whether the
object stuck to the hand. The differences between repeats of one action show how good either score can be.
"""

from typing import Any

import numpy as np

from pushjax.datasets import Recordings
from pushjax.datasets.recordings import Floats, rotation, wrap_angle
from pushjax.experiments._tables import bootstrapped_ci95, deviation_mm, relative_motions
from pushjax.experiments.two_finger import predictions
from pushjax.experiments.two_finger.predictions import SPLITS, OnGrid, Tested, per_push

MAX_STUCK_MOTION = 0.003  # m
MIN_PUSHES_OF_A_DAY = 10
DAY = 86400.0  # s


def object_scores(log: Recordings, prediction: OnGrid, errors: np.ndarray, tested: Tested, seed: int) -> dict[str, Any]:
    """Return every score of one object, from the deviations (radii, frictions, n), mm, of its predictions."""
    no_motion_errors, action = deviation_mm(log.start, log.end, log.length), log.about("action")
    pairs = list(zip(tested.chosen, tested.test, strict=True))
    means = [errors[at][pushes].mean() for at, pushes in pairs]
    no_motion = float(np.mean([no_motion_errors[pushes].mean() for pushes in tested.test]))
    mean = float(np.mean(means))
    push_errors = per_push(errors, tested)
    was_tested = np.isfinite(push_errors)
    interval = bootstrapped_ci95(push_errors[was_tested], np.random.default_rng(seed), action[was_tested])
    return {
        "mean_mm": mean,
        "no_motion_mm": no_motion,
        "ratio": mean / no_motion,
        "ci95_mm": float(1.96 * np.std(means, ddof=1) / np.sqrt(SPLITS)),
        "ci95_bootstrap_mm": interval,
        "median_mm": float(np.median(push_errors[was_tested])),
        "worst_mm": float(push_errors[was_tested].max()),
        "worst_push": log.pushes[np.nanargmax(push_errors)].index,
        "friction": float(np.mean([predictions.FRICTIONS[friction] for _, friction in tested.chosen])),
        "radius_mm": float(1e3 * np.mean([predictions.RADII[radius] for radius, _ in tested.chosen])),
        "pushes": len(log),
        "unusable": len(log.problems),
        "actions": len(np.unique(action)),
        "splits": SPLITS,
        "failed_steps": int(prediction.failed.sum()),
        "jammed_pushes": float(np.mean([prediction.jammed[at].sum() for at in tested.chosen])),
        "repeats": _repeats(log, push_errors),
    } | _stick_agreement(log, prediction.final, tested)


def _stick_agreement(log: Recordings, final: np.ndarray, tested: Tested) -> dict[str, Any]:
    """Compare prediction and measurement on whether the object stuck to the hand."""
    measured_stuck = stick_deviation(log, log.end) < MAX_STUCK_MOTION
    table = np.zeros((2, 2))
    for at, pushes in zip(tested.chosen, tested.test, strict=True):
        predicted_stuck = stick_deviation(log, final[at]) < MAX_STUCK_MOTION
        np.add.at(table, (measured_stuck[pushes].astype(int), predicted_stuck[pushes].astype(int)), 1.0)
    table /= table.sum()
    shares = {
        "both": table[1, 1],
        "only_measured": table[1, 0],
        "only_predicted": table[0, 1],
        "neither": table[0, 0],
    }
    return {
        "stick_agreement": float(table[0, 0] + table[1, 1]),
        # the agreement reached by always giving the more frequent answer
        "stick_by_chance": float(max(table.sum(axis=1))),
        "stuck": {name: float(share) for name, share in shares.items()},
    }


def _repeats(log: Recordings, push_errors: np.ndarray) -> dict[str, Any]:
    """Compare the repeats of each action with each other, and with the model on the same pushes."""
    moved, stuck = relative_motions(log.start, log.end), stick_deviation(log, log.end) < MAX_STUCK_MOTION
    actions = log.about("action")
    floor, model, agree = [], [], []
    for action in np.unique(actions):
        same_action = np.flatnonzero(actions == action)
        if len(same_action) < 2:
            continue
        for push in same_action:
            others = same_action[same_action != push]
            distance = float(deviation_mm(moved[push], moved[others].mean(axis=0), log.length))
            # The mean of all repeats is estimated from the other k - 1, which makes the deviation too large by
            # sqrt(k / (k - 1)).
            floor.append(distance * np.sqrt(len(others) / len(same_action)))
            model.append(push_errors[push])
            agree += list(stuck[others] == stuck[push])
    if not floor:
        return {"pushes": 0}
    model = np.array(model)[np.isfinite(model)]
    return {
        "pushes": len(floor),
        "floor_mm": float(np.mean(floor)),
        "floor_median_mm": float(np.median(floor)),
        "model_mm": float(np.mean(model)) if len(model) else None,
        "model_median_mm": float(np.median(model)) if len(model) else None,
        "floor_agreement": float(np.mean(agree)),  # on whether the object stuck
    }


def stick_deviation(log: Recordings, end: np.ndarray) -> Floats:
    """Return the motions (n,) of the object relative to the hand, m, if the object ends at the poses (n, 3)."""
    assert log.length is not None
    hands = np.array([push.hand[[0, -1], :3] for push in log.pushes]).swapaxes(0, 1)
    before, after = (_in_hand_frame(*poses) for poses in zip(hands, (log.start, end), strict=True))
    # zero if both moved as one body; closing an initial gap between hand and object counts as relative motion too
    change = after - before
    return np.hypot(change[:, 0], change[:, 1]) + log.length * np.abs(wrap_angle(change[:, 2]))


def _in_hand_frame(hand: np.ndarray, pose: np.ndarray) -> Floats:
    """Return the poses (n, 3) of the object in the frame of the hand."""
    offset = np.einsum("nji,nj->ni", rotation(hand[:, 2]), pose[:, :2] - hand[:, :2])
    return np.column_stack([offset, pose[:, 2] - hand[:, 2]])


def days(log: Recordings, errors: np.ndarray) -> list[dict[str, Any]]:
    """Find each day's (UTC) best friction and radius on all its pushes, to see whether the setup stayed the same."""
    rows, day = [], np.floor(log.about("began") / DAY).astype(int)
    for number in np.unique(day):
        of_day = day == number
        if np.count_nonzero(of_day) < MIN_PUSHES_OF_A_DAY:
            continue
        scores = errors[..., of_day].mean(axis=-1)
        radius, friction = np.unravel_index(int(np.argmin(scores)), scores.shape)
        date = str(np.datetime64(int(number), "D"))
        best = {"friction": float(predictions.FRICTIONS[friction]), "radius_mm": 1e3 * predictions.RADII[int(radius)]}
        rows.append({"day": date, "pushes": int(of_day.sum()), **best, "mean_mm": float(scores.min())})
    return rows
