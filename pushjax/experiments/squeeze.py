"""A parallel jaw closes on a rectangle from four start poses, with four different outcomes.

This is the first figure of the paper: a jaw with 27 x 10 mm pads closes along y on a 50 x 35 mm rectangle. The start
pose decides whether the rectangle ends grasped off center, jammed, grasped off center the other way, or slipped out.

Both a jam and a grasp end the motion. Here a rectangle counts as grasped if it ends flat between the pads and touches
each of them along an edge. It counts as jammed if it is wedged askew between them.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax import plot
from pushjax.experiments._record import result_record
from pushjax.experiments._report import POSE, Table, saved, table
from pushjax.experiments._slider_options import fitted_surface

WIDTH, HEIGHT = 0.050, 0.035  # m, of the rectangle
FRICTION = 0.2
PAD, THICKNESS = 0.027, 0.010  # m, width and thickness of a pad
OPENING, CLOSED = 0.075, 0.0005  # m, first and last opening of the jaw
# Start poses: x (m), y (m), angle (degrees)
STARTS = {
    "grasped with offset": (0.010, 0.0, 32.0),
    "jammed": (0.0, 0.005, 60.0),
    "grasped with the other offset": (-0.014, -0.002, 28.0),
    "slipped out": (0.030, 0.0, 45.0),
}
HOLD = 5  # steps for which the closed jaw waits, so that a rectangle that has slipped out is free at the end
FLAT = np.radians(1.0)  # largest tilt of a flat grasp: the last step leaves a little


def run(seed: int = 0, out: Path | None = None, steps: int = 1500) -> dict[str, Any]:
    """Simulate the four closings with a quartic fitted to 64 support points.

    Args:
        seed: Seed of the wrench-twist pairs that the quartic is fitted to.
        out: Folder for the pictures. None: no pictures.
        steps: Number of steps in which the jaw closes.

    Returns:
        The record, with one row per start pose: name, start (m, m, degrees), final pose (m, rad), and what `outcome`
        gives.
    """
    block = pj.Polygon.rectangle(WIDTH, HEIGHT)
    slider = pj.Slider(block, fitted_surface(pj.Support.uniform(block, points=64), "quartic", seed))
    hand = pj.Hand.parallel_jaw(PAD, THICKNESS)
    closing = pj.line((0.0, 0.0, 0.0, OPENING), (0.0, 0.0, 0.0, CLOSED), steps)
    path = jnp.concatenate([closing, jnp.repeat(closing[-1:], HOLD, axis=0)])
    starts = jnp.array([(x, y, np.radians(angle)) for x, y, angle in STARTS.values()])
    simulate = jax.jit(jax.vmap(lambda pose: pj.rollout(slider, hand, path, pose=pose, friction=FRICTION)))
    grasps = simulate(starts)
    drawn = {name: jax.tree.map(lambda leaf, k=k: leaf[k], grasps) for k, name in enumerate(STARTS)}
    rows = [
        {"name": name, "start": STARTS[name], "pose": grasp.pose[-1]} | outcome(grasp) for name, grasp in drawn.items()
    ]
    pictures = saved(out, lambda: {"squeeze.png": plot.push_figure(block, hand, drawn, friction=FRICTION)})
    settings = {"seed": seed, "steps": steps, "friction": FRICTION, "slider_m": (WIDTH, HEIGHT)}
    settings |= {"pad_m": (PAD, THICKNESS), "opening_m": (OPENING, CLOSED)}
    return result_record("squeeze", settings, rows=rows, pictures=pictures)


def outcome(grasp: pj.Trajectory) -> dict[str, Any]:
    """Classify how one closing ended."""
    status = pj.Status(int(grasp.status[-1]))
    tilt = abs((float(grasp.pose[-1, 2]) + np.pi / 4) % (np.pi / 2) - np.pi / 4)
    held = "grasped" if tilt < FLAT else "jammed"
    return {
        "outcome": "failed" if status.failed else "slipped out" if int(grasp.stopped) < 0 else held,
        "status": status.name,
        "opening_mm": 1e3 * float(grasp.configuration[-1, 3]),
        "tilt_deg": float(np.degrees(tilt)),  # from the nearest multiple of 90 degrees
        "failed_steps": int(np.sum(np.asarray(grasp.failed))),
    }


def summary(record: dict[str, Any]) -> list[str | Table]:
    """Return the report on a record of `run`."""
    return [
        f"A jaw with {1e3 * PAD:.0f} mm pads closes on a 50 x 35 mm rectangle, friction {FRICTION}:",
        table(
            record["rows"],
            ("start that ends", "name"),
            ("outcome", "outcome"),
            *POSE,
            ("opening / mm", "opening_mm", ".2f"),
        ),
    ]
