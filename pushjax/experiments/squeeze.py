"""A parallel jaw closes on a rectangle: four start poses, four outcomes.

The paper's first figure: a jaw with 27 x 10 mm pads closing along y on a 50 x 35 mm rectangle. Depending on where the
rectangle lies it ends grasped off centre, jammed, grasped off centre the other way, or slipped out.

Both a jam and a grasp end the motion. Called grasped here is what ends flat between the pads, each touching along an
edge; jammed, what is wedged between them askew.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.report import envelope

WIDTH, HEIGHT, FRICTION = 0.050, 0.035, 0.2
PAD, THICKNESS = 0.027, 0.010
OPENING, CLOSED = 0.075, 0.0005
# Start poses: m, m, degrees
STARTS = {
    "grasped with offset": (0.010, 0.0, 32.0),
    "jammed": (0.0, 0.005, 60.0),
    "grasped with the other offset": (-0.014, -0.002, 28.0),
    "slipped out": (0.030, 0.0, 45.0),
}
HOLD = 5  # steps for which the closed jaw waits: what has slipped out is then free
FLAT = np.radians(1.0)  # nearer than this to one of its edges a grasp is flat: the last step leaves a little


def run(seed: int = 0, out: Path | None = None, steps: int = 1500) -> dict[str, Any]:
    """All four, with a quartic fitted to 64 support points; the picture into `out`."""
    block = pj.Polygon.rectangle(WIDTH, HEIGHT)
    pairs = pj.Support.uniform(block, points=64).wrench_twist_pairs(jax.random.key(seed), 400)
    slider = pj.Slider(block, pj.fit_limit_surface(*pairs, degree=4))
    hand = pj.Hand.parallel_jaw(PAD, THICKNESS)
    closing = pj.line((0.0, 0.0, 0.0, OPENING), (0.0, 0.0, 0.0, CLOSED), steps)
    path = jnp.concatenate([closing, jnp.repeat(closing[-1:], HOLD, axis=0)])
    poses = jnp.array([(x, y, np.radians(angle)) for x, y, angle in STARTS.values()])
    close = jax.jit(jax.vmap(lambda pose: pj.rollout(slider, hand, path, pose=pose, friction=FRICTION)))
    grasps = close(poses)
    rows, drawn = [], {}
    for k, (name, start) in enumerate(STARTS.items()):
        grasp = jax.tree.map(lambda leaf, k=k: leaf[k], grasps)
        rows.append({"name": name, "start": start, "pose": grasp.pose[-1]} | outcome(grasp))
        drawn[name] = grasp
    pictures = [] if out is None else _draw(out, block, hand, drawn)
    settings = {"seed": seed, "steps": steps, "friction": FRICTION, "slider_m": (WIDTH, HEIGHT)}
    settings |= {"pad_m": (PAD, THICKNESS), "opening_m": (OPENING, CLOSED)}
    return envelope("squeeze", settings, rows=rows, pictures=pictures)


def outcome(grasp: pj.Trajectory) -> dict[str, Any]:
    """What became of one closing: in words, the status, the opening at which the jaw stopped, failed steps."""
    status = pj.Status(int(grasp.status[-1]))
    stopped = int(grasp.stopped)
    tilt = abs((float(grasp.pose[-1, 2]) + np.pi / 4) % (np.pi / 2) - np.pi / 4)
    words = "failed" if status.failed else "slipped out" if stopped < 0 else "grasped" if tilt < FLAT else "jammed"
    return {
        "outcome": words,
        "status": status.name,
        "opening_mm": 1e3 * float(grasp.configuration[-1, 3]),
        "tilt_deg": float(np.degrees(tilt)),
        "failed_steps": int(np.sum(np.asarray(grasp.failed))),
    }


def _draw(out: Path, block: pj.Polygon, hand: pj.Hand, grasps: dict[str, pj.Trajectory]) -> list[str]:
    from pushjax import plot

    return [str(plot.save(plot.grasp_figure(block, hand, grasps), out / "squeeze.png"))]


def summary(record: dict[str, Any]) -> str:
    """What the command prints."""
    lines = [f"A jaw with {1e3 * PAD:.0f} mm pads closes on a 50 x 35 mm rectangle (mu = {FRICTION}):"]
    for row in record["rows"]:
        x, y, theta = np.asarray(row["pose"], float)
        lines.append(
            f"  {row['name']:30} {row['outcome']:12} x = {1e3 * x:6.2f} mm, y = {1e3 * y:5.2f} mm, theta = "
            f"{np.degrees(theta):6.2f} deg, opening {row['opening_mm']:5.2f} mm   {row['status']}"
        )
    lines += [f"drew {path}" for path in record["pictures"]]
    return "\n".join(lines)
