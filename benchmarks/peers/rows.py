"""Benchmark rows of other programs.

Pushes and grasps are by MuJoCo and MJX, fits by cvxpy and jaxopt, contact problems by scipy and jaxopt.

MuJoCo and MJX each run at their largest timestep that stays within 0.1 mm of their own converged answer.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

import pushjax as pj
from benchmarks import cases, grasps, reference_push
from benchmarks.peers import by_jaxopt, contacts, coulomb, fits, grasp, mjx, mujoco
from benchmarks.peers.scene import Scene, Settings, engine
from pushjax import plot
from pushjax.plot.style import STYLE, curve_styles

HALF = reference_push.SIDE / 2
SUPPORTS = {
    "three": ((-0.03, -0.02), (0.03, -0.02), (0.0, 0.03)),
    "four": ((-HALF, -HALF), (HALF, -HALF), (HALF, HALF), (-HALF, HALF)),
}
STICKS = (0.004, 0.01)  # offsets from the middle of the side at which the tip sticks, m
TIMED, BATCH = 40, 64
FITS, PROBLEMS, MOST_CONTACTS = 20, 100, 4
REPEATS = 3  # number of times that each is timed
NAMES = {"mujoco": "MuJoCo", "mjx": "MJX"}
ALIKE = {"grasp_surfaces": "grasp_two_fingers"}  # cases that are the same problem for the other programs


def check(case: Sequence[str]) -> None:
    """Raise ValueError if none of the cases has a peer, or if a program that is needed is not installed."""
    if not set(case) & set(PEERS):
        raise ValueError(f"--peers is for {', '.join(PEERS)}; got it with {' '.join(case)}")
    if {"push", "grasp"} & set(case):
        engine()
    if "fit" in case:
        fits.cvxpy()
    if {"fit", "solve"} & set(case):
        by_jaxopt.jaxopt()


def rows(case: Sequence[str]) -> list[dict[str, Any]]:
    """Run the other programs on those of the cases that they have, and return one row for each program."""
    # `of` names the rows that it is compared with. `processor_s_each` is the CPU time of one problem in s, the median
    # of `REPEATS` runs, and `processor_s_range` the range of the runs.
    return [found for name in case if name in PEERS for found in PEERS[name]()]


def _pushes() -> list[dict[str, Any]]:
    """Return rows of MuJoCo on three and on four supports, and of MJX on four, with the slip of a sticking finger."""
    found = [_mujoco(name) for name in SUPPORTS]
    return [*found, _mjx("four")]


def _grasps() -> list[dict[str, Any]]:
    """Return the row of MuJoCo on four supports, with its error against rigid contact."""
    scene = Scene(SUPPORTS["four"], friction_tip=grasps.FRICTION)
    table, pose = grasp.accuracy(scene, grasp.SUPPORTED, grasp.Fingers())
    at = mujoco.largest(table, 1e-3 * reference_push.ALLOWED_MM)
    poses = np.resize(grasps.fan(), (TIMED, 3))
    _, each = _repeated(lambda: grasp.grasp(scene, grasp.SUPPORTED, grasp.Fingers(), at.timestep, poses), TIMED)
    both = np.abs(pose[:, 2]) - np.abs(grasps.reference()[:, 2])  # geometry determines the rigid angle
    return [
        {
            "of": "grasp_two_fingers",
            "peer": "mujoco",
            "supports": "four",
            "timestep_s": at.timestep,
            "error_mm": at.error_mm,
            "rigid_error_mm": float(1e3 * reference_push.LENGTH * np.abs(both).max()),
            "by_timestep": [row._asdict() for row in table],
        }
        | each
    ]


def _fits() -> list[dict[str, Any]]:
    """Return the rows of cvxpy and of jaxopt, with the worst ratios of pushjax's loss to theirs."""
    found = []
    for degree, name in ((4, "fit_quartic"), (2, "fit_ellipsoid")):
        wrench, twist, length = (np.asarray(part) for part in cases.pairs("float64", FITS))
        ours = {}
        for dtype in ("float32", "float64"):
            work = cases.fit(dtype, FITS, degree)
            ours[dtype] = np.asarray(jax.jit(work.function)(*work.args)[1].loss, float)
        for peer, solver in (("cvxpy", fits.fit), ("jaxopt", by_jaxopt.fit)):
            theirs, each = _repeated(lambda fit=solver, these=(wrench, twist, length, degree): fit(*these), FITS)
            ratio = {dtype: float((loss / theirs.loss).max()) for dtype, loss in ours.items()}
            found.append(each | {"of": name, "peer": peer, "loss_over_theirs": ratio, "clipped": theirs.clipped})
    return found


