"""What was found from logs, as numbers for the report."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

import pushjax as pj
from pushjax.datasets import LogError
from pushjax.identification.noise import Noise
from pushjax.identification.uncertainty import Profile, normal_interval, profile_interval

# unknowns that are lengths, but for one number that is an angle
LENGTHS = ("pressure_center", "inset", "overshoot", "lag_distance", "hand_offset", "frame_offset")
ANGLE = "frame_offset.2"


class Findings(NamedTuple):
    """Everything that was found, before it is printed and drawn.

    Attributes:
        problems: Errors of the logs and pushes that were left out.
        slider: The slider as expected before the fit.
        hand: The hand.
        pushes: The pushes that were learned from.
        found: The result of the identification.
        predicted: The same pushes, predicted with that result.
        profiles: Profile of each number that is no part of the surface.
        noise: How much friction scatters, if asked for.
        length: Length that weighs rotation in the deviations, m.
    """

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
        """Predicted final poses (pushes, 3), with the pushes of all conditions in a row."""
        return self.rows(self.predicted.pose[..., -1, :])

    def rows(self, value: Any) -> np.ndarray:
        """Put the pushes of all conditions in a row, without the padding.

        Args:
            value: (..., pushes, ...), with the axes of conditions and pushes first.
        """
        used = np.asarray(self.pushes.weight) > 0
        return np.asarray(value, float)[used]

    def deviation_mm(self, poses: np.ndarray) -> np.ndarray:
        """Return the deviation of final poses (pushes, 3) from the measured ones, (pushes,), mm."""
        return 1e3 * np.asarray(pj.deviation(poses, self.rows(self.pushes.end), self.length), float)


def unit(label: str) -> tuple[str, float]:
    """Return the unit that a number is shown in, and how many of it make one SI unit."""
    if label == ANGLE:
        return "°", 180 / np.pi
    return ("mm", 1e3) if label.startswith(LENGTHS) else ("", 1.0)


def parameters(findings: Findings, level: float) -> list[dict[str, Any]]:
    """Describe each number found that is no part of the surface.

    Args:
        findings: What was found.
        level: Level of the intervals, such as 0.9.

    Returns:
        One row per number: estimate, normal and profile interval, how far it is determined, and its profile.
    """
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
                "determined": found.variance_reduction[each.label],
                "z": float(found.z[index]),
                "z_deviation": float(deviation[index]),
                "profile_value": scale * each.value,
                "profile_rise": each.rise,
            }
        )
    return rows


def predictions(findings: Findings) -> dict[str, Any]:
    """Describe how well the pushes are predicted.

    Deviations of the final poses are in mm: with what was found, as expected before the fit, and if nothing had moved.
    """
    found = findings.found
    off = findings.deviation_mm(findings.final)
    determined = [value for label, value in found.variance_reduction.items() if label.startswith("surface")]
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
        "surface": np.asarray(found.parameters.surface),
        "length_m": np.asarray(found.prior.mean_surface.length),
        "information_share": {name: findings.rows(found.information_share(name)) for name in found.prior.layout.names},
    }


def _expected(findings: Findings) -> jax.Array:
    """Predict final poses with the prior's mean, without any push, at the middle of the friction's range."""
    found = findings.found
    before = eqx.tree_at(lambda one: one.z, found, found.prior.mean)
    return before.predict(findings.pushes, findings.slider, findings.hand).pose[..., -1, :]
