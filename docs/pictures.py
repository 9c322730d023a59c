"""Draw the pictures and animations of the documentation.

    python docs/pictures.py [push grasp stochastic pusht limit_surfaces motion_cone real among_fixtures tasks]
                            [--to FOLDER] [--suffix .gif]

Without a name, all are drawn; this takes five minutes, most of it for compiling. `real` needs PUSHJAX_DATA and `pusht`
needs gym-pusht; without, they are left out.
"""

import argparse
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl

mpl.use("Agg")  # draws to files, because there may be no screen

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, Polygon, Rectangle

import pushjax as pj
from pushjax import planning, plot
from pushjax.datasets import Recording, find_data
from pushjax.experiments import demo, squeeze, stochastic_push, table2
from pushjax.experiments._report import pushes_by_error
from pushjax.experiments.pusht_mpc import make_plant
from pushjax.experiments.tables import ideal_surface
from pushjax.geometry.se2_numpy import compose, inverse, to_world
from pushjax.planning.pusht import PIXEL, pusht_pose
from pushjax.plot.parts import draw_fixtures, placed_outline
from pushjax.plot.style import BLACK, BLUE, GRAY, GREEN, MM, ORANGE, RED, STYLE, legend_below, panel_row
from pushjax.tasks import PushAlongWall, PushBox, PushClutter, PushTwoFingers, Squeeze, TableTask
from pushjax.tasks.push_t import AGENT_RADIUS, T_CENTER, T_VERTICES
from pushjax.tasks.push_t import GOAL as GOAL_IN_GYM

PUSHES = 200
FRICTIONS = {"friction 0.1: it slides": 0.1, "friction 0.6: it sticks": 0.6}
REAL, STEPS, REAL_FRICTION = ("hardboard", "3pts1"), 60, 0.25
SHOWN = {"10th percentile": 0.1, "median": 0.5, "90th percentile": 0.9}
GRASPS = {"held flat": "grasped with offset", "wedged": "jammed"}


def push() -> plot.Animation:
    """Draw oblique pushes of a square: with low friction the finger slides along its side, with high it sticks."""
    slider, hand = pj.Slider.uniform(pj.Polygon.rectangle(0.09, 0.09)), pj.Hand.finger(0.00475)
    path = pj.line((-0.052, 0.020), (0.018, -0.020), 120)
    pushes = {name: pj.rollout(slider, hand, path, pose=jnp.zeros(3), friction=mu) for name, mu in FRICTIONS.items()}
    return plot.animate(slider.shape, hand, pushes)


def grasp() -> plot.Animation:
    """Draw a parallel jaw that closes on a rectangle from two start poses: one ends held flat, the other wedged."""
    slider = pj.Slider.uniform(pj.Polygon.rectangle(squeeze.WIDTH, squeeze.HEIGHT))
    hand = pj.Hand.parallel_jaw(squeeze.PAD, squeeze.THICKNESS)
    path = pj.line((0.0, 0.0, 0.0, squeeze.OPENING), (0.0, 0.0, 0.0, squeeze.CLOSED), 700)
    grasps = {}
    for name, start in GRASPS.items():
        x, y, angle = squeeze.STARTS[start]
        pose = jnp.array([x, y, np.radians(angle)])
        grasps[name] = pj.rollout(slider, hand, path, pose=pose, friction=squeeze.FRICTION)
    return plot.animate(slider.shape, hand, grasps, friction=squeeze.FRICTION)


def stochastic() -> plot.Animation:
    """Draw one push with 200 samples of the friction under the square and at the finger."""
    slider, hand, path = stochastic_push.push_setup(0, 100)
    setup = {"pose": jnp.zeros(3), "model": pj.FrictionModel(dof=20, friction=(0.15, 0.35)), "trajectories": True}
    many = pj.monte_carlo(jax.random.key(1), PUSHES, slider, hand, path, **setup)
    title = "One push under uncertain friction"
    return plot.animate_cloud(slider.shape, hand, path, np.asarray(many.trajectory), title=title)


def limit_surfaces() -> Figure:
    """Draw the ellipsoid and the quartic of a square on four corners, with the twists of wrenches as arrows."""
    block = pj.Polygon.rectangle(demo.SIDE, demo.SIDE)
    support = pj.Support.points(block.vertices)
    pairs = support.wrench_twist_pairs(jax.random.key(0), 400)
    fitted = {name: pj.fit_limit_surface(*pairs, degree=d) for name, d in (("ellipsoid", 2), ("quartic", 4))}
    return plot.limit_surfaces(fitted, pairs, float(support.load))


def motion_cone() -> Figure:
    """Draw one contact of a square with its friction cone, its motion cone, and a push outside the motion cone."""
    return plot.motion_cone_figure(*demo.motion_cone_setup(jax.random.key(0)))


