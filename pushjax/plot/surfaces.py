"""Pictures of limit surfaces."""

from collections.abc import Mapping

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pushjax._math.vec import Vec3
from pushjax.friction.limit_surface import LimitSurface
from pushjax.friction.support import WrenchTwistPairs
from pushjax.plot.style import STYLE, curve_styles

FORCE_X, FORCE_Y, TORQUE = "$f_x$ / load", "$f_y$ / load", r"$\tau$ / (length · load)"
CUT_DISTANCE = 0.06  # pairs at most this far from a cut are drawn with it, in units of the load
ARROW_LENGTH = 0.5  # length of the arrow of a twist, in units of the load
VIEW = np.radians(30), np.radians(-60)  # elevation and azimuth of the viewer
# A wrench is on the viewer's side if the cosine of its angle to the direction of the viewer is larger than this.
MIN_COSINE = 0.25


def limit_surfaces(
    surfaces: Mapping[str, LimitSurface], pairs: WrenchTwistPairs, load: float, *, arrows: int = 12
) -> Figure:
    """Draw level sets H = 1 in 3-D and cuts through them, with the wrenches that they were fitted to.

    Forces are drawn in units of the load, torques in units of length times load. At some of the wrenches an arrow shows
    the twist, as `(vx, vy, length omega)`. A twist is parallel to the gradient of H. So where the surface fits, the
    arrow is normal to the surface.

    Args:
        surfaces: Limit surfaces by name. Their length must be that of the pairs.
        pairs: The pairs that the surfaces were fitted to.
        load: Total friction limit of the support, N.
        arrows: Number of pairs with an arrow, spread over the side that is seen.
    """
    with plt.rc_context(STYLE):
        figure = plt.figure(figsize=(3.6 * len(surfaces) + 4.0, 3.9), layout="constrained")
        grid = figure.add_gridspec(2, len(surfaces) + 1, width_ratios=[1.0] * len(surfaces) + [0.85])
        length = float(pairs.length)
        wrench = np.asarray(pairs.wrench) / load / np.array([1, 1, length])
        twist = np.asarray(pairs.twist) * np.array([1, 1, length])
        shown = _spread_out(wrench, arrows)
        for column, (name, surface, style) in enumerate(curve_styles(surfaces)):
            axes = figure.add_subplot(grid[:, column], projection="3d")
            _draw_level_set(axes, surface, load, style["color"])
            axes.scatter(*wrench.T, s=2, color="0.2", alpha=0.6, depthshade=False)
            axes.quiver(
                *wrench[shown].T, *(ARROW_LENGTH * twist[shown]).T, color="black", lw=1.1, arrow_length_ratio=0.25
            )
            axes.set_title(name)
        for row, title, vertical in ((0, "cut through $f_y = 0$", 2), (1, "cut through $\\tau = 0$", 1)):
            axes = figure.add_subplot(grid[row, -1])
            _draw_cut(axes, surfaces, wrench, load, vertical)
            axes.set(title=title)
        figure.axes[-2].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
        return figure


def _draw_level_set(axes: Axes, surface: LimitSurface, load: float, color: str) -> None:
    """Draw the level set H = 1 of a surface in 3-D."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 49), np.linspace(0, np.pi, 25))
    directions = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=-1)
    x, y, z = np.moveaxis(_on_level_set(surface, directions) / load, -1, 0)
    axes.plot_surface(x, y, z, color=color, alpha=0.35, linewidth=0.2, edgecolor=color)  # type: ignore[attr-defined]
    # few ticks, because the labels of more ticks would run into the labels of the axes
    axes.set(xlabel=FORCE_X, ylabel=FORCE_Y, xticks=[-1, 0, 1], yticks=[-1, 0, 1])
    axes.set_zlabel(TORQUE)  # type: ignore[attr-defined]
    elevation, azimuth = np.degrees(VIEW)
    axes.view_init(elev=elevation, azim=azimuth)  # type: ignore[attr-defined]
    axes.set_box_aspect((1, 1, 1), zoom=0.88)  # type: ignore[call-arg]


def _draw_cut(
    axes: Axes,
    surfaces: Mapping[str, LimitSurface],
    wrench: np.ndarray,  # (pairs, 3), in units of the load
    load: float,  # total friction limit of the support, N
    # component on the vertical axis: 1 for f_y, 2 for the torque; f_x is horizontal, the third zero in the cut
    vertical: int,
) -> None:
    """Draw a cut through the level sets, and the wrenches near it."""
    angle = np.linspace(0, 2 * np.pi, 241)
    circle = np.zeros((len(angle), 3))
    circle[:, 0], circle[:, vertical] = np.cos(angle), np.sin(angle)
    for name, surface, style in curve_styles(surfaces):
        cut = _on_level_set(surface, circle) / load
        axes.plot(cut[:, 0], cut[:, vertical], label=name, **style)
    near = np.abs(wrench[:, 3 - vertical]) < CUT_DISTANCE
    axes.plot(wrench[near, 0], wrench[near, vertical], ".", color="0.2", ms=3, label="pairs nearby")
    axes.set(xlabel=FORCE_X, ylabel=TORQUE if vertical == 2 else FORCE_Y, aspect="equal")


def _spread_out(wrench: np.ndarray, count: int) -> np.ndarray:
    """Return indices of up to `count` wrenches on the viewer's side, each as far as possible from those before it."""
    elevation, azimuth = VIEW
    viewer = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    visible = np.flatnonzero(wrench @ viewer > MIN_COSINE * np.linalg.norm(wrench, axis=1))
    if count < 1 or not len(visible):
        return visible[:0]
    chosen = [int(np.argmax(wrench[visible] @ viewer))]
    nearest_distance = np.full(len(visible), np.inf)
    while len(chosen) < min(count, len(visible)):
        nearest_distance = np.minimum(
            nearest_distance, np.linalg.norm(wrench[visible] - wrench[visible[chosen[-1]]], axis=1)
        )
        chosen.append(int(np.argmax(nearest_distance)))
    return visible[chosen]


def _on_level_set(surface: LimitSurface, normalized: np.ndarray) -> np.ndarray:
    """Scale wrenches `(fx, fy, tau / length)` along their rays to H = 1; the result has the same form, in N."""
    form = jax.tree.map(np.asarray, surface.form())  # with NumPy, so that nothing is compiled for a picture
    value = np.asarray(form.value(Vec3(*np.moveaxis(normalized, -1, 0))))
    return normalized * value[..., None] ** (-1 / form.degree)
