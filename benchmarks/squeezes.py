"""Squeezes in a row that bring a block into one pose: planned, repeated, and at random.

Five blocks of four corners lie somewhere between two wide pads, within 10 mm and a quarter turn either way. No sequence
measures anything. After each squeeze it is counted how many poses can be told apart (the exponential of the entropy),
and at the end how often the block is held within 5 mm and 5 degrees of its most likely pose. Start poses and friction
are others than those of the search.

- `planned` squeezes are those of `plan_squeezes`.
- `repeated`: the planned first squeeze, again and again.
- `random`: the jaw at random angles; the mean over several sequences.
"""

import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import pushjax as pj
from pushjax import plot
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record
from pushjax.planning import SqueezeOutcomes, SqueezePlan, Squeezes, plan_squeezes, squeeze_outcomes
from pushjax.planning.goal import ANGLE_TOLERANCE, symmetric_turns
from pushjax.planning.squeezes.plan_squeezes import WIDTH
from pushjax.planning.squeezes.pose_spread import distances, entropy, most_likely
from pushjax.plot.files import save

HAND = pj.Hand.parallel_jaw(0.07, 0.01)
OPENING, CLOSED = 0.1, 0.01  # m
AWAY, POSITION = 0.01, 0.005  # half of the width of the square of start positions, and tolerance of the final one, m
DRAWN = 40  # samples of a picture
# Corners in mm, about the centroid, and how many angles look the same. All have four corners, so that one compiled
# program does for all of them.
BLOCKS = {
    "rectangle": (((-25, -17.5), (25, -17.5), (25, 17.5), (-25, 17.5)), 2),
    "narrow rectangle": (((-30, -10), (30, -10), (30, 10), (-30, 10)), 2),
    "rhombus": (((-30, 0), (0, -18), (30, 0), (0, 18)), 2),
    "trapezoid": (((-30, -13), (30, -13), (14, 16), (-14, 16)), 1),
    "irregular": (((-26, -14), (22, -18), (28, 8), (-14, 22)), 1),
}


def run(
    count: int = 3,
    belief: int = 128,
    unseen: int = 256,
    sequences: int = 5,
    friction: tuple[float, float] = (0.05, 0.1),
    dof: float = 100.0,
    out: Path | None = None,
    seed: int = 0,
    progress: ProgressCallback = no_progress,
) -> dict[str, Any]:
    """Squeeze all blocks.

    Args:
        count: Number of squeezes.
        belief: Number of start poses of the search.
        unseen: Number of other start poses, which judge all sequences.
        sequences: Number of random sequences.
        friction: Lowest and highest coefficient of friction of the pads.
        dof: Degrees of freedom of the limit surface.
        out: Folder for the picture; None for no picture.
        seed: Seed of everything random.
        progress: Called with the number of blocks done and their total.

    Returns:
        The record, with a row for each block and kind of sequence.
    """
    how = {"model": pj.FrictionModel(dof, friction), "squeezes": Squeezes(OPENING, closed=CLOSED)}
    rows, drawn = [], None
    for k, (name, (corners, symmetry)) in enumerate(BLOCKS.items()):
        slider, rng = _slider(corners), np.random.default_rng([seed, k])
        start, others = _belief(rng, belief), _belief(rng, unseen)
        began = time.perf_counter()
        plan = plan_squeezes(
            jax.random.key(seed),
            slider,
            HAND,
            start,
            count=count,
            symmetry=symmetry,
            position_tolerance=POSITION,
            **how,
        )
        seconds = time.perf_counter() - began
        angles = rng.uniform(0, np.pi, (sequences, count, 1))
        kinds = {
            "planned": [plan.jaws],
            "repeated": [np.repeat(plan.jaws[:1], count, axis=0)],
            "random": [np.column_stack([np.zeros((count, 2)), each]) for each in angles],
        }
        key = jax.random.key(10**6 + seed + k)
        done = {
            kind: [squeeze_outcomes(key, slider, HAND, others, jaws, **how) for jaws in each]
            for kind, each in kinds.items()
        }
        rows += [{"block": name, "squeezes": kind} | _row(each, slider, symmetry) for kind, each in done.items()]
        rows[-3] |= _agreement(plan, done["planned"][0], slider, symmetry) | {"seconds": seconds}
        drawn = drawn or (slider, plan, done["planned"][0], rows[-3]["poses"])
        progress(k + 1, len(BLOCKS))
    pictures = []
    if out is not None and drawn is not None:
        pictures = [str(save(_picture(*drawn), out / "squeezes.png"))]
    settings = {"count": count, "belief": belief, "unseen": unseen, "sequences": sequences, "friction": friction}
    return result_record("squeezes", settings | {"dof": dof, "seed": seed}, rows=rows, pictures=pictures)


