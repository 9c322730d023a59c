"""Read original logs of the aluminum triangle pushed with two fingers.

Each session has two files, `exp_<time>_sensor<N>.txt` and `exp_<time>_pushaction<N>.txt`. The first is laid out as a
log of one finger (`records`). The second has the number of pushes, and then for each the type of its motion and eleven
numbers (`Action`). Push i follows action i; the shorter of the two files counts. World frame, body frame and hand frame
are those of `two_finger`.

Only the object's poses are taken from the sensor's file. The hand's path is the commanded one, from the measured start
pose, because the robot's own stream ends after half of the rotation.
"""

import itertools
from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pushjax.datasets import triangle_setup
from pushjax.datasets.pushes import Floats, LogError, nothing_usable, rotation, wrap_angle
from pushjax.datasets.records import Record, read_records
from pushjax.datasets.triangle import body_pose
from pushjax.datasets.two_finger import TwoFingerLog, stick_deviation

HALF_SPACING = 0.025  # m, from the middle of the hand to the center of each finger
# At the end one finger touches the outline, as far as the motion capture and an unknown outline tell: its center is
# between these distances from the outline, m. If not, the motion capture jumped or the hand did not reach the object.
CLOSEST, FARTHEST = -0.002, 0.004
MAX_TURN = np.radians(60)  # no action turns the object so far; the motion capture jumped
NUMBERS = (3, 3, 3, 2)  # on the lines of an action after its type


class Action(NamedTuple):
    """A planned push, in the body frame of the object before the push.

    Attributes:
        turns: Whether the hand turns; else it moves straight.
        contact: (2,) point midway between the fingers when they touch, m.
        target: (2,) center of rotation, m; or direction of the straight motion, a unit vector.
        approach: (2,) direction of the approach, a unit vector.
        amount: Angle of the rotation, rad, or length of the straight motion, m.
        closing: Distance from the middle of the hand to `contact` at the start, along `approach`, m.
    """

    turns: bool
    contact: Floats
    target: Floats
    approach: Floats
    amount: float
    closing: float


def load_two_finger_logs(folder: str | PathLike[str]) -> TwoFingerLog:
    """Read all sessions in a folder of one arrangement of the supports.

    A push becomes a problem if its records are damaged, if neither finger is at the outline at the end, or if the
    object turns by more than 60 degrees.

    Args:
        folder: The folder, whose name tells the arrangement (`triangle_setup.name_support`).

    Returns:
        The usable pushes, in the order of time, and the problems of the others. The surface is unknown.

    Raises:
        LogError: If there are no such files, if a file of actions is damaged, or if no push is usable.
    """
    where = Path(folder)
    sensors = sorted(where.glob("exp_*_sensor*.txt"))
    if not sensors:
        raise LogError(where, "expected logs exp_…_sensor….txt, found none")
    name, points = triangle_setup.name_support(where / "any") or (triangle_setup.UNKNOWN, np.empty((0, 2)))
    rows: list[dict] = []
    problems: list[LogError] = []
    actions: list[Action] = []
    for sensor in sensors:
        planned = _actions(sensor.with_name(sensor.name.replace("_sensor", "_pushaction")))
        for record, action in zip(read_records(sensor), planned, strict=False):
            found = record if isinstance(record, LogError) else _row(sensor, record, action)
            if isinstance(found, LogError):
                problems.append(found)
            else:
                rows.append(found)
                actions.append(action)
    if not rows:
        raise nothing_usable(where, problems)
    order = np.argsort([row["time"] for row in rows])
    columns = {key: np.array([rows[k][key] for k in order]) for key in rows[0]}
    group = np.unique([_nominal(actions[k]) for k in order], axis=0, return_inverse=True)[1].reshape(-1)
    deviation = stick_deviation(
        columns["hand_start"], columns["hand_end"], columns["pose_start"], columns["pose_end"], triangle_setup.LENGTH
    )
    return TwoFingerLog(
        index=np.arange(len(rows)),
        group=group.astype(np.int64),
        **columns,
        stick_deviation=deviation,
        vertices=triangle_setup.VERTICES.copy(),
        length=triangle_setup.LENGTH,
        spacing=2 * HALF_SPACING,
        support_points=points,
        support_force=triangle_setup.support_force(points),
        problems=tuple(problems),
        surface=triangle_setup.UNKNOWN,
        arrangement=name,
        source=str(where),
    )


