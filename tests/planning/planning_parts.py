"""What several tests of planning share: polygons, and a box on a table that one finger pushes."""

import numpy as np

import pushjax as pj
from pushjax.geometry.se2_numpy import compose, inverse
from pushjax.planning import PushScene, SpeedLimits, Workspace
from pushjax.planning.between_pushes import Transits, transits_between

L = np.array([(0, 0), (0.1, 0), (0.1, 0.03), (0.03, 0.03), (0.03, 0.12), (0, 0.12)])
PLUS = 0.03 * np.array(
    [(1, -3), (1, -1), (3, -1), (3, 1), (1, 1), (1, 3), (-1, 3), (-1, 1), (-3, 1), (-3, -1), (-1, -1), (-1, -3)]
)
T = 0.03 * np.array([(-2, 1), (-2, 0), (-0.5, 0), (-0.5, -3), (0.5, -3), (0.5, 0), (2, 0), (2, 1)])

RADIUS, FRICTION, ENOUGH = 0.015, 0.1, 0.95
TABLE, SPEEDS = Workspace.rectangle((0.0, 0.0), (0.5, 0.5)), SpeedLimits(0.05, 0.02, 0.02)


def scene_of(shape=None, friction=FRICTION, fixtures=()):
    """Return a scene with the limit surface of gym-pusht's T; a box of 100 × 60 mm if not told otherwise."""
    slider = pj.Slider(shape or pj.Polygon.rectangle(0.10, 0.06), pj.Ellipsoid(np.eye(3), 0.05))
    return PushScene(slider, pj.Hand.finger(RADIUS), friction, fixtures)


def poses_reaching(library, goal):
    """Return the pose from which each entry of a library reaches a goal."""
    return compose(goal, inverse(library.relative))


def transits_around_one(vertices, radius, clearance, paths, poses, samples, **options) -> Transits:
    """The transits around one slider: poses (pushes + 1, 3), samples (samples, pushes + 1, 3)."""
    return transits_between([vertices], radius, clearance, paths, poses[:, None], samples[:, :, None], **options)
