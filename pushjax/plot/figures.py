"""Pictures. Lengths in mm, angles in degrees on every axis; colours that the colour-blind can tell apart."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from pushjax.hands import Finger, Hand, Pad
from pushjax.limit_surface import LimitSurface
from pushjax.rollout import Trajectory
from pushjax.shapes import Shape
from pushjax.solve import Contacts, Motion, friction_cone, motion_cone
from pushjax.status import Status
from pushjax.support import Support, WrenchTwistPairs

MM = 1e3
BLUE, ORANGE, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"  # Okabe & Ito
START, BETWEEN, END = "black", "0.72", "#C1121F"

STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "savefig.dpi": 160,
}


def _row(panels: int, width: float, height: float, shared: bool = False) -> tuple[Figure, list[Axes]]:
    """Panels side by side, each of that size in inches. shared: they show the same range."""
    figure, axes = plt.subplots(
        1, panels, figsize=(width * panels, height), sharex=shared, sharey=shared, layout="constrained", squeeze=False
    )
    return figure, list(axes[0])


def legend_below(figure: Figure, axes: Axes, columns: int) -> None:
    """One legend for all panels, of what `axes` shows."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=columns)


def _legend_of_moments(figure: Figure, axes: Axes) -> None:
    for color, label in ((START, "start"), (BETWEEN, "between"), (END, "end")):
        axes.plot([], [], color=color, label=label)
    legend_below(figure, axes, columns=4)


def save(figure: Figure, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, bbox_inches="tight")
    plt.close(figure)
    return path


def limit_surfaces(surfaces: Mapping[str, LimitSurface], pairs: WrenchTwistPairs, load: float) -> Figure:
    """Level sets H = 1 in 3-D, over load and length, and cuts through them, with the wrenches they were fitted to."""
    with plt.rc_context(STYLE):
        figure = plt.figure(figsize=(4.1 * len(surfaces) + 4.4, 3.9), layout="constrained")
        grid = figure.add_gridspec(2, len(surfaces) + 1, width_ratios=[1.0] * len(surfaces) + [0.85])
        wrench = np.asarray(pairs.wrench) / load / np.array([1, 1, float(pairs.length)])
        colors = dict(zip(surfaces, (ORANGE, BLUE, GREEN), strict=False))
        for column, (name, surface) in enumerate(surfaces.items()):
            axes = figure.add_subplot(grid[:, column], projection="3d")
            u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 49), np.linspace(0, np.pi, 25))
            ball = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=-1)
            x, y, z = np.moveaxis(_on_level_set(surface, ball) / load, -1, 0)
            axes.plot_surface(x, y, z, color=colors[name], alpha=0.35, linewidth=0.2, edgecolor=colors[name])  # type: ignore[attr-defined]
            axes.scatter(*wrench.T, s=3, color="0.2", depthshade=False)
            # few ticks: in between, the labels of the axes run into them
            axes.set(title=name, xlabel="$f_x$ / load", ylabel="$f_y$ / load", xticks=[-1, 0, 1], yticks=[-1, 0, 1])
            axes.set_zlabel(r"$\tau$ / (length · load)")  # type: ignore[attr-defined]
            axes.set_box_aspect((1, 1, 1), zoom=0.88)  # type: ignore[call-arg]
        for row, (title, other, label) in enumerate(
            (("cut through $f_y = 0$", 2, r"$\tau$ / (length · load)"), ("cut through $\\tau = 0$", 1, "$f_y$ / load"))
        ):
            axes = figure.add_subplot(grid[row, -1])
            angle = np.linspace(0, 2 * np.pi, 241)
            circle = np.zeros((len(angle), 3))
            circle[:, 0], circle[:, other] = np.cos(angle), np.sin(angle)
            for name, surface in surfaces.items():
                cut = _on_level_set(surface, circle) / load
                axes.plot(cut[:, 0], cut[:, other], color=colors[name], label=name)
            near = np.abs(wrench[:, 3 - other]) < 0.06
            axes.plot(wrench[near, 0], wrench[near, other], ".", color="0.2", ms=3, label="pairs nearby")
            axes.set(title=title, xlabel="$f_x$ / load", ylabel=label, aspect="equal")
        figure.axes[-2].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
        return figure


