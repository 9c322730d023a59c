"""Options of the identification from logs.

This module does not import JAX, so that the command line answers at once.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from pushjax.experiments._cli_option import cli_option

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
    """Each log has its own friction and surface; all logs share the calibration. Default: they share everything."""
    steps: int = 40
    """Number of steps of each push."""
    parts: int = 1
    """Number of equally spaced poses per push to fit, if the object was tracked during the push (1: only the final
    pose)."""
    forces: bool = False
    """Use measured forces too; needs parts."""
    noise: bool = False
    """Also estimate how much pushes scatter."""

    def check(self) -> None:
        """Raise ValueError for the first invalid option that can be found without a log."""
        low, high = self.friction
        if not 0 <= low < high < math.inf:
            raise ValueError(f"--friction must be lowest and highest, at least 0 and different; got {low:g} {high:g}")
        if self.radius is not None and not 0 <= self.radius < math.inf:
            raise ValueError(f"--radius must be a length of at least 0 m; got {self.radius:g}")
        for name in ("pressure_center", "inset", "overshoot", "lag_distance", "hand_offset", "frame_offset"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise ValueError(f"--{name.replace('_', '-')} must be a positive length in m; got {value:g}")
        if not 0 < self.surface_dof < math.inf:
            raise ValueError(f"--surface-dof must be positive; got {self.surface_dof:g}")
        if self.steps < 1:
            raise ValueError(f"--steps must be at least 1; got {self.steps}")
        if not 1 <= self.parts < max(self.steps, 2):
            raise ValueError(f"--parts must be at least 1, and fewer than the {self.steps} steps; got {self.parts}")
        if self.forces and self.parts < 2:
            needs = "the parts of a push, each of which gives a wrench, to be 2 at least"
            raise ValueError(f"--forces needs --parts, {needs}; got {self.parts}")
