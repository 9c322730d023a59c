"""What was found from logs, as numbers for the report."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

import pushjax as pj
from pushjax.datasets import LogError
from pushjax.identification.noise import Noise
from pushjax.identification.uncertainty import Profile, normal_interval, profile_interval
from pushjax.identification.unknowns import LENGTHS

# unknowns that are lengths, but for one number that is an angle
ANGLE = "frame_offset.2"


class Findings(NamedTuple):
    """Everything that was found, before it is printed and drawn."""

    problems: tuple[LogError, ...]  # errors of the logs and pushes that were left out
    slider: pj.Slider  # as expected before the fit
    hand: pj.Hand
    pushes: pj.Pushes  # training pushes
    found: pj.Identified
    predicted: pj.Trajectory  # the training pushes, predicted with `found`
    profiles: tuple[Profile, ...]  # of each number that is no part of the surface
    noise: Noise | None  # scatter of friction, if asked for
    length: float  # characteristic length of the deviations, m

    @property
    def final(self) -> np.ndarray:
        """Predicted final poses (pushes, 3), with the pushes of all conditions in a row."""
        return self.rows(self.predicted.pose[..., -1, :])

    def rows(self, value: Any) -> np.ndarray:
        """Flatten (conditions, pushes, ...) or (pushes, ...) to (pushes, ...), without the padding."""
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
    """Return one row for each identified number, except those of the surface: estimate, intervals, profile."""
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
                "profile_drop": each.log_posterior_drop,
            }
        )
    return rows


def predictions(findings: Findings) -> dict[str, Any]:
    """Return the deviations of the final poses: as identified, as expected before, and without motion."""
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