def real() -> Figure:
    """Draw a robot's pushes of a triangle on three support points, with predictions from the known support points.

    Nothing is fitted to the pushes. Three pushes are shown, at three percentiles of the deviation.
    """
    data = find_data()
    if data is None:
        raise SystemExit("real: set PUSHJAX_DATA to the folder of real data")
    log, geometry = table2.load(data / "three_point_push", *REAL), table2.GEOMETRIES["measured"]
    if log is None or log.length is None:
        raise SystemExit(f"real: {data} has no log of {', '.join(map(str, REAL))}")
    pushes, block = table2.recorded(log, geometry, STEPS), table2.outline(log, geometry)
    slider = pj.Slider(block, ideal_surface(log, "quartic", 0))
    hand = pj.Hand.finger(geometry.radius)

    def end(start, path):
        return pj.rollout(slider, hand, path, pose=start, friction=REAL_FRICTION).pose[-1]

    predicted = jax.jit(jax.vmap(end))(pushes.start, pushes.path)
    off = MM * np.asarray(pj.deviation(predicted, pushes.end, log.length))
    ends = np.stack([pushes.start, pushes.end], axis=1)
    measured = [Recording(k, np.asarray(path), ends[k]) for k, path in enumerate(pushes.path)]
    return plot.real_figure(block, pushes_by_error(measured, np.asarray(predicted), off, SHOWN), hand)


# PushT in gym-pusht

SCREEN = 512  # side of the workspace, px
SEED = 1
FRAMES_BETWEEN, SLOWER = 3, 2  # frames for a control step of a tenth of a second, and how much slower than real
HOLD = 15  # frames of the end


class Moment(NamedTuple):
    """What is drawn of one control step."""

    finger: np.ndarray  # (2,), its center, px
    pose: np.ndarray  # (3,), of the T's center of gravity, px and rad
    push: np.ndarray | None  # (2, 2), start and end of the push that is going on, px; None between episodes
    pushes: int  # so far
    coverage: float  # part of the goal that the T covers


def pusht_moments(seed: int) -> list[Moment]:
    """Play one episode, and return its control steps."""
    plant, made = make_plant(), planning.pusht_controller()
    seen, _ = plant.reset(seed=seed)
    state, key, moments, over, coverage = made.initial_state(), jax.random.key(seed), [], False, 0.0
    while True:
        now = planning.pusht_observation(seen)
        pushed = None if state.push is None else np.stack([state.push.start, state.end]) / PIXEL
        at = now.pose / [PIXEL, PIXEL, 1.0]
        moments.append(Moment(np.array(seen[:2]), at, pushed, state.pushes, coverage))
        if over:
            return moments
        action, state = made(key, now, state)
        seen, _, terminated, truncated, info = plant.step(np.clip(action / PIXEL, 0, SCREEN))
        coverage, over = float(info["coverage"]), terminated or truncated


def pusht() -> plot.Animation:
    """Draw one episode of PushT in gym-pusht, solved by the planner of `pushjax reproduce pusht-mpc`.

    The T, its goal, the finger, and the push that is going on.
    """
    moments = pusht_moments(SEED)
    corners = np.array(T_VERTICES, float) - T_CENTER
    goal = pusht_pose(GOAL_IN_GYM) / [PIXEL, PIXEL, 1.0]
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(4.0, 4.25), layout="constrained")
        axes.set(xlim=(0, SCREEN), ylim=(SCREEN, 0), aspect="equal", xticks=[], yticks=[])
        for spine in axes.spines.values():
            spine.set(visible=True, color=GRAY, linewidth=3)
        axes.add_patch(Polygon(to_world(goal, corners), facecolor="#B9E4C9", edgecolor=GREEN, lw=1))
        block = Polygon(corners, facecolor="#8FA3B8", edgecolor="#4A5B6C", lw=1.2)
        arrow = FancyArrowPatch((0, 0), (1, 1), arrowstyle="-|>", mutation_scale=11, lw=1.6, color=ORANGE, zorder=3)
        finger = Circle((0, 0), AGENT_RADIUS, color=BLUE, zorder=4)
        for patch in (block, arrow, finger):
            axes.add_patch(patch)
        title = axes.set_title(" ")

    def draw(k: int) -> None:
        step, part = divmod(min(k, FRAMES_BETWEEN * (len(moments) - 1)), FRAMES_BETWEEN)
        now, after, share = moments[step], moments[min(step + 1, len(moments) - 1)], part / FRAMES_BETWEEN
        turns = 2 * np.pi * round((after.pose[2] - now.pose[2]) / (2 * np.pi))
        block.set_xy(to_world(now.pose + share * (after.pose - now.pose - [0, 0, turns]), corners))
        finger.center = tuple(now.finger + share * (after.finger - now.finger))
        arrow.set_visible(after.push is not None)
        if after.push is not None:
            arrow.set_positions(*map(tuple, after.push))
        solved = ", solved" if now.coverage > 0.95 else ""
        title.set_text(f"push {max(1, after.pushes)}, {0.1 * (step + share):.1f} s, {now.coverage:.0%}{solved}")

    frames = FRAMES_BETWEEN * (len(moments) - 1) + HOLD
    return plot.Animation(figure, draw, frames, SLOWER * 0.1 * frames / FRAMES_BETWEEN)


