"""Logs in the layout of the MIT data set: three streams, brought to one clock."""

import json

import numpy as np
import pytest
from recorded import SPEED, START, fails, mit_log, same, tables, write_streams

from pushjax.datasets import load_recordings
from pushjax.datasets.streams import MAX_GAP

MIT_JSONS = (
    "motion_surface=plywood_shape=hex_a=0_v=150_i=1.000_s=0.000_t=-0.349.json",
    "motion_surface=plywood_shape=rect1_a=0_v=100_i=0.000_s=0.000_t=0.000.json",
    "motion_surface=plywood_shape=rect1_a=0_v=100_i=1.000_s=0.900_t=-1.396.json",
    "motion_surface=plywood_shape=rect1_a=0_v=100_i=2.000_s=0.000_t=0.349.json",
    "motion_surface=plywood_shape=rect1_a=0_v=100_i=3.000_s=0.100_t=1.047.json",
)
# The curated arrays are the raw numbers minus a time: only the last digit may differ.
EXACT = 1e-12
# Linear motion, interpolated at other times of the order of a second.
LINEAR = 1e-9
KINDS = pytest.mark.parametrize("suffix", [".json", ".h5", ".hdf5"])


@KINDS
def test_streams_are_brought_to_the_tips_stamps(tmp_path, suffix):
    found = load_recordings(mit_log(tmp_path, tables(), suffix))
    (push,) = found.pushes
    assert (found.problems, push.index) == ((), 0)
    # the object is tracked until 0.8 s, the tip from 0 s
    time = np.linspace(0.0, 0.8, 33)
    np.testing.assert_allclose(push.time, time, atol=1e-6)
    np.testing.assert_allclose(push.hand, np.column_stack([0.3 + SPEED * time, 0 * time]), atol=LINEAR)
    assert push.tracked.all()
    # time stamps of 2.4e-7 s resolution, at up to 1.4e9
    expected = np.column_stack([0.4 + SPEED * time, 0.01 * time, 3.0 + 0.5 * time])
    np.testing.assert_allclose(push.pose - push.pose[0] + expected[0], expected, atol=1e-6)
    np.testing.assert_allclose(np.cos(push.pose[:, 2] - expected[:, 2]), 1.0, atol=1e-9)
    force = push.force
    assert force is not None
    assert np.isnan(force[:4]).all()
    np.testing.assert_allclose(force[4:], np.column_stack([2 * time, -1 - time])[4:], atol=1e-6)


def test_raw_logs_agree_with_the_curated_arrays(data, converted, tmp_path):
    archives = {}
    for path in (data / "mit_push_full").glob("*.npz"):
        with np.load(path) as archive:
            archives[str(archive["source_file"])] = path.name, dict(archive)
    for name in MIT_JSONS:
        raw = data / "raw" / "mit_push_full" / name
        file, content = archives[name]
        ours, curated = load_recordings(raw), load_recordings(converted / "mit_push_full" / file)
        (push,) = ours.pushes
        same(push, curated.pushes[0], EXACT)
        # the name of the original tells the object
        np.testing.assert_allclose(ours.vertices, content["vertices_body"], atol=2e-7)
        assert ours.length == pytest.approx(float(content["rho"]), abs=2e-7)
        assert (ours.tip_radius, ours.surface, ours.object) == (content["tip_radius"], curated.surface, curated.object)
        # the common window of tip and object, without losing a row
        time, seen = content["tip_t"], content["object_t"]
        inside = (time >= seen[0]) & (time <= seen[-1])
        np.testing.assert_allclose(push.time, time[inside], atol=EXACT)
        np.testing.assert_allclose(push.hand, content["tip_xy"][inside], atol=EXACT)
        for column in range(3):
            expected = np.interp(time[inside], seen, content["object_pose"][:, column])
            np.testing.assert_allclose(push.pose[:, column], expected, atol=EXACT)
        streams = {key: np.array(rows) for key, rows in json.loads(raw.read_text()).items()}
        same(load_recordings(write_streams(tmp_path / "log.h5", streams)).pushes[0], push, 0.0)


def test_force_on_the_object_does_work_on_it(converted):
    """The logged wrench is the reaction: with its sign the tip would brake the object.

    This does not hold in every log, because the sensor has an offset and the tip sometimes slides along the object.
    """
    power = []
    for path in sorted((converted / "mit_push_full").glob("*.npz")):
        (push,) = load_recordings(path).pushes
        velocity = np.gradient(push.hand, push.time, axis=0)
        power.append(np.nanmean(np.sum(velocity * push.force, axis=1)))
    assert np.mean(np.array(power) > 0) > 0.8


def test_stamps_of_a_tracker_may_jitter_but_not_jump(tmp_path):
    made = tables()
    body = made["object_pose"]
    body[[10, 11]] = body[[11, 10]]
    (push,) = load_recordings(mit_log(tmp_path, made)).pushes
    same(push, load_recordings(mit_log(tmp_path, tables())).pushes[0], 0.0)
    body[20:, 0] -= 0.3
    fails(mit_log(tmp_path, made), "stamps of object_pose that do not go back by more than 0.05 s", "in row 20")
    for name in ("tip_pose", "ft_wrench"):
        made = tables()
        made[name][[5, 6]] = made[name][[6, 5]]
        fails(mit_log(tmp_path, made), f"stamps of {name} that do not go back at all", "in row 6")


