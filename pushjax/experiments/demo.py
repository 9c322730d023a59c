"""A first push: fit two limit surfaces to the friction of a square, push it with both, and draw the results."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

import pushjax as pj
from pushjax import plot
from pushjax.experiments._record import result_record
from pushjax.experiments._report import POSE, Table, saved, table

SIDE, RADIUS, FRICTION = 0.09, 0.00475, 0.25
START, END, STEPS = (-0.05, 0.018), (0.0, 0.018), 100


def run(seed: int = 0, out: Path | None = None, say: Callable[[str], None] = lambda words: None) -> dict[str, Any]:
    """Fit both surfaces to 64 support points under the square, and push it off center over 50 mm with each.

    Args:
        seed: Seed of the wrench-twist pairs.
        out: Folder for the pictures. None: no pictures.
        say: Called with a description of what is done next.

    Returns:
        The record. It has one row per surface: the angle error of the fit (degrees), whether the fit converged, the
        final pose (m, rad), the number of steps in each contact mode, and the first failed step or -1. `apart_mm` is
        the deviation between the two final poses.
    """
    say("demo: computing wrench-twist pairs of the friction at 64 support points under a square")
    key = jax.random.key(seed)
    block = pj.Polygon.rectangle(SIDE, SIDE)
    support = pj.Support.uniform(block, points=64)
    pairs = support.wrench_twist_pairs(key, 400)
    hand, path, start = pj.Hand.finger(RADIUS), pj.line(START, END, STEPS), np.zeros(3)

    rows, surfaces, pushes = [], {}, {}
    for degree, name in ((2, "ellipsoid"), (4, "quartic")):
        say(f"demo: fitting the {name}, then pushing with it (the first time this compiles)")
        surface, fit = pj.fit_limit_surface(*pairs, degree=degree, report=True)
        push = pj.rollout(pj.Slider(block, surface), hand, path, pose=start, friction=FRICTION)
        surfaces[name], pushes[name] = surface, push
        rows.append(
            {
                "model": name,
                "fit_angle_deg": float(np.degrees(fit.angle)),
                "fit_converged": bool(fit.converged),
                "pose": push.pose[-1],
                "modes": _steps_by_mode(push),
                "first_failure": int(push.first_failure),
            }
        )
    apart = pj.deviation(pushes["ellipsoid"].pose[-1], pushes["quartic"].pose[-1], pairs.length)
    say("demo: drawing")
    pictures = saved(
        out,
        lambda: {
            "limit_surfaces.png": plot.limit_surfaces(surfaces, pairs, float(support.load)),
            "motion_cone.png": plot.motion_cone_figure(*motion_cone_setup(key)),
            "push.png": plot.push_figure(block, hand, pushes),
        },
    )
    settings = {"seed": seed, "side_m": SIDE, "radius_m": RADIUS, "friction": FRICTION, "steps": STEPS, "pairs": 400}
    return result_record("demo", settings, rows=rows, apart_mm=1e3 * float(apart), pictures=pictures)


def _steps_by_mode(push: pj.Trajectory) -> dict[str, int]:
    """Return the number of steps in each contact mode, by the mode's name."""
    values, counts = np.unique(np.asarray(push.mode), return_counts=True)
    return {pj.ContactMode(int(v)).name: int(c) for v, c in zip(values, counts, strict=True)}


def motion_cone_setup(key: jax.Array):
    """Set up the paper's figure 2: 100 grid points, a quartic from 200 pairs, a push to the right of the motion cone.

    Args:
        key: PRNG key of the wrench-twist pairs.

    Returns:
        The square, its support, the limit surface, the contact and its solution: the arguments of
        `plot.motion_cone_figure`.
    """
    block = pj.Polygon.rectangle(SIDE, SIDE)
    support = pj.Support.uniform(block, points=100)
    surface = pj.fit_limit_surface(*support.wrench_twist_pairs(key, 200), degree=4)
    point, normal = np.array([[-0.02, -SIDE / 2]]), np.array([[0.0, 1.0]])
    right = np.asarray(pj.motion_cone(surface, point[0], normal[0], FRICTION)[1])
    turn = -np.radians(15)  # the push lies clockwise of the cone's right edge
    push = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ right
    contacts = pj.Contacts(point, normal, push[None], FRICTION)
    return block, support, surface, contacts, pj.solve_contacts(surface, contacts)


def summary(record: dict[str, Any]) -> list[str | Table]:
    """Return the report on a record of `run`."""
    return [
        f"A 90 mm square, 64 support points, pushed 18 mm off center over 50 mm, friction {FRICTION}:",
        table(
            record["rows"],
            ("surface", "model"),
            ("mean error of twists / °", "fit_angle_deg", ".1f"),
            *POSE,
            ("steps", lambda row: ", ".join(f"{count} {mode.lower()}" for mode, count in row["modes"].items())),
        ),
        f"The two end {record['apart_mm']:.2f} mm apart (position, and angle times the radius of gyration).",
        "motion_cone.png is the paper's figure 2, with 100 support points." if record["pictures"] else "",
    ]