def _problems() -> list[dict[str, Any]]:
    """Return the rows of scipy and jaxopt on problems that have a motion, with the fraction of motions they find."""
    found = []
    for m in range(1, MOST_CONTACTS + 1):
        work = cases.solve("float64", 4 * PROBLEMS, m)
        surface, problem = work.args
        moving = np.flatnonzero(np.any(np.asarray(jax.jit(work.function)(*work.args)) != 0, axis=1))[:PROBLEMS]
        kept = jax.tree.map(lambda leaf, k=moving: leaf[k], problem)
        these = surface.coefficients[moving], surface.length[moving], kept
        for peer, solver in (("scipy", contacts.solve), ("jaxopt", by_jaxopt.solve)):
            theirs, each = _repeated(lambda solve=solver, these=these: solve(*these), len(moving))
            found.append(each | {"of": f"solve_{m}", "peer": peer, "found": float(theirs.found.mean())})
    return found


def _repeated(run: Callable[[], Any], count: int) -> tuple[Any, dict[str, Any]]:
    """Run a function `REPEATS` times; return its first result, and median and range of the CPU time per item."""
    found = [run() for _ in range(REPEATS)]
    each = [one.processor / count for one in found]
    return found[0], {"processor_s_each": float(np.median(each)), "processor_s_range": [min(each), max(each)]}


PEERS: dict[str, Callable[[], list[dict[str, Any]]]] = {
    "push": _pushes,
    "grasp": _grasps,
    "fit": _fits,
    "solve": _problems,
}


def _mujoco(name: str) -> dict[str, Any]:
    scene, settings = Scene(SUPPORTS[name]), Settings()
    table = mujoco.accuracy(scene, settings)
    at = mujoco.largest(table, 1e-3 * reference_push.ALLOWED_MM)
    found, each = _repeated(lambda: mujoco.timed(scene, settings, at.timestep, TIMED), TIMED)
    slip = mujoco.push(scene, settings, at.timestep, *_straight(scene, STICKS)).slip
    return each | _row("mujoco", name, at, table, found.pose, slip)


def _mjx(name: str) -> dict[str, Any]:
    scene = Scene(SUPPORTS[name])
    starts, ends = (np.resize(part, (BATCH, 2)) for part in mujoco.fan(scene))
    batch = mjx.Batch(scene, mjx.SETTINGS, mjx.CONVERGED, starts, ends)
    table = mjx.accuracy(batch)
    at = mujoco.largest(table, 1e-3 * reference_push.ALLOWED_MM)
    found, each = _repeated(lambda: batch.pushed(at.timestep, mjx.softened(at.timestep)), BATCH)
    slip = found.slip[[mujoco.PUSHES.index((offset, 0.0)) for offset in STICKS]]
    each |= {"compile_s": batch.compile_seconds, "batch": BATCH, "dtype": "float64"}
    return each | _row("mjx", name, at, table, found.pose, slip)


def _row(
    peer: str,
    supports: str,
    at: mujoco.StepError,  # of the timestep that is used
    table: list[mujoco.StepError],
    pose: np.ndarray,  # final poses of `mujoco.fan`, maybe repeated, (n, 3)
    slip: np.ndarray,  # where the tip sticks, m
) -> dict[str, Any]:
    """Return the row of a simulator, with its error against exact Coulomb friction."""
    exact = _exact(supports)
    return {
        "of": "push_quartic",
        "peer": peer,
        "supports": supports,
        "timestep_s": at.timestep,
        "error_mm": at.error_mm,
        "exact_error_mm": float(reference_push.error_mm(pose[: len(exact)], exact).max()),
        "slip_um": _um(slip),
        "by_timestep": [row._asdict() for row in table],
    }


