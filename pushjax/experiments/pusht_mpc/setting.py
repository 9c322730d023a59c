"""The task PushT in SI units: slider, finger, workspace and goal of the package `gym-pusht`.

One pixel of `gym-pusht` is 1 mm here. The body frame of the slider is at the T's center of gravity. In `gym-pusht` all
velocity is lost in each time step, so a step's motion is the impulse divided by mass and inertia. That is the motion
under an elliptic limit surface whose length is the square root of inertia over mass. There is no friction at the
finger: the coefficients of the shapes are zero.
"""

import numpy as np

import pushjax as pj
from pushjax.geometry.se2_numpy import to_world
from pushjax.planning.finger_control import Pace, SpringDamper
from pushjax.planning.workspace import Workspace
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
CENTER_OF_GRAVITY = np.array(T_CENTER)  # px, in the body frame of gym-pusht
FINGER_RADIUS = AGENT_RADIUS * PIXEL
ENOUGH = 0.95  # coverage from which an episode is a success
STEPS = 300  # usual limit of an episode


def slider() -> pj.Slider:
    """Return the T."""
    corners = PIXEL * (np.array(T_VERTICES, float) - CENTER_OF_GRAVITY)
    return pj.Slider(pj.Polygon(corners), pj.Ellipsoid(np.eye(3), PIXEL * T_LENGTH))


def workspace() -> Workspace:
    """Return the limits: the finger stays a little within those of actions, and the T out of the walls."""
    finger_low, finger_high, slider_low, slider_high = (PIXEL * np.full(2, each) for each in (2.0, 510.0, 8.0, 504.0))
    return Workspace(finger_low, finger_high, slider_low, slider_high)


def finger_control() -> SpringDamper:
    """Return the model of the finger."""
    low, high = np.zeros(2), np.full(2, SIZE * PIXEL)
    return SpringDamper(STIFFNESS, DAMPING, PHYSICS_TIMESTEP, PHYSICS_STEPS, low=low, high=high)


def pace() -> Pace:
    """Return the speeds at which the planner moves the finger."""
    return Pace(free=60 * PIXEL, push=24 * PIXEL, acceleration=20 * PIXEL)


def from_gym(position: np.ndarray, angle: float) -> np.ndarray:
    """Return the pose of the center of gravity, m and rad, for the position (px) and angle of gym-pusht's body."""
    center = to_world(np.array([*position, angle]), np.array(CENTER_OF_GRAVITY))
    return np.array([*(PIXEL * center), angle])


def goal() -> np.ndarray:
    """Return the goal of the center of gravity, (3,), m and rad."""
    return from_gym(np.array(GOAL[:2]), GOAL[2])
