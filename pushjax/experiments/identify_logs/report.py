"""The report on what was identified, in words and with units."""

import re
from typing import Any

import numpy as np

from pushjax.experiments._report import Table, table

# A posterior counts as normal if the widths of its profile's interval and of the normal one differ at most by this
# factor.
NOT_NORMAL = 2.0
MAX_PROBLEMS = 10  # problems that are listed
# There is a warning unless the mean deviation of the predicted final poses is less than POOR times the mean motion, or
# is less than both the mean motion and NO_BETTER times the mean deviation before the fit.
POOR, NO_BETTER = 0.4, 0.9
# descriptions of the unknowns that the options offer, by label without the number of a condition
NAMES = {
    "friction": "friction at the contact",
    "inset": "distance by which the outline is smaller than given",
    "overshoot": "distance that the hand goes beyond the logged path",
    "lag_distance": "distance by which the hand lags behind its log",
    "pressure_center.0": "center of pressure, x in the body frame",
    "pressure_center.1": "center of pressure, y in the body frame",
    "hand_offset.0": "offset of the hand, x in the world frame",
    "hand_offset.1": "offset of the hand, y in the world frame",
    "frame_offset.0": "offset of the object's frame, x in the body frame",
    "frame_offset.1": "offset of the object's frame, y in the body frame",
    "frame_offset.2": "rotation of the object's frame",
}


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
            ("", _name),
            ("estimate", "estimate", ".4g"),
            (f"{chosen['level']:.0%} interval", lambda row: _interval(row["interval"])),
            ("profile", lambda row: _interval(row["profile"])),
            ("unit", "unit"),
            ("determined", "determined", ".0%"),
        ),
        *(
            f"{_name(row)}: the posterior is far from normal; take the profile's interval, and not the estimate"
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


def _name(row: dict[str, Any]) -> str:
    """Describe an unknown; its label follows if it has the number of a condition."""
    label = row["label"]
    unknown = NAMES[re.sub(r"\[\d+\]", "", label)]
    return f"{unknown} ({label})" if "[" in label else unknown


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
