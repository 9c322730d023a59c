"""Split the text of a triangle log into records. This module knows the layout, not the meaning of the numbers.

The layout has one item per line. The first line is the number of pushes. Each push then has its object pose before and
after (7 numbers each), the number of force samples, those samples (3 numbers each), the number of robot samples, and
those samples (8 numbers each).

A damaged record must not make the records after it unreadable. If its sample counts are still consistent, the next
record starts where they say. Otherwise the next record starts at the next place that looks like a start: poses and a
count are the only consecutive lines of 7, 7 and 1 numbers. Two neighboring records whose starts are both unrecognizable
count as one, and the indices of the records after them are too low by one.
"""

import gzip
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pushjax.datasets.push_log import Floats, LogError

POSE_COLUMNS, COUNT_COLUMNS, FORCE_COLUMNS, ROBOT_COLUMNS = 7, 1, 3, 8
MAX_BYTES = 1 << 28  # of a log's text; the published ones have a few MB
# A push has about 670 force samples and 220 robot samples. Even a very long push stays far below this.
MAX_SAMPLES = 1_000_000
# The norms of logged quaternions deviate from one by 7e-7 (motion capture, six digits) and 7e-4 (robot, three digits).
QUATERNION_TOLERANCE = 0.01
# No logged quantity (s, mm, N) comes near this value. Squares of larger numbers might overflow later.
LARGEST_NUMBER = 1e12
_GZIP_MAGIC = b"\x1f\x8b"


@dataclass(frozen=True, eq=False)
class Record:
    """One push as logged."""

    index: int  # number of the push in its log, from 0
    line: int  # line of the first pose in the file, from 1
    poses: Floats  # (2, 7), object poses before and after the push, one logged line each
    force: Floats  # (K, 3), samples
    robot: Floats  # (M, 8), samples

    @property
    def force_line(self) -> int:
        """Line of the first force sample, from 1."""
        return self.line + 3

    @property
    def robot_line(self) -> int:
        """Line of the first robot sample, from 1."""
        return self.force_line + len(self.force) + 1


class ParseError(Exception):
    """A record that cannot be read, raised before the file and the push that it belongs to are known."""

    def __init__(self, message: str, line: int, *, at_end: bool = False) -> None:
        super().__init__(message)
        self.line = line  # from 1
        self.at_end = at_end  # whether the log ends too early


def read_records(path: Path) -> Iterator[Record | LogError]:
    """Iterate over the records of a log, plain or gzip-compressed, with an error for each damaged part."""
    lines, damage = _read_lines(path)
    promised, fault = _read_header(lines)
    if fault is not None:
        yield LogError(path, str(fault), line=1)
    index = 0 if promised is None and _matching_start_lines(lines, 0) >= 2 else 1
    number = 0
    while index < len(lines):
        if number == promised:
            message = f"expected the end of the log after {promised} pushes, found more lines"
            yield LogError(path, message, line=index + 1)
        if promised is not None and number >= promised and _matching_start_lines(lines, index) < 2:
            return
        try:
            record, index = _read_record(lines, index, number)
            yield record
        except ParseError as found:
            ending = _promised_count(promised) + damage if found.at_end else ""
            yield LogError(path, str(found) + ending, push=number, line=found.line)
            if found.at_end:
                return
            index = _find_next_record(lines, index, found.line - 1)
        number += 1
    if promised is not None and number < promised:
        message = f"expected {promised} pushes as in the header, found {number}: the log is truncated{damage}"
        yield LogError(path, message, push=number, line=len(lines))
    elif damage:
        yield LogError(path, damage.lstrip("; "), line=len(lines))


def _read_lines(path: Path) -> tuple[list[str], str]:
    """Read the intact lines of a log, and describe the damage of its gzip stream ("" if there is none)."""
    damage = ""
    try:
        text = path.read_bytes()
    except OSError as error:
        reason = error.strerror or error
        raise LogError(path, f"expected a push log, but cannot read the file: {reason}") from error
    if text.startswith(_GZIP_MAGIC):
        try:
            with gzip.open(path) as stream:
                text = stream.read(MAX_BYTES + 1)
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            damage = f"; the gzip stream is damaged: {error}"
            text = _decompress_readable_part(text)
            # The stream may be cut inside a number, and the rest still looks like a number: drop the last line.
            text = text[: text.rfind(b"\n") + 1]
    if len(text) > MAX_BYTES:
        raise LogError(path, f"expected a push log, found more than {MAX_BYTES >> 20} MB of text")
    lines = text.decode("ascii", errors="replace").rstrip().splitlines()
    if not lines:
        raise LogError(path, f"expected the number of pushes in the first line, found an empty file{damage}")
    return lines, damage


def _decompress_readable_part(zipped: bytes) -> bytes:
    """Return what a gzip stream holds before its damage."""
    stream = zlib.decompressobj(wbits=zlib.MAX_WBITS | 16)
    text = bytearray()
    try:
        for position in range(len(zipped)):  # byte by byte, because a call that fails returns nothing
            if len(text) > MAX_BYTES:
                break
            text += stream.decompress(zipped[position : position + 1])
    except zlib.error:
        pass
    return bytes(text)


def _read_header(lines: list[str]) -> tuple[int | None, ParseError | None]:
    """Read the promised number of pushes from the first line: the number, or None and the fault."""
    try:
        promised = _read_count(lines, 0, "pushes")
    except ParseError as fault:
        return None, fault
    if promised == 0:
        return None, ParseError("expected the number of pushes, found 0", 1)
    return promised, None


def _promised_count(promised: int | None) -> str:
    """Describe the number of pushes that the header promises, if it is known."""
    return "" if promised is None else f" (the header promises {promised} pushes)"


