"""Split the text of a triangle log into records. This module knows the layout, not the meaning of the numbers.

The layout has one item per line. The first line is the number of pushes. Each push then has its object pose before and
after (7 numbers each), the number of force samples, those samples (3 numbers each), the number of robot samples, and
those samples (8 numbers each). A line that breaks the layout ends the reading: the pushes before it are kept.
"""

import gzip
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pushjax.datasets.checks import LARGEST_NUMBER
from pushjax.datasets.recordings import Floats, LogError, quoted

POSE_COLUMNS, FORCE_COLUMNS, ROBOT_COLUMNS = 7, 3, 8
MAX_BYTES = 1 << 28  # of a log's text; the published ones have a few MB
# A push has about 670 force samples and 220 robot samples. Even a very long push stays far below this.
MAX_COUNT = 1_000_000
# Broken trials have one to three samples per push.
MIN_SAMPLES = 4
# The norms of logged quaternions deviate from one by 7e-7 (motion capture, six digits) and 7e-4 (robot, three digits).
QUATERNION_TOLERANCE = 0.01


@dataclass(frozen=True, eq=False)
class Record:
    """One push as logged."""

    index: int  # number of the push in its log, from 0
    line: int  # line of the first pose in the file, from 1
    poses: Floats  # (2, 7), object poses before and after the push, one logged line each
    force: Floats  # (K, 3), samples
    robot: Floats  # (M, 8), samples

    def check_samples(self) -> None:
        """Raise ValueError unless there are enough samples, and clocks that rise and overlap in time."""
        for what, samples in (("force", self.force), ("robot", self.robot)):
            if len(samples) < MIN_SAMPLES:
                raise ValueError(f"expected at least {MIN_SAMPLES} {what} samples, found {len(samples)}")
            step = float(np.diff(samples[:, 0]).min())
            if step < 0:
                message = f"expected time stamps that do not decrease ({what} samples), found a step of {step:.3g} s"
                raise ValueError(message)
        check_quaternions(self.robot[:, 4:], "robot sample")
        if self.robot[0, 0] > self.force[-1, 0] or self.robot[-1, 0] < self.force[0, 0]:
            raise ValueError("expected robot samples from the time of the force samples, found none")


def check_quaternions(quaternions: Floats, what: str) -> None:
    """Raise ValueError unless quaternions (n, 4) have unit norm."""
    norm = np.linalg.norm(quaternions, axis=1)
    bad = norm[np.abs(norm - 1) > QUATERNION_TOLERANCE]
    if len(bad):
        raise ValueError(f"expected a unit quaternion ({what}), found one of norm {bad[0]:.3g}")


def read_records(path: Path) -> tuple[list[Record], list[LogError]]:
    """Read the records of a log, plain or gzip-compressed, and at most one problem of the layout."""
    reader = _Reader(path)
    promised = reader.read_count("pushes")
    records: list[Record] = []
    for number in range(promised):
        reader.push = number
        try:
            records.append(reader.read_record())
        except LogError as error:
            error.message += f" (the header promises {promised} pushes)"
            return records, [error]
    reader.push = None
    if reader.at < len(reader.lines):
        return records, [reader.error(f"expected the end of the log after {promised} pushes, found more lines")]
    return records, []


class _Reader:
    """Reads the lines of a log one after another."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.lines = _read_lines(path)
        self.at = 0  # lines that were read
        self.push: int | None = None  # number of the push that is being read

    def error(self, message: str) -> LogError:
        """Make the error for the next line."""
        return LogError(self.path, message, push=self.push, line=min(self.at + 1, len(self.lines)))

    def read_record(self) -> Record:
        """Read one push."""
        line = self.at + 1
        poses = self.read_table(2, POSE_COLUMNS, "object poses before and after the push")
        force = self.read_table(self.read_count("force samples"), FORCE_COLUMNS, "force samples")
        robot = self.read_table(self.read_count("robot samples"), ROBOT_COLUMNS, "robot samples")
        assert self.push is not None
        return Record(self.push, line, poses, force, robot)

    def read_count(self, what: str) -> int:
        """Read the number of samples or pushes, 0 to MAX_COUNT."""
        if self.at >= len(self.lines):
            raise self.error(f"expected the number of {what}, found the end of the log")
        line = self.lines[self.at]
        if not (line.isdecimal() and int(line) <= MAX_COUNT):
            raise self.error(f"expected the number of {what} (0 to {MAX_COUNT}), found {quoted(line)}")
        self.at += 1
        return int(line)

    def read_table(self, count: int, columns: int, what: str) -> Floats:
        """Read a table (count, columns), one row from each line."""
        table = np.empty((count, columns))
        for row in range(count):
            if self.at >= len(self.lines):
                raise self.error(f"expected {count} lines ({what}), the log ends after {row}")
            tokens = self.lines[self.at].split()
            if len(tokens) != columns:
                found = quoted(self.lines[self.at])
                raise self.error(f"expected {columns} numbers ({what}), found {len(tokens)}: {found}")
            try:
                table[row] = tokens
            except ValueError:
                raise self.error(f"expected numbers ({what}), found {quoted(self.lines[self.at])}") from None
            if not np.all(np.abs(table[row]) < LARGEST_NUMBER):
                found = quoted(self.lines[self.at])
                raise self.error(f"expected finite numbers below {LARGEST_NUMBER:g} ({what}), found {found}")
            self.at += 1
        return table


def _read_lines(path: Path) -> list[str]:
    """Read the lines of a log."""
    try:
        with path.open("rb") as plain:
            zipped = plain.read(2) == b"\x1f\x8b"
        with (gzip.open if zipped else open)(path, "rb") as stream:
            text = stream.read(MAX_BYTES + 1)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise LogError(path, f"expected a push log, but the gzip stream is damaged: {error}") from error
    except OSError as error:
        raise LogError(path, f"expected a push log, but cannot read the file: {error.strerror or error}") from error
    if len(text) > MAX_BYTES:
        raise LogError(path, f"expected a push log, found more than {MAX_BYTES >> 20} MB of text")
    lines = text.decode("ascii", errors="replace").rstrip().splitlines()
    if not lines:
        raise LogError(path, "expected the number of pushes in the first line, found an empty file")
    return [line.strip() for line in lines]
