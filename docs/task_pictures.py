"""Draw an episode of each of the tasks on a table.

    python docs/task_pictures.py

writes docs/tasks.png.
"""

from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl

mpl.use("Agg")  # draws to files, because there may be no screen

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pushjax import plot, tasks
from pushjax.plot import parts
from pushjax.plot.style import BLACK, BLUE, GRAY, GREEN, MM, STYLE, panel_row

PALE = "#9CC4DE"  # of the hand between start and end


class Episode(NamedTuple):
    """An episode with given actions.

    Attributes:
        env: The task.
        start: Configuration of the hand and pose of the block.
        motions: Actions, each with the number of control steps in which it is taken.
    """

    env: tasks.TableTask
    start: tuple[float, ...]
    motions: tuple[tuple[int, tuple[float, ...]], ...]


EPISODES = (
    Episode(tasks.PushBox(), (-0.15, 0.015, -0.09, 0.0, 0.2), ((7, (1.0, -0.1)),)),
    Episode(
        tasks.PushAlongWall(),
        (-0.09, -0.01, -0.1, -0.08, 0.35),
        ((4, (0.0, -1.0)), (1, (0.0, 1.0)), (4, (-1.0, 0.0)), (2, (0.0, -0.95)), (11, (0.98, 0.0))),
    ),
    Episode(tasks.PushTwoFingers(), (-0.16, 0.0, 0.1, -0.1, 0.0, 0.0), ((9, (0.9, 0.2, 0.5)),)),
    Episode(
        tasks.Squeeze(),
        (-0.1, -0.06, 0.9, 0.14, -0.105, -0.055, 0.5),
        ((4, (0.0, 0.0, 0.0, -1.0)), (5, (0.83, 0.5, -0.75, -1.0))),
    ),
)


def panels() -> Figure:
    """Draw an episode of each task: block and hand after every other control step, and the goal."""
    with plt.rc_context(STYLE):
        figure, axes = panel_row(len(EPISODES), 2.6, 2.7)
        for axis, episode in zip(axes, EPISODES, strict=True):
            _draw(axis, episode)
    return figure


def _states(episode: Episode) -> list[tasks.TaskState]:
    """Return the states of an episode. Without walls, it is moved such that the last one is the goal."""
    env, params = episode.env, episode.env.default_params
    step = jax.jit(lambda state, action: env.step_env(jax.random.key(0), state, action, params)[1])
    actions = np.concatenate([np.tile(action, (count, 1)) for count, action in episode.motions])
    states, start = [], np.array(episode.start)
    for _ in range(1 if env.fixtures(env.state_of(start, params), params) else 2):
        if states:
            (x, y, angle), goal = np.asarray(states[-1].pose), np.asarray(params.goal)
            turn = np.exp(1j * (goal[2] - angle))
            for k in (0, len(start) - 3):
                place = goal[0] + 1j * goal[1] + turn * (start[k] - x + 1j * (start[k + 1] - y))
                start[k : k + 2] = place.real, place.imag
            turned = (actions[:, 0] + 1j * actions[:, 1]) * turn
            actions[:, :2] = np.stack([turned.real, turned.imag], axis=1)
            start[[2, -1] if len(start) > 5 else [-1]] += goal[2] - angle
        states = [env.state_of(start, params)]
        for action in actions:
            states.append(step(states[-1], jnp.asarray(action)))
    return states


def _draw(axis: Axes, episode: Episode) -> None:
    """Draw an episode."""
    env, states = episode.env, _states(episode)
    params = env.default_params
    shape, goal = params.slider.shape, parts.placed_outline(np.asarray(params.corners), np.asarray(params.goal))
    axis.fill(*goal.T, color=GREEN, alpha=0.3, lw=0)
    parts.draw_fixtures(axis, env.fixtures(states[0], params))
    for k, state in enumerate(states):
        ends = k in (0, len(states) - 1)
        if ends or k % 2 == 0:
            parts.outline(axis, shape, np.asarray(state.pose), BLACK if ends else GRAY, 1.3 if ends else 0.8)
            poses = np.asarray(env.hand_model.poses(state.hand[None])[0])
            parts.hand_at(axis, env.hand_model, poses, BLUE if ends else PALE, 1.3 if ends else 0.8)
    axis.plot(*MM * np.array([state.hand[:2] for state in states]).T, color=BLUE, lw=0.8, ls=":")
    axis.set(title=env.name, xlim=(-210, 160), ylim=(-185, 185), aspect="equal", xlabel="mm")


if __name__ == "__main__":
    plot.save(panels(), Path(__file__).parent / "tasks.png")
