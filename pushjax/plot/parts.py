"""The parts of pictures: outlines, fingers, arrows, centers of rotation. Most take SI units and draw in mm."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle
from matplotlib.patches import Polygon as PolygonPatch

from pushjax.geometry.se2_numpy import to_world
from pushjax.geometry.shape import Shape
from pushjax.plot.style import GRAY, MM, PURPLE
from pushjax.simulation.fixtures import Fixture, Wall
from pushjax.simulation.hand import Hand, Pad

SMOOTH_OUTLINE_POINTS = 200  # points along a smooth outline
FAR = 10.0  # m; to here a wall is drawn, which is beyond every picture
FIXTURE = "0.88"  # color of fixtures


def vertices(shape: Shape) -> np.ndarray:
    """Return the vertices (n, 2) of a polygon, or points along a smooth outline, body frame, m."""
    points = getattr(shape, "vertices", None)
    return np.asarray(shape.boundary(SMOOTH_OUTLINE_POINTS) if points is None else points)


def placed_outline(points: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Return the closed outline (..., points + 1, 2), mm, of points (points, 2), m, at poses (..., 3), m and rad."""
    return MM * to_world(np.asarray(poses)[..., None, :], np.vstack([points, points[:1]]))


def centroids(shape: Shape, poses: np.ndarray) -> np.ndarray:
    """Return the centroids (..., 2), mm, of a body at poses (..., 3), m and rad."""
    return MM * to_world(np.asarray(poses), np.asarray(shape.centroid, float))


def finger_poses(hand: Hand, configurations: Any) -> np.ndarray:
    """Return the poses (..., fingers, 3) of the fingers at configurations (..., dof), m and rad."""
    poses = np.asarray(hand.poses(jnp.asarray(configurations)), float)
    return poses if poses.shape[-1] == 3 else np.insert(poses, 2, 0.0, axis=-1)  # a hand that never turns has none


def outline(axes: Axes, shape: Shape, pose: np.ndarray, color: str, width: float, **line: Any) -> None:
    """Draw a shape at a pose, in mm.

    Args:
        axes: Axes to draw into.
        shape: The shape.
        pose: (3,), m and rad.
        color: Color of the line.
        width: Width of the line, in points.
        line: Other arguments of `Axes.plot`.
    """
    axes.plot(*placed_outline(vertices(shape), np.asarray(pose)).T, color=color, lw=width, **line)


def hand_at(axes: Axes, hand: Hand, poses: np.ndarray, color: str, width: float) -> None:
    """Draw the fingers of a hand, in mm.

    Args:
        axes: Axes to draw into.
        hand: The hand.
        poses: (fingers, 2) or (fingers, 3), centers or poses of the fingers as `hand.poses` gives them, m and rad.
        color: Color of the lines.
        width: Width of the lines, in points.
    """
    for finger, where in zip(hand.fingers, np.asarray(poses), strict=True):
        if isinstance(finger, Pad):
            outline(axes, finger.shape, where, color, width)
        else:
            axes.add_patch(Circle(tuple(MM * where[:2]), MM * float(finger.radius), color=color, fill=False, lw=width))


def draw_fixtures(axes: Axes, fixtures: Sequence[Wall | Fixture]) -> None:
    """Draw fixtures filled, in mm; walls do not extend the data limits of the axes."""
    low, high = (MM * FAR * sign for sign in (-1, 1))
    for fixture in fixtures:
        if isinstance(fixture, Wall):
            point, normal = MM * np.asarray(fixture.point, float), np.asarray(fixture.normal, float)
            along = np.array([normal[1], -normal[0]])
            ends = point + np.outer([low, high], along)
            corners = np.concatenate([ends, ends[::-1] + low * normal])
        else:
            corners = placed_outline(vertices(fixture.shape), np.asarray(fixture.pose))
        patch = PolygonPatch(corners, facecolor=FIXTURE, edgecolor=GRAY, lw=0.8, zorder=0)
        axes.add_artist(patch) if isinstance(fixture, Wall) else axes.add_patch(patch)


def arrow(axes: Axes, tail: np.ndarray, tip: np.ndarray, color: str, width: float) -> None:
    """Draw an arrow from one point (2,) to another, in mm, and extend the data limits of the axes to both."""
    shape = {"arrowstyle": "-|>", "color": color, "lw": width, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (tip[0], tip[1]), (tail[0], tail[1]), arrowprops=shape)
    axes.update_datalim([tail, tip])
    axes.autoscale_view()


def center_of_rotation(axes: Axes, twist: np.ndarray) -> None:
    """Draw the center of rotation of a twist (3,), body frame, and the sign of the turn; none if it only translates."""
    vx, vy, omega = twist
    if omega == 0:
        return
    center = MM * np.array([-vy, vx]) / omega
    axes.plot(*center, "o", mfc="white", mec=PURPLE, ms=13, mew=1.6)
    axes.annotate("+" if omega > 0 else "\N{MINUS SIGN}", center, ha="center", va="center", color=PURPLE, fontsize=12)
    axes.plot([], [], "o", mfc="white", mec=PURPLE, label="center of rotation")
