"""Read original logs of the aluminum triangle pushed with two fingers.

Each session has two files, `exp_<time>_sensor<N>.txt` and `exp_<time>_pushaction<N>.txt`. The first is laid out as a
log of one finger (`records`). The second has the number of pushes, and then for each the type of its motion and eleven
numbers (`Action`). Push i follows action i; the shorter of the two files counts. World frame, body frame and hand frame
are those of `two_finger`.

Only the object's poses are taken from the sensor's file. The hand's path is the commanded one, from the measured start
pose, because the robot's own stream ends after half of the rotation.
"""

from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pushjax.datasets import triangle_setup
from pushjax.datasets.mit_shapes import nearest_on_outline
from pushjax.datasets.push_log import Floats, LogError, nothing_usable, rotation, wrap_angle
from pushjax.datasets.records import ParseError, Record, check_quaternions, read_records
from pushjax.datasets.triangle import body_pose
from pushjax.datasets.two_finger import TwoFingerLog, stick_deviation

HALF_SPACING = 0.025  # m, from the middle of the hand to the center of each finger
# At the end one finger touches the outline, as far as the motion capture and an unknown outline tell: its center is
# between these distances from the outline, m. If not, the motion capture jumped or the hand did not reach the object.
MIN_END_GAP, MAX_END_GAP = -0.002, 0.004
MAX_TURN = np.radians(60)  # no action turns the object so far; the motion capture jumped
NUMBERS_PER_LINE = (3, 3, 3, 2)  # on the lines of an action after its type


class Action(NamedTuple):
    """A planned push, in the body frame of the object before the push."""

    turns: bool  # whether the hand turns; else it moves straight
    contact: Floats  # (2,), point midway between the fingers when they touch, m
    target: Floats  # (2,), center of rotation, m; or unit vector of the straight motion
    approach: Floats  # (2,), unit vector of the approach
    amount: float  # angle of the rotation, rad, or length of the straight motion, m
    closing: float  # distance from the point midway between the fingers to `contact` at the start, along `approach`, m


def load_two_finger_logs(folder: str | PathLike[str]) -> TwoFingerLog:
    """Read all sessions in a folder of one arrangement of the supports.

    A push becomes a problem if its records are damaged, if neither finger is at the outline at the end, or if the
    object turns by more than 60 degrees.

    Args:
        folder: The folder, whose name tells the arrangement (`triangle_setup.support_from_name`).

    Returns:
        The usable pushes, in the order of time, and the problems of the others. The surface is unknown.

    Raises:
        LogError: If there are no such files, if a file of actions is damaged, or if no push is usable.
    """
    path = Path(folder).expanduser()
    sensors = sorted(path.glob("exp_*_sensor*.txt"))
    if not sensors:
        raise LogError(path, "expected logs exp_…_sensor….txt, found none")
    name, points = triangle_setup.support_from_name(path / "any") or (triangle_setup.UNKNOWN, np.empty((0, 2)))
    rows: list[dict] = []
    problems: list[LogError] = []
    actions: list[Action] = []
    for sensor in sensors:
        planned = list(_read_actions(sensor.with_name(sensor.name.replace("_sensor", "_pushaction"))))
        for record in read_records(sensor):
            if isinstance(record, LogError):  # of a push, or of the whole file
                if record.push is None or record.push < len(planned):
                    problems.append(record)
            elif record.index < len(planned):
                action = planned[record.index]
                found = _convert_push(sensor, record, action)
                if isinstance(found, LogError):
                    problems.append(found)
                else:
                    rows.append(found)
                    actions.append(action)
    if not rows:
        raise nothing_usable(path, problems)
    order = np.argsort([row["time"] for row in rows])
    columns = {key: np.array([rows[k][key] for k in order]) for key in rows[0]}
    group = np.unique([_nominal_numbers(actions[k]) for k in order], axis=0, return_inverse=True)[1].reshape(-1)
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
        source=str(path),
    )


