"""The figures of a report in words, each with its unit."""

from typing import Any

import numpy as np

# The posterior of a number counts as normal if its profile's interval is at most so many times as wide as that of a
# normal posterior, and the other way round.
NOT_NORMAL = 2.0
# What the unknowns are called in the report; the others keep the name that `pj.Unknowns` gives them.
NAMES = {
    "friction": "coefficient of friction at the contact",
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


def figures(record: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the figures of a record as pairs of a description and a value with its unit."""
    level = f"{record['settings']['level']:.0%}"
    rows = [_unknown(row, level) for row in record["rows"]]
    rows += [
        ("limit surface", f"{record['surface_determined']:.1f} of {record['surface_numbers']} numbers are determined"),
        ("pushes that were used", str(record["pushes"])),
        ("poses used of each push", str(record["poses"])),
        ("measured wrenches that were used", str(record["wrenches"])),
        ("prediction of the final poses", predicted(record)),
        ("standard deviation of what stays unexplained in a pose", f"{record['sigma_mm']:.3g} mm"),
        ("fit", f"{'converged' if record['converged'] else 'did NOT converge'} after {record['steps']} steps"),
        ("failed steps of the predicted pushes", str(record["failed_steps"])),
    ]
    if record["noise"] is not None:
        rows.append(("how friction scatters from push to push", noise(record["noise"])))
    if record["warning"] is not None:
        rows.insert(0, ("WARNING", record["warning"]))
    rows += [("left out", problem) for problem in record["problems"]]
    return rows


def is_not_normal(row: dict[str, Any]) -> bool:
    """Return whether a posterior is so far from normal that only its profile's interval is right."""
    # An example is the friction of a finger that never slides: the pushes only bound it from below.
    normal, exact = (row[name][1] - row[name][0] for name in ("interval", "profile"))
    return not normal / NOT_NORMAL <= exact <= normal * NOT_NORMAL


def predicted(record: dict[str, Any]) -> str:
    """Say how far predicted final poses are from the measured ones."""
    return (
        f"The final poses are predicted to {record['mean_mm']:.2f} mm in the mean, and to {record['worst_mm']:.2f} mm "
        f"at worst. Without learning from them, the mean error is {record['expected_mm']:.2f} mm. The objects moved "
        f"{record['no_motion_mm']:.1f} mm."
    )


def noise(noise: dict[str, Any]) -> str:
    """Describe the noise in a sentence."""
    friction = np.array2string(np.asarray(noise["friction"]), precision=3)
    of_distance, of_turn = noise["relative_error"]
    return (
        f"{noise['surface_dof']:.0f} degrees of freedom of the limit surface, friction {friction}, hand off by "
        f"{noise['hand_offset_mm']:.2f} mm, poses by {noise['sigma_mm']:.2f} mm, {100 * of_distance:.1f} % of their "
        f"distance and {100 * of_turn:.1f} % of their turn; energy score {noise['score_mm']:.2f} mm"
    )


def _unknown(row: dict[str, Any], level: str) -> tuple[str, str]:
    """Describe one number that was found: estimate, interval, and how much the pushes say about it."""
    label = row["label"]
    # several conditions add the number of the condition to the name
    name = NAMES.get(label) or next(
        (f"{text} ({label})" for key, text in NAMES.items() if label.startswith(key)), label
    )
    unit = f" {row['unit']}" if row["unit"] else ""
    low, high = row["profile"]
    share = f"the pushes remove {row['determined']:.0%} of the prior variance"
    if is_not_normal(row):
        share = "its posterior is far from normal, so the estimate says little"
    return name, f"{row['estimate']:.4g}{unit}; {level} interval {low:.3g} to {high:.3g}{unit}; {share}"
