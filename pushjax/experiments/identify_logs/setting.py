"""What was pushed, by what and on what, read from command-line options or from the logs themselves."""

import csv
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

import pushjax as pj
from pushjax.datasets.recordings import Recordings

SHAPES = "rectangle:0.1x0.05, disk:0.05, ellipse:0.06x0.04 (semi-axes), regular:6x0.05, or a CSV file of vertices"
HANDS = "finger, two_fingers, three_fingers, or parallel_jaw:0.05x0.01 (width and thickness of a pad)"
SUPPORTS = "uniform, rim, or points:0.03,0.04;-0.03,0.04;0,-0.04"
NUM_PAIRS = 400
NUM_POINTS = 100  # support points under a slider whose pressure is known everywhere


def shape_of(text: str | None, recordings: list[Recordings]) -> pj.Polygon | pj.Disk | pj.Ellipse:
    """Return the outline of the object.

    Args:
        text: The outline as an option, m. None: that of the logs.
        recordings: The logs.

    Raises:
        ValueError: If the text is no outline, or the logs have none or different ones.
    """
    if text is None:
        known = [one.vertices for one in recordings if one.vertices is not None]
        if len(known) < len(recordings):
            raise ValueError(f"--shape: the logs do not tell the object's outline; give one of {SHAPES}")
        if any(v.shape != known[0].shape or not np.allclose(v, known[0]) for v in known):
            raise ValueError("the logs are of objects with different outlines: identify them one by one")
        return pj.Polygon(known[0])
    kind, colon, rest = text.partition(":")
    if kind not in ("rectangle", "disk", "ellipse", "regular"):
        if colon and not Path(text).exists():
            raise ValueError(f"--shape: expected {SHAPES}; got {text!r}")
        return pj.Polygon(_vertices(Path(text)))
    wanted = 1 if kind == "disk" else 2
    sizes = _numbers("--shape", text, rest, "x", wanted, SHAPES)
    if kind == "disk":
        return pj.Disk(sizes[0])
    if kind == "ellipse":
        return pj.Ellipse(*sizes)
    if kind == "regular":
        return pj.Polygon.regular(int(sizes[0]), sizes[1])
    return pj.Polygon.rectangle(*sizes)


def hand_of(text: str, radius: float | None, recordings: list[Recordings]) -> pj.Hand:
    """Return the hand.

    Args:
        text: The kind of hand as an option.
        radius: Radius of the fingers, m. None: that of the logs.
        recordings: The logs.

    Raises:
        ValueError: If the text is no hand, or the logs do not have one radius.
    """
    kind, _, rest = text.partition(":")
    if kind == "parallel_jaw":
        return pj.Hand.parallel_jaw(*_numbers("--hand", text, rest, "x", 2, HANDS))
    makes: dict[str, Callable[..., pj.Hand]] = {
        "finger": pj.Hand.finger,
        "two_fingers": pj.Hand.two_fingers,
        "three_fingers": pj.Hand.three_fingers,
    }
    if kind not in makes or rest:
        raise ValueError(f"--hand: expected {HANDS}; got {text!r}")
    if radius is None:
        known = {one.tip_radius for one in recordings}
        if len(known) > 1 or known == {None}:
            raise ValueError("--radius: the logs do not tell the finger's radius; give it in m")
        radius = known.pop()
    return makes[kind](radius)


def support_of(text: str | None, shape, recordings: Recordings) -> pj.Support:
    """Return the support of the object in one log, with unit load.

    Args:
        text: The support as an option. None: the support points of the log, or uniform pressure if it has none.
        shape: Outline of the object.
        recordings: The log.

    Raises:
        ValueError: If the text is no support.
    """
    if text is None and recordings.support_points is not None and len(recordings.support_points):
        return pj.Support.tripod(recordings.support_points)
    if text in (None, "uniform"):
        return pj.Support.uniform(shape, NUM_POINTS)
    if text == "rim":
        return pj.Support.rim(shape, NUM_POINTS)
    kind, _, rest = str(text).partition(":")
    if kind != "points":
        raise ValueError(f"--support: expected {SUPPORTS}; got {text!r}")
    points = [_numbers("--support", str(text), point, ",", 2, SUPPORTS) for point in rest.split(";")]
    return pj.Support.tripod(points) if len(points) == 3 else pj.Support.points(points)


def expected_surface(support: pj.Support, degree: int, seed: int) -> pj.LimitSurface:
    """Fit the limit surface that a support leads to expect.

    Args:
        support: The support.
        degree: 4 for a quartic, else an ellipsoid.
        seed: Seed of the wrench-twist pairs.
    """
    pairs = support.wrench_twist_pairs(jax.random.key(seed), NUM_PAIRS)
    return pj.fit_limit_surface(*pairs, degree=4 if degree == 4 else 2)


def _vertices(path: Path) -> np.ndarray:
    """Read a file with one vertex x, y (m) per line; a heading is allowed."""
    try:
        rows = [row for row in csv.reader(path.read_text().splitlines()) if row]
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"--shape: {path}: expected {SHAPES}; {error}") from error
    numbers = []
    for k, row in enumerate(rows):
        try:
            numbers.append([float(cell) for cell in row])
        except ValueError as error:
            if k > 0:
                raise ValueError(f"--shape: {path}, line {k + 1}: expected two numbers, x and y; got {row}") from error
    if any(len(row) != 2 for row in numbers) or len(numbers) < 3:
        raise ValueError(f"--shape: {path}: expected at least three vertices, two numbers each; got {len(numbers)}")
    return np.array(numbers)


def _numbers(option: str, given: str, text: str, separator: str, count: int, allowed: str) -> list[float]:
    """Read `count` numbers that are separated by `separator`; raise ValueError with the option's name otherwise."""
    try:
        found = [float(part) for part in text.split(separator)]
    except ValueError:
        found = []
    if len(found) != count:
        raise ValueError(f"{option}: expected {allowed}; got {given!r}")
    return found
