"""Recorded pushes of any hand and object: one structure for all files, and what the readers of files share.

Frames: *world* is the base frame of the robot. *body* is fixed to the object. A body point p lies at
(x, y) + R(theta) p in the world. Forces and wrenches are those that the hand applies *to the object*.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class LogError(ValueError):
    """A log, or one push of it, that cannot be used.

    Attributes:
        path: The file, as given by the caller.
        message: What was expected, and what was found.
        push: Index of the push in the file, from 0; None if unknown.
        line: Line in the file, from 1; None if unknown.
    """

    def __init__(
        self, path: str | PathLike[str], message: str, push: int | None = None, line: int | None = None
    ) -> None:
        super().__init__(path, message, push, line)  # all arguments, from which pickle makes the error again
        self.path = fspath(path)
        self.message = message
        self.push = push
        self.line = line

    def __str__(self) -> str:
        place = [self.path]
        if self.push is not None:
            place.append(f"push {self.push}")
        if self.line is not None:
            place.append(f"line {self.line}")
        return f"{', '.join(place)}: {self.message}"


def nothing_usable(path: str | PathLike[str], problems: Sequence[LogError]) -> LogError:
    """Return the error for a file without a usable push: the first problem, and how many more there are."""
    if not problems:
        return LogError(path, "expected at least one push, found none")
    first = problems[0]
    more = f" (and {len(problems) - 1} more problems)" if len(problems) > 1 else ""
    return LogError(first.path, f"no usable push: {first.message}{more}", push=first.push, line=first.line)


def _no_rows() -> Floats:
    return np.empty((0, 3))


@dataclass(frozen=True, eq=False)
class Recording:
    """One push: m samples of the hand, and what is known of the object at each of them.

    Attributes:
        index: Index of the push in its file, from 0.
        hand: (m, dof) configurations of the hand as `pushjax.Hand` takes them, in m and rad, world frame. With dof = 2
            they are the center (x, y) of a finger. With more, the third is the angle theta, which is continuous, and
            the fourth is the distance d of the hand.
        pose: (m, 3) pose of the body frame in the world: x, y (m), theta (rad). Theta takes the short way from one
            tracked sample to the next. NaN where the object was not tracked, but never in the first and last sample.
        force: (m, 2) forces on the object, in N, world frame, NaN where there is none; None if no force was recorded.
        time: (m,) times, in s, non-decreasing, from an arbitrary origin; None if no time was recorded.
        wrench: (p, 3) wrenches on the object, of any scale, in the body frame about its origin, from the forces of the
            push; (0, 3) if unknown.
        twist: (p, 3) twists of the object under these wrenches, of any scale, in the body frame about its origin.
        about: What else is known of the push, by name, as numbers, text or arrays; `Recordings.about` lists the names.
    """

    index: int
    hand: Floats
    pose: Floats
    force: Floats | None = None
    time: Floats | None = None
    wrench: Floats = field(default_factory=_no_rows)
    twist: Floats = field(default_factory=_no_rows)
    about: Mapping[str, Any] = field(default_factory=dict)

    @property
    def tracked(self) -> NDArray[np.bool_]:
        """(m,) whether the object was tracked."""
        return np.isfinite(self.pose[:, 0])


@dataclass(frozen=True, eq=False)
class Recordings:
    """The usable pushes of one file, the problems of the others, and what is known of the object.

    Optional attributes are None if they are unknown.

    Attributes:
        pushes: The usable pushes, in the order of the file, all with the same dof.
        problems: One error for each unusable push, and one for each problem of the file as a whole (a truncated end,
            say).
        source: The file or folder that was read.
        vertices: (k, 2) vertices of the object, in m, body frame.
        length: Characteristic length, in m, which weighs rotation against translation.
        tip_radius: Radius of the finger, in m.
        support_points: (p, 2) support points, in m, body frame; (0, 2) if the whole face touches the surface.
        support_force: (p,) normal force at each support point, in N.
        surface: Name of the surface that the object slides on.
        object: Name of the object; of the triangle, the name of its supports.
    """

    pushes: tuple[Recording, ...]
    problems: tuple[LogError, ...]
    source: str
    vertices: Floats | None = None
    length: float | None = None
    tip_radius: float | None = None
    support_points: Floats | None = None
    support_force: Floats | None = None
    surface: str | None = None
    object: str | None = None

    def __len__(self) -> int:
        return len(self.pushes)

    @property
    def start(self) -> Floats:
        """(n, 3) pose of the object at the first sample of each push, in m and rad, world frame."""
        return np.array([push.pose[0] for push in self.pushes]).reshape(-1, 3)

    @property
    def end(self) -> Floats:
        """(n, 3) pose of the object at the last sample of each push, in m and rad, world frame."""
        return np.array([push.pose[-1] for push in self.pushes]).reshape(-1, 3)

    def about(self, name: str) -> NDArray[Any]:
        """Return what is known of each push under a name.

        Args:
            name: From `load_two_finger_logs`: "action" (equal for repetitions of the same nominal push) and "began" (s
                since 1970). From `load_mit_folder`: "action", "speed" (m/s), "side" (from 0), "fraction" (position
                along the side, in [0, 1]), "angle" (from the normal of the side, rad) and "repetition" (from 0). From
                an `.npz` file: the names of its arrays `about_…`.

        Returns:
            (n, ...) values.

        Raises:
            KeyError: If nothing is known under that name.
        """
        return np.array([push.about[name] for push in self.pushes])

    def save(self, path: str | PathLike[str]) -> None:
        """Write everything to an `.npz` file, from which `load_recordings` reads the same numbers.

        Args:
            path: The file. The page "Data" of the documentation lists its arrays.

        Raises:
            ValueError: If there are no pushes.
        """
        if not self.pushes:
            raise ValueError("pushes: expected at least one to save; got none")
        fields = {"path": "hand"} | {name: name for name in ("pose", "force", "time", "wrench", "twist")}
        columns = {name: [getattr(push, field) for push in self.pushes] for name, field in fields.items()}
        arrays = {name: _padded(rows) for name, rows in columns.items() if all(row is not None for row in rows)}
        arrays["index"] = np.array([push.index for push in self.pushes])
        arrays |= {f"about_{name}": self.about(name) for name in self.pushes[0].about}
        arrays |= {name: np.asarray(fact) for name in FACTS if (fact := getattr(self, name)) is not None}
        if self.problems:
            arrays["problem"] = np.array([problem.message for problem in self.problems])
            arrays["problem_push"] = np.array([-1 if each.push is None else each.push for each in self.problems])
        with Path(path).expanduser().open("wb") as file:  # given a path, NumPy would append a suffix
            np.savez_compressed(file, allow_pickle=False, **arrays)


FACTS = ("vertices", "length", "tip_radius", "support_points", "support_force", "surface", "object")


def _padded(rows: Sequence[Floats]) -> Floats:
    """Return arrays (m, ...) of several lengths m as one array, with NaN after the end of the shorter ones."""
    padded = np.full((len(rows), max(map(len, rows)), *rows[0].shape[1:]), np.nan)
    for target, row in zip(padded, rows, strict=True):
        target[: len(row)] = row
    return padded


def collect(path: Path, results: Iterable[Recording | LogError], **facts: Any) -> Recordings:
    """Collect the recordings and the errors of all pushes of a file; LogError if no push is usable."""
    results = list(results)
    problems = tuple(result for result in results if isinstance(result, LogError))
    pushes = tuple(result for result in results if isinstance(result, Recording))
    if not pushes:
        raise nothing_usable(path, problems)
    return Recordings(pushes, problems, str(path), **facts)


def quoted(text: str) -> str:
    """Quote text for a message, shortened to 40 characters."""
    return repr(text if len(text) <= 40 else text[:37] + "...")
