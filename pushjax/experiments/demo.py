"""A first push: fit two limit surfaces to the friction of a square, push it with both, and draw the results."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

import pushjax as pj
from pushjax.experiments._record import result_record

SIDE, RADIUS, FRICTION = 0.09, 0.00475, 0.25
START, END, STEPS = (-0.05, 0.018), (0.0, 0.018), 100
MOTION_CONE = "motion_cone.png"


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
        surfaces[name], pushes[name] = surface, (push, path)
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
    apart = pj.deviation(pushes["ellipsoid"][0].pose[-1], pushes["quartic"][0].pose[-1], pairs.length)
    say("demo: drawing")
    pictures = [] if out is None else _draw(out, key, block, support, pairs, surfaces, pushes)
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


def _draw(out: Path, key, block, support, pairs, surfaces, pushes) -> list[str]:
    """Draw the three pictures into the folder `out` and return their paths."""
    from pushjax import plot

    drawn = {
        "limit_surfaces.png": plot.limit_surfaces(surfaces, pairs, float(support.load)),
        MOTION_CONE: plot.motion_cone_figure(*motion_cone_setup(key)),
        "push.png": plot.push_figure(block, pushes, RADIUS),
    }
    return [str(plot.save(figure, out / name)) for name, figure in drawn.items()]


def summary(record: dict[str, Any]) -> str:
    """Return the text that the command prints for a record of `run`."""
    lines = ["A 90 mm square, 64 support points, pushed 18 mm off center over 50 mm (mu = 0.25):"]
    for row in record["rows"]:
        x, y, theta = np.asarray(row["pose"], float)
        modes = ", ".join(f"{count} {name.lower()}" for name, count in row["modes"].items())
        lines.append(
            f"  {row['model']:<10} mean error of twists {row['fit_angle_deg']:.1f} deg   ends at x = {1e3 * x:.2f} mm, "
            f"y = {1e3 * y:.2f} mm, theta = {np.degrees(theta):.2f} deg   steps: {modes}"
        )
    lines.append(f"  the two end {record['apart_mm']:.2f} mm apart (position, and angle times the radius of gyration)")
    note = " (the paper's figure 2, with 100 support points)"
    lines += [f"  drew {path}{note if Path(path).name == MOTION_CONE else ''}" for path in record["pictures"]]
    return "\n".join(lines)
