"""The same push by MuJoCo and MJX, each at its largest step within 0.1 mm of its own converged answer."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.bench import tasks
from pushjax.bench.peers import mjx, mujoco
from pushjax.bench.peers.scene import Scene, Settings

HALF = tasks.SIDE / 2
SUPPORTS = {
    "three": ((-0.03, -0.02), (0.03, -0.02), (0.0, 0.03)),
    "four": ((-HALF, -HALF), (HALF, -HALF), (HALF, HALF), (-HALF, HALF)),
}
STICKS = (0.004, 0.01)  # m off the middle of the side
TIMED, BATCH = 40, 64


def rows() -> list[dict[str, Any]]:
    """Of MuJoCo on three supports and on four, and of MJX on four: seconds of processor per push, and how far a finger
    that sticks slips."""
    found = [_mujoco(name) for name in SUPPORTS]
    return [*found, _mjx("four", found[-1])]


def _mujoco(name: str) -> dict[str, Any]:
    scene, settings = Scene(SUPPORTS[name]), Settings()
    timestep, table = mujoco.largest_step(scene, settings, 1e-3 * tasks.ALLOWED_MM)
    if np.isnan(timestep):
        raise ValueError(f"MuJoCo on {name} supports comes within {tasks.ALLOWED_MM} mm at no timestep")
    at = next(row for row in table if row.timestep == timestep)
    return {
        "peer": "mujoco",
        "supports": name,
        "timestep_s": timestep,
        "error_mm": at.error_mm,
        "processor_s_per_push": mujoco.timed(scene, settings, timestep, TIMED),
        "slip_um": _um(mujoco.push(scene, settings, timestep, *_straight(scene, STICKS)).slip),
        "by_timestep": [row._asdict() for row in table],
    }


def _mjx(name: str, converged: dict[str, Any]) -> dict[str, Any]:
    """Its error is that of the fan against MuJoCo's at a tenth of the step."""
    scene = Scene(SUPPORTS[name])
    starts, ends = mujoco.fan(scene)
    many_starts, many_ends = (np.resize(part, (BATCH, 2)) for part in (starts, ends))
    batch = mjx.Batch(scene, mjx.SETTINGS, mjx.TIMESTEP, many_starts, many_ends)
    pose = batch.pushed().pose[: len(starts)]
    exact = mujoco.push(scene, mjx.SETTINGS, mjx.TIMESTEP / 10, starts, ends).pose
    return {
        "peer": "mjx",
        "supports": name,
        "timestep_s": mjx.TIMESTEP,
        "error_mm": float(np.max(tasks.error_mm(pose, exact))),
        "processor_s_per_push": batch.pushed().processor / BATCH,
        "compile_s": batch.compile_seconds,
        "batch": BATCH,
        "dtype": "float64",
        "slip_um": None,
        "by_timestep": [],
    }


def slip_um(dtype: str, offsets: tuple[float, ...] = STICKS, steps: int = 50) -> list[float]:
    """How far the tip of pushjax's own straight pushes slides along the side, all that it does not roll: um.

    Raises ValueError for an offset (m, from the middle of the side) at which it does not stick.
    """
    here = tasks.task("quartic", dtype)
    offset = jnp.asarray(offsets, dtype)
    push = jax.vmap(here.push)(tasks.paths(offset, jnp.zeros_like(offset), steps))
    for off, mode in zip(offsets, np.asarray(push.mode), strict=True):
        if not np.all(mode == pj.ContactMode.STICKING):
            raise ValueError(f"a push {1e3 * off:g} mm off the middle does not stick")
    scene = Scene(SUPPORTS["four"])
    return _um(mujoco.slip(scene, np.asarray(push.pose[:, -1], float), *_straight(scene, offsets)))


def _straight(scene: Scene, offsets: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Starts and ends (n, 2) of pushes along the normal of the side."""
    starts = np.array([[-scene.side / 2 - scene.tip_radius, y] for y in offsets])
    return starts, starts + np.array([scene.travel, 0.0])


def _um(slip: np.ndarray) -> list[float]:
    return (1e6 * np.abs(slip)).tolist()


def compare(rows: list[dict[str, Any]], peers: list[dict[str, Any]]) -> None:
    """Write into the rows of quartic pushes how many times as many of them a processor does, beside the faster of
    MuJoCo's; and how far theirs and ours slip."""
    best = min((peer for peer in peers if peer["peer"] == "mujoco"), key=lambda peer: peer["processor_s_per_push"])
    for row in rows:
        if row["case"] == "push_quartic":
            row["peer"] = "mujoco"
            row["peer_ratio"] = best["processor_s_per_push"] * row["batch"] / row["processor_s"]
            row["slip_um"] = slip_um(row["dtype"])


def draw(record: dict[str, Any], out: Path) -> str:
    """Time against error, of pushes by their steps."""
    from pushjax import plot

    curves: dict[str, list[tuple[float, float]]] = {}
    for row in record["by_steps"]:
        point = row["processor_s"] / row["batch"], row["pose_error_mm"]
        curves.setdefault(f"pushjax, {row['dtype']}", []).append(point)
    for peer in record["peers"]:
        # the last is what the others are compared with
        points = [(1e-6 * row["us_per_push"], row["error_mm"]) for row in peer["by_timestep"] if row["error_mm"] > 0]
        if points:
            curves[f"MuJoCo, {peer['supports']} supports"] = points
    return str(plot.save(plot.speed_figure(curves, tasks.ALLOWED_MM), out / "bench.png"))


def summary(peers: list[dict[str, Any]], rows: list[dict[str, Any]]) -> list[str]:
    """What the command prints."""
    lines = ["", f"the same push, each within {tasks.ALLOWED_MM} mm of its own converged answer:"]
    for peer in peers:
        slip = "" if peer["slip_um"] is None else f", slip {' and '.join(f'{x:.1f}' for x in peer['slip_um'])} um"
        lines.append(
            f"  {peer['peer']}, {peer['supports']} supports: {1e3 * peer['timestep_s']:.3g} ms steps "
            f"({peer['error_mm']:.3f} mm), {1e3 * peer['processor_s_per_push']:.2f} ms of a processor{slip}"
        )
    for row in rows:
        if row["peer_ratio"] is not None:
            slip = " and ".join(f"{x:.1g}" for x in row["slip_um"])
            each = 1e6 * row["processor_s"] / row["batch"]
            lines.append(
                f"  pushjax, {row['dtype']}, batch {row['batch']}: {row['steps']:.3g} steps "
                f"({row['pose_error_mm']:.3f} mm), {each:.2f} us of a processor, "
                f"1/{row['peer_ratio']:.0f} of {row['peer']}'s; slip {slip} um"
            )
    return lines
