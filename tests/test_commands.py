"""The command line: what it prints, draws and writes, and how it ends on bad input."""

import json
import subprocess
import sys

import matplotlib.image
import numpy as np
import pytest

from pushjax import cli
from pushjax.experiments import table2

# Of the paper's figure: the mean over conditions, and any one condition. 35 of 50 pushes are there, split at random.
MEAN, CELL = 1.05, 1.25


def read(path):
    record = json.loads(path.read_text())
    assert {"experiment", "versions", "machine", "settings"} <= record.keys()
    return record


def test_demo(tmp_path, capsys):
    cli.main(["demo", "--out", str(tmp_path / "out"), "--json", str(tmp_path / "demo.json")])
    record = read(tmp_path / "demo.json")
    ellipsoid, quartic = record["rows"]
    assert (ellipsoid["model"], quartic["model"]) == ("ellipsoid", "quartic")
    assert quartic["fit_angle_deg"] < 2 < ellipsoid["fit_angle_deg"]
    for row in record["rows"]:
        x, y, theta = row["pose"]
        # pushed 45 mm along x above the centre: it moves on, and turns clockwise
        assert 0.03 < x < 0.05
        assert -0.03 < y < 0
        assert -0.6 < theta < -0.2
        assert sum(row["modes"].values()) == 100
        assert row["first_failure"] == -1
    assert 1 < record["apart_mm"] < 10
    printed = capsys.readouterr().out
    assert "quartic" in printed
    for name in ("limit_surfaces.png", "motion_cone.png", "push.png"):
        image = matplotlib.image.imread(tmp_path / "out" / name)
        assert image.shape[0] > 300
        assert image[..., :3].std() > 0.02  # not blank


def test_demo_repeats_to_the_bit(tmp_path):
    from pushjax.experiments import demo

    first, second = demo.run(seed=3), demo.run(seed=3)
    assert all(np.array_equal(a["pose"], b["pose"]) for a, b in zip(first["rows"], second["rows"], strict=True))
    other = demo.run(seed=4)
    assert not np.array_equal(first["rows"][1]["pose"], other["rows"][1]["pose"])