def _read_actions(path: Path) -> Iterator[Action]:
    """Iterate over the actions of a file of planned pushes."""
    try:
        lines = path.read_text("utf-8", errors="replace").splitlines()
    except OSError as error:
        raise LogError(path, f"expected planned pushes, but cannot read the file: {error.strerror or error}") from error
    size = 1 + len(NUMBERS_PER_LINE)
    for index in range(1, len(lines) - size + 1, size):
        kind = lines[index].strip()
        try:
            values = [np.array(line.split(), float) for line in lines[index + 1 : index + size]]
            valid = all(len(v) == n and np.isfinite(v).all() for v, n in zip(values, NUMBERS_PER_LINE, strict=True))
            # the approach and, unless the push turns, the target are directions
            valid &= values[2][:2].any() and ("Rotation" in kind or values[1][:2].any())
        except ValueError:
            valid = False
        if not kind or not valid:
            message = "expected the type of a push and 3, 3, 3 and 2 numbers on the lines after it"
            raise LogError(path, message, line=index + 1)
        yield _parse_action(kind, values)


def _parse_action(kind: str, values: list[Floats]) -> Action:
    """Return the action of a type and its lines of numbers, which are in mm and degrees, in the corner frame."""
    turns = "Rotation" in kind
    contact, target, approach = (point[:2] for point in values[:3])
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


def _nominal_numbers(action: Action) -> Floats:
    """Return the numbers (9,) of an action, which are equal for its repetitions."""
    return np.concatenate([[action.turns, action.amount, action.closing], *action[1:4]])


def _convert_push(path: Path, record: Record, action: Action) -> dict | LogError:
    """Return one row of the arrays of `TwoFingerLog`, by name, or the error that says why the push is not usable."""
    if not len(record.force):
        return LogError(path, "expected force samples, found none", push=record.index)
    try:
        check_quaternions(record.poses[:, 3:], record.line, "object pose")
    except ParseError as fault:
        return LogError(path, str(fault), push=record.index, line=fault.line)
    start, end = (body_pose(row) for row in record.poses)
    object_turn = float(wrap_angle(end[2] - start[2]))
    end[2] = start[2] + object_turn
    world_from_body = rotation(start[2])
    position = start[:2] + world_from_body @ (action.contact - action.closing * action.approach)
    heading = np.arctan2(*(world_from_body @ action.approach)[::-1])
    if action.turns:
        center, angle = start[:2] + world_from_body @ action.target, action.amount
        end_position = center + rotation(angle) @ (position - center)
    else:
        center, angle = np.full(2, np.nan), 0.0
        end_position = position + world_from_body @ (action.closing * action.approach + action.amount * action.target)
    hand_start, hand_end = np.append(position, heading), np.append(end_position, heading + angle)
    gaps = [_finger_gaps(*poses) for poses in ((hand_start, start), (hand_end, end))]
    nearest = float(np.min(gaps[1]))
    if not MIN_END_GAP < nearest < MAX_END_GAP:
        expected = f"between {1e3 * MIN_END_GAP:g} and {1e3 * MAX_END_GAP:g} mm from the outline at the end"
        return LogError(path, f"expected a finger {expected}, found {1e3 * nearest:.3g} mm", push=record.index)
    if not abs(object_turn) < MAX_TURN:
        found = f"found {np.degrees(object_turn):.3g}: the motion capture jumped"
        return LogError(path, f"expected the object to turn by less than 60 degrees, {found}", push=record.index)
    row = {"time": record.force[0, 0], "pose_start": start, "pose_end": end, "turn": angle, "center": center}
    row |= {"hand_start": hand_start, "hand_end": hand_end, "gap_start": gaps[0], "gap_end": gaps[1]}
    return row


def _finger_gaps(hand: Floats, pose: Floats) -> Floats:
    """Return the signed distances (2,) of the fingers' centers from the outline, m, for poses of hand and object."""
    offsets = np.array([[0.0, HALF_SPACING], [0.0, -HALF_SPACING]])
    fingers = hand[:2] + offsets @ rotation(hand[2]).T
    return nearest_on_outline(triangle_setup.VERTICES, (fingers - pose[:2]) @ rotation(pose[2]))[0]