def _read_record(lines: list[str], start: int, number: int) -> tuple[Record, int]:
    """Read the record that starts at line index `start`, and return it with the line index after its end."""
    pose_before = _read_table(lines, start, 1, POSE_COLUMNS, "object pose before the push")
    pose_after = _read_table(lines, start + 1, 1, POSE_COLUMNS, "object pose after the push")
    force_count = _read_count(lines, start + 2, "force samples")
    force = _read_table(lines, start + 3, force_count, FORCE_COLUMNS, "force sample")
    robot_at = start + 3 + force_count
    robot_count = _read_count(lines, robot_at, "robot samples")
    robot = _read_table(lines, robot_at + 1, robot_count, ROBOT_COLUMNS, "robot sample")
    end = robot_at + 1 + robot_count
    if end < len(lines) and _matching_start_lines(lines, end) < 2 and _column_count(lines, end) == ROBOT_COLUMNS:
        raise ParseError(
            f"expected the next push after {robot_count} robot samples, found another robot sample", end + 1
        )
    return Record(number, start + 1, np.concatenate([pose_before, pose_after]), force, robot), end


def _read_count(lines: list[str], index: int, what: str) -> int:
    """Read the number of samples or pushes, 0 to MAX_SAMPLES, at line index `index`."""
    if index >= len(lines):
        raise ParseError(f"expected the number of {what}, found the end of the log", len(lines), at_end=True)
    try:
        count = int(lines[index])
    except ValueError:
        raise ParseError(f"expected the number of {what}, found {quoted(lines[index])}", index + 1) from None
    if not 0 <= count <= MAX_SAMPLES:
        raise ParseError(f"expected the number of {what} (0 to {MAX_SAMPLES}), found {count}", index + 1)
    return count


def _read_table(lines: list[str], first: int, count: int, columns: int, what: str) -> Floats:
    """Read a table (count, columns) from `count` lines, starting at line index `first`."""
    rows = [line.split() for line in lines[first : first + count]]
    try:
        table = np.array(rows, dtype=np.float64).reshape(-1, columns) if rows else np.empty((0, columns))
        valid = len(table) == count and len(rows) == count and bool(np.all(np.abs(table) < LARGEST_NUMBER))
    except ValueError:
        valid = False
    if not valid or any(len(row) != columns for row in rows):
        raise _describe_table_error(lines, first, count, columns, what)
    return table


def _describe_table_error(lines: list[str], first: int, count: int, columns: int, what: str) -> ParseError:
    """Return the error for the first fault in the lines of a table that is known to be bad."""
    for row, line in enumerate(lines[first : first + count]):
        where = what if count == 1 else f"{what} {row + 1} of {count}"
        tokens = line.split()
        if len(tokens) != columns:
            # If the last line of the file has too few numbers, it was cut off while it was written.
            cut = first + row == len(lines) - 1 and len(tokens) < columns
            found = "the log ends in the middle of a line" if cut else f"found {len(tokens)}: {quoted(line)}"
            return ParseError(f"expected {columns} numbers ({where}), {found}", first + row + 1, at_end=cut)
        for token in tokens:
            try:
                value = float(token)
            except ValueError:
                return ParseError(f"expected a number ({where}), found {quoted(token)}", first + row + 1)
            if not np.isfinite(value):
                return ParseError(f"expected finite numbers ({where}), found {token}", first + row + 1)
            if abs(value) >= LARGEST_NUMBER:
                message = f"expected numbers below {LARGEST_NUMBER:g} ({where}), found {token}"
                return ParseError(message, first + row + 1)
    remaining = max(len(lines) - first, 0)
    return ParseError(f"expected {count} lines ({what}), the log ends after {remaining}", len(lines), at_end=True)


def quoted(text: str) -> str:
    """Quote text for a message, shortened to 40 characters."""
    return repr(text if len(text) <= 40 else text[:37] + "...")


def _column_count(lines: list[str], index: int) -> int:
    """Count the numbers on the line at index `index`; -1 after the end of the file."""
    return len(lines[index].split()) if index < len(lines) else -1


def _matching_start_lines(lines: list[str], index: int) -> int:
    """Count those of three lines from `index` whose number of columns fits the start of a record."""
    # an intact start scores 3, a start with one damaged line 2
    start_columns = (POSE_COLUMNS, POSE_COLUMNS, COUNT_COLUMNS)
    return sum(_column_count(lines, index + row) == columns for row, columns in enumerate(start_columns))


def _find_next_record(lines: list[str], start: int, fault_at: int) -> int:
    """Return the line index of the next record after a damaged one, or the number of lines."""
    try:
        robot_at = start + 3 + _read_count(lines, start + 2, "")
        end = robot_at + 1 + _read_count(lines, robot_at, "")
        if end == len(lines) or _matching_start_lines(lines, end) >= 2:
            return end
    except ParseError:
        pass
    # The lines before the fault have been recognized as part of this record, so the search starts at the fault.
    for candidate in range(max(fault_at, start + 1), len(lines)):
        if _matching_start_lines(lines, candidate) >= 2:
            # A damaged line just before an intact start (score 3) also scores 2: skip it.
            return candidate + 1 if _matching_start_lines(lines, candidate + 1) == 3 else candidate
    return len(lines)


def check_quaternions(quaternions: Floats, line: int, what: str) -> None:
    """Raise ParseError unless the quaternions, the first of which is on `line`, have unit norm."""
    norm = np.linalg.norm(quaternions, axis=1)
    bad = np.flatnonzero(np.abs(norm - 1) > QUATERNION_TOLERANCE)
    if len(bad):
        raise ParseError(
            f"expected a unit quaternion ({what}), found one of norm {norm[bad[0]]:.3g}", line + int(bad[0])
        )
