"""Grasping under uncertainty: final poses of a rectangle or a butterfly that a parallel jaw closes on.

The pads of the jaw are 27 x 10 mm. The jaw closes from 85 mm until it is stopped or shut. The limit surface is an
ellipsoid, sampled with 250 degrees of freedom around the one that the pressure gives. The pressure acts along the rim;
the rectangle is also simulated on six points. The friction of the pads is uniform in [0.015, 0.02].

The paper leaves two things open, which are chosen here. One is how far the jaw is open at first. The other is that
start poses that overlap the open jaw are sampled again.

Reference: Zhou et al. 2017, section VI.C, figures on grasping under uncertainty.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record
from pushjax.experiments.grasps.outcomes import classify, spikes, start_poses
from pushjax.experiments.grasps.sliders import SLIDERS

PAD_WIDTH, PAD_THICKNESS = 0.027, 0.010  # m
STEPS = 840  # steps in which the jaw closes
HOLD = 5  # steps for which the closed jaw waits, so that a slider that has slipped out is free at the end
DOF = 250.0
FRICTION = (0.015, 0.02)
PAIRS = 400  # wrench-twist pairs that the mean ellipsoid is fitted to
BINS = 45  # of each histogram in the record; the picture has more
OUTCOMES = ("grasped", "jammed", "free", "failed")


def run(
    slider: str,
    seed: int = 0,
    out: Path | None = None,
    n: int | None = None,
    steps: int = STEPS,
    dof: float = DOF,
    friction: tuple[float, float] = FRICTION,
    progress: ProgressCallback = no_progress,
) -> dict[str, Any]:
    """Simulate the grasps of one slider, once for each pressure distribution under it.

    Args:
        slider: "rectangle" or "butterfly".
        seed: Seed of the wrench-twist pairs and the start poses; the grasps use `seed + 1`.
        out: Folder for the pictures. None: no pictures.
        n: Number of grasps. None: that of the slider's setting.
        steps: Steps in which the jaw closes.
        dof: Degrees of freedom of the sampled ellipsoids.
        friction: Lowest and highest coefficient of friction of the pads.
        progress: Called with the number of grasps done and their total.

    Returns:
        The record: `cells` has the results for each pressure distribution, `starts` the start poses, and `redrawn` the
        number of start poses that were sampled again because they overlapped the open jaw.

    Raises:
        ValueError: If the slider is unknown.
    """
    if slider not in SLIDERS:
        raise ValueError(f"slider must be one of {', '.join(SLIDERS)}; got {slider!r}")
    setting = SLIDERS[slider]()
    count = setting.n if n is None else n
    hand = pj.Hand.parallel_jaw(PAD_WIDTH, PAD_THICKNESS)
    open_configuration, shut_configuration = ((0.0, 0.0, 0.0, d) for d in setting.opening)
    path = jnp.concatenate(
        [pj.line(open_configuration, shut_configuration, steps), jnp.asarray([shut_configuration] * HOLD)]
    )
    model = pj.FrictionModel(dof=dof, friction=friction)
    slider_by_pressure = {}
    for name, support in setting.supports.items():
        pairs = support.wrench_twist_pairs(jax.random.key(seed), PAIRS)
        slider_by_pressure[name] = pj.Slider(setting.shape, pj.fit_limit_surface(*pairs, degree=2))
    starts, resampled = start_poses(next(iter(slider_by_pressure.values())), hand, path[0], setting.circle, count, seed)
    cells, shown = [], {}
    for k, (name, grasped_slider) in enumerate(slider_by_pressure.items()):

        def report_progress(done: int, total: int, before: int = k * count) -> None:
            progress(before + done, len(slider_by_pressure) * count)

        key = jax.random.key(seed + 1)
        grasps = pj.monte_carlo(
            key, count, grasped_slider, hand, path, pose=starts, model=model, progress=report_progress
        )
        outcomes = classify(grasps, setting.shape, PAD_WIDTH)
        cells.append({"pressure": name} | _results(grasps, outcomes, setting.symmetry))
        shown[name] = grasps, outcomes
    pictures = []
    if out is not None:
        from pushjax.experiments.grasps.picture import draw

        pictures = draw(out, f"grasp_{slider}", setting, hand, path, starts, shown)
    settings = {"seed": seed, "steps": steps, "dof": dof, "friction": friction, "pad_m": (PAD_WIDTH, PAD_THICKNESS)}
    settings |= {"opening_m": setting.opening, "circle_m": setting.circle, "pairs": PAIRS}
    first = cells[0]
    return result_record(
        f"grasp-{slider}",
        settings,
        n=count,
        outcomes=first["outcomes"],
        redrawn=resampled,
        starts=starts,
        cells=cells,
        pictures=pictures,
    )


def _results(grasps: pj.MonteCarlo, outcomes: np.ndarray, symmetry: float) -> dict[str, Any]:
    """Return the results for one pressure distribution: outcomes, and the spikes and histograms of the held poses."""
    held = grasps.stopped >= 0
    pose = np.asarray(grasps.pose, np.float64)
    histograms = {
        name: grasps.histogram(pose[held, k], BINS) for k, name in enumerate(("x", "y", "theta")) if held.any()
    }
    return {
        "outcomes": {name: int(np.sum(outcomes == name)) for name in OUTCOMES},
        "statuses": grasps.summary()["statuses"],
        "failed_steps": int(grasps.failed.sum()),
        "spikes": spikes(pose[held, 2], symmetry) if held.any() else [],
        "held": histograms,
        "pose": pose,
        "outcome_of_each": outcomes,
        "seconds": grasps.seconds,
    }


def summary(record: dict[str, Any]) -> str:
    """Return the text that the command prints for a record of `run`."""
    name = record["experiment"].removeprefix("grasp-")
    lines = [
        f"A jaw closes on a {name} from {record['n']} poses ({record['redrawn']} sampled again, which overlapped it):"
    ]
    for cell in record["cells"]:
        counts = ", ".join(f"{count} {word}" for word, count in cell["outcomes"].items())
        found = ", ".join(f"{spike['degrees']:.0f}° {spike['share']:.0%}" for spike in cell["spikes"][:8])
        lines.append(f"  {cell['pressure']:10} {counts}   ({cell['seconds']:.0f} s)")
        lines.append(f"  {'':10} angles that hold: {found or 'none above the others'}")
    lines += [f"drew {path}" for path in record["pictures"]]
    return "\n".join(lines)
