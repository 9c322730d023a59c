"""Stable pushes to random goals: slip against the hand, with the bound on curvature and beyond it.

Two fingers side by side carry a box along Dubins paths whose curvature is bounded such that both contacts stick for all
sampled limit surfaces and coefficients of friction. Slip is what a corner of the box moves in the frame of the hand,
from poses alone. A simulation follows arcs by chords, so its own error falls with the square of the length of a step;
the rows "half as many steps" show it.

- `margin`: the bound that is reduced by the margin, under the friction it was computed for.
- `half as many steps`: the same in coarser steps.
- `unseen friction`: the same under friction it was not computed for.
- `no margin, 1.1 x`: curvatures a tenth beyond the bound without margin, under the friction it was computed for.
- `2 x`: curvatures twice those of the margin.
"""

import time
from collections.abc import Sequence
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import pushjax as pj
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record
from pushjax.planning import StableContact, StablePush, shortest_push, stable_contacts
from pushjax.planning.friction_samples import draw_friction

BOX, RADIUS, SPACING = pj.Polygon.rectangle(0.09, 0.06), 0.005, 0.04
HAND = pj.Hand.two_fingers(RADIUS)
REACH = 0.3  # half of the width of the square of the goals, m
TOGETHER = 4  # goals that are simulated together, each under all samples
Case = Literal["margin", "half as many steps", "unseen friction", "no margin, 1.1 x", "2 x"]
CASES: tuple[Case, ...] = get_args(Case)
SLIPS = 1e-3  # m, more than any error of the simulation


@jax.jit
def largest_slips(surfaces: pj.LimitSurface, friction: Array, paths: Array) -> Array:
    """Return the largest slip of the box in the hand along each path under each friction, (goals, samples), m."""

    def slip(path: Array, surface: pj.LimitSurface, mu: Array) -> Array:
        pose = pj.rollout(pj.Slider(BOX, surface), HAND, path, pose=jnp.zeros(3), friction=mu).pose
        corners = jax.vmap(lambda p: pj.se2.transform(p, BOX.vertices))(pose)
        held = jax.vmap(lambda q, points: pj.se2.transform(pj.se2.inverse(q), points))(path[:, :3], corners)
        return jnp.sqrt(jnp.max(jnp.sum((held - held[:1]) ** 2, axis=-1)))

    each = jax.vmap(slip, (None, 0, 0))
    return jax.lax.map(lambda path: each(path, surfaces, friction), paths, batch_size=TOGETHER)


def run(
    goals: int = 1000,
    samples: int = 64,
    steps: int = 200,
    dof: float = 200.0,
    friction: tuple[float, float] = (0.3, 0.5),
    margin: float = 0.1,
    degree: int = 2,
    case: tuple[Case, ...] = CASES,
    seed: int = 0,
    progress: ProgressCallback = no_progress,
) -> dict[str, Any]:
    """Plan stable pushes to random goals, and simulate them under many samples of friction.

    Args:
        goals: Number of goals: positions in a square of 600 mm around the box, at any angle.
        samples: Number of samples of friction.
        steps: Number of steps of a path.
        dof: Degrees of freedom of the limit surface.
        friction: Lowest and highest coefficient of friction of the fingers.
        margin: Margin of the bound.
        degree: Degree of the limit surface.
        case: Which rows. Default: all.
        seed: Seed of the goals and of the friction.
        progress: Called with the number of rows done and their total.

    Returns:
        The record, with a row for each bound: the largest slip, and the fractions of pushes and of goals that slip.
    """
    slider, model = pj.Slider.uniform(BOX, degree=degree), pj.FrictionModel(dof, friction)
    key, unseen = jax.random.key(seed), jax.random.key(seed + 1)
    poses = np.random.default_rng(seed).uniform(-1, 1, (goals, 3)) * [REACH, REACH, np.pi]
    start = time.perf_counter()
    bounds = {
        each: stable_contacts(key, slider, HAND, model=model, opening=(SPACING,), samples=samples, margin=each)
        for each in (margin, 0.0)
    }
    bound_s = (time.perf_counter() - start) / 2
    cases: dict[Case, tuple[Sequence[StableContact], Any, int]] = {
        "margin": (bounds[margin], key, steps),
        "half as many steps": (bounds[margin], key, steps // 2),
        "unseen friction": (bounds[margin], unseen, steps),
        "no margin, 1.1 x": (_tighter(bounds[0.0], 1.1), key, steps),
        "2 x": (_tighter(bounds[margin], 2.0), key, steps),
    }
    rows = []
    for name in case:
        contacts, drawn, count = cases[name]
        start = time.perf_counter()
        pushes = [shortest_push(contacts, np.zeros(3), pose, steps=count) for pose in poses]
        plan_s = (time.perf_counter() - start) / goals
        draws = jax.tree.map(lambda leaf: leaf[:, 0], draw_friction(drawn, slider.surface, model, samples))
        paths = jnp.stack([push.path for push in pushes if push.path is not None])
        slip = np.asarray(largest_slips(draws.surface, draws.friction, paths))
        rows.append(_row(name, slip, pushes) | {"plan_ms": 1e3 * plan_s})
        progress(len(rows), len(case))
    settings = {"goals": goals, "samples": samples, "steps": steps, "dof": dof, "friction": friction, "margin": margin}
    turns = [{"edge": each.contact.edge} | each.turn._asdict() for each in bounds[margin]]
    return result_record(
        "stable_pushes", settings | {"degree": degree, "seed": seed}, rows=rows, turns=turns, bound_s=bound_s
    )


def _tighter(contacts: Sequence[StableContact], factor: float) -> list[StableContact]:
    """Return contacts whose curvatures are multiplied by a factor."""
    return [
        each._replace(turn=each.turn._replace(left=factor * each.turn.left, right=factor * each.turn.right))
        for each in contacts
    ]


def _row(name: str, slip: np.ndarray, pushes: list[StablePush]) -> dict[str, Any]:
    lengths = [push.dubins.length for push in pushes if push.dubins is not None]
    return {
        "case": name,
        "paths": len(slip),
        "length_m": float(np.mean(lengths)),
        "slip_mm": 1e3 * float(slip.max()),
        "slipping_pushes": float(np.mean(slip > SLIPS)),
        "slipping_goals": float(np.mean(np.any(slip > SLIPS, axis=1))),
    }


def summary(record: dict[str, Any]) -> str:
    """Return the text that the command prints."""
    settings, turns = record["settings"], record["turns"]
    radii = [1e3 / each[side] for each in turns for side in ("left", "right")]
    lines = [
        f"{settings['goals']} goals, each under {settings['samples']} samples of friction; tightest turns of "
        f"{min(radii):.0f} to {max(radii):.0f} mm radius on {len(turns)} edges",
        f"{'case':22}{'path / mm':>10}{'largest slip / mm':>19}{'slip > 1 mm':>13}{'of goals':>10}{'ms a plan':>11}",
    ]
    for row in record["rows"]:
        lines.append(
            f"{row['case']:22}{1e3 * row['length_m']:10.0f}{row['slip_mm']:19.4f}{100 * row['slipping_pushes']:11.1f} %"
            f"{100 * row['slipping_goals']:8.1f} %{row['plan_ms']:11.1f}"
        )
    return "\n".join(lines)
