"""What was found of logs, as figures."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

import pushjax as pj
from pushjax.datasets import LogError
from pushjax.identify.noise import Noise
from pushjax.identify.uncertainty import Profile, normal_interval, profile_interval

METRES = ("center", "inset", "end", "lag", "offset", "marker")
ANGLE = "marker.2"


class Findings(NamedTuple):
    """Everything, before it is printed and drawn. slider: as expected. length: m, of the deviations."""

    problems: tuple[LogError, ...]
    slider: pj.Slider
    hand: pj.Hand
    pushes: pj.Pushes
    found: pj.Identified
    predicted: pj.Trajectory
    profiles: tuple[Profile, ...]
    noise: Noise | None
    length: float

    @property
    def final(self) -> np.ndarray:
        """Predicted final poses, (pushes, 3), of all conditions in a row."""
        return self.rows(self.predicted.pose[..., -1, :])

    def rows(self, value: Any) -> np.ndarray:
        """(..., pushes, ...) of all conditions in a row, without what only fills them up."""
        there = np.asarray(self.pushes.weight) > 0
        return np.asarray(value, float)[there]

    def deviation_mm(self, poses: np.ndarray) -> np.ndarray:
        """(pushes,), from the measured final poses."""
        return 1e3 * np.asarray(pj.deviation(poses, self.rows(self.pushes.end), self.length), float)


def unit(label: str) -> tuple[str, float]:
    """In which a number is shown, and how many of those there are in one of SI."""
    if label == ANGLE:
        return "°", 180 / np.pi
    return ("mm", 1e3) if label.startswith(METRES) else ("", 1.0)


def parameters(findings: Findings, level: float) -> list[dict[str, Any]]:
    """One row for each number found that is no part of the surface."""
    found, rows = findings.found, []
    deviation = np.sqrt(np.diagonal(np.asarray(found.covariance, float)))
    for each in findings.profiles:
        name, scale = unit(each.label)
        index = found.labels.index(each.label)
        rows.append(
            {
                "label": each.label,
                "unit": name,
                "estimate": scale * float(each.value[each.normal == 0][0]),
                "interval": [scale * end for end in normal_interval(found, each.label, level)],
                "profile": [scale * end for end in profile_interval(each, level)],
                "determined": found.determined[each.label],
                "z": float(found.z[index]),
                "z_deviation": float(deviation[index]),
                "profile_value": scale * each.value,
                "profile_rise": each.rise,
            }
        )
    return rows


def predictions(findings: Findings) -> dict[str, Any]:
    """How far off the final poses are, in mm: as found, as was expected before, and had nothing moved."""
    found = findings.found
    off = findings.deviation_mm(findings.final)
    determined = [value for label, value in found.determined.items() if label.startswith("surface")]
    before = findings.rows(_expected(findings))
    return {
        "pushes": len(off),
        "mean_mm": float(off.mean()),
        "worst_mm": float(off.max()),
        "expected_mm": float(findings.deviation_mm(before).mean()),
        "no_motion_mm": float(findings.deviation_mm(findings.rows(findings.pushes.start)).mean()),
        "failed_steps": int(findings.rows(findings.predicted.failed).sum()),
        "residual_mm": 1e3 * findings.rows(found.residual),
        "surface_numbers": len(determined),
        "surface_determined": float(sum(determined)),
        "surface": np.asarray(found.physical.surface),
        "length_m": np.asarray(found.prior.mean.length),
        "told_by": {name: findings.rows(found.told_by(name)) for name in found.prior.layout.names},
    }


def _expected(findings: Findings) -> jax.Array:
    """Final poses as predicted before any push was seen, at the middle of the friction's range."""
    found = findings.found
    before = eqx.tree_at(lambda one: one.z, found, found.prior.start)
    return before.predict(findings.pushes, findings.slider, findings.hand).pose[..., -1, :]
