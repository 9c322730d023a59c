"""Pushes of sliders with different outlines: polygons by their number of vertices, and smooth shapes.

A disk and an ellipse have no vertices. A `Curve` has control points, and its cost is proportional to their number; the
number of vertices of the outline that it was fitted to (`Curve.fit`) does not matter. The paths of the tip, the limit
surface and the friction are the same for all. Each outline is some 90 mm wide, and the tip touches it where it meets
the negative x axis.
"""

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from benchmarks import tasks
from benchmarks.cases import Work, final_poses
from pushjax.geometry.shape import Shape

HALF = tasks.SIDE / 2
VERTICES = (4, 6, 16, 64)
CONTROLS = (12, 24)
TRACED = (64, 1024)  # numbers of vertices of the outlines that curves are fitted to
OFFSET, TRAVEL, STEPS = 2e-3, 0.02, 8  # offset and travel in m; with these the tip stays on its side, also on a disk


# Name, number of vertices or control points, and number of vertices of the outline that a curve is fitted to.
OUTLINES = (
    *(("polygon", n, 0) for n in VERTICES),
    ("disk", 0, 0),
    ("ellipse", 0, 0),
    *(("curve", n, TRACED[0]) for n in CONTROLS),
    ("curve", CONTROLS[-1], TRACED[1]),
)


def outline(name: str, count: int = 0, traced: int = 0) -> Shape:
    """Return an outline.

    Args:
        name: "polygon", "curve", "disk" or "ellipse".
        count: Number of vertices of a polygon, or of control points of a curve.
        traced: Number of vertices on the circle that a curve is fitted to.
    """
    if name == "polygon":
        angle = np.pi * (1 + (2 * np.arange(count) + 1) / count)
        rim = HALF / np.cos(np.pi / count)
        return pj.Polygon(rim * np.stack([np.cos(angle), np.sin(angle)], axis=1), convex=True)
    if name == "curve":
        angle = 2 * np.pi * np.arange(traced) / traced
        return pj.Curve.fit(HALF * np.stack([np.cos(angle), np.sin(angle)], axis=1), count, convex=True)
    return pj.Disk(HALF) if name == "disk" else pj.Ellipse(HALF, 0.8 * HALF)


def task(dtype: str, which: tuple[str, int, int]) -> tasks.Task:
    """Return the push of `tasks` with the outline `which` of `OUTLINES`."""
    here = tasks.task("quartic", dtype)
    return here._replace(slider=pj.Slider(tasks.cast(outline(*which), dtype), here.slider.surface))


def push(dtype: str, batch: int, which: tuple[str, int, int]) -> Work:
    """Make a program for the final poses of pushes of 20 mm, each with its own path and friction.

    Args:
        dtype: Floating type.
        batch: Number of pushes.
        which: One of `OUTLINES`.
    """
    here = task(dtype, which)
    keys = jax.random.split(jax.random.key(0), 3)

    def uniform(key, low, high):
        return jax.random.uniform(key, (batch,), dtype, low, high)

    ends = tasks.paths(uniform(keys[0], -OFFSET, OFFSET), uniform(keys[1], -tasks.MAX_ANGLE, tasks.MAX_ANGLE), 1)
    start, along = ends[:, :1], (ends[:, 1:] - ends[:, :1]) * (TRAVEL / tasks.TRAVEL)
    path = start + jnp.linspace(0, 1, STEPS + 1, dtype=dtype)[None, :, None] * along

    label = "_".join(str(part) for part in ("push", *which) if part)
    return Work(label, dtype, batch, STEPS, final_poses(here.push, batch), (path, uniform(keys[2], 0.15, 0.35)))
