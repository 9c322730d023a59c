"""The animation of PushT, solved in the package gym-pusht by the planner of `pushjax reproduce pusht-mpc`.

`python docs/pictures.py pusht` writes it.
"""

from typing import NamedTuple

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle, FancyArrowPatch
from matplotlib.patches import Polygon as PolygonPatch

from pushjax import plot
from pushjax.experiments.pusht_mpc import player, setting
from pushjax.geometry.polygon_numpy import outline_vertices
from pushjax.geometry.se2_numpy import to_world
from pushjax.planning import Observation

SIDE = 512  # of the workspace, px
SEED = 1
FRAMES_BETWEEN, SLOWER = 3, 2  # frames for a control step of a tenth of a second, and how much slower than real
HOLD = 15  # frames of the end


class Moment(NamedTuple):
    """What is drawn of one control step.

    Attributes:
        finger: Center of the finger, (2,), px.
        pose: Pose of the T's center of gravity, (3,), px and rad.
        push: Start and end of the push that is going on, (2, 2), px; None between episodes.
        pushing: Whether the finger pushes.
        pushes: Number of pushes so far.
        coverage: Part of the goal that the T covers.
    """

    finger: np.ndarray
    pose: np.ndarray
    push: np.ndarray | None
    pushing: bool
    pushes: int
    coverage: float


def episode(seed: int) -> list[Moment]:
    """Play one episode, and return its control steps."""
    plant, (made, _) = player.make_plant(), player.controller()
    seen, info = plant.reset(seed=seed)
    memory, key, moments, over = made.initial_memory(), jax.random.key(seed), [], False
    coverage = 0.0
    while True:
        pose = setting.from_gym(seen[2:4], seen[4])
        push = None if memory.push is None else np.stack([memory.push.start, memory.end]) / setting.PIXEL
        at = np.array([*(pose[:2] / setting.PIXEL), pose[2]])
        moments.append(Moment(np.array(seen[:2]), at, push, memory.pushing, memory.pushes, coverage))
        if over:
            return moments
        action, memory = made(key, Observation(setting.PIXEL * seen[:2], pose), memory)
        seen, _, terminated, truncated, info = plant.step(np.clip(action / setting.PIXEL, 0, SIDE))
        coverage, over = float(info["coverage"]), terminated or truncated


def animation(seed: int = SEED) -> plot.Animation:
    """Draw one episode: the T, its goal, the finger, and the push that is going on."""
    moments = episode(seed)
    corners = outline_vertices(setting.slider().shape) / setting.PIXEL
    goal = setting.goal() / [setting.PIXEL, setting.PIXEL, 1.0]
    with plt.rc_context(plot.STYLE):
        figure, axes = plt.subplots(figsize=(4.0, 4.25), layout="constrained")
        axes.set(xlim=(0, SIDE), ylim=(SIDE, 0), aspect="equal", xticks=[], yticks=[])
        for spine in axes.spines.values():
            spine.set(visible=True, color=plot.GRAY, linewidth=3)
        axes.add_patch(PolygonPatch(to_world(goal, corners), facecolor="#B9E4C9", edgecolor=plot.GREEN, lw=1))
        block = PolygonPatch(corners, facecolor="#8FA3B8", edgecolor="#4A5B6C", lw=1.2)
        arrow = FancyArrowPatch(
            (0, 0), (1, 1), arrowstyle="-|>", mutation_scale=11, lw=1.6, color=plot.ORANGE, zorder=3
        )
        finger = Circle((0, 0), setting.FINGER_RADIUS / setting.PIXEL, color=plot.BLUE, zorder=4)
        for patch in (block, arrow, finger):
            axes.add_patch(patch)
        title = axes.set_title(" ")

        def draw(k: int) -> None:
            step, part = divmod(min(k, FRAMES_BETWEEN * (len(moments) - 1)), FRAMES_BETWEEN)
            now, after = moments[step], moments[min(step + 1, len(moments) - 1)]
            share = part / FRAMES_BETWEEN
            pose = now.pose + share * (after.pose - now.pose - [0, 0, turns(after.pose[2] - now.pose[2])])
            block.set_xy(to_world(pose, corners))
            finger.center = tuple(now.finger + share * (after.finger - now.finger))
            arrow.set_visible(after.push is not None)
            if after.push is not None:
                arrow.set_positions(*map(tuple, after.push))
            over = ", solved" if now.coverage > setting.ENOUGH else ""
            title.set_text(f"push {max(1, after.pushes)}, {0.1 * (step + share):.1f} s, {now.coverage:.0%}{over}")

        frames = FRAMES_BETWEEN * (len(moments) - 1) + HOLD
        return plot.Animation(figure, draw, frames, SLOWER * 0.1 * frames / FRAMES_BETWEEN)


def turns(angle: float) -> float:
    """Return the whole turns in a difference of angles, rad."""
    return 2 * np.pi * round(angle / (2 * np.pi))
