"""The picture of a box that is pushed around fixtures, by a controller that knows of them and by one that does not.

`python docs/pictures.py among_fixtures` writes it.
"""

from typing import NamedTuple

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

import pushjax as pj
from pushjax import planning, plot
from pushjax.geometry.se2_numpy import compose, inverse
from pushjax.plot.parts import draw_fixtures, outline
from pushjax.plot.style import MM, panel_row

RADIUS, FRICTION, SIDE = 0.015, 0.1, 0.5
GOAL, START, FINGER = np.array([0.40, 0.25, 0.8]), np.array([0.12, 0.30, 1.2]), np.array([0.05, 0.18])
FIXTURES = (
    pj.Fixture(pj.Polygon.rectangle(0.04, 0.20), (0.27, 0.25, 0.0)),
    pj.Fixture(pj.Disk(0.03), (0.33, 0.45, 0.0)),
    pj.Fixture(pj.Polygon([(-0.04, -0.03), (0.04, -0.03), (0.0, 0.04)]), (0.12, 0.08, 0.3)),
)
KNOWN = {"a planner that knows the fixtures": FIXTURES, "one that does not": ()}
STEPS, LEG = 80, 32  # control steps at most, and steps of the simulation in each


class Episode(NamedTuple):
    """Poses of the slider after each control step, the finger's paths in them, and whether it pushes in each."""

    poses: list[np.ndarray]
    paths: list[np.ndarray]
    pushing: list[bool]


def episode(slider: pj.Slider, pushes: planning.PushLibrary, known: tuple) -> Episode:
    """Play one episode among the fixtures, with a planner that knows some of them."""
    table = planning.Workspace.rectangle((0.0, 0.0), (SIDE, SIDE), known)
    planner = planning.PushPlanner(slider, RADIUS, pushes, GOAL, table, planning.Pace(0.05, 0.02, 0.02))
    made = planning.PushController(planner, planning.PositionControl())
    memory, hand, pose, finger = made.initial_memory(), pj.Hand.finger(RADIUS), START, FINGER
    found = Episode([START], [], [])
    while len(found.paths) < STEPS and planner.measure(compose(inverse(GOAL), pose)) < planner.measure.enough:
        target, memory = made(jax.random.key(0), planning.Observation(finger, pose), memory)
        path = pj.line(finger, target, LEG)
        done = pj.rollout(slider, hand, path, pose=pose, friction=FRICTION, fixtures=FIXTURES)
        paths = np.asarray(done.configuration, float)  # the finger stops at a jam
        pose, finger = np.asarray(done.pose[-1], float), paths[-1]
        found.poses.append(pose)
        found.paths.append(paths)
        found.pushing.append(memory.pushing)
    return found


def figure() -> Figure:
    """Draw both episodes: the box after each push, and the paths of the finger."""
    slider = pj.Slider(pj.Polygon.rectangle(0.10, 0.06), pj.Ellipsoid(np.eye(3), 0.05))
    pushes = planning.PushLibrary.build(slider, RADIUS, friction=FRICTION, contacts=120, angles=7)
    with plt.rc_context(plot.STYLE):
        drawn, all_axes = panel_row(len(KNOWN), 4.0, 4.2, shared=True)
        for axes, (name, known) in zip(all_axes, KNOWN.items(), strict=True):
            found = episode(slider, pushes, known)
            _draw(axes, slider, found)
            axes.set_title(f"{name}: {len(found.paths)} control steps")
        all_axes[0].set_ylabel("y / mm")
        handles, labels = all_axes[0].get_legend_handles_labels()
        drawn.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return drawn


def _draw(axes: Axes, slider: pj.Slider, found: Episode) -> None:
    axes.add_patch(Rectangle((0, 0), MM * SIDE, MM * SIDE, fill=False, color=plot.GRAY, lw=1))
    draw_fixtures(axes, FIXTURES)
    ends = [k + 1 for k in range(len(found.pushing) - 1) if found.pushing[k] and not found.pushing[k + 1]]
    for k in ends:
        outline(axes, slider.shape, found.poses[k], plot.GRAY, 0.8)
    outline(axes, slider.shape, GOAL, plot.GREEN, 3.0, label="goal")
    outline(axes, slider.shape, START, plot.BLACK, 1.4, label="box at the start")
    outline(axes, slider.shape, found.poses[-1], plot.RED, 1.4, label="at the end")
    for pushing, color, label in ((False, plot.BLUE, "finger, free"), (True, plot.ORANGE, "finger, pushing")):
        lines = [MM * path for path, now in zip(found.paths, found.pushing, strict=True) if now == pushing]
        axes.add_collection(LineCollection(lines, colors=color, lw=1.0 + pushing, label=label))
    axes.add_patch(Circle(tuple(MM * FINGER), MM * RADIUS, color=plot.BLUE, fill=False, lw=1.0))
    axes.set(xlabel="x / mm", aspect="equal", xlim=(-8, MM * SIDE + 8), ylim=(-8, MM * SIDE + 8))
