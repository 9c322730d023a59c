"""The controller of PushT in the package `gym-pusht`, in SI units: one pixel is 1 mm.

The body frame of the slider is at the T's center of gravity. In `gym-pusht` all velocity is lost in each time step, so
a step's motion is the impulse divided by mass and inertia. That is the motion under an elliptic limit surface whose
length is the square root of inertia over mass. There is no friction at the finger: the coefficients of the shapes are
zero.
"""

from pathlib import Path

import numpy as np
import platformdirs

from pushjax.friction.ellipsoid import Ellipsoid
from pushjax.geometry.polygon import Polygon
from pushjax.geometry.se2_numpy import to_world
from pushjax.planning.controller import Observation, PushController
from pushjax.planning.finger_control import SpeedLimits, SpringDamper
from pushjax.planning.push_library import PushLibrary
from pushjax.planning.push_planner import PushPlanner
from pushjax.planning.scene import PushScene
from pushjax.planning.workspace import Workspace
from pushjax.simulation.hand import Hand
from pushjax.simulation.slider import Slider
from pushjax.tasks.push_t import (
    AGENT_RADIUS,
    DAMPING,
    GOAL,
    PHYSICS_STEPS,
    PHYSICS_TIMESTEP,
    SIZE,
    STIFFNESS,
    T_CENTER,
    T_LENGTH,
    T_VERTICES,
)

PIXEL = 1e-3  # m
# px. The finger stays a little within the limits of actions, and the T out of the walls.
FINGER_LIMITS, T_LIMITS = (2.0, 510.0), (8.0, 504.0)


def pusht_controller(
    *,
    look_ahead: bool = True,
    use_cost_to_go: bool = True,
    feedback: bool = True,
    friction: float = 0.0,
    noise: float = 0.0,
    cache: Path | None = None,
) -> PushController:
    """Build the controller that solves PushT of `gym-pusht`, which has the goal of that task.

    Its actions are positions in m; divided by 0.001 they are those of `gym-pusht`. The first call simulates a library
    of pushes, which takes about a minute.

    Args:
        look_ahead: Whether plans of two pushes are considered.
        use_cost_to_go: Whether pushes far from the goal are chosen by the cost to go, or by the distance to the goal.
        feedback: Whether the end of a push is corrected while it runs.
        friction: Coefficient of contact friction in the model; `gym-pusht` has none.
        noise: Standard deviation of the positions that are seen, m.
        cache: Folder in which the library is kept. None: a folder in the user's cache folder.

    Returns:
        The controller, with all of its programs compiled.

    Raises:
        ValueError: If `friction` is negative or not finite.
    """
    cache = cache or platformdirs.user_cache_path("pushjax", appauthor=False) / "planning"
    corners = PIXEL * (np.array(T_VERTICES, float) - np.array(T_CENTER))
    slider = Slider(Polygon(corners), Ellipsoid(np.eye(3), PIXEL * T_LENGTH))
    scene = PushScene(slider, Hand.finger(AGENT_RADIUS * PIXEL), friction)
    (finger_low, finger_high), (low, high) = PIXEL * np.array([FINGER_LIMITS, T_LIMITS])
    workspace = Workspace(*(np.full(2, each) for each in (finger_low, finger_high, low, high)))
    speeds = SpeedLimits(free=60 * PIXEL, push=24 * PIXEL, acceleration=20 * PIXEL)
    library = PushLibrary.build(scene, cache=cache)
    given = scene, library, pusht_pose(GOAL), workspace, speeds
    planner = PushPlanner(*given, look_ahead=look_ahead, use_cost_to_go=use_cost_to_go)
    planner.prepare()
    limits = np.zeros(2), np.full(2, SIZE * PIXEL)
    control = SpringDamper(STIFFNESS, DAMPING, PHYSICS_TIMESTEP, PHYSICS_STEPS, *limits)
    controller = PushController(planner, control, feedback=feedback, noise=noise)
    controller.prepare()
    return controller


def pusht_observation(state: np.ndarray) -> Observation:
    """Return what a controller sees, for the observation "state" of `gym-pusht`.

    Args:
        state: Position of the agent (px), position (px) and angle (rad) of the T, (5,).
    """
    return Observation(PIXEL * np.asarray(state[:2], float), pusht_pose(state[2:]))


def pusht_pose(pose: np.ndarray | tuple[float, float, float]) -> np.ndarray:
    """Return the pose of the T's center of gravity, (3,), m and rad, for that of the T in `gym-pusht`, px and rad."""
    center = to_world(np.asarray(pose, float), np.array(T_CENTER))
    return np.array([*(PIXEL * center), pose[2]])
