"""The report on what was identified from logs: numbers with units, words, and pictures."""

import re
from typing import Any, NamedTuple

import equinox as eqx
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from scipy.interpolate import PchipInterpolator

import pushjax as pj
from pushjax import plot
from pushjax.datasets import LogError, Recording
from pushjax.experiments._report import Table, distribution_panel, pushes_by_error, table
from pushjax.identification.noise import Noise
from pushjax.identification.uncertainty import DROP_AT_90, Profile, normal_interval, profile_interval
from pushjax.plot.style import BLUE, GRAY, ORANGE, STYLE, legend_below

SHOWN = {"best": 0.0, "median": 0.5, "90th percentile": 0.9, "worst": 1.0}
# A posterior counts as normal if the widths of its profile's interval and of the normal one differ at most by this
# factor.
NOT_NORMAL = 2.0
MAX_PROBLEMS = 10  # problems that are listed
# There is a warning unless the mean deviation of the predicted final poses is less than POOR times the mean motion, or
# is less than both the mean motion and NO_BETTER times the mean deviation before the fit.
POOR, NO_BETTER = 0.4, 0.9
UNITS = {"": 1.0, "mm": 1e3, "°": 180 / np.pi}  # how many make one SI unit
# description and unit of the unknowns that the options offer, by label without the number of a condition
UNKNOWNS = {
    "friction": ("friction at the contact", ""),
    "inset": ("distance by which the outline is smaller than given", "mm"),
    "overshoot": ("distance that the hand goes beyond the logged path", "mm"),
    "lag_distance": ("distance by which the hand lags behind its log", "mm"),
    "pressure_center.0": ("center of pressure, x in the body frame", "mm"),
    "pressure_center.1": ("center of pressure, y in the body frame", "mm"),
    "hand_offset.0": ("offset of the hand, x in the world frame", "mm"),
    "hand_offset.1": ("offset of the hand, y in the world frame", "mm"),
    "frame_offset.0": ("offset of the object's frame, x in the body frame", "mm"),
    "frame_offset.1": ("offset of the object's frame, y in the body frame", "mm"),
    "frame_offset.2": ("rotation of the object's frame", "°"),
}


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


def described(label: str) -> tuple[str, str]:
    """Return what an unknown is, with its label if that has the number of a condition, and its unit."""
    words, unit = UNKNOWNS[re.sub(r"\[\d+\]", "", label)]
    return (f"{words} ({label})" if "[" in label else words), unit


