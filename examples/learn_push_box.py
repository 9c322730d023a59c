"""Learn to push a block to a pose, with and without random friction, with and without derivatives of the simulator.

    python -m examples.learn_push_box --to learning.json [--seconds 50] [--seeds 3] [--picture learning.png]

trains policies for `pushjax.tasks.PushBox` with two learners and the same processor time for each, and tests them
under friction that they have not seen. With --picture the learning curves of a file are drawn.

- `examples.ppo`: proximal policy optimization, once with known and once with random friction.
- `examples.analytic`: derivatives of the return through the simulator.
"""

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from examples import analytic, ppo
from examples.push_box_policy import KNOWN, RANDOM, TESTS, Friction, evaluate


class Run(NamedTuple):
    """A way to learn.

    Attributes:
        start: Function from key and parameters to the learner before the first update.
        update: Function from learner, key and parameters to the learner after an update.
        friction: Friction in the training.
        steps: Control steps of an update.
    """

    start: Callable[..., Any]
    update: Callable[..., Any]
    friction: Friction
    steps: int


PPO_STEPS = ppo.ENVIRONMENTS * ppo.STEPS
RUNS = {
    "PPO, random friction": Run(ppo.start, ppo.update, RANDOM, PPO_STEPS),
    "PPO, known friction": Run(ppo.start, ppo.update, KNOWN, PPO_STEPS),
} | {
    f"analytic gradients over {horizon} steps, random friction": Run(
        analytic.start, partial(analytic.update, horizon=horizon), RANDOM, analytic.ENVIRONMENTS * horizon
    )
    for horizon in (4, 16)
}
CURVE_POINTS = 8


def train(name: str, seed: int, seconds: float) -> dict[str, Any]:
    """Train one policy and test it.

    Args:
        name: One of `RUNS`.
        seed: Seed of everything random.
        seconds: Processor time of all updates together, without compilation and tests.

    Returns:
        The record: the curve (processor time, control steps, success under the friction of the training, and reward of
        a control step), and the tests.
    """
    run = RUNS[name]
    params, key = run.friction.params(), jax.random.key(seed)
    learner = run.start(key, params)
    _, reward = jax.block_until_ready(run.update(learner, key, params))  # compiles
    curve, used, updates = [], 0.0, 0
    while True:
        if used >= len(curve) * seconds / CURVE_POINTS:
            outcome = evaluate(learner.policy, jax.random.key(1000), params)
            curve.append((used, updates * run.steps, float(np.mean(outcome.success)), float(reward)))
            said = f"{updates} updates, reward {curve[-1][3]:.3f}, success {curve[-1][2]:.3f}"
            print(f"{name}, seed {seed}: {used:.0f} s, {said}", flush=True)
        if used >= seconds:
            break
        begin = time.process_time()
        key, update_key = jax.random.split(key)
        learner, reward = jax.block_until_ready(run.update(learner, update_key, params))
        used, updates = used + time.process_time() - begin, updates + 1
    tests = {}
    for test, tested in TESTS.items():
        outcome = evaluate(learner.policy, jax.random.key(2000), tested.params())
        fields = {"success": outcome.success, "coverage": outcome.coverage, "steps": outcome.steps}
        tests[test] = {field: float(np.mean(value)) for field, value in fields.items()}
    print({test: round(values["success"], 3) for test, values in tests.items()}, flush=True)
    return {"run": name, "seed": seed, "curve": curve, "tests": tests}


def summary(records: list[dict[str, Any]]) -> str:
    """Return a table of the tests: mean over the seeds with its standard error, and the lowest and the highest."""
    lines = ["| | " + " | ".join(TESTS) + " |", "|---" * (1 + len(TESTS)) + "|"]
    for name in RUNS:
        cells = []
        for test in TESTS:
            values = [record["tests"][test]["success"] for record in records if record["run"] == name]
            if len(values) > 1:
                error = np.std(values, ddof=1) / len(values) ** 0.5
                cells.append(f"{np.mean(values):.2f} ± {error:.2f} ({min(values):.2f} to {max(values):.2f})")
            else:
                cells += [f"{value:.2f}" for value in values] or [""]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def draw(records: list[dict[str, Any]], path: Path) -> None:
    """Draw success over processor time: each seed as a thin line, and their mean."""
    from matplotlib import pyplot as plt

    from pushjax.plot.style import SERIES, STYLE

    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
        for name, (color, dash, _) in zip(RUNS, SERIES, strict=False):
            curves = [np.array(record["curve"]) for record in records if record["run"] == name]
            if not curves:
                continue
            for curve in curves:
                axes.plot(curve[:, 0], curve[:, 2], color=color, lw=0.6, alpha=0.5)
            grid = np.linspace(0, min(curve[-1, 0] for curve in curves), 60)
            mean = np.mean([np.interp(grid, curve[:, 0], curve[:, 2]) for curve in curves], axis=0)
            axes.plot(grid, mean, color=color, ls=dash, label=name)
        axes.set(xlabel="processor time of the training, s", ylabel="episodes with success", ylim=(0, 1))
        figure.legend(loc="outside lower center", ncols=2)
        figure.savefig(path)
        plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--to", type=Path, required=True, help="file of the records; those in it are kept")
    parser.add_argument("--seconds", type=float, default=50.0, help="processor time of each training")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--runs", nargs="*", choices=list(RUNS), default=list(RUNS))
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    records = json.loads(arguments.to.read_text()) if arguments.to.exists() else []
    done = {(record["run"], record["seed"]) for record in records}
    for name in arguments.runs:
        for seed in range(arguments.seeds):
            if (name, seed) not in done:
                records.append(train(name, seed, arguments.seconds))
                arguments.to.write_text(json.dumps(records))
    print(summary(records))
    if arguments.picture:
        draw(records, arguments.picture)


if __name__ == "__main__":
    main()
