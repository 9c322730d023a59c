"""What pictures are made of: outlines, fingers, arrows, centres of rotation. All take SI units and draw in mm."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle

from pushjax.hands import Finger, Hand, Pad
from pushjax.plot.style import MM, PURPLE
from pushjax.shapes import Shape

FINE = 200  # points of a smooth outline


def vertices(shape: Shape) -> np.ndarray:
    """The outline as a polygon's vertices (vertices, 2), body frame, m: a polygon's own, else points along it."""
    points = getattr(shape, "vertices", None)
    return np.asarray(shape.boundary(FINE) if points is None else points)


def placed(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Points (points, 2) m of a body at the poses (..., 3), closed and in mm: (..., points + 1, 2)."""
    x, y, theta = np.moveaxis(np.asarray(pose)[..., None], -2, 0)
    c, s = np.cos(theta), np.sin(theta)
    px, py = np.vstack([points, points[:1]]).T
    return MM * np.stack([c * px - s * py + x, s * px + c * py + y], axis=-1)


def outline(axes: Axes, shape: Shape, pose: np.ndarray, color: str, width: float, **line: Any) -> None:
    """The shape at a pose (3,), in mm. line: anything else of `Axes.plot`."""
    axes.plot(*placed(vertices(shape), np.asarray(pose)).T, color=color, lw=width, **line)


def hand_at(axes: Axes, hand: Hand, poses: np.ndarray, color: str, width: float) -> None:
    """The fingers at their poses (fingers, width), in mm."""
    for finger, where in zip(hand.fingers, np.asarray(poses), strict=True):
        _finger(axes, finger, where, color, width)


def _finger(axes: Axes, finger: Finger, pose: np.ndarray, color: str, width: float) -> None:
    if isinstance(finger, Pad):
        outline(axes, finger.shape, pose, color, width)
    else:
        axes.add_patch(Circle(tuple(MM * pose[:2]), MM * float(finger.radius), color=color, fill=False, lw=width))


def arrow(axes: Axes, tail: np.ndarray, tip: np.ndarray, color: str, width: float) -> None:
    """From one point (2,) to another, mm; both count for the range that the axes show."""
    shape = {"arrowstyle": "-|>", "color": color, "lw": width, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (tip[0], tip[1]), (tail[0], tail[1]), arrowprops=shape)
    axes.update_datalim([tail, tip])
    axes.autoscale_view()


def center_of_rotation(axes: Axes, twist: np.ndarray) -> None:
    """About which a twist (3,), body frame, turns the slider, with the sign of the turn; nothing of a translation."""
    vx, vy, omega = twist
    if omega == 0:
        return
    center = MM * np.array([-vy, vx]) / omega
    axes.plot(*center, "o", mfc="white", mec=PURPLE, ms=13, mew=1.6)
    axes.annotate("+" if omega > 0 else "\N{MINUS SIGN}", center, ha="center", va="center", color=PURPLE, fontsize=12)
    axes.plot([], [], "o", mfc="white", mec=PURPLE, label="centre of rotation")
