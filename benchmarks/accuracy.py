"""Error and penetration depth of pushes as functions of the step.

A 90 mm square is pushed 221 times by 50 mm. The pushes start every 5 mm across a side and go every 10 degrees up to 60
degrees from its normal; the friction coefficient is 0.25. Some slide off a corner. All is computed in float64; the
reference has 6400 steps.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from benchmarks.timing import both_dtypes
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record
from pushjax.geometry import se2

TRAVEL, FRICTION, GAP, REFERENCE = 0.05, 0.25, 0.0005, 6400
RADII, STEPS = (0.00475, 0.001, 0.0), (10, 25, 50, 100, 200)


def fan(slider: pj.Slider, radius: float, steps: int) -> tuple[np.ndarray, float]:
    """Simulate the fan of pushes; return final poses (pushes, 3) and the largest penetration after any step, m."""
    offsets, angles = np.meshgrid(np.linspace(-0.04, 0.04, 17), np.radians(np.linspace(-60, 60, 13)))

    def one(offset, angle):
        start = jnp.stack([-0.045 - radius - GAP, offset])
        path = pj.line(start, start + TRAVEL * jnp.stack([jnp.cos(angle), jnp.sin(angle)]), steps)
        push = pj.rollout(slider, pj.Hand.finger(radius), path, pose=jnp.zeros(3), friction=FRICTION)
        fingers = jax.vmap(lambda pose, q: se2.transform(se2.inverse(pose), q))(push.pose, path)
        gap = jax.vmap(slider.shape.signed_distance)(fingers) - radius
        return push.pose[-1], jnp.min(gap)

    pose, gap = jax.jit(jax.vmap(one))(offsets.ravel(), angles.ravel())
    return np.asarray(pose), max(0.0, -float(jnp.min(gap)))


def run(progress: ProgressCallback = no_progress) -> dict[str, Any]:
    """Compare pushes in large steps with pushes in small ones.

    Args:
        progress: Called with the number of rows done and their total.

    Returns:
        The record, with one row for each radius of the finger and step, all in mm: the worst and the median distance of
        the final positions from the reference, the worst angle (degrees), and the largest penetration depth.
    """
    rows: list[dict[str, Any]] = []
    with both_dtypes():
        square = pj.Polygon.rectangle(0.09, 0.09)
        surface = pj.fit_limit_surface(*pj.Support.uniform(square).wrench_twist_pairs(jax.random.key(0), 400))
        slider = pj.Slider(square, surface)
        for radius in RADII:
            exact, _ = fan(slider, radius, REFERENCE)
            for steps in STEPS:
                pose, depth = fan(slider, radius, steps)
                off = 1e3 * np.linalg.norm(pose[:, :2] - exact[:, :2], axis=1)
                turn = np.degrees(np.abs(pose[:, 2] - exact[:, 2]).max())
                row = {"radius_mm": 1e3 * radius, "step_mm": 1e3 * TRAVEL / steps, "worst_mm": off.max()}
                row |= {"worst_deg": turn, "median_mm": np.median(off), "penetration_mm": 1e3 * depth}
                rows.append(row)
                progress(len(rows), len(RADII) * len(STEPS))
        return result_record("accuracy", {"steps_of_reference": REFERENCE}, rows=rows)


def summary(record: dict[str, Any]) -> str:
    """Return what the command prints."""
    lines = [f"{'finger':>10}{'step':>10}{'worst (mm, deg)':>20}{'median (mm)':>14}{'penetration (um)':>18}"]
    for row in record["rows"]:
        lines.append(
            f"{row['radius_mm']:7.3g} mm{row['step_mm']:7.3g} mm{row['worst_mm']:11.4f} {row['worst_deg']:8.4f}"
            f"{row['median_mm']:14.6f}{1e3 * row['penetration_mm']:18.4f}"
        )
    return "\n".join(lines)