@pytest.fixture(scope="module")
def table(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("table2")
    arguments = ["reproduce", "table2", "--data", str(data), "--steps", "30"]
    cli.main([*arguments, "--out", str(folder), "--json", str(folder / "table2.json")])
    assert (folder / "table2.png").exists()
    return read(folder / "table2.json")


def test_table2_is_as_good_as_the_paper(table):
    assert len(table["cells"]) == 16
    for model in ("quartic", "ellipsoid"):
        mine = [cell for cell in table["cells"] if cell["model"] == model]
        assert np.mean([c["mean_mm"] for c in mine]) <= MEAN * np.mean([c["paper_mm"] for c in mine])
    for cell in table["cells"]:
        low = cell["mean_mm"] - cell["ci95_bootstrap_mm"]
        assert cell["mean_mm"] <= CELL * cell["paper_mm"] or low <= cell["paper_mm"], cell
        # the measured motion, which the model has no part in
        paper = table2.PAPER_NO_MOTION_MM[cell["surface"]][table2.OBJECTS.index(cell["object"])]
        assert cell["no_motion_mm"] == pytest.approx(paper, abs=0.8)


def test_table2_no_push_fails_or_blows_up(table):
    for cell in table["cells"]:
        assert cell["failed_steps"] == 0
        assert cell["worst_mm"] < 25  # the object moves 10 to 35 mm
        assert 0 < cell["friction"] < 0.8
        assert (cell["splits"], cell["pushes"]) == (10, 35)
        assert 0 < cell["ci95_mm"] < cell["mean_mm"]


def test_jam(tmp_path, capsys):
    cli.main(["reproduce", "jam", "--out", str(tmp_path), "--json", str(tmp_path / "jam.json")])
    record = json.loads((tmp_path / "jam.json").read_text())
    assert record["verdicts"] == {"0.25": "MOVING", "0.55": "JAMMED"}
    assert [row["model"] for row in record["rows"]] == ["ellipsoid", "quartic"]
    for row in record["rows"]:
        assert row["threshold"] == pytest.approx(0.4)
        assert 0.9989 < row["last_moving"] / row["threshold"] < row["jams_from"] / row["threshold"] < 1.0011
        assert row["statuses"] == ["JAMMED", "MOVING"]
    assert (tmp_path / "jam.png").stat().st_size > 10_000
    assert "jams from 0.4004" in capsys.readouterr().out


def test_bench_contacts(monkeypatch):
    """Two thousand problems of two contacts, judged by the independent solver."""
    from pushjax.experiments import bench_contacts

    monkeypatch.setattr(bench_contacts, "MODELS", {"quartic": 4})
    kept = []
    record = bench_contacts.run(
        scale=0.0, contacts=(2,), starts=20, keep=lambda so_far: kept.append(len(so_far["rows"]))
    )
    assert kept == [len(record["rows"])] == [1]
    for row in record["rows"]:
        assert row["problems"] == 2000
        assert row["wrong"] == row["not_converged"] == 0
        assert row["solved"] + row["jammed"] == 2000
        assert row["jammed"] > 100
        assert row["worst_violation"] < 1e-8
    assert "wrong" in bench_contacts.summary(record)


def test_bench_of_too_many_contacts(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["bench", "contacts", "--contacts", "2", "9"])
    assert stop.value.code == 1
    assert "contacts must be from 1 to 8; got 9" in capsys.readouterr().err


def test_options_that_would_do_nothing_are_refused(capsys):
    for options in (["jam", "--steps", "10"], ["squeeze", "--data", "."], ["two-finger", "--geometry", "measured"]):
        with pytest.raises(SystemExit) as stop:
            cli.main(["reproduce", *options])
        assert stop.value.code == 1
        assert f"{options[1]} is for " in capsys.readouterr().err


def test_table2_wants_data(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PUSHJAX_DATA", str(tmp_path / "nowhere"))
    with pytest.raises(SystemExit) as stop:
        cli.main(["reproduce", "table2"])
    assert stop.value.code == 1
    error = capsys.readouterr().err
    assert error.startswith("pushjax: no recorded pushes found")
    assert error.count("\n") == 1
    with pytest.raises(SystemExit):
        cli.main(["reproduce", "table2", "--data", str(tmp_path)])
    assert "hardboard_3pts1.npz" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["demmo"], ["reproduce", "table3"], ["demo", "--sed", "1"], []])
def test_wrong_words_end_with_a_usage_error(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(arguments)
    assert stop.value.code == 2
    assert capsys.readouterr().err


def test_import_changes_nothing_global():
    """No configuration of JAX's, no drawing library, no command line on import."""
    program = (
        "import sys, jax; before = dict(jax.config.values); import pushjax; "
        "changed = [k for k, v in before.items() if jax.config.values[k] != v]; assert not changed, changed; "
        "assert not {'matplotlib', 'tyro', 'rich'} & set(sys.modules), 'imported too much'"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_float32_is_the_default():
    """Without x64 everything runs in float32, without a warning."""
    program = (
        "import warnings; warnings.simplefilter('error', UserWarning); import numpy as np, pushjax as pj; "
        "surface = pj.Ellipsoid(np.eye(3), 0.03); slider = pj.Slider(pj.Polygon.rectangle(0.09, 0.09), surface); "
        "push = pj.rollout(slider, pj.Hand.finger(0.004), pj.line((-0.06, 0.01), (0, 0.01), 20), "
        "pose=np.zeros(3), friction=0.25); assert push.pose.dtype == 'float32', push.pose.dtype; "
        "assert push.pose[-1, 0] > 0.03; assert push.mode.dtype == push.status.dtype == 'int8'"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
