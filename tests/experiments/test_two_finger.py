"""Two-finger pushes: the loader, the measure of sticking, and the experiment on the real pushes."""

import matplotlib as mpl

mpl.use("Agg")

import json
import shutil

import matplotlib.image
import numpy as np
import pytest

import pushjax as pj
from pushjax.datasets import LogError, Recording, Recordings, load_recordings
from pushjax.experiments import tables, two_finger
from pushjax.experiments._record import write_json

EXACT = 1e-12
# Upper limit of the experiment's error for each object, as a fraction of the motion.
RATIO = 0.25
OBJECTS = {"3pts1": 3, "3pts3": 3, "patch": 0}


def log_of(start, end, hands, actions):
    """Return a log of pushes of which the ends are known: poses (n, 3) of the object, and (n, 2, 3) of the hand."""
    pushes = [
        Recording(k, np.column_stack([hand, [0.05, 0.05]]), np.array(ends), about={"action": action})
        for k, (*ends, hand, action) in enumerate(zip(start, end, hands, actions, strict=True))
    ]
    return Recordings(tuple(pushes), (), "made", length=0.07)


def test_stuck_objects_do_not_move_in_the_hand(rng):
    hands, angle, shift = rng.normal(size=(2, 5, 3)), rng.normal(size=(2, 5)), rng.normal(size=(5, 2))
    hands[..., 2] += 2 * np.pi * np.array([[0], [1]])  # a full turn is not a motion
    c, s = np.cos(hands[..., 2]), np.sin(hands[..., 2])
    x, y = shift.T
    where = hands[..., :2] + np.stack([c * x - s * y, s * x + c * y], axis=-1)
    start, end = np.concatenate([where, hands[..., 2:] + angle[:1, :, None]], axis=-1)
    log = log_of(start, end, hands.swapaxes(0, 1), range(5))
    np.testing.assert_allclose(two_finger.stick_deviation(log, end), 0, atol=EXACT)
    np.testing.assert_allclose(two_finger.stick_deviation(log, end + np.array([0, 0, 0.1])), 0.007, atol=EXACT)


def test_real_logs(data, converted):
    """The curated measure of sticking equals ours, and paths begin, pass and end where the hand does."""
    for name, supports in OBJECTS.items():
        log = load_recordings(converted / "two_finger_push" / f"{name}.npz")
        with np.load(data / "two_finger_push" / f"{name}.npz") as archive:
            known = archive["stick_deviation"][archive["valid"].astype(bool)]
        np.testing.assert_allclose(two_finger.stick_deviation(log, log.end), known, atol=EXACT)
        assert log.support_points.shape == (supports, 2)
        np.testing.assert_allclose(pj.Pushes.of(log, 3).path, [push.hand[::40] for push in log.pushes], atol=EXACT)


def test_repeats_of_an_action_stay_on_one_side_of_a_split(rng):
    action = np.arange(10) // 2
    train = tables.training_masks(action, two_finger.TRAIN_SHARE, rng)
    assert train.shape == (tables.SPLITS, 10)
    for trains in train:
        assert 0 < trains.sum() < 10
        assert not set(action[trains]) & set(action[~trains])
    errors = rng.uniform(size=train.shape)
    expected = [np.nan if each.all() else errors[~each, k].mean() for k, each in enumerate(train.T)]
    np.testing.assert_allclose(tables.per_push(errors, ~train), expected, rtol=EXACT)


@pytest.fixture(scope="module")
def record(converted, tmp_path_factory):
    if not (converted / "two_finger_push").is_dir():
        pytest.skip("no two_finger_push folder")
    folder = tmp_path_factory.mktemp("two_finger")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(two_finger, "FRICTIONS", np.linspace(0.2, 0.5, 4))
        patch.setattr(two_finger, "RADII", (0.0, 0.001))
        found = two_finger.run(converted, out=folder, steps=30)
    write_json(found, folder / "record.json")
    return json.loads((folder / "record.json").read_text())


@pytest.mark.slow
def test_predicts_the_real_pushes(record):
    assert [cell["object"] for cell in record["cells"]] == list(OBJECTS)
    for cell in record["cells"]:
        assert cell["mean_mm"] < RATIO * cell["no_motion_mm"], cell["object"]
        assert cell["ratio"] == pytest.approx(cell["mean_mm"] / cell["no_motion_mm"])
        assert cell["median_mm"] < cell["mean_mm"]
        assert cell["stick_agreement"] > cell["stick_by_chance"] + 0.05
        assert 0.2 <= cell["friction"] <= 0.5
        assert sum(cell["stuck"].values()) == pytest.approx(1)
        assert cell["failed_steps"] == 0  # of 30 steps times 8 settings, in float64
        assert cell["jammed_pushes"] == 0
        assert cell["pushes"] == {"3pts1": 95, "3pts3": 298, "patch": 138}[cell["object"]]


@pytest.mark.slow
def test_repeats_bound_what_can_be_predicted(record):
    for cell in record["cells"]:
        repeats = cell["repeats"]
        assert 0 < repeats["floor_mm"] < repeats["model_mm"]
        assert repeats["pushes"] >= 50
        assert 0.8 < repeats["floor_agreement"] <= 1


@pytest.mark.slow
def test_draws_and_sums_up(record):
    assert len(record["pictures"]) == 1 + len(OBJECTS)
    for picture in record["pictures"]:
        image = matplotlib.image.imread(picture)
        assert image.shape[0] > 300
        assert image[..., :3].std() > 0.02  # not blank
    _, table, *_ = two_finger.summary(record)
    assert [row[0] for row in table.rows] == list(OBJECTS)


def test_refuses_another_model(tmp_path):
    with pytest.raises(ValueError, match="model"):
        two_finger.run(tmp_path, model="cubic")
    with pytest.raises(LogError, match=r"expected 3pts1\.npz, or a folder 3pts1 of published logs"):
        two_finger.run(tmp_path)


def test_published_logs_take_the_place_of_an_archive(data, converted, tmp_path):
    """Without an archive, a folder with the name of the arrangement is read, as `pushjax data triangle` leaves it."""
    session = data / "raw/two_finger_push/30_90_30_30_30_90"
    shutil.copytree(session, tmp_path / "3pts3")
    log = two_finger.load(tmp_path, "3pts3")
    assert (len(log), log.object) == (1, "3pts3")
    assert len(two_finger.load(converted / "two_finger_push", "3pts3")) > 100