# A box among fixtures

RADIUS, FRICTION, SIDE = 0.015, 0.1, 0.5
GOAL, START, FINGER = np.array([0.40, 0.25, 0.8]), np.array([0.12, 0.30, 1.2]), np.array([0.05, 0.18])
FIXTURES = (
    pj.Fixture(pj.Polygon.rectangle(0.04, 0.20), (0.27, 0.25, 0.0)),
    pj.Fixture(pj.Disk(0.03), (0.33, 0.45, 0.0)),
    pj.Fixture(pj.Polygon([(-0.04, -0.03), (0.04, -0.03), (0.0, 0.04)]), (0.12, 0.08, 0.3)),
)
KNOWN = {"a planner that knows the fixtures": FIXTURES, "one that does not": ()}
MOST_STEPS, LEG = 80, 32  # control steps at most, and steps of the simulation in each


class Episode(NamedTuple):
    """Poses of the slider after each control step, the finger's paths in them, and whether it pushes in each."""

    poses: list[np.ndarray]
    paths: list[np.ndarray]
    pushing: list[bool]


def episode_among_fixtures(scene: planning.PushScene, pushes: planning.PushLibrary) -> Episode:
    """Play one episode among the fixtures, with a planner that knows some of them."""
    table = planning.Workspace.rectangle((0.0, 0.0), (SIDE, SIDE))
    planner = planning.PushPlanner(scene, pushes, GOAL, table, planning.SpeedLimits(0.05, 0.02, 0.02))
    made = planning.PushController(planner, planning.PositionControl())
    state, pose, finger = made.initial_state(), START, FINGER
    found = Episode([START], [], [])
    while len(found.paths) < MOST_STEPS and planner.measure(compose(inverse(GOAL), pose)) < planner.measure.enough:
        target, state = made(jax.random.key(0), planning.Observation(finger, pose), state)
        path = pj.line(finger, target, LEG)
        done = pj.rollout(scene.slider, scene.hand, path, pose=pose, friction=FRICTION, fixtures=FIXTURES)
        paths = np.asarray(done.configuration, float)  # the finger stops at a jam
        pose, finger = np.asarray(done.pose[-1], float), paths[-1]
        found.poses.append(pose)
        found.paths.append(paths)
        found.pushing.append(state.pushing)
    return found


def among_fixtures() -> Figure:
    """Draw a box that is pushed around fixtures, by a planner that knows them and by one that does not.

    Drawn are the box after each push, and the paths of the finger.
    """
    slider = pj.Slider(pj.Polygon.rectangle(0.10, 0.06), pj.Ellipsoid(np.eye(3), 0.05))
    scenes = {
        name: planning.PushScene(slider, pj.Hand.finger(RADIUS), FRICTION, known) for name, known in KNOWN.items()
    }
    pushes = planning.PushLibrary.build(next(iter(scenes.values())), contacts=120, angles=7)
    with plt.rc_context(STYLE):
        figure, all_axes = panel_row(len(KNOWN), 4.0, 4.2, shared=True)
        for axes, (name, scene) in zip(all_axes, scenes.items(), strict=True):
            found = episode_among_fixtures(scene, pushes)
            _draw_among_fixtures(axes, slider.shape, found)
            axes.set_title(f"{name}: {len(found.paths)} control steps")
        all_axes[0].set_ylabel("y / mm")
        legend_below(figure, all_axes[0], columns=5)
    return figure


def _draw_among_fixtures(axes: Axes, shape: pj.Shape, found: Episode) -> None:
    axes.add_patch(Rectangle((0, 0), MM * SIDE, MM * SIDE, fill=False, color=GRAY, lw=1))
    draw_fixtures(axes, FIXTURES)
    ends = [k + 1 for k in range(len(found.pushing) - 1) if found.pushing[k] and not found.pushing[k + 1]]
    for k in ends:
        plot.outline(axes, shape, found.poses[k], GRAY, 0.8)
    plot.outline(axes, shape, GOAL, GREEN, 3.0, label="goal")
    plot.outline(axes, shape, START, BLACK, 1.4, label="box at the start")
    plot.outline(axes, shape, found.poses[-1], RED, 1.4, label="at the end")
    for pushing, color, label in ((False, BLUE, "finger, free"), (True, ORANGE, "finger, pushing")):
        lines = [MM * path for path, now in zip(found.paths, found.pushing, strict=True) if now == pushing]
        axes.add_collection(LineCollection(lines, colors=color, lw=1.0 + pushing, label=label))
    axes.add_patch(Circle(tuple(MM * FINGER), MM * RADIUS, color=BLUE, fill=False, lw=1.0))
    axes.set(xlabel="x / mm", aspect="equal", xlim=(-8, MM * SIDE + 8), ylim=(-8, MM * SIDE + 8))