def _on_level_set(surface: LimitSurface, normalized: np.ndarray) -> np.ndarray:
    """Normalised wrenches scaled along their rays to H = 1."""
    flat = normalized.reshape(-1, 3) * np.array([1, 1, float(surface.length)])
    level = np.array(jax.vmap(surface.on_level_set)(flat.astype(surface.length.dtype)))
    level[:, 2] /= float(surface.length)
    return level.reshape(normalized.shape)


def motion_cone_figure(
    shape: Shape, support: Support, surface: LimitSurface, contacts: Contacts, motion: Motion
) -> Figure:
    """One contact: support points, friction cone, motion cone, the push, and the centre of rotation with its sign."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(5.6, 4.9), layout="constrained")
        outline(axes, shape, np.zeros(3), START, 1.4)
        axes.plot(*(MM * np.asarray(support.point)).T, ".", color=BETWEEN, ms=3, label="support points")
        point, normal = np.asarray(contacts.point[0]), np.asarray(contacts.normal[0])
        mu = float(contacts.friction[0])
        reach = 0.45 * float(np.max(np.asarray(shape.bounds[1] - shape.bounds[0])))
        cones = (
            ("friction cone", friction_cone(normal, mu), GREEN, "--"),
            ("motion cone", motion_cone(surface, point, normal, mu), BLUE, "-"),
        )
        for name, edges, color, dash in cones:
            for k, edge in enumerate(np.asarray(edges)):
                end = point + reach * edge
                label = name if k == 0 else None
                axes.plot(*(MM * np.array([point, end])).T, dash, color=color, lw=1.6, label=label)
            wedge = MM * np.array([point, *(point + reach * np.asarray(edges))])
            axes.fill(*wedge.T, color=color, alpha=0.10, lw=0)
        push = np.asarray(contacts.displacement[0])
        push = 0.5 * reach * push / np.linalg.norm(push)
        tip, tail = MM * point, MM * (point - push)
        arrow = {"arrowstyle": "-|>", "color": ORANGE, "lw": 2.2}
        axes.annotate("", (tip[0], tip[1]), (tail[0], tail[1]), arrowprops=arrow)
        axes.plot([], [], color=ORANGE, lw=2.2, label="push")
        _center_of_rotation(axes, np.asarray(motion.twist))
        axes.update_datalim([1.1 * tail - 0.1 * tip])  # an arrow does not count by itself
        axes.autoscale_view()
        axes.set(xlabel="x / mm", ylabel="y / mm", aspect="equal")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3)
        return figure


def _center_of_rotation(axes: Axes, twist: np.ndarray) -> None:
    vx, vy, omega = twist
    if omega == 0:
        return
    center = MM * np.array([-vy, vx]) / omega
    axes.plot(*center, "o", mfc="white", mec=PURPLE, ms=13, mew=1.6)
    axes.annotate("+" if omega > 0 else "\N{MINUS SIGN}", center, ha="center", va="center", color=PURPLE, fontsize=12)
    axes.plot([], [], "o", mfc="white", mec=PURPLE, label="centre of rotation")


def push_figure(
    shape: Shape, pushes: Mapping[str, tuple[Trajectory, np.ndarray]], radius: float, frames: int = 5
) -> Figure:
    """Pushes side by side: outline and finger at the start black, at the end red, between grey; the centre's trace."""
    with plt.rc_context(STYLE):
        figure, all_axes = _row(len(pushes), 4.0, 4.2, shared=True)
        for axes, (name, (push, path)) in zip(all_axes, pushes.items(), strict=True):
            pose, path = np.asarray(push.pose), np.asarray(path)
            shown = np.unique(np.linspace(0, len(pose) - 1, frames + 2).round().astype(int))
            for k in [*shown[1:-1], shown[0], shown[-1]]:
                color = START if k == 0 else END if k == shown[-1] else BETWEEN
                outline(axes, shape, pose[k], color, 1.4 if color != BETWEEN else 0.8)
                axes.add_patch(Circle(MM * path[k], MM * radius, color=color, fill=color != BETWEEN, lw=0.8))
            axes.plot(*(MM * pose[:, :2]).T, color=BLUE, lw=1.2, label="centre of the slider")
            axes.set(title=name, xlabel="x / mm", ylabel="y / mm", aspect="equal")
        _legend_of_moments(figure, all_axes[0])
        return figure