def parameters(findings: Findings, level: float) -> list[dict[str, Any]]:
    """Return one row for each identified number, except those of the surface: estimate, intervals, profile."""
    found, rows = findings.found, []
    deviation = np.sqrt(np.diagonal(np.asarray(found.covariance, float)))
    for each in findings.profiles:
        words, unit = described(each.label)
        scale, index = UNITS[unit], found.labels.index(each.label)
        rows.append(
            {
                "label": each.label,
                "name": words,
                "unit": unit,
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
    # the prior's mean: what is expected without any push, at the middle of the friction's range
    expected = eqx.tree_at(lambda one: one.z, found, found.prior.mean)
    before = findings.rows(expected.predict(findings.pushes, findings.slider, findings.hand).pose[..., -1, :])
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


def figures(findings: Findings) -> dict[str, Figure]:
    """Draw four pushes, predicted over measured; residuals; and profiles."""
    with plt.rc_context(STYLE):
        return {
            "identify_pushes.png": _pushes(findings),
            "identify_residuals.png": _residuals(findings),
            "identify_profiles.png": _profiles(findings),
        }


def _pushes(findings: Findings) -> Figure:
    """Draw the best, the median, the 90th percentile and the worst push, predicted over measured."""
    pushes = findings.pushes
    paths, start, end = (findings.rows(each) for each in (pushes.path, pushes.start, pushes.end))
    measured = [Recording(k, path, np.stack([start[k], end[k]])) for k, path in enumerate(paths)]
    shown = pushes_by_error(measured, findings.final, findings.deviation_mm(findings.final), SHOWN)
    return plot.real_figure(findings.slider.shape, shown, findings.hand)


def _residuals(findings: Findings) -> Figure:
    """Draw the residuals with rings of one and two sigma, and the distribution of deviations."""
    residual = 1e3 * findings.rows(findings.found.residual)
    sigma = 1e3 * float(findings.found.sigma)
    figure, axes = plt.subplots(1, 3, figsize=(12.0, 3.8), layout="constrained")
    for panel, (a, b), names in (
        (axes[0], (0, 1), ("x / mm", "y / mm")),
        (axes[1], (0, 2), ("x / mm", "length · angle / mm")),
    ):
        panel.plot(residual[:, a], residual[:, b], "o", color=BLUE, ms=4, alpha=0.7)
        angle = np.linspace(0, 2 * np.pi, 100)
        for radius, dash in ((sigma, "-"), (2 * sigma, "--")):
            panel.plot(radius * np.cos(angle), radius * np.sin(angle), dash, color=GRAY, zorder=0)
        panel.set(xlabel=f"predicted less measured {names[0]}", ylabel=f"predicted less measured {names[1]}")
        panel.set_aspect("equal", adjustable="datalim")
    axes[0].set_title(f"rings: one and two sigma, {sigma:.2g} mm")
    still = findings.deviation_mm(findings.rows(findings.pushes.start))
    distribution_panel(axes[2], findings.deviation_mm(findings.final), still)
    return figure


def _profiles(findings: Findings) -> Figure:
    """Draw the profile of each number beside its normal approximation."""
    profiles = findings.profiles
    columns = min(len(profiles), 4)
    rows = -(-len(profiles) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(3.4 * columns, 3.0 * rows), layout="constrained", squeeze=False)
    for panel in axes.flat[len(profiles) :]:
        panel.set_visible(False)
    for panel, each in zip(axes.flat, profiles, strict=False):
        _, unit = described(each.label)
        scale = UNITS[unit]
        # Signed distances of the values from the estimate, in standard deviations of z.
        distance = np.sign(np.arange(len(each.normal)) - np.argmin(each.normal)) * np.sqrt(2 * each.normal)
        dense = np.linspace(distance[0], distance[-1], 200)
        value, drop = (PchipInterpolator(distance, y)(dense) for y in (scale * each.value, each.log_posterior_drop))
        panel.plot(value, drop, "-", color=BLUE, label="all else at its best")
        panel.plot(scale * each.value, each.log_posterior_drop, "o", color=BLUE, ms=3)
        panel.plot(value, dense**2 / 2, "--", color=ORANGE, label="normal")
        panel.axhline(DROP_AT_90, color=GRAY, lw=0.8, label="where a 90 % interval ends")
        panel.set(xlabel=each.label + (f" / {unit}" if unit else ""), ylim=(0, 5))
    axes[0, 0].set_ylabel("drop of the log posterior density")
    legend_below(figure, axes[0, 0], columns=3)
    return figure


def summary(record: dict[str, Any]) -> list[str | Table]:
    """Return the report on a record of `run`."""
    chosen, problems, rows = record["settings"], record["problems"], record["rows"]
    counted = "1 problem" if len(problems) == 1 else f"{len(problems)} problems"
    more = [f"and {len(problems) - MAX_PROBLEMS} more (see the JSON)"] if len(problems) > MAX_PROBLEMS else []
    few = f"Only final poses: not every push was seen {chosen['parts'] - 1} times on the way."
    failed = record["failed_steps"]
    return [
        *([] if record["warning"] is None else [f"WARNING: {record['warning']}"]),
        f"{record['pushes']} pushes used, {counted}.",
        *problems[:MAX_PROBLEMS],
        *more,
        *([few] if record["poses"] < chosen["parts"] else []),
        *([f"{record['wrenches']} measured wrenches."] if chosen["forces"] else []),
        table(
            rows,
            ("", "name"),
            ("estimate", "estimate", ".4g"),
            (f"{chosen['level']:.0%} interval", lambda row: _interval(row["interval"])),
            ("profile", lambda row: _interval(row["profile"])),
            ("unit", "unit"),
            ("determined", "determined", ".0%"),
        ),
        *(
            f"{row['name']}: the posterior is far from normal; take the profile's interval, and not the estimate"
            for row in rows
            if _is_not_normal(row)
        ),
        f"limit surface: the pushes determine {record['surface_determined']:.1f} of the {record['surface_numbers']} "
        "numbers that its prior varies",
        f"The final poses are predicted to {record['mean_mm']:.2f} mm in the mean, and to {record['worst_mm']:.2f} mm "
        f"at worst. Without learning from them, the mean error is {record['expected_mm']:.2f} mm. The objects moved "
        f"{record['no_motion_mm']:.1f} mm.",
        f"sigma: {record['sigma_mm']:.3g} mm; " + ("converged" if record["converged"] else "NOT converged"),
        *([] if record["noise"] is None else [_noise(record["noise"])]),
        "interval: for a normal posterior; profile: with all other numbers refitted; determined: part of the prior "
        "variance that the pushes remove",
        *([f"{failed} steps of the predicted pushes failed (see the JSON)"] if failed else []),
        *([] if record["identified"] is None else [f"wrote {record['identified']}, for pushjax.Identified.load"]),
    ]


def warning(predicted: dict[str, Any]) -> str | None:
    """Return a warning if the fit explains next to nothing, because its estimates then mean nothing; else None."""
    mean, before, still = (predicted[f"{name}_mm"] for name in ("mean", "expected", "no_motion"))
    if mean < POOR * still or (mean < NO_BETTER * before and mean < still):
        return None
    return (
        f"what was found predicts final poses to {mean:.3g} mm in the mean, of {still:.3g} that the objects moved, and "
        f"to {before:.3g} before: are units, frames, outline and radius right?"
    )


def _interval(ends: list[float]) -> str:
    return f"{ends[0]:.3g} to {ends[1]:.3g}"


def _is_not_normal(row: dict[str, Any]) -> bool:
    """Return whether a posterior is so far from normal that only its profile's interval is right."""
    # An example is the friction of a finger that never slides: the pushes only bound it from below.
    normal, exact = (row[name][1] - row[name][0] for name in ("interval", "profile"))
    return not normal / NOT_NORMAL <= exact <= normal * NOT_NORMAL


def _noise(noise: dict[str, Any]) -> str:
    """Describe in a sentence how friction scatters from push to push."""
    friction = np.array2string(np.asarray(noise["friction"]), precision=3)
    of_distance, of_turn = noise["relative_error"]
    return (
        f"noise: {noise['surface_dof']:.0f} degrees of freedom of the limit surface, friction {friction}, hand off by "
        f"{noise['hand_offset_mm']:.2f} mm, poses by {noise['sigma_mm']:.2f} mm, {100 * of_distance:.1f} % of their "
        f"distance and {100 * of_turn:.1f} % of their turn; energy score {noise['score_mm']:.2f} mm"
    )
