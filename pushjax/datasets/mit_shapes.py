"""Outlines of the eleven objects of the MIT pushing data set, in the frames their tracker reports.

Source: Yu, Bauza, Fazeli, Rodriguez, "More than a million ways to be pushed", IROS 2016; the numbers are those that the
toolbox of Zhou, Bagnell, Mason, RSS 2017, takes. The origin is the centre of all but the triangles, where it is 45 mm
from each leg.
"""

from typing import NamedTuple

import numpy as np

from pushjax.datasets.pushes import Floats

TIP_RADIUS = 0.00475  # m
_RECTANGLES = {"rect1": (0.045, 0.045), "rect2": (0.044955, 0.05629), "rect3": (0.067505, 0.04497)}
_LEGS = {"tri1": (0.1259, 0.12587), "tri2": (0.151, 0.12587), "tri3": (0.1765, 0.12561)}
_RIGHT_ANGLE = 0.045
_SEMI_AXES = {"ellip1": (0.0525, 0.0525), "ellip2": (0.0525, 0.065445), "ellip3": (0.0525, 0.0785)}
_ELLIPSE_CORNERS = 99
_HEXAGON = 0.0605
MIT_SHAPES = (*_RECTANGLES, *_LEGS, *_SEMI_AXES, "hex", "butter")

# The butterfly, from the tip of one wing: a cubic spline with one knot on each side, at u steps of about 5 mm. x is odd
# in u, y even. In m per power of u; the last of each is of the cube beyond the knot.
_KNOT = 10.8359
_X = (6.77379e-3, -2.016559e-5, 6.916228e-5)  # u, u^3
_Y = (-0.0780175, 4.187392e-4, -1.220402e-5, 1.140326e-5)  # 1, u^2, |u|^3
_STEPS = 19  # to each side; the next one is the waist
_WAIST = 0.0274593
_POINTS = 8  # of a step, as published; there x runs one of them ahead of y, and to the right by
_SHIFT = 8.03e-5


class MitShape(NamedTuple):
    """vertices: (v, 2) m, body, counter-clockwise. length: m, which weighs rotation against translation: the vertices'
    mean distance from their mean. tip_radius: m."""

    vertices: Floats
    length: float
    tip_radius: float


def mit_shape(name: str) -> MitShape:
    """One of MIT_SHAPES. Ellipses have 99 vertices, the butterfly 636. Raises ValueError for another name."""
    if name not in MIT_SHAPES:
        raise ValueError(f"shape must be one of {', '.join(MIT_SHAPES)}; got {name!r}")
    vertices = _vertices(name)
    return MitShape(vertices, float(np.linalg.norm(vertices - vertices.mean(axis=0), axis=1).mean()), TIP_RADIUS)


def nearest_on_outline(vertices: Floats, points: Floats) -> tuple[Floats, Floats]:
    """(n,) signed distances in m, negative inside, and (n, 2) the nearest places of an outline (v, 2) of straight edges
    to n points (n, 2)."""
    edge = np.roll(vertices, -1, axis=0) - vertices
    to = points[:, None] - vertices
    share = np.clip(np.sum(to * edge, axis=2) / np.sum(edge**2, axis=1), 0, 1)
    apart = np.linalg.norm(to - share[..., None] * edge, axis=2)
    each, nearest = np.arange(len(points)), np.argmin(apart, axis=1)
    place = vertices[nearest] + share[each, nearest][:, None] * edge[nearest]
    # inside, the edges that cross the point's height to its right wind once around it
    above = to[..., 1] < 0
    left = edge[:, 0] * to[..., 1] > edge[:, 1] * to[..., 0]
    rising, falling = ~above & np.roll(above, -1, axis=1), above & ~np.roll(above, -1, axis=1)
    turns = np.sum(rising & left, axis=1) - np.sum(falling & ~left, axis=1)
    return np.where(turns == 0, 1, -1) * apart[each, nearest], place


def _vertices(name: str) -> Floats:
    if name in _RECTANGLES:
        return np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * np.array(_RECTANGLES[name])
    if name in _LEGS:
        along_x, along_y = _LEGS[name]
        return _RIGHT_ANGLE - np.array([[0, 0], [along_x, 0], [0, along_y]])
    if name in _SEMI_AXES:
        return _around(_ELLIPSE_CORNERS, 0) * np.array(_SEMI_AXES[name])
    return _HEXAGON * _around(6, 1) if name == "hex" else _butterfly()


def _around(corners: int, first: int) -> Floats:
    angle = 2 * np.pi * (np.arange(corners) + first) / corners
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _butterfly() -> Floats:
    """From the waist on the left around the lower wing; the upper one is that, turned by half."""
    u = np.arange(-_STEPS, _STEPS + 1.0)
    beyond = np.clip(np.abs(u) - _KNOT, 0, None) ** 3
    x = _X[0] * u + _X[1] * u**3 + _X[2] * np.sign(u) * beyond + _SHIFT
    y = _Y[0] + _Y[1] * u**2 + _Y[2] * np.abs(u) ** 3 + _Y[3] * beyond
    step = _POINTS * (u + _STEPS) + _POINTS - 1
    end = step[-1] + _POINTS - 1
    at = np.arange(end)
    lower_x = np.interp(at, [0, *(step - 1), end], [-_WAIST, *x, _WAIST])
    lower = np.stack([lower_x, np.interp(at, [0, *step, end], [0, *y, 0])], axis=1)
    return np.concatenate([lower, -lower])