def grasp_figure(shape: Shape, hand: Hand, grasps: Mapping[str, Trajectory], frames: int = 4) -> Figure:
    """Grasps side by side: slider and fingers at the start black, at the end red, between grey; the centre's trace."""
    with plt.rc_context(STYLE):
        figure, all_axes = _row(len(grasps), 3.1, 3.9, shared=True)
        for axes, (name, grasp) in zip(all_axes, grasps.items(), strict=True):
            pose = np.asarray(grasp.pose)
            fingers = np.asarray(hand.poses(grasp.configuration))
            # only where the slider moves is there something to see
            moves = np.flatnonzero(np.any(np.diff(pose, axis=0) != 0, axis=1))
            last = len(pose) - 1 if moves.size == 0 else min(moves[-1] + 1, len(pose) - 1)
            first = 0 if moves.size == 0 else moves[0]
            between = np.linspace(first, last, frames + 2).round().astype(int)[1:-1]
            for k, color in [*((k, BETWEEN) for k in between), (0, START), (last, END)]:
                width = 0.8 if color == BETWEEN else 1.4
                outline(axes, shape, pose[k], color, width)
                hand_at(axes, hand, fingers[k], color, width)
            axes.plot(*(MM * pose[:, :2]).T, color=BLUE, lw=1.4, label="centre of the slider", zorder=4)
            axes.set(title=name.replace(": ", ":\n"), xlabel="x / mm", aspect="equal")
        all_axes[0].set_ylabel("y / mm")
        _legend_of_moments(figure, all_axes[0])
        return figure


def hand_at(axes: Axes, hand: Hand, poses: np.ndarray, color: str, width: float) -> None:
    """The fingers at their poses (fingers, width), in mm."""
    for finger, where in zip(hand.fingers, poses, strict=True):
        _finger(axes, finger, where, color, width)


def _finger(axes: Axes, finger: Finger, pose: np.ndarray, color: str, width: float) -> None:
    if isinstance(finger, Pad):
        outline(axes, finger.shape, pose, color, width)
    else:
        axes.add_patch(Circle(tuple(MM * pose[:2]), MM * float(finger.radius), color=color, fill=False, lw=width))