# Tasks on a table

PALE = "#9CC4DE"  # of the hand between start and end
# Of each task the configuration of the hand and the pose of the block at the start, and the actions, each with the
# number of control steps in which it is taken. They end at the goal.
EPISODES: tuple[tuple[TableTask, tuple[float, ...], tuple[tuple[int, tuple[float, ...]], ...]], ...] = (
    (PushBox(), (-0.1382, -0.1066, -0.0948, -0.0626, 1.2379), ((7, (0.594, 0.811)),)),
    (
        PushAlongWall(),
        (-0.09, -0.01, -0.1, -0.08, 0.35),
        ((4, (0.0, -1.0)), (1, (0.0, 1.0)), (4, (-1.0, 0.0)), (2, (0.0, -0.95)), (11, (0.98, 0.0))),
    ),
    (PushTwoFingers(), (-0.1716, 0.1258, -0.9088, -0.1396, 0.0751, -1.0088), ((9, (0.649, -0.655, 0.5)),)),
    (
        Squeeze(),
        (-0.0903, -0.0371, 0.7505, 0.14, -0.0945, -0.0314, 0.3505),
        ((4, (0.0, 0.0, 0.0, -1.0)), (5, (0.895, 0.371, -0.75, -1.0))),
    ),
    (
        PushClutter(blocks=3),
        (-0.155, 0.0, 0.02, 0.0, 0.0, -0.07, 0.0, 0.0, -0.005, 0.075, 0.5),
        ((10, (1.0, 0.0)), (1, (0.25, 0.0))),
    ),
)


def tasks() -> Figure:
    """Draw an episode of each task: block and hand after every other control step, and the goal."""
    with plt.rc_context(STYLE):
        figure, all_axes = panel_row(len(EPISODES), 2.6, 2.7)
        for axes, (env, start, motions) in zip(all_axes, EPISODES, strict=True):
            params, states = env.default_params, [env.state_of(start, env.default_params)]
            step = jax.jit(partial(env.step_env, jax.random.key(0), params=params))
            for action in np.concatenate([np.tile(action, (count, 1)) for count, action in motions]):
                states.append(step(states[-1], jnp.asarray(action))[1])
            axes.fill(*placed_outline(np.asarray(params.corners), np.asarray(params.goal)).T, GREEN, alpha=0.3, lw=0)
            draw_fixtures(axes, env.fixtures(states[0], params))
            for k, state in enumerate(states):
                ends = k in (0, len(states) - 1)
                if ends or k % 2 == 0:
                    width, poses = 1.3 if ends else 0.8, np.asarray(env.hand_model.poses(state.hand[None])[0])
                    for pose in np.asarray(state.pose).reshape(-1, 3):
                        plot.outline(axes, params.slider.shape, pose, BLACK if ends else GRAY, width)
                    plot.hand_at(axes, env.hand_model, poses, BLUE if ends else PALE, width)
            axes.plot(*MM * np.array([state.hand[:2] for state in states]).T, color=BLUE, lw=0.8, ls=":")
            axes.set(title=env.name, xlim=(-210, 200), ylim=(-185, 185), aspect="equal", xlabel="mm")
    return figure


MOVING: dict[str, Callable[[], plot.Animation]] = {made.__name__: made for made in (push, grasp, stochastic, pusht)}
STILL: dict[str, Callable[[], Figure]] = {
    made.__name__: made for made in (limit_surfaces, motion_cone, real, among_fixtures, tasks)
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(MOVING | STILL))
    parser.add_argument("--to", type=Path, default=Path(__file__).parent)
    parser.add_argument("--suffix", default=".gif", help="of what moves: .gif, .html or .mp4")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.names if name not in MOVING | STILL]
    if unknown:
        parser.error(f"no picture is named {', '.join(unknown)}; there are {', '.join(MOVING | STILL)}")
    without = ([] if find_data() else ["real"]) + ([] if find_spec("gym_pusht") else ["pusht"])
    for name in arguments.names or [name for name in MOVING | STILL if name not in without]:
        suffix = arguments.suffix if name in MOVING else ".png"
        path = plot.save((MOVING | STILL)[name](), arguments.to / f"{name}{suffix}")
        print(f"drew {path}, {path.stat().st_size / 1e3:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