@cache
def _exact(name: str) -> np.ndarray:
    scene = Scene(SUPPORTS[name])
    points = np.array(scene.supports)
    return np.array([coulomb.push(points, *each)[0] for each in zip(*mujoco.fan(scene), strict=True)])


@cache
def slip_um(dtype: str, offsets: tuple[float, ...] = STICKS, steps: int = 50) -> list[float]:
    """Return the slip (µm) along the side, without rolling, of the tip in straight sticking pushes by pushjax."""
    here = reference_push.task("quartic", dtype)
    offset = jnp.asarray(offsets, dtype)
    push = jax.jit(jax.vmap(here.push))(reference_push.paths(offset, jnp.zeros_like(offset), steps))
    for off, mode in zip(offsets, np.asarray(push.mode), strict=True):
        if not np.all(mode == pj.ContactMode.STICKING):
            raise ValueError(f"a push {1e3 * off:g} mm off the middle does not stick")
    scene = Scene(SUPPORTS["four"])
    return _um(mujoco.slip(scene, np.asarray(push.pose[:, -1], float), *_straight(scene, offsets)))


@cache
def same_fan_error_mm(dtype: str, steps: int) -> float:
    """Return pushjax's largest error (mm) over MuJoCo's pushes on four supports, against its converged answer."""
    return float(
        reference_push.error_mm(_same_fan(dtype, steps), _same_fan("float64", reference_push.REFERENCE_STEPS)).max()
    )


def _same_fan(dtype: str, steps: int) -> np.ndarray:
    """Return the final poses of MuJoCo's pushes by pushjax, (pushes, 3), m and rad."""
    here = reference_push.task("quartic", dtype)._replace(slider=reference_push.cast(_on_four(), dtype))
    offset, angle = (jnp.asarray(part, dtype) for part in np.array(mujoco.PUSHES).T)
    return np.asarray(jax.jit(jax.vmap(here.push))(reference_push.paths(offset, angle, steps)).pose[:, -1], float)


@cache
def _on_four() -> pj.Slider:
    """Return the square on the four supports, with the quartic fitted to their limit surface."""
    pairs = pj.Support.points(np.array(SUPPORTS["four"])).wrench_twist_pairs(jax.random.key(0), 400)
    return pj.Slider(reference_push.square("quartic").shape, pj.fit_limit_surface(*pairs, degree=4))