def jam_figure(shape: Shape, panels: list[tuple[Contacts, Motion]]) -> Figure:
    """Two closing contacts, labelled: where a centre of rotation keeps both fingers out, and what their forces can do.

    Each panel: friction cones; the contact normals and the region between or beyond them where a counter-clockwise (+)
    or clockwise (-) centre of rotation moves both contacts away from their fingers; the line through the contacts,
    along which they press on each other if it lies in both cones; the verdict, with the centre of rotation.
    """
    with plt.rc_context(STYLE):
        figure, all_axes = _row(len(panels), 5.0, 4.6)
        low, high = (MM * np.asarray(b) for b in shape.bounds)
        reach = 0.55 * (high - low).max()
        box = low - 0.4 * reach, high + 0.4 * reach
        for axes, (contacts, motion) in zip(all_axes, panels, strict=True):
            point, normal = MM * np.asarray(contacts.point), np.asarray(contacts.normal)
            mu = np.asarray(contacts.friction)
            grid = np.stack(np.meshgrid(*(np.linspace(a, b, 301) for a, b in zip(*box, strict=True))), axis=-1)
            arm = point[:, None, None] - grid[None]
            # a counter-clockwise turn about c moves p along perp(p - c)
            away = -normal[:, None, None, 0] * arm[..., 1] + normal[:, None, None, 1] * arm[..., 0]
            for sign, color in ((1, ORANGE), (-1, PURPLE)):
                region = np.all(sign * away > 0, axis=0)
                if region.any():
                    axes.contourf(grid[..., 0], grid[..., 1], region, levels=[0.5, 1.5], colors=[color], alpha=0.16)
                    label = "centre of rotation allowed, " + ("+" if sign > 0 else "\N{MINUS SIGN}")
                    axes.fill([], [], color=color, alpha=0.16, label=label)
            outline(axes, shape, np.zeros(3), START, 1.4)
            for name, p, n, m in zip("AC", point, normal, mu, strict=False):
                axes.plot(*np.array([p - 2 * reach * n, p + 2 * reach * n]).T, "--", color=BLUE, lw=0.9)
                tangent = np.array([-n[1], n[0]])
                for side in (1, -1):
                    edge = (n + side * m * tangent) / np.hypot(1, m)
                    axes.plot(*np.array([p, p + 0.9 * reach * edge]).T, color=GREEN, lw=1.6)
                axes.annotate(
                    "",
                    tuple(p),
                    tuple(p - 0.4 * reach * n),
                    arrowprops={"arrowstyle": "-|>", "color": "0.3", "lw": 1.8},
                )
                axes.annotate(name, tuple(p - 0.5 * reach * n), ha="center", va="center")
            axes.plot(*point.T, ":", color="0.2", lw=1.3)
            status = Status(int(motion.status)).name
            _center_of_rotation(axes, np.asarray(motion.twist))
            axes.plot([], [], color=GREEN, label="friction cone")
            axes.plot([], [], "--", color=BLUE, lw=0.9, label="contact normal")
            axes.plot([], [], ":", color="0.2", label="line through both contacts")
            axes.set(title=f"$\\mu$ = {mu[0]:.2f}: {status}", xlabel="x / mm", ylabel="y / mm", aspect="equal")
            axes.set(xlim=(box[0][0], box[1][0]), ylim=(box[0][1], box[1][1]))
        legend_below(figure, all_axes[0], columns=3)
        return figure


def outline(axes: Axes, shape: Shape, pose: np.ndarray, color: str, width: float, **line: Any) -> None:
    """The shape at a pose (3,), in mm. line: anything else of `Axes.plot`."""
    points = getattr(shape, "vertices", None)
    p = np.asarray(shape.boundary(200) if points is None else points)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    p = p @ np.array([[c, s], [-s, c]]) + pose[:2]
    axes.plot(*(MM * np.vstack([p, p[:1]])).T, color=color, lw=width, **line)


def table_figure(cells: list[dict], title: str, width: float = 8.6) -> Figure:
    """Mean deviation by condition: ours with its interval, and the paper's, one group of bars a condition."""
    with plt.rc_context(STYLE):
        conditions = list(dict.fromkeys((cell["surface"], cell["object"]) for cell in cells))
        figure, axes = plt.subplots(figsize=(width, 3.8), layout="constrained")
        for k, (model, color) in enumerate((("quartic", BLUE), ("ellipsoid", ORANGE))):
            mine = [cell for cell in cells if cell["model"] == model]
            if not mine:
                continue
            x = np.arange(len(conditions)) + (k - 0.5) * 0.36
            height = [cell["mean_mm"] for cell in mine]
            error = [cell["ci95_bootstrap_mm"] for cell in mine]
            axes.bar(x, height, 0.34, yerr=error, color=color, label=f"{model}, this run", capsize=2, ecolor="0.25")
            paper = [np.nan if cell["paper_mm"] is None else cell["paper_mm"] for cell in mine]
            axes.plot(x, paper, "_", color="black", ms=13, mew=1.8, label="the paper" if k == 0 else None)
        axes.set_xticks(np.arange(len(conditions)), [name for _, name in conditions])
        surfaces = np.array([surface for surface, _ in conditions])
        for surface in dict.fromkeys(surfaces.tolist()):
            middle = float(np.mean(np.flatnonzero(surfaces == surface)))
            axes.text(middle, -0.15, surface, transform=axes.get_xaxis_transform(), ha="center", va="center")
        axes.set(ylabel="mean deviation / mm", title=title)
        axes.legend(ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.2))
        return figure
