"""Outlines of sliders: signed distance, closest point, normal, swept contact."""

from pushjax.shapes._base import Closest as Closest
from pushjax.shapes._base import Facing as Facing
from pushjax.shapes._base import Outline as Outline
from pushjax.shapes._base import Shape as Shape
from pushjax.shapes.curve import Curve as Curve
from pushjax.shapes.disk import Disk as Disk
from pushjax.shapes.disk import DiskOutline as DiskOutline
from pushjax.shapes.ellipse import Ellipse as Ellipse
from pushjax.shapes.polygon import Polygon as Polygon
from pushjax.shapes.polygon import PolygonOutline as PolygonOutline
