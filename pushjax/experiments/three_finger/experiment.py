"""Three-finger grasps that the authors of Zhou et al. 2017 simulated, simulated again from the same starts.

Known are the limit surface, the outline, the fingers and how they close; not the friction. It is fitted on half of
the runs, and the other half is what is reported. Every run is gone through twice: in equal steps, to learn where it
stops, and then with most of the steps around there, for a jam is located to one step, and just before it the object
moves fast.

Runs that end apart are put in a class by what an experiment says (`CLASSES`); nothing else puts them there.
"""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pushjax.datasets.three_finger import ThreeFingerLog, load_three_finger_npz
from pushjax.experiments.three_finger.causes import CLASSES, FAR, NEAR, control, explain
from pushjax.experiments.three_finger.law import TOUCHING, touching
from pushjax.experiments.three_finger.runs import (
    NUDGE,
    Runs,
    apart_at_end,
    fitted_friction,
    float64,
    last_distance,
    simulate,
)
from pushjax.report import envelope
from pushjax.status import Status

OBJECTS = ("triangle", "hex", "hex_small")


def run(
    folder: Path,
    seed: int = 0,
    out: Path | None = None,
    steps: int = 400,
    progress: Callable[[int, int], None] = lambda done, total: None,
    limit: int | None = None,
) -> dict[str, Any]:
    """All three objects. folder: the data's, with `three_finger_sim/`. limit: take only so many runs of each.

    Raises ValueError for a limit below two: the friction is fitted on half of the runs, the other half is reported.
    """
    if limit is not None and limit < 2:
        raise ValueError(f"limit must be at least 2, half of it to fit and half to report; got {limit}")
    cells, shown, found = [], {}, []
    with float64():
        for done, name in enumerate(OBJECTS):
            log = load_three_finger_npz(folder / "three_finger_sim" / f"{name}.npz")
            order = np.random.default_rng(seed).permutation(log.runs)[:limit]
            fit, test = order[: len(order) // 2], np.sort(order[len(order) // 2 :])
            friction = fitted_friction(log, fit, steps)
            ours = simulate(log, test, friction, steps)
            apart = apart_at_end(log, test, ours)
            causes = explain(log, test, ours, friction, apart)
            cells.append({"object": name} | _cell(log, test, ours, friction, apart, causes))
            found += [{"object": name} | cause for cause in causes]
            shown[name] = (log, test, ours, apart)
            progress(done + 1, len(OBJECTS))
        pictures = [] if out is None else _draw(shown, out)
        settings = {"seed": seed, "steps": steps, "limit": limit, "near": NEAR, "far": FAR, "classes": CLASSES}
        return envelope("three-finger", settings, cells=cells, apart=found, pictures=pictures)


def _cell(
    log: ThreeFingerLog,
    which: np.ndarray,
    ours: Runs,
    friction: float,
    apart: np.ndarray,
    causes: list[dict[str, Any]],
) -> dict[str, Any]:
    far = [cause for cause in causes if cause["mm"] > FAR[0] or cause["deg"] > FAR[1]]
    return {
        "runs": len(which),
        "friction": friction,
        "median": np.median(apart, axis=0).tolist(),
        "percentile95": np.percentile(apart, 95, axis=0).tolist(),
        "worst": apart.max(axis=0).tolist(),
        "states": states(log, which, ours),
        "near": int(np.sum(np.all(apart <= NEAR, axis=1))),
        "far": dict(Counter(cause["class"] for cause in far)),
        "classes": dict(Counter(cause["class"] for cause in causes)),
        "control": control(log, which, friction, apart),
    }


def states(log: ThreeFingerLog, which: np.ndarray, ours: Runs) -> dict[str, dict[str, int]]:
    """How often each of their final states (moving, or stopped; fingers touching) meets each of ours."""
    gap = touching(log, log.pose[which, -1], log.distance[which, -1]).gap
    fingers = np.sum(gap < TOUCHING, axis=1)
    stopped = log.distance[which, -1] > last_distance(log) + NUDGE
    table: dict[str, Counter] = {}
    for stops, number, status in zip(stopped, fingers, ours.status, strict=True):
        theirs = f"{'stopped' if stops else 'open'}, {number} touching"
        table.setdefault(theirs, Counter())[Status(int(status)).name] += 1
    return {theirs: dict(table[theirs]) for theirs in sorted(table)}


def _draw(shown: dict[str, tuple[ThreeFingerLog, np.ndarray, Runs, np.ndarray]], out: Path) -> list[str]:
    import matplotlib.pyplot as plt

    from pushjax import plot

    colors = dict(zip(shown, (plot.BLUE, plot.ORANGE, plot.GREEN), strict=False))
    with plt.rc_context(plot.STYLE):
        figure, axes = plt.subplots(2, 3, figsize=(10.5, 6.6), layout="constrained")
        for column, (unit, least) in enumerate((("mm", 1e-5), ("degrees", 1e-5))):
            for name, (_, _, _, apart) in shown.items():
                values = np.sort(np.maximum(apart[:, column], least))
                share = np.arange(1, len(values) + 1) / len(values)
                axes[0, column].step(values, share, where="post", color=colors[name], label=name)
            for bound, dash in ((NEAR, ":"), (FAR, "--")):
                axes[0, column].axvline(bound[column], color="0.5", lw=0.8, ls=dash)
            axes[0, column].set(xscale="log", xlabel=f"difference of the final pose / {unit}", ylim=(0, 1.02))
        axes[0, 0].set_ylabel("share of the runs")
        axes[0, 0].legend(loc="upper left")
        axes[0, 2].set_axis_off()
        for kind, dash, width in (("theirs", "-", 3.0), ("ours", "-", 1.0)):
            axes[0, 2].plot([], [], dash, lw=width, color="0.75" if kind == "theirs" else "black", label=kind)
        axes[0, 2].plot([], [], "ko", ms=3, label="start")
        axes[0, 2].legend(loc="lower center", title="below: centres, as the hand closes\nred: ends apart")
        for name, panel in zip(shown, axes[1], strict=False):
            log, which, ours, apart = shown[name]
            moved = np.flatnonzero(np.abs(log.pose[which, -1] - log.pose[which, 0]).max(axis=1) > 1e-3)
            away = np.any(apart[moved] > NEAR, axis=1)
            for k in [*moved[~away][:10], *moved[away][:3]]:
                wrong = bool(np.any(apart[k] > NEAR))
                panel.plot(*(1e3 * log.pose[which[k], :, :2].T), color="0.75", lw=3)
                panel.plot(*(1e3 * ours.pose[k, :, :2].T), color=plot.END if wrong else "black", lw=1)
                panel.plot(*(1e3 * ours.pose[k, 0, :2]), "ko", ms=3)
            panel.set(title=name, xlabel="x / mm", ylabel="y / mm", aspect="equal")
        return [str(plot.save(figure, out / "three_finger.png"))]


def summary(record: dict[str, Any]) -> str:
    """What the command prints."""
    lines = [
        "Final poses, the authors' own simulation against ours; half of the runs (friction fitted to the other).",
        "",
    ]
    lines.append(f"{'':11}{'runs':>5}{'friction':>10}{'median':>21}{'95 %':>21}{'worst':>21}")
    for cell in record["cells"]:
        pairs = (cell["median"], cell["percentile95"], cell["worst"])
        columns = "".join(f"{f'{mm:.4f} mm {deg:.4f}°':>21}" for mm, deg in pairs)
        lines.append(f"{cell['object']:11}{cell['runs']:5}{cell['friction']:10.4f}{columns}")
    for cell in record["cells"]:
        lines += ["", f"{cell['object']}: final states, theirs and ours"]
        for theirs, row in cell["states"].items():
            lines.append(f"  {theirs:22}" + ", ".join(f"{name} {count}" for name, count in sorted(row.items())))
        lines.append(f"  {cell['near']} of {cell['runs']} within {NEAR[0]} mm and {NEAR[1]}°; the others:")
        for name, count in sorted(cell["classes"].items(), key=lambda item: -item[1]):
            far = cell["far"].get(name, 0)
            lines.append(f"    {count:4} {name} ({CLASSES[name]}); {far} beyond {FAR[0]} mm or {FAR[1]}°")
        control = cell["control"]
        lines.append(f"  the law is broken likewise in {control['broken']} of {control['runs']} runs that end together")
    lines += [f"drew {path}" for path in record["pictures"]]
    return "\n".join(lines)
