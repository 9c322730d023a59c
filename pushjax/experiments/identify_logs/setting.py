"""What was pushed, by what and on what, read from command-line options or from the logs themselves."""

from collections.abc import Callable

import numpy as np

import pushjax as pj
from pushjax.datasets.recordings import Recordings
from pushjax.experiments._slider_options import SHAPES, parse_numbers, parse_shape, parse_support

HANDS = "finger, two_fingers, three_fingers, or parallel_jaw:0.05x0.01 (width and thickness of a pad)"


def shape_of(text: str | None, recordings: list[Recordings]) -> pj.Polygon | pj.Disk | pj.Ellipse:
    """Return the outline of the object, m, from the option or else from the logs."""
    if text is not None:
        return parse_shape(text)
    known = [one.vertices for one in recordings if one.vertices is not None]
    if len(known) < len(recordings):
        raise ValueError(f"--shape: the logs do not tell the object's outline; give one of {SHAPES}")
    if any(v.shape != known[0].shape or not np.allclose(v, known[0]) for v in known):
        raise ValueError("the logs are of objects with different outlines: identify them one by one")
    return pj.Polygon(known[0])


def hand_of(text: str, radius: float | None, recordings: list[Recordings]) -> pj.Hand:
    """Return the hand; fingers have the given radius, m, or else that of the logs."""
    kind, _, rest = text.partition(":")
    if kind == "parallel_jaw":
        return pj.Hand.parallel_jaw(*parse_numbers("--hand", text, rest, "x", 2, HANDS))
    constructors: dict[str, Callable[..., pj.Hand]] = {
        "finger": pj.Hand.finger,
        "two_fingers": pj.Hand.two_fingers,
        "three_fingers": pj.Hand.three_fingers,
    }
    if kind not in constructors or rest:
        raise ValueError(f"--hand: expected {HANDS}; got {text!r}")
    if radius is None:
        known = {one.tip_radius for one in recordings}
        if len(known) > 1 or known == {None}:
            raise ValueError("--radius: the logs do not tell the finger's radius; give it in m")
        radius = known.pop()
    return constructors[kind](radius)


def support_of(text: str | None, shape: pj.Shape, recordings: Recordings) -> pj.Support:
    """Return the support with unit load: the option's, or else the log's points, or else uniform pressure."""
    if text is None and recordings.support_points is not None and len(recordings.support_points):
        return pj.Support.tripod(recordings.support_points)
    return parse_support("uniform" if text is None else text, shape)
