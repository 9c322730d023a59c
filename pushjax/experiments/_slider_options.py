"""Sliders of experiments: limit surfaces of supports, and outlines, supports and fixtures from text of options."""

import math
from pathlib import Path

import jax
import numpy as np

import pushjax as pj

SHAPES = "rectangle:0.1x0.05, disk:0.05, ellipse:0.06x0.04 (semi-axes), regular:6x0.05, or a CSV file of vertices"
FIXTURES = "wall@X,Y,ANGLE of its normal, or SHAPE@X,Y,THETA with a shape as in --shape"
SUPPORTS = "uniform, rim, or points:0.03,0.04;-0.03,0.04;0,-0.04"
MODELS = {"quartic": 4, "ellipsoid": 2}  # limit surfaces and their degrees
PAIRS = 400  # wrench-twist pairs that a limit surface is fitted to
NUM_POINTS = 100  # points in place of a continuous pressure, "uniform" or "rim"


def fitted_surface(support: pj.Support, model: str, seed: int) -> pj.LimitSurface:
    """Fit a limit surface, a "quartic" or an "ellipsoid", to sampled wrench-twist pairs of a support."""
    return pj.fit_limit_surface(*support.wrench_twist_pairs(jax.random.key(seed), PAIRS), degree=MODELS[model])


def parse_shape(text: str, option: str = "--shape") -> pj.Polygon | pj.Disk | pj.Ellipse:
    """Return the outline, m, that the value of a command-line option describes."""
    kind, colon, rest = text.partition(":")
    if kind not in ("rectangle", "disk", "ellipse", "regular"):
        if colon and not Path(text).expanduser().exists():
            raise ValueError(f"{option}: expected {SHAPES}; got {text!r}")
        return pj.Polygon(_vertices(Path(text), option))
    sizes = parse_numbers(option, text, rest, "x", 1 if kind == "disk" else 2, SHAPES)
    if kind == "disk":
        return pj.Disk(sizes[0])
    if kind == "ellipse":
        return pj.Ellipse(*sizes)
    if kind == "regular":
        if not (sizes[0] >= 3 and sizes[0].is_integer()):
            raise ValueError(f"{option}: a regular polygon needs a whole number of at least three sides; got {text!r}")
        return pj.Polygon.regular(int(sizes[0]), sizes[1])
    return pj.Polygon.rectangle(*sizes)


def parse_support(text: str, shape: pj.Shape) -> pj.Support:
    """Return the support, with unit load, that the value of the option `--support` describes."""
    if text == "uniform":
        return pj.Support.uniform(shape, NUM_POINTS)
    if text == "rim":
        return pj.Support.rim(shape, NUM_POINTS)
    kind, _, rest = text.partition(":")
    if kind != "points":
        raise ValueError(f"--support: expected {SUPPORTS}; got {text!r}")
    points = [parse_numbers("--support", text, point, ",", 2, SUPPORTS) for point in rest.split(";")]
    return pj.Support.tripod(points) if len(points) == 3 else pj.Support.points(points)


def parse_fixture(text: str, friction: float) -> pj.Wall | pj.Fixture:
    """Return the wall or the fixed body that a value of the option `--fixtures` describes."""
    kind, _, place = text.rpartition("@")
    x, y, angle = parse_numbers("--fixtures", text, place, ",", 3, FIXTURES)
    if kind == "wall":
        return pj.Wall((x, y), (math.cos(angle), math.sin(angle)), friction=friction)
    shape = parse_shape(kind, "--fixtures")
    if isinstance(shape, pj.Ellipse):
        raise ValueError(f"--fixtures: a body is a disk or a polygon; got {text!r}")
    return pj.Fixture(shape, (x, y, angle), friction=friction)


def _vertices(path: Path, option: str) -> np.ndarray:
    """Read a file with one vertex x, y (m) per line; a heading, a first line without any number, is allowed."""
    try:
        lines = path.expanduser().read_text("utf-8-sig").splitlines()
        is_heading = not any(cell.strip(" +-.")[:1].isdigit() for cell in "".join(lines[:1]).split(","))
        vertices = np.loadtxt(lines[is_heading:], delimiter=",", ndmin=2)
    except (OSError, ValueError) as error:
        raise ValueError(f"{option}: {path}: expected {SHAPES}; {error}") from error
    if len(vertices) < 3 or vertices.shape[1] != 2:
        raise ValueError(f"{option}: {path}: expected at least three vertices, two numbers each")
    return vertices


def parse_numbers(option: str, value: str, text: str, separator: str, count: int, allowed: str) -> list[float]:
    """Parse `count` numbers from `text`, the part of an option's `value` that holds them."""
    try:
        found = [float(part) for part in text.split(separator)]
    except ValueError:
        found = []
    if len(found) != count:
        raise ValueError(f"{option}: expected {allowed}; got {value!r}")
    return found
