"""Outlines of the eleven objects of the MIT pushing data set, in the frames that their tracker reports.

The origin is the center of the object. For triangles, it is the point 45 mm from each leg.

Reference: Yu, Bauza, Fazeli, Rodriguez, "More than a million ways to be pushed", IROS 2016. The numbers are those of
the toolbox of Zhou, Bagnell, Mason, RSS 2017.
"""

from typing import NamedTuple

import numpy as np

from pushjax.datasets.recordings import Floats

TIP_RADIUS = 0.00475  # radius of the pusher's tip, m
# Dimensions in m: half sides of rectangles, legs of triangles, distance of the origin from each leg.
_RECTANGLES = {"rect1": (0.045, 0.045), "rect2": (0.044955, 0.05629), "rect3": (0.067505, 0.04497)}
_LEGS = {"tri1": (0.1259, 0.12587), "tri2": (0.151, 0.12587), "tri3": (0.1765, 0.12561)}
_LEG_DISTANCE = 0.045
_SEMI_AXES = {"ellip1": (0.0525, 0.0525), "ellip2": (0.0525, 0.065445), "ellip3": (0.0525, 0.0785)}
_ELLIPSE_CORNERS = 99
_HEXAGON_RADIUS = 0.0605  # distance of the vertices from the center, m
MIT_SHAPES = (*_RECTANGLES, *_LEGS, *_SEMI_AXES, "hex", "butter")

# The lower wing of the butterfly is a cubic spline x(u), y(u) of a parameter u. The tip of the wing is at u = 0, with
# one knot on each side of it, at |u| = _KNOT. One unit of u is a step of about 5 mm. x is odd in u, y is even.
# Coefficients are in m per power of u. The last coefficient of each belongs to (|u| - _KNOT)^3, which counts only
# beyond the knots.
_KNOT = 10.8359
_X = (6.77379e-3, -2.016559e-5, 6.916228e-5)  # u, u^3
_Y = (-0.0780175, 4.187392e-4, -1.220402e-5, 1.140326e-5)  # 1, u^2, |u|^3
_STEPS = 19  # steps of the spline to each side of u = 0; one step more leads to the waist
_WAIST = 0.0274593  # half width of the waist, where y = 0, m
# The published outline has 8 points per step. In it, each x belongs to the y of the next point, and x is shifted right
# by _SHIFT (m).
_POINTS = 8
_SHIFT = 8.03e-5


class MitShape(NamedTuple):
    """The outline of an object, and the tip that pushes it; ellipses have 99 vertices, the butterfly has 636."""

    vertices: Floats  # (v, 2), m, body frame, counterclockwise
    length: float  # mean distance of the vertices from their mean, m, which weighs rotation against translation
    tip_radius: float  # m


def mit_shape(name: str) -> MitShape:
    """Return one of the shapes in MIT_SHAPES."""
    if name not in MIT_SHAPES:
        raise ValueError(f"shape must be one of {', '.join(MIT_SHAPES)}; got {name!r}")
    vertices = _vertices(name)
    return MitShape(vertices, float(np.linalg.norm(vertices - vertices.mean(axis=0), axis=1).mean()), TIP_RADIUS)


def nearest_on_outline(vertices: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Return signed distances (n,), m, negative inside, of points from a polygon, and its nearest points (n, 2)."""
    edge = np.roll(vertices, -1, axis=0) - vertices
    offset = points[:, None] - vertices
    fraction = np.clip(np.sum(offset * edge, axis=2) / np.sum(edge**2, axis=1), 0, 1)
    distance = np.linalg.norm(offset - fraction[..., None] * edge, axis=2)
    rows, edge_index = np.arange(len(points)), np.argmin(distance, axis=1)
    nearest_point = vertices[edge_index] + fraction[rows, edge_index][:, None] * edge[edge_index]
    # A point is inside if the ray from it along +x crosses an odd number of edges.
    above = offset[..., 1] < 0  # whether the first vertex of each edge is above the point
    next_above = np.roll(above, -1, axis=1)
    left = edge[:, 0] * offset[..., 1] > edge[:, 1] * offset[..., 0]
    inside = np.sum((above != next_above) & (left == next_above), axis=1) % 2 == 1
    return np.where(inside, -1, 1) * distance[rows, edge_index], nearest_point


def _vertices(name: str) -> Floats:
    """Return the vertices (v, 2) of a shape in MIT_SHAPES, in m."""
    if name in _RECTANGLES:
        return np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * np.array(_RECTANGLES[name])
    if name in _LEGS:
        along_x, along_y = _LEGS[name]
        return _LEG_DISTANCE - np.array([[0, 0], [along_x, 0], [0, along_y]])
    if name in _SEMI_AXES:
        return _on_unit_circle(_ELLIPSE_CORNERS, 0) * np.array(_SEMI_AXES[name])
    return _HEXAGON_RADIUS * _on_unit_circle(6, 1) if name == "hex" else _butterfly()


def _on_unit_circle(count: int, first: int) -> Floats:
    """Return points (corners, 2) at equal angles on the unit circle, the first at `first` steps from the x axis."""
    angle = 2 * np.pi * (np.arange(count) + first) / count
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _butterfly() -> Floats:
    """Return the butterfly's vertices, from the waist on the left around the lower wing and then the upper one."""
    u = np.arange(-_STEPS, _STEPS + 1.0)
    beyond = np.clip(np.abs(u) - _KNOT, 0, None) ** 3
    x = _X[0] * u + _X[1] * u**3 + _X[2] * np.sign(u) * beyond + _SHIFT
    y = _Y[0] + _Y[1] * u**2 + _Y[2] * np.abs(u) ** 3 + _Y[3] * beyond
    step = _POINTS * (u + _STEPS) + _POINTS - 1
    end = step[-1] + _POINTS - 1
    point = np.arange(end)
    lower_x = np.interp(point, [0, *(step - 1), end], [-_WAIST, *x, _WAIST])
    lower = np.stack([lower_x, np.interp(point, [0, *step, end], [0, *y, 0])], axis=1)
    return np.concatenate([lower, -lower])  # the upper wing is the lower one, turned by half a turn