def _actions(path: Path) -> Iterator[Action]:
    """Iterate over the actions of a file.

    Raises:
        LogError: If the file is missing or damaged.
    """
    try:
        lines = path.read_text().splitlines()
    except OSError as error:
        raise LogError(path, f"expected planned pushes, but cannot read the file: {error.strerror or error}") from error
    size = 1 + len(NUMBERS)
    for at in range(1, len(lines) - size + 1, size):
        kind = lines[at].strip()
        try:
            values = [np.array(line.split(), float) for line in lines[at + 1 : at + size]]
            fits = all(len(v) == n and np.isfinite(v).all() for v, n in zip(values, NUMBERS, strict=True))
        except ValueError:
            fits = False
        if not kind or not fits:
            message = "expected the type of a push and 3, 3, 3 and 2 numbers on the lines after it"
            raise LogError(path, message, line=at + 1)
        yield _action(kind, values)


def _action(kind: str, values: list[Floats]) -> Action:
    """Convert the numbers of an action from millimeters and degrees in the corner frame."""
    turns = "Rotation" in kind
    contact, target, approach = (each[:2] for each in values[:3])
    center = triangle_setup.CENTER_OF_MASS[:2]
    amount, closing = values[3]
    return Action(
        turns=turns,
        contact=contact / 1000 - center,
        target=target / 1000 - center if turns else target / np.linalg.norm(target),
        approach=approach / np.linalg.norm(approach),
        amount=float(np.radians(amount) if turns else amount / 1000),
        closing=float(closing / 1000),
    )


def _nominal(action: Action) -> Floats:
    """Return the numbers of an action, equal for its repetitions."""
    return np.concatenate([[action.turns, action.amount, action.closing], *action[1:4]])


def _row(path: Path, record: Record, action: Action) -> dict | LogError:
    """Convert a push to fields of `TwoFingerLog`, or say why it is not usable."""
    start, end = (body_pose(row) for row in record.poses)
    turned = float(wrap_angle(end[2] - start[2]))
    end[2] = start[2] + turned
    turn = rotation(start[2])
    where = start[:2] + turn @ (action.contact - action.closing * action.approach)
    heading = np.arctan2(*(turn @ action.approach)[::-1])
    if action.turns:
        center, angle = start[:2] + turn @ action.target, action.amount
        after = center + rotation(angle) @ (where - center)
    else:
        center, angle = np.full(2, np.nan), 0.0
        after = where + turn @ (action.closing * action.approach + action.amount * action.target)
    hand_start, hand_end = np.append(where, heading), np.append(after, heading + angle)
    gaps = [_gaps(*both) for both in ((hand_start, start), (hand_end, end))]
    nearest = float(np.min(gaps[1]))
    if not CLOSEST < nearest < FARTHEST:
        expected = f"between {1e3 * CLOSEST:g} and {1e3 * FARTHEST:g} mm from the outline at the end"
        return LogError(path, f"expected a finger {expected}, found {1e3 * nearest:.3g} mm", push=record.index)
    if not abs(turned) < MAX_TURN:
        found = f"found {np.degrees(turned):.3g}: the motion capture jumped"
        return LogError(path, f"expected the object to turn by less than 60 degrees, {found}", push=record.index)
    row = {"time": record.force[0, 0], "pose_start": start, "pose_end": end, "turn": angle, "center": center}
    row |= {"hand_start": hand_start, "hand_end": hand_end, "gap_start": gaps[0], "gap_end": gaps[1]}
    return row


def _gaps(hand: Floats, pose: Floats) -> Floats:
    """Return the distances (2,) of the fingers' centers from the outline, negative inside, m."""
    sides = np.array([[0.0, HALF_SPACING], [0.0, -HALF_SPACING]])
    fingers = hand[:2] + sides @ rotation(hand[2]).T
    points = (fingers - pose[:2]) @ rotation(pose[2])
    corners = triangle_setup.VERTICES
    distances, inside = [], np.ones(2, bool)
    for a, b in itertools.pairwise([*corners, corners[0]]):
        along = np.clip((points - a) @ (b - a) / np.sum((b - a) ** 2), 0, 1)
        distances.append(np.linalg.norm(points - a - along[:, None] * (b - a), axis=1))
        inside &= (b - a)[0] * (points - a)[:, 1] - (b - a)[1] * (points - a)[:, 0] < 0  # vertices go clockwise
    return np.where(inside, -1, 1) * np.min(distances, axis=0)