def test_an_object_lost_for_long_is_not_tracked(tmp_path):
    lost = np.linspace(-0.3, 0.8, 34)
    lost = lost[(lost < 0.15) | (lost > 0.15 + MAX_GAP)]
    (push,) = load_recordings(mit_log(tmp_path, tables(body=lost))).pushes
    before, after = lost[lost < 0.15][-1], lost[lost > 0.15][0]
    hidden = (push.time > before + 1e-6) & (push.time < after - 1e-6)
    np.testing.assert_array_equal(push.tracked, ~hidden)
    assert np.isnan(push.pose[hidden]).all()
    assert push.tracked[[0, -1]].all()
    assert 0 < hidden.sum() < len(hidden)
    # samples that contain no numbers are left out
    made = tables()
    made["object_pose"][(made["object_pose"][:, 0] > START + 0.15) & (made["object_pose"][:, 0] < START + 0.66), 1:] = (
        np.nan
    )
    np.testing.assert_array_equal(load_recordings(mit_log(tmp_path, made)).pushes[0].tracked, push.tracked)


def test_a_push_begins_and_ends_where_the_object_is_tracked(tmp_path):
    lost = np.array([-0.3, 0.31, 0.33, 0.5, 0.6, 1.5])
    (push,) = load_recordings(mit_log(tmp_path, tables(body=lost))).pushes
    assert push.tracked.all()
    assert push.time is not None
    np.testing.assert_allclose(push.time[[0, -1]], [0.325, 0.6], atol=1e-6)


def test_streams_that_do_not_overlap(tmp_path):
    later = np.linspace(5.0, 6.0, 20)
    text = (
        "expected streams that overlap in time, found tip_pose from 0.000 s to 1.000 s and {} from 5.000 s to 6.000 s"
    )
    fails(mit_log(tmp_path, tables(body=later)), text.format("object_pose"))
    fails(mit_log(tmp_path, tables(wrench=later)), text.format("ft_wrench"))
    fails(
        mit_log(tmp_path, tables(body=np.array([-1.0, 0.01]))), "tracked at two samples of tip_pose at least, found 0"
    )
    made = tables()
    made["object_pose"][:, 1:] = np.nan
    fails(mit_log(tmp_path, made), "tracked at two samples of tip_pose at least, found 0")


@KINDS
@pytest.mark.parametrize(
    ("name", "row", "column", "words"),
    [
        ("tip_pose", 7, 1, "for hand_x, found none in row 7 of tip_pose"),
        ("ft_wrench", 0, 2, "for force_y, found none in row 0 of ft_wrench"),
        ("object_pose", 3, 0, "for time, found none in row 3 of object_pose"),
        ("object_pose", 3, 3, "for object_theta (or none of"),
    ],
)
def test_streams_with_nan(tmp_path, suffix, name, row, column, words):
    made = tables()
    made[name][row, column] = np.nan
    error = fails(mit_log(tmp_path, made, suffix), "no usable push", words)
    assert error.push == 0


@pytest.mark.parametrize("suffix", [".json", ".h5"])
def test_logs_of_another_layout(tmp_path, suffix):
    made = tables()
    fails(
        mit_log(tmp_path, {**made, "tip_pose": made["tip_pose"][:, :3]}, suffix), "tip_pose to have rows of 4 numbers"
    )
    fails(mit_log(tmp_path, {**made, "tip_pose": made["tip_pose"][:0]}, suffix), "tip_pose")
    fails(mit_log(tmp_path, {**made, "tip_pose": made["tip_pose"][:1]}, suffix), "at least two samples in tip_pose")
    fails(
        mit_log(tmp_path, {"poses": made["tip_pose"]}, suffix), "found no tip_pose, object_pose, ft_wrench, but poses"
    )
    fails(mit_log(tmp_path, {}, suffix), "but nothing")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[1, 2]", "expected a JSON object with tip_pose, object_pose, ft_wrench, found a list"),
        ('{"tip_pose": [[1, 2, 3, 4], [1, 2]], "object_pose": [], "ft_wrench": []}', "something else: row 1 is [1, 2]"),
        ('{"tip_pose": "x", "object_pose": [], "ft_wrench": []}', "tip_pose to have rows of 4 numbers"),
        ('{"tip_pose": {"t": 1}, "object_pose": [], "ft_wrench": []}', "tip_pose to have rows of 4 numbers"),
        ("[" * 100_000, "expected a JSON log of a push, found something else"),
        ("\ufeff{", "expected a JSON log of a push, found something else"),
        (" ", "expected a JSON log of a push, found something else"),
    ],
)
def test_json_that_is_no_log(tmp_path, text, words):
    path = tmp_path / "log.json"
    path.write_text(text)
    fails(path, words)
