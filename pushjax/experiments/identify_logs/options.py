"""What was pushed, by what and on what, and what is to be found: from options, or else from the logs."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

import pushjax as pj
from pushjax.datasets.recordings import Recordings
from pushjax.experiments._cli_option import cli_option
from pushjax.experiments._slider_options import SHAPES, parse_numbers, parse_shape, parse_support

HANDS = "finger, two_fingers, three_fingers, or parallel_jaw:0.05x0.01 (width and thickness of a pad)"
Meters = Annotated[float | None, cli_option("M")]


@dataclass
class Options:
    """What is known and what is to be found, as options of the command line."""

    shape: Annotated[str | None, cli_option("SHAPE")] = None
    """The object: rectangle:0.1x0.05, disk:0.05 (radius), ellipse:0.06x0.04 (semi-axes), regular:6x0.05 (corners,
    distance of each), all in m, or a CSV file of vertices. Default: what the logs tell."""
    hand: str = "finger"
    """finger, two_fingers, three_fingers, or parallel_jaw:0.05x0.01 (m, a pad's width and thickness)."""
    radius: Meters = None
    """Radius of the fingers, m. Default: what the logs tell."""
    support: Annotated[str | None, cli_option("SUPPORT")] = None
    """Pressure distribution under the object, which gives the prior of the limit surface: uniform, rim, or
    points:x,y;x,y;x,y (m). Default: what the logs tell, else uniform."""
    surface: Literal["quartic", "ellipsoid"] = "quartic"
    """Kind of limit surface."""
    surface_dof: float = 50.0
    """How well the limit surface is known beforehand: degrees of freedom of its prior; fewer, less well."""
    friction: tuple[float, float] = (0.0, 1.0)
    """Lowest and highest friction coefficient of the fingers."""
    pressure_center: Meters = None
    """Estimate the center of pressure too; the value is the standard deviation of its prior, m. Likewise for the next
    five options."""
    inset: Meters = None
    """Estimate by how much the outline is smaller."""
    overshoot: Meters = None
    """Estimate how far the hand went on after the end of its path."""
    lag_distance: Meters = None
    """Estimate the distance by which the hand was behind its path."""
    hand_offset: Meters = None
    """Estimate the displacement of the hand from its path."""
    frame_offset: Meters = None
    """Estimate the pose of the object's frame in the tracked frame; its angle times the length of the surface."""
    contact_at_end: bool = False
    """The finger touches the object at the end of most pushes: use the gap that was measured there."""
    separate: bool = False
    """Each log has its own friction and surface; all logs share the calibration."""
    steps: int = 40
    """Number of steps of each push."""
    parts: int = 1
    """Number of equally spaced poses per push to fit, if the object was tracked during the push (1: only the final
    pose)."""
    forces: bool = False
    """Use measured forces too; needs parts."""
    noise: bool = False
    """Also estimate how much pushes scatter."""


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
