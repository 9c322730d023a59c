"""Polygons divided into triangles, judged by Shapely."""

import numpy as np
import pytest
from polygons import POLYGONS, star

from pushjax.geometry.polygon_numpy import triangles

shapely = pytest.importorskip("shapely")

OUTLINES = [*POLYGONS.values(), *(star(int(n), seed) for seed, n in enumerate(np.arange(200) % 20 + 3))]


def turned(vertices: np.ndarray, angle: float) -> np.ndarray:
    return vertices @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_triangles_are_the_polygon(angle):
    """They lie side by side in the polygon and fill it."""
    for outline in OUTLINES:
        vertices = turned(outline, angle)
        polygon, parts = shapely.Polygon(vertices), [shapely.Polygon(each) for each in triangles(vertices)]
        assert len(parts) <= len(vertices) - 2
        assert shapely.union_all(parts).symmetric_difference(polygon).area < 1e-9 * polygon.area
        assert abs(sum(each.area for each in parts) - polygon.area) < 1e-9 * polygon.area
        assert all(shapely.get_exterior_ring(each).is_ccw for each in parts)


def test_points_on_edges_make_no_triangle():
    """The corner of an L that is divided along its edges still gives as few triangles as the L."""
    vertices = np.array([(0, 0), (5, 0), (10, 0), (10, 3), (3, 3), (3, 10), (0, 10), (0, 5)]) / 100
    assert len(triangles(vertices)) == 4