def _straight(scene: Scene, offsets: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return start and end positions of the tip's center, both (n, 2), m, of pushes along the normal of the side."""
    starts = np.array([[-scene.side / 2 - scene.tip_radius, y] for y in offsets])
    return starts, starts + np.array([scene.travel, 0.0])


def _um(slip: np.ndarray) -> list[float]:
    return (1e6 * np.abs(slip)).tolist()


def compare(rows: list[dict[str, Any]], peers: list[dict[str, Any]]) -> None:
    """Add the comparison with the fastest other program to the rows of pushjax, in place."""
    # A row that has a peer gets `peer`, its name, and `peer_ratio`, how many times as many problems pushjax solves in
    # the same CPU time. Rows of pushes also get `slip_um`, the slip of a sticking finger in the same number of steps,
    # and `same_fan_error_mm`, the error over MuJoCo's pushes.
    for row in rows:
        same = [peer for peer in peers if peer["of"] == ALIKE.get(row["case"], row["case"])]
        if same:
            # the one that finds the most motions, because a program that misses many does less work
            best = min(same, key=lambda peer: (-peer.get("found", 1.0), peer["processor_s_each"]))
            row["peer"] = best["peer"]
            row["peer_ratio"] = best["processor_s_each"] * row["batch"] / row["processor_s"]
            if row["case"] == "push_quartic":
                steps = round(row["steps"])
                row["slip_um"] = slip_um(row["dtype"], steps=steps)
                row["same_fan_error_mm"] = same_fan_error_mm(row["dtype"], steps)


def draw(record: dict[str, Any], out: Path) -> str:
    """Draw computing time against error of pushes by number of steps; save to the folder `out` and return the path."""
    curves: dict[str, list[tuple[float, float]]] = {}
    for row in record["by_steps"]:
        point = row["processor_s"] / row["batch"], row["pose_error_mm"]
        curves.setdefault(f"pushjax, {row['dtype']}", []).append(point)
    for peer in (peer for peer in record["peers"] if peer["of"] == "push_quartic"):
        # a row with error zero is the reference that the others are compared with
        points = [(1e-6 * row["us_per_push"], row["error_mm"]) for row in peer["by_timestep"] if row["error_mm"] > 0]
        if points:
            curves[f"{NAMES[peer['peer']]}, {peer['supports']} supports"] = points
    return str(plot.save(speed_figure(curves, reference_push.ALLOWED_MM), out / "bench.png"))


def speed_figure(curves: Mapping[str, Sequence[tuple[float, float]]], allowed_mm: float) -> Figure:
    """Plot the time of a push (s) against the error of its final pose (mm), with a line at the allowed error."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(6.8, 3.8), layout="constrained")
        for name, points, look in curve_styles(curves):
            times, errors = zip(*sorted(points), strict=True)
            axes.loglog(errors, [1e6 * t for t in times], ms=4, lw=1.1, label=name, **look)
        axes.axvline(allowed_mm, color="0.6", lw=0.9, ls="--")
        axes.set(xlabel="worst error of a final pose / mm", ylabel="time of one core per push / µs")
        axes.set_title("What accuracy costs")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
        return figure


def summary(peers: list[dict[str, Any]], rows: list[dict[str, Any]]) -> list[str]:
    """Return the lines that the command prints, from the peers' rows and pushjax's after `compare`."""
    lines = ["", f"the same by others; simulators within {reference_push.ALLOWED_MM} mm of their own converged answer:"]
    for peer in peers:
        each = f"{1e3 * peer['processor_s_each']:.2f} ms of CPU time"
        lines.append(f"  {peer['of']}, {peer['peer']}: {each}{_more(peer)}")
    for row in rows:
        if row["peer_ratio"] is not None:
            each = 1e6 * row["processor_s"] / row["batch"]
            more = "" if row["pose_error_mm"] is None else f" ({row['steps']:.3g} steps, {row['pose_error_mm']:.3f} mm)"
            slip = f"; slip {' and '.join(f'{x:.1g}' for x in row['slip_um'])} um" if "slip_um" in row else ""
            if "same_fan_error_mm" in row:
                slip += f"; {row['same_fan_error_mm']:.3f} mm over the pushes of MuJoCo's"
            lines.append(
                f"  {row['case']}, pushjax, {row['dtype']}, batch {row['batch']}: {each:.2f} us of CPU time{more}, "
                f"1/{row['peer_ratio']:.0f} of {row['peer']}'s{slip}"
            )
    return lines


def _more(peer: dict[str, Any]) -> str:
    said = ""
    if "timestep_s" in peer:
        said += f", {peer['supports']} supports, {1e3 * peer['timestep_s']:.3g} ms steps ({peer['error_mm']:.3f} mm)"
    if "exact_error_mm" in peer:
        said += f", {peer['exact_error_mm']:.2f} mm from exact friction"
    if "rigid_error_mm" in peer:
        said += f", {peer['rigid_error_mm']:.2f} mm from rigid contact"
    if peer.get("slip_um"):
        said += f", slip {' and '.join(f'{x:.1f}' for x in peer['slip_um'])} um"
    if "loss_over_theirs" in peer:
        said += "; our loss over theirs: " + ", ".join(f"{x:.6f} ({d})" for d, x in peer["loss_over_theirs"].items())
    if "found" in peer:
        said += f", finds {100 * peer['found']:.0f} % of the motions"
    return said
