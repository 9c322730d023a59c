"""Helpers that read what a figure shows, for tests of figures."""

import re

import numpy as np

SIDE, RADIUS = 0.06, 0.005
MM = 1e3
BARE = re.compile(r" / |^count$|^pushes learned from$")  # an axis names its unit, or what it counts
SMALLEST = 7  # pt


def in_world(pose, side=SIDE) -> np.ndarray:
    """Return the corners of a square at a pose, mm, closed."""
    corners = side / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return MM * (corners @ np.array([[c, s], [-s, c]]) + np.asarray(pose)[:2])


def legend(figure_or_axes) -> list[str]:
    """Return the legend entries of an axes, or of all legends of a figure."""
    of = getattr(figure_or_axes, "legends", None)
    found = [figure_or_axes.get_legend()] if of is None else of
    return [text.get_text() for each in found for text in each.get_texts()]


def legible(figure) -> None:
    """Check that every axis has a unit, that no text is too small, and that the figure can be drawn."""
    figure.canvas.draw()
    for axes in figure.axes:
        for label in (axes.get_xlabel(), axes.get_ylabel()):
            assert BARE.search(label), f"no unit: {label!r}"
        sizes = [text.get_fontsize() for text in axes.texts] + [axes.title.get_fontsize()]
        sizes += [text.get_fontsize() for text in axes.get_xticklabels() + axes.get_yticklabels()]
        assert min(sizes) >= SMALLEST


def ends_of(axes, color) -> list[np.ndarray]:
    """Return the data of all lines of a color."""
    return [line.get_xydata() for line in axes.lines if line.get_color() == color and len(line.get_xydata())]