def _slider(corners: tuple[tuple[float, float], ...]) -> pj.Slider:
    """Return a block with its centroid at its origin."""
    vertices = 1e-3 * np.array(corners, float)
    vertices = vertices - np.asarray(pj.Polygon(vertices).centroid)
    return pj.Slider.uniform(pj.Polygon(vertices), degree=2)


def _belief(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.column_stack([rng.uniform(-AWAY, AWAY, (count, 2)), rng.uniform(-np.pi / 2, np.pi / 2, count)])


def _row(outcomes: list[SqueezeOutcomes], slider: pj.Slider, symmetry: int) -> dict[str, Any]:
    """Return how many poses can be told apart before and after each squeeze, and how often the last one is known."""
    turns, length = np.asarray(symmetric_turns(symmetry), float), float(slider.surface.length)
    poses, known, failed = [], [], 0
    for each in outcomes:
        poses.append(np.exp(entropy(np.moveaxis(each.poses, 1, 0), turns, length, WIDTH * length)))
        _, near = most_likely(each.poses[:, -1], turns, POSITION, ANGLE_TOLERANCE)
        known.append(np.mean(near & each.held[:, -1]))
        failed += int(each.failed.sum())
    held = float(np.mean([each.held[:, -1].mean() for each in outcomes]))
    return {"poses": np.mean(poses, axis=0), "known": float(np.mean(known)), "held": held, "failed": failed}


def _agreement(plan: SqueezePlan, real: SqueezeOutcomes, slider: pj.Slider, symmetry: int) -> dict[str, float]:
    """Return what the plan predicts, and how often a block that it has not seen ends among its predicted poses."""
    turns, length = np.asarray(symmetric_turns(symmetry), float), float(slider.surface.length)
    predicted = plan.outcomes.poses[:, -1]
    apart, turned = distances(np.concatenate([real.poses[:, -1], predicted]), turns, length)
    among = np.hypot(apart, turned)[: len(real.poses), len(real.poses) :].min(axis=1) <= 2 * WIDTH * length
    apart, turned = distances(np.concatenate([plan.pose[None], real.poses[:, -1]]), turns, 1.0)
    near = (apart[0, 1:] <= POSITION) & (turned[0, 1:] <= ANGLE_TOLERANCE)
    came_true = float(np.mean(near & real.held[:, -1]))
    return {"predicted": plan.success, "came_true": came_true, "among_predicted": float(np.mean(among))}


def _picture(slider: pj.Slider, plan: SqueezePlan, done: SqueezeOutcomes, told: np.ndarray) -> Any:
    """Draw the unseen blocks before the first squeeze and after each."""
    count = len(plan.jaws)
    with plt.rc_context(plot.STYLE):
        figure, panels = plt.subplots(1, count + 1, figsize=(3.0 * (count + 1), 3.3), layout="constrained")
        for k, axes in enumerate(panels):
            for pose in done.poses[:DRAWN, k]:
                plot.outline(axes, slider.shape, pose, plot.RED, 0.6, alpha=0.4)
            if k < count:
                jaw = jnp.array([*plan.jaws[k], OPENING])
                plot.hand_at(axes, HAND, np.asarray(HAND.poses(jaw)), plot.BLUE, 1.4)
            title = "start" if k == 0 else f"after {k} squeeze{'s' if k > 1 else ''}"
            axes.set(
                title=f"{title}: {told[k]:.1f} poses", xlim=(-75, 75), ylim=(-75, 75), xlabel="x / mm", aspect="equal"
            )
        panels[0].set_ylabel("y / mm")
    return figure


def summary(record: dict[str, Any]) -> str:
    """Return the text that the command prints."""
    count = record["settings"]["count"]
    after = "".join(f"{'after ' + str(k):>9}" for k in range(1, count + 1))
    lines = ["poses that can be told apart, and how often the block is held within 5 mm and 5 deg of the likeliest"]
    lines.append(f"{'block':18}{'squeezes':10}{'start':>8}{after}{'known':>9}")
    for row in record["rows"]:
        numbers = "".join(f"{number:9.1f}" for number in row["poses"][1:])
        lines.append(f"{row['block']:18}{row['squeezes']:10}{row['poses'][0]:8.1f}{numbers}{100 * row['known']:7.0f} %")
    for row in record["rows"]:
        if "predicted" in row:
            lines.append(
                f"{row['block']}: predicted {row['predicted']:.0%}, came true {row['came_true']:.0%}; "
                f"{row['among_predicted']:.0%} end among the predicted poses; planned in {row['seconds']:.0f} s"
            )
    return "\n".join(lines + [f"drew {path}" for path in record["pictures"]])
