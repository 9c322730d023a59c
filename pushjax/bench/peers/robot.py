"""MuJoCo on real pushes: the triangle of the paper's second table, as `experiments.table2` predicts it.

Everything is what table 2's "ideal" gives pushjax: the known support points, the start pose, where the finger went, and
a friction of the finger chosen on a grid, for each random split by the pushes learned from. The finger goes straight
from its first to its last place. The friction of the table is known and does not matter.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import pushjax as pj
from pushjax.bench.peers.mujoco import push
from pushjax.bench.peers.scene import Scene, Settings
from pushjax.datasets import PushLog
from pushjax.experiments.table2.conditions import CONDITIONS, GEOMETRIES, Geometry, load, outline, recorded, training

FRICTIONS = tuple(np.round(np.linspace(0.0, 0.8, 17), 3))
TRAIN_SHARE = 0.4
TIMESTEP = 0.005
# A sphere needs a radius; on straight edges a smaller outline is the same.
SMALLEST_TIP = 0.0005


def robot_error(
    folder: Path,
    settings: Settings | None = None,
    timestep: float = TIMESTEP,
    frictions: tuple[float, ...] = FRICTIONS,
    geometry: str = "nominal",
    conditions: tuple[tuple[str, str], ...] = tuple(CONDITIONS),
    seed: int = 0,
) -> dict[str, Any]:
    """Mean deviation (`pj.deviation`, mm) of the final pose over the pushes not learned from and ten splits.

    folder: the data's, with `three_point_push/`. geometry: "nominal" or "measured", as of table 2. Returns mean_mm over
    conditions, and `cells`: surface, object, mean_mm, friction (mean over splits), pushes and seconds of each.
    """
    cells = []
    for surface, name in conditions:
        log = load(folder / "three_point_push", surface, name)
        where = GEOMETRIES[geometry]
        errors, seconds = deviations(log, where, settings or Settings(), timestep, frictions)
        # the generator of each condition's splits, as table 2 has it
        train = training(log, TRAIN_SHARE, np.random.default_rng(seed + list(CONDITIONS).index((surface, name))))
        best = [int(np.argmin(errors[:, mine].mean(axis=1))) for mine in train]
        mean = np.mean([errors[b][~mine].mean() for b, mine in zip(best, train, strict=True)])
        cells.append(
            {
                "surface": surface,
                "object": name,
                "mean_mm": float(mean),
                "friction": float(np.mean(np.array(frictions)[best])),
                "pushes": errors.shape[1],
                "seconds": seconds,
            }
        )
    return {"mean_mm": float(np.mean([cell["mean_mm"] for cell in cells])), "cells": cells}


def deviations(
    log: PushLog, geometry: Geometry, settings: Settings, timestep: float, frictions: tuple[float, ...]
) -> tuple[np.ndarray, float]:
    """(frictions, pushes) mm, and the seconds of all pushes."""
    pushes = recorded(log, geometry, 2)
    start, end = (np.asarray(each, float) for each in (pushes.start, pushes.end))
    cos, sin = np.cos(start[:, 2]), np.sin(start[:, 2])

    def in_body(point: np.ndarray) -> np.ndarray:
        x, y = (np.asarray(point, float) - start[:, :2]).T
        return np.stack([cos * x + sin * y, cos * y - sin * x], axis=1)

    first, last = (in_body(np.asarray(pushes.path)[:, k]) for k in (0, -1))
    errors, seconds = [], 0.0
    for friction in frictions:
        found = push(replace(scene(log, geometry), friction_tip=float(friction)), settings, timestep, first, last)
        x, y, theta = found.pose.T
        final = np.stack(
            [start[:, 0] + cos * x - sin * y, start[:, 1] + sin * x + cos * y, start[:, 2] + theta], axis=1
        )
        errors.append(1e3 * np.asarray(pj.deviation(final, end, log.length), float))
        seconds += found.seconds
    return np.array(errors), seconds


def scene(log: PushLog, geometry: Geometry) -> Scene:
    """The triangle on its three points."""
    radius = max(geometry.radius, SMALLEST_TIP)
    smaller = geometry._replace(inset=geometry.inset + radius - geometry.radius)
    corners = np.asarray(outline(log, smaller).vertices, float)
    return Scene(
        tuple(map(tuple, np.asarray(log.support_points, float).tolist())),
        outline=tuple(map(tuple, corners.tolist())),
        tip_radius=radius,
    )
