"""Table 2 on few pushes: what can be computed is, and every other cell says why it cannot be."""

from dataclasses import replace

import numpy as np
import pytest
from drawn import legend

import pushjax as pj
from pushjax.datasets import load_recordings
from pushjax.experiments import table2, tables
from pushjax.experiments._slider_options import MODELS

# Pushes of two conditions; the folder has no other. Half of fourteen are as many pairs as an ellipsoid needs, and
# fewer than a quartic.
PUSHES = {"3pts1": 14, "3pts2": 1}
SPLITS = 3


@pytest.fixture(scope="module")
def few(converted, tmp_path_factory):
    """Return the record of table 2 of a few pushes on hardboard, and its folder."""

    def load(folder, surface, name):
        if surface != "hardboard" or name not in PUSHES:
            return None
        log = load_recordings(folder / f"{surface}_{name}.npz")
        return replace(log, pushes=log.pushes[: PUSHES[name]])

    out = tmp_path_factory.mktemp("table2")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(table2, "load", load)
        patch.setattr(tables, "SPLITS", SPLITS)
        return table2.run(converted, out=out, steps=15, method=("ideal", "wrench_twist")), out


@pytest.mark.slow
def test_cells_say_why_they_have_no_figure(few):
    missing = {
        (cell["method"], cell["model"], cell["object"]): cell["missing"]
        for cell in few[0]["cells"]
        if cell["surface"] == "hardboard" and cell["mean_mm"] is None
    }
    for method in ("ideal", "wrench_twist"):
        for model in ("quartic", "ellipsoid"):
            assert missing.pop((method, model, "3pts2")) == "1 push, needs 2"
            assert missing.pop((method, model, "3pts3")) == missing.pop((method, model, "3pts4")) == "no log"
    assert missing == {("wrench_twist", "quartic", "3pts1"): "7 pairs, needs 15"}
    assert {cell.get("missing") for cell in few[0]["cells"] if cell["surface"] == "plywood"} == {"no log"}


@pytest.mark.slow
def test_other_cells_and_means_are_of_the_few_pushes(few, converted):
    record, _ = few
    log = load_recordings(converted / "three_point_push" / "hardboard_3pts1.npz")
    moved = (log.end - log.start)[:14]
    deviations = [1e3 * (np.hypot(*each[:2]) + log.length * abs(each[2])) for each in moved]
    figures = [cell for cell in record["cells"] if cell["mean_mm"] is not None]
    expected = {("ideal", "quartic"), ("ideal", "ellipsoid"), ("wrench_twist", "ellipsoid")}
    assert {(cell["method"], cell["model"]) for cell in figures} == expected
    for cell in figures:
        assert (cell["pushes"], cell["splits"]) == (14, SPLITS)
        assert min(deviations) < cell["no_motion_mm"] < max(deviations)
        assert cell["mean_mm"] < 0.5 * cell["no_motion_mm"]
        rows = [row for row in record["means"] if (row["method"], row["model"]) == (cell["method"], cell["model"])]
        assert [row["surface"] for row in rows] == ["hardboard", "all"]
        assert all((row["mean_mm"], row["conditions"]) == (cell["mean_mm"], 1) for row in rows)
    assert {(row["method"], row["model"]) for row in record["means"]} == expected


@pytest.mark.slow
def test_summary_of_few_pushes(few):
    _, cells, means, note, *_ = table2.summary(few[0])
    hardboard = [row for row in cells.rows if row[1:3] == ["quartic", "hardboard"]]
    words = {(method, name): text for method, _, _, name, text, *_ in hardboard}
    assert [words["ideal", name] for name in ("3pts2", "3pts3", "3pts4")] == ["1 push, needs 2", "no log", "no log"]
    assert words["wrench_twist", "3pts1"] == "7 pairs, needs 15"
    assert {row[3] for row in means.rows} == {"1"}
    assert "could not be computed" in note


@pytest.mark.slow
def test_picture_of_few_pushes(few):
    record, out = few
    assert (out / "table2_wrench_twist.png").exists()
    mine = [cell for cell in record["cells"] if cell["method"] == "wrench_twist"]
    (axes,) = tables.table_figure(mine, "Few").axes
    words = [text.get_text() for text in axes.texts]
    assert words.count("no log") == 12
    assert words.count("1 push, needs 2") == 2
    assert words.count("7 pairs, needs 15") == 1
    assert np.sum(np.isfinite([bar.get_height() for bar in axes.patches])) == 1
    assert "quartic, this run" in legend(axes)


def test_few_or_no_pushes():
    train = np.zeros((2, 40), bool)
    train[:, :20] = True
    for method in ("ideal", "wrench_twist", "identified"):
        assert table2.reason_missing(train, method, "quartic") is None
        assert table2.reason_missing(None, method, "ellipsoid") == "no log"
        assert table2.reason_missing(train[:, :1], method, "ellipsoid") == "1 push, needs 2"
    for count, model in ((15, "quartic"), (6, "ellipsoid")):
        few, enough = (np.arange(40)[None] < each for each in (count - 1, count))
        assert table2.reason_missing(enough, "wrench_twist", model) is None
        assert table2.reason_missing(few, "wrench_twist", model) == f"{count - 1} pairs, needs {count}"
        assert table2.reason_missing(few, "identified", model) is None
        with pytest.raises(ValueError, match=f"{count - 1} pairs; a surface .* needs at least {count}"):
            pj.fit_limit_surface(np.ones((count - 1, 3)), np.ones((count - 1, 3)), 1.0, degree=MODELS[model])


def test_every_split_learns_from_some_and_predicts_others():
    for count in (2, 3, 7):
        for share in (0.4, 0.5):
            chosen = tables.training_masks(np.arange(count), share, np.random.default_rng(0))
            assert np.all((chosen.sum(axis=1) > 0) & (chosen.sum(axis=1) < count))


def test_a_folder_without_any_condition(tmp_path):
    (tmp_path / "three_point_push").mkdir()
    with pytest.raises(ValueError, match=r"hardboard_3pts1\.npz, or published logs named .* found none"):
        table2.run(tmp_path)


def test_published_logs_take_the_place_of_a_file(data, converted):
    ours = table2.load(converted / "three_point_push", "plywood", "3pts2")
    originals = table2.load(data / "raw" / "three_point_push", "plywood", "3pts2")
    assert (originals.surface, originals.object) == (ours.surface, ours.object) == ("plywood", "3pts2")
    assert len(originals) == len(ours)
    assert table2.load(data / "raw" / "three_point_push", "plywood", "3pts9") is None


def test_paths_end_where_the_robot_was_told_to_stop(data, converted):
    name = "three_point_push/hardboard_3pts1.npz"
    log = load_recordings(converted / name)
    with np.load(data / name) as archive:
        expected = archive["tip_end_commanded_xy"][archive["valid"]]
    pushes = table2.recorded(log, table2.GEOMETRIES["measured"], 10)
    np.testing.assert_allclose(pushes.path[:, -1], expected, rtol=0, atol=3e-8)  # the curated path is float32
    np.testing.assert_array_equal(pushes.end, log.end)
