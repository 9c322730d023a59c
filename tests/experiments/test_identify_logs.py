"""From log files to parameters: which pushes are used, which are left out and why, and the content of the report."""

import contextlib
import csv
import json
import re
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_t

import pushjax as pj
from pushjax.cli import main as cli
from pushjax.datasets import LogError, Recordings, load_recordings
from pushjax.datasets.recordings import Recording
from pushjax.experiments._identify_report import described, warning
from pushjax.experiments.identify import Options, conditions
from pushjax.identification.pushes_of_recordings import screen
from pushjax.identification.uncertainty import bootstrap, profile_interval

WIDTH, HEIGHT, RADIUS, STEPS, MU = 0.1, 0.06, 0.005, 12, 0.3
COLUMNS = ("push", "hand_x", "hand_y", "object_x", "object_y", "object_theta", "force_x", "force_y")
INSET, NOISE = 0.001, 5e-5


@pytest.fixture(scope="module")
def block():
    return pj.Polygon.rectangle(WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def surface(block):
    return pj.fit_limit_surface(*pj.Support.uniform(block, 100).wrench_twist_pairs(jax.random.key(0), 400), degree=2)


@pytest.fixture(scope="module")
def rollouts(block, surface):
    """Simulate pushes of a block that is a millimeter smaller than stated."""
    rng = np.random.default_rng(0)
    side = rng.uniform(-0.6, 0.6, 16) * WIDTH / 2
    start = np.stack([rng.uniform(-0.1, 0.1, 16), rng.uniform(-0.1, 0.1, 16), rng.uniform(-3, 3, 16)], axis=1)
    c, s = np.cos(start[:, 2]), np.sin(start[:, 2])
    turn = np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)
    begin = np.stack([side, np.full(16, -HEIGHT / 2 - RADIUS - 0.001)], axis=1)
    along = np.stack([rng.uniform(-0.4, 0.4, 16), np.ones(16)], axis=1)
    local = begin[:, None] + np.linspace(0, 0.03, STEPS + 1)[None, :, None] * along[:, None]
    path = start[:, None, :2] + np.einsum("nij,nsj->nsi", turn, local)
    slider, hand = pj.Slider(block.inset(INSET), surface), pj.Hand.finger(RADIUS)
    push = jax.jit(jax.vmap(lambda start, path: pj.rollout(slider, hand, path, pose=start, friction=MU)))
    done = push(jnp.asarray(start), jnp.asarray(path))
    # the body frame's force halfway, expressed in the world frame
    middle = np.asarray((done.pose[:, 1:] + done.pose[:, :-1]) / 2)[..., 2]
    f = np.asarray(done.wrench)[..., :2]
    c, s = np.cos(middle), np.sin(middle)
    force = np.stack([c * f[..., 0] - s * f[..., 1], s * f[..., 0] + c * f[..., 1]], axis=-1)
    return path, np.asarray(done.pose), np.concatenate([force[:, :1], force], axis=1)


def write(path, pushes):
    with path.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(COLUMNS)
        for name, hand, pose, force in pushes:
            for row in zip(hand, pose, force, strict=True):
                out.writerow([name, *(repr(float(x)) for part in row for x in part)])
    return path


@pytest.fixture(scope="module")
def log(rollouts, tmp_path_factory):
    """Write a log of sixteen good pushes and five bad ones."""
    path, pose, force = rollouts
    pose = pose + NOISE * np.random.default_rng(1).normal(size=pose.shape) / [1, 1, 0.03]
    pushes = [(str(k), path[k], pose[k], force[k]) for k in range(16)]
    lost, away, still, jump, degrees = (pose[0].copy() for _ in range(5))
    lost[-1] = np.nan
    degrees[:, 2] = 57.3 * degrees[:, 2] + np.linspace(0, 100, STEPS + 1)
    jump[-1, 0] += 1.0
    pushes.append(("millimeters", 1e3 * path[0], pose[0], force[0]))
    pushes.append(("away", path[0] + [0.3, 0.0], np.repeat(away[:1], STEPS + 1, axis=0), force[0]))
    pushes.append(("still", np.repeat(path[0][:1], STEPS + 1, axis=0), still, force[0]))
    pushes.append(("jump", path[0], jump, force[0]))
    pushes.append(("degrees", path[0], degrees, force[0]))
    pushes.append(("lost", path[0], lost, force[0]))
    return write(tmp_path_factory.mktemp("logs") / "pushes.csv", pushes)


def arguments(log, out):
    given = ["--shape", f"rectangle:{WIDTH}x{HEIGHT}", "--radius", str(RADIUS), "--surface", "ellipsoid"]
    given += [
        "--steps",
        str(STEPS),
        "--parts",
        "3",
        "--inset",
        "0.002",
        "--out",
        str(out),
        "--json",
        str(out / "id.json"),
    ]
    return ["identify", str(log), *given]


@pytest.fixture(scope="module")
def report(log, tmp_path_factory):
    out = tmp_path_factory.mktemp("report")
    with (out / "stderr.txt").open("w") as file, contextlib.redirect_stderr(file):
        cli.main(arguments(log, out))
    return out, json.loads((out / "id.json").read_text())


@pytest.mark.slow
def test_a_csv_tells_friction_and_inset(report):
    out, record = report
    assert (record["experiment"], record["pushes"], record["failed_steps"]) == ("identify", 16, 0)
    friction, inset = record["rows"]
    assert (friction["label"], inset["label"], inset["unit"]) == ("friction", "inset", "mm")
    for row, truth in ((friction, MU), (inset, 1e3 * INSET)):
        low, high = row["interval"]
        assert low < row["estimate"] < high
        assert abs(row["estimate"] - truth) < 2 * (high - low)
        assert row["profile"][0] <= row["estimate"] <= row["profile"][1]
        assert row["determined"] > 0.9
    assert abs(friction["estimate"] - MU) < 0.01
    assert abs(inset["estimate"] - 1e3 * INSET) < 0.1
    assert 0.3 * NOISE < 1e-3 * record["sigma_mm"] < 2 * NOISE
    assert record["mean_mm"] < 0.2 < record["expected_mm"]
    for name in ("identify_pushes.png", "identify_residuals.png", "identify_profiles.png", "identify.html"):
        assert (out / name).stat().st_size > 5000
    assert pj.Identified.load(record["identified"]).friction.shape == ()


@pytest.mark.slow
def test_the_page_has_words_and_units(report):
    """The report has no key of the record; the whole record is below it, as JSON."""
    out, record = report
    page = (out / "identify.html").read_text()
    report = page[: page.index("<summary>Settings")]
    assert "_mm" not in report
    for words in (
        "friction at the contact",
        f"<td>{record['rows'][1]['estimate']:.4g}</td>",
        "<td>mm</td>",
        f"Without learning from them, the mean error is {record['expected_mm']:.2f} mm.",
        f"The objects moved {record['no_motion_mm']:.1f} mm.",
        record["problems"][0].split(":")[0],
    ):
        assert words in report
    assert "expected_mm" in page[page.index('<pre id="record">') :]


@pytest.mark.slow
def test_it_says_what_it_is_doing(report):
    """In a pipe, progress is printed as lines; a bar is for terminals."""
    out, _ = report
    lines = (out / "stderr.txt").read_text().splitlines()
    lines = [line for line in lines if not re.search(r": \d+ s", line)]  # what takes long is said again
    assert lines[0] == "pushjax: importing JAX"
    assert lines[1].startswith("pushjax: computing identify")
    assert lines[2] == "pushjax: reading 1 log"
    assert all(line.startswith("pushjax: left out: ") for line in lines[3:9])  # before the fit begins
    assert lines[9].startswith("pushjax: fitting to 16 pushes")
    assert "pushjax: interval of friction" in lines


@pytest.mark.slow
def test_what_cannot_be_used_is_named_and_counted(report):
    _, record = report
    reasons = (
        "in millimeters?",
        "never touches",
        "expected at least 0.0001 m",
        "tracker jumped",
        "in degrees?",
        "to be tracked in the last",
    )
    assert len(record["problems"]) == len(reasons)
    for index, reason in enumerate(reasons):
        found = [problem for problem in record["problems"] if reason in problem]
        assert len(found) == 1, reason
        assert f"push {16 + index}" in found[0]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"--shape": None}, "the logs do not tell the object's outline"),
        ({"--radius": None}, "--radius"),
        ({"--shape": "rectangle:100x60"}, "is it in millimeters?"),
        ({"--shape": "square:0.1"}, "or a CSV file of vertices; got 'square:0.1'"),
        ({"--shape": "disk:a"}, "got 'disk:a'"),
        ({"--hand": "two_fingers"}, "the hand has 2 numbers; a hand two_fingers has 4"),
        ({"--support": "middle"}, "--support: expected uniform, rim, or points"),
        ({"--friction": ["0.5", "0.2"]}, "friction must be (lowest, highest), not negative; got (0.5, 0.2)"),
        ({"--inset": "-1"}, "inset"),
        ({"--steps": "0"}, "steps must be at least 1; got 0"),
        ({"--forces": [], "--parts": "1"}, "--forces needs --parts"),
        ({"--parts": "12"}, "parts must be at least 1, and fewer than the 12 steps"),
    ],
)
def test_bad_options_end_with_one_line(log, tmp_path, capsys, changed, message):
    given = arguments(log, tmp_path)
    for option, value in changed.items():
        if option in given:
            at = given.index(option)
            del given[at : at + 2]
        if value is not None:
            given += [option, *(value if isinstance(value, list) else [value])]
    with pytest.raises(SystemExit) as ended:
        cli.main(given)
    assert ended.value.code == 1
    *before, error = capsys.readouterr().err.splitlines()
    assert message in error
    assert error.startswith("pushjax: ")
    assert all(re.match("pushjax: (importing JAX|computing|reading|left out)", line) for line in before)


def test_calibration_that_is_asked_for_is_looked_for(log, tmp_path, monkeypatch):
    class Asked(Exception):
        pass

    def identify(pushes, slider, hand, unknowns, *, contact_at_end):
        raise Asked(unknowns, contact_at_end)

    monkeypatch.setattr(pj, "identify", identify)
    with pytest.raises(Asked) as asked:
        cli.main([*arguments(log, tmp_path), "--frame-offset", "0.003", "--hand-offset", "0.004", "--contact-at-end"])
    unknowns, contact_at_end = asked.value.args
    assert contact_at_end
    assert unknowns.names == ("friction", "surface", "inset", "hand_offset", "frame_offset")
    assert (float(unknowns.frame_offset), float(unknowns.hand_offset)) == pytest.approx((0.003, 0.004), rel=1e-6)


def test_what_is_no_pushes_is_named(log, block, surface):
    slider, hand = pj.Slider(block, surface), pj.Hand.finger(RADIUS)
    with pytest.raises(TypeError, match="pushes: expected a Pushes; got a Recordings"):
        pj.identify(load_recordings(log), slider, hand)
    with pytest.raises(TypeError, match="log: expected a Recordings; got a str"):
        pj.Pushes.of("pushes.csv")
    with pytest.raises(TypeError, match="shape: expected a Shape; got a"):
        pj.Slider(surface, block)
    with pytest.raises(TypeError, match="surface: expected a LimitSurface; got a NoneType"):
        pj.Slider(block, None)


def test_units_of_what_is_found():
    assert described("frame_offset.1")[1] == described("hand_offset.0")[1] == "mm"
    assert described("frame_offset.2") == ("rotation of the object's frame", "°")
    assert described("friction[1]") == ("friction at the contact (friction[1])", "")


def test_too_few_pushes(rollouts, tmp_path, capsys):
    path, pose, force = rollouts
    few = write(tmp_path / "few.csv", [(str(k), path[k], pose[k], force[k]) for k in range(2)])
    with pytest.raises(SystemExit):
        cli.main(arguments(few, tmp_path))
    assert "at least 3 usable pushes; found 2" in capsys.readouterr().err


def test_a_file_in_degrees(rollouts, tmp_path):
    """With two rows per push, angles in degrees are not unwrapped, or they would look like any other angle."""
    path, pose, _ = rollouts
    ends = [0, STEPS]
    seen = pose[:, ends] * [1, 1, 57.3]
    seen[3, :, 2] = 5.0, 9.0
    rows = [(str(k), path[k][ends], seen[k], np.zeros((2, 2))) for k in range(16)]
    with pytest.raises(LogError, match=r"object_theta is up to .* rad; .*is it in degrees\? \(and 15 more"):
        load_recordings(write(tmp_path / "degrees.csv", rows))
    # a third of the pushes could only be in degrees; the others could be in radians, but are rejected with them
    seen[5:, :, 2] /= 57.3
    seen[:5, :, 2] = np.linspace(0, 60, 5)[:, None] + [0.0, 30.0]
    rows = [(str(k), path[k][ends], seen[k], np.zeros((2, 2))) for k in range(16)]
    with pytest.raises(LogError, match="15 more"):
        load_recordings(write(tmp_path / "some.csv", rows))


def test_what_explains_nothing_is_called_so():
    poor = {"mean_mm": 29.0, "expected_mm": 30.0, "no_motion_mm": 40.0}
    assert "29 mm in the mean, of 40 that the objects moved" in str(warning(poor))
    assert "are units, frames" in str(warning(poor | {"mean_mm": 50.0, "expected_mm": 80.0}))
    assert warning(poor | {"mean_mm": 20.0}) is None
    assert warning(poor | {"mean_mm": 5.0, "expected_mm": 5.0}) is None


def test_screening_of_nothing_usable(log, block):
    recordings = load_recordings(log)
    bad = replace(recordings, pushes=recordings.pushes[16:18])
    with pytest.raises(LogError, match=r"no usable push: .*and 1 more"):
        screen(bad, block, pj.Hand.finger(RADIUS))


def test_recordings_as_arrays(log, block, rollouts, surface):
    """Recordings give poses at equal parts of the path, and wrenches that agree with the surface."""
    path, pose, _ = rollouts
    recordings = screen(load_recordings(log), block, pj.Hand.finger(RADIUS))
    pushes = pj.Pushes.of(recordings, STEPS, parts=3, shape=block.inset(INSET))
    assert pushes.poses_between.shape == (16, 2, 3)
    np.testing.assert_allclose(pushes.path, path, atol=1e-12)
    np.testing.assert_array_equal(pushes.observed_steps, [4, 8, 12])
    np.testing.assert_allclose(pushes.poses, pose[:, [4, 8, 12]], atol=10 * NOISE / 0.03)
    there = np.any(np.asarray(pushes.wrench) != 0, axis=-1)
    assert there.mean() > 0.8
    metric = np.array([1, 1, float(surface.length)])
    one = np.asarray(jax.vmap(jax.vmap(surface.twist))(pushes.wrench))[there] * metric
    other = np.asarray(pushes.twist)[there] * metric
    cosine = np.sum(one * other, axis=-1) / np.linalg.norm(one, axis=-1) / np.linalg.norm(other, axis=-1)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    assert np.median(angle) < 5
    alone = pj.Pushes.of(recordings, STEPS)
    assert alone.poses_between.shape == (16, 0, 3)
    assert alone.wrench.shape == (16, 0, 3)


def test_a_push_that_was_seen_too_rarely_is_left_out(log, block):
    """One such push does not take the poses on the way, and the forces, from all others."""
    whole = load_recordings(log)
    tracked = np.isin(np.arange(STEPS + 1), (0, 5, STEPS))
    rare = [replace(push, pose=np.where(tracked[:, None], push.pose, np.nan)) for push in whole.pushes]
    recordings = replace(whole, pushes=(*whole.pushes[:3], rare[3], *whole.pushes[4:]))
    screened = screen(recordings, block, pj.Hand.finger(RADIUS), parts=3)
    assert "the object was tracked 1 times on the way; 3 parts need 2" in [p.message for p in screened.problems]
    assert pj.Pushes.of(screened, STEPS, parts=3, shape=block).wrench.shape == (15, 2 + 1, 3)
    untracked = replace(recordings, pushes=tuple(rare))
    assert len(screen(untracked, block, pj.Hand.finger(RADIUS), parts=3).pushes) == 16  # their final poses are used


def test_a_part_that_only_turns_tells_about_the_torque(block):
    """A couple turns the slider about its origin: the part has a wrench and a twist without translation."""
    angle = np.linspace(0, 0.1, STEPS + 1)
    pose = np.stack([0 * angle, 0 * angle, angle], axis=1)
    hand = 0.04 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    tangent = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    push = Recording(0, hand, pose, tangent)
    pushes = pj.Pushes.of(Recordings((push,), (), "made"), STEPS, parts=3, shape=block)
    assert np.all(np.asarray(pushes.has_pair))
    np.testing.assert_allclose(pushes.twist[0], np.tile([0, 0, 0.1 / 3], (3, 1)), atol=1e-6)


def test_logs_that_tell_less_than_others(log, block):
    """If several logs are used together, only what all of them contain is used."""
    whole = screen(load_recordings(log), block, pj.Hand.finger(RADIUS))
    ends = np.isin(np.arange(STEPS + 1), (0, STEPS))[:, None]
    pushes = tuple(replace(push, pose=np.where(ends, push.pose, np.nan)) for push in whole.pushes)
    unseen = replace(whole, pushes=pushes)
    unfelt = replace(whole, pushes=tuple(replace(p, force=None) for p in whole.pushes))
    options = Options(surface="ellipsoid", steps=STEPS, parts=3, forces=True)
    for recordings, shapes in (([whole], (2, 3)), ([whole, unseen], (0, 0)), ([unfelt, whole], (2, 0))):
        pushes, _ = conditions(recordings, block, options, 0)
        assert pushes.start.shape == (16 * len(recordings), 3)
        assert (pushes.poses_between.shape[-2], pushes.wrench.shape[-2]) == shapes


@pytest.mark.slow
def test_wrenches_alone_tell_a_surface(log, block, rollouts, surface):
    """Pushes have no weight here for the surface: it is identified from the wrenches alone."""
    recordings = screen(load_recordings(log), block, pj.Hand.finger(RADIUS))
    pushes = pj.Pushes.of(recordings, STEPS, parts=3, shape=block.inset(INSET))
    wrong = pj.Ellipsoid(np.asarray(surface.A) * np.outer([1, 1, 1.7], [1, 1, 1.7]), surface.length)
    slider, hand = pj.Slider(block, wrong), pj.Hand.finger(RADIUS)
    unknowns = pj.Unknowns((0.0, 1.0), surface_dof=5, inset=0.002)
    with_forces = pj.identify(pushes, slider, hand, unknowns)
    without = pj.identify(pj.Pushes.of(recordings, STEPS, parts=3), slider, hand, unknowns)
    assert float(with_forces.direction_sigma) < 0.1
    assert float(without.direction_sigma) == 0
    shape = with_forces.surface.A / with_forces.surface.A[0, 0]
    np.testing.assert_allclose(np.diagonal(shape), np.diagonal(surface.A / surface.A[0, 0]), rtol=0.1)
    assert abs(float(with_forces.friction) - MU) < 0.02
    known, unknown = (
        np.mean([v for k, v in f.variance_reduction.items() if k.startswith("surface")]) for f in (with_forces, without)
    )
    assert known > unknown


@pytest.fixture(scope="module")
def few(log, block):
    recordings = screen(load_recordings(log), block, pj.Hand.finger(RADIUS))
    return pj.Pushes.of(recordings, STEPS)


@pytest.fixture(scope="module")
def found(few, block, surface):
    slider, hand = pj.Slider(block, surface), pj.Hand.finger(RADIUS)
    return pj.identify(few, slider, hand, pj.Unknowns((0.0, 1.0), surface_dof=None, inset=0.002), sigma=NOISE)


@pytest.mark.slow
def test_profile_of_a_friction_that_is_only_bounded():
    """The finger never slides, so all frictions from some on explain the pushes alike, and the derivative is zero."""
    disk, rng = pj.Disk(0.04), np.random.default_rng(0)
    slider, hand = pj.Slider(disk, pj.Ellipsoid(np.diag([1.0, 1.0, 1.5]), 0.027)), pj.Hand.finger(RADIUS)
    around, turn = 2 * np.pi * (np.arange(16) + 0.5) / 16, rng.uniform(-0.15, 0.15, 16)
    begin = 0.0455 * np.stack([np.cos(around), np.sin(around)], axis=1)
    along = -np.stack([np.cos(around + turn), np.sin(around + turn)], axis=1)
    path = begin[:, None] + np.linspace(0, 0.03, STEPS + 1)[None, :, None] * along[:, None]
    push = jax.jit(jax.vmap(lambda path: pj.rollout(slider, hand, path, pose=jnp.zeros(3), friction=0.2).pose[-1]))
    end = np.asarray(push(path)) + rng.normal(size=(16, 3)) * [1e-4, 1e-4, 1e-4 / 0.027]
    pushes = pj.Pushes(np.zeros((16, 3)), path, end)
    found = pj.identify(pushes, slider, hand, pj.Unknowns((0.0, 1.0), surface_dof=None), sigma=1e-4)
    friction = found.profile(pushes, slider, hand, "friction")
    low, high = profile_interval(friction)
    assert 0.02 < low < 0.06  # with 0.05 the finger slides, with 0.1 it never does
    assert high == pytest.approx(1, abs=0.01)
    assert friction.log_posterior_drop[0] > 10


@pytest.mark.slow
def test_profile_is_the_loss_with_one_number_held(few, found, block, surface):
    slider, hand = pj.Slider(block, surface), pj.Hand.finger(RADIUS)
    friction = found.profile(few, slider, hand, "friction", points=3)
    assert friction.log_posterior_drop.min() == 0
    at = np.argmin(np.abs(friction.normal))
    assert friction.log_posterior_drop[at] < 1e-3
    assert friction.value[at] == pytest.approx(float(found.friction), abs=1e-9)
    # with little noise the result is nearly normal
    np.testing.assert_allclose(friction.log_posterior_drop, friction.normal, rtol=0.3, atol=0.05)
    low, high = profile_interval(friction, 0.9)
    expected = [float(end) for end in found.interval(0.9)["friction"]]
    np.testing.assert_allclose([low, high], expected, atol=0.3 * (expected[1] - expected[0]))
    with pytest.raises(ValueError, match="label must be one of friction, inset"):
        found.profile(few, slider, hand, "surface.0")


@pytest.mark.slow
def test_bootstrap(few, found, block, surface):
    slider, hand = pj.Slider(block, surface), pj.Hand.finger(RADIUS)
    estimates = found.bootstrap(jax.random.key(0), few, slider, hand, 40)
    z = bootstrap(jax.random.key(0), found, few, slider, hand, 40)
    np.testing.assert_array_equal(estimates.friction, jax.vmap(found.prior.parameters)(z).friction[:, 0])
    assert z.shape == (40, 2)
    laplace = np.sqrt(np.diagonal(found.covariance))
    assert np.all(np.abs(np.log(z.std(axis=0) / laplace)) < np.log(2.5))
    assert np.all(np.abs(z.mean(axis=0) - found.z) < 2 * laplace)


@pytest.mark.slow
def test_noise(few, found, block, surface, tmp_path):
    """Identify the noise of simulated pushes: the result predicts better than the initial guess."""
    slider, hand = pj.Slider(block, surface), pj.Hand.finger(RADIUS)
    friction = found.friction + 0.15 * jnp.array([[-1.0, 1.0]])
    values = (15.0, 3e-4, 4e-4, [0.01, 0.02], 4.0)
    dof, offset, sigma, relative, tails = (jnp.array(value) for value in values)
    score = jnp.array(0.0), jnp.zeros(1)
    known = pj.Noise(dof, friction[0], offset, sigma, relative, tails, found, *score, "sum_of_squares")
    many = jax.tree.map(lambda leaf: jnp.concatenate([leaf] * 5), few)
    drawn = known.predict(jax.random.key(1), many, slider, hand, 2)
    assert drawn.shape == (80, 2, 3)
    again = known.predict(jax.random.key(1), many, slider, hand, 2)
    np.testing.assert_array_equal(drawn, again)
    seen = pj.Pushes(many.start, many.path, drawn[:, 0])
    noise = pj.identify_noise(jax.random.key(2), found, seen, slider, hand, samples=16, steps=60)
    assert noise.history.shape == (60,)
    assert noise.score < noise.history[:5].mean()
    assert np.isfinite(noise.history).all()
    assert 10 < float(noise.surface_dof) < 30
    assert float(noise.student_dof) < 10
    assert noise.friction.shape == (2,)
    assert noise.model.friction.shape == (2,)
    noise.save(tmp_path / "noise.json")
    loaded = pj.Noise.load(tmp_path / "noise.json")
    for one, other in zip(jax.tree.leaves(noise), jax.tree.leaves(loaded), strict=True):
        np.testing.assert_array_equal(one, other)
    found.save(tmp_path / "found.json")
    with pytest.raises(ValueError, match="is not a noise file: its format is another"):
        pj.Noise.load(tmp_path / "found.json")
    likelihood: Any = "likelihood"
    with pytest.raises(ValueError, match="score must be one of energy, density; got 'likelihood'"):
        pj.identify_noise(jax.random.key(2), found, seen, slider, hand, score=likelihood)
    with pytest.raises(ValueError, match="samples must be at least 2"):
        pj.identify_noise(jax.random.key(2), found, seen, slider, hand, samples=1)


@pytest.mark.slow
def test_density(few, found, block, surface):
    """The density of predicted poses is correct, and the noise that maximizes it is near that of the pushes.

    If surface and friction are certain, the density is Student's t about the only pose.
    """
    slider, hand = pj.Slider(block, surface), pj.Hand.finger(RADIUS)
    sigma, relative, tails = 4e-4, np.array([0.05, 0.15]), 4.0
    sure = jnp.stack([found.friction, found.friction])
    numbers = (jnp.array(value) for value in (1e9, 1e-9, sigma, [0.0, 0.0], tails))
    dof, offset, spread, none, nu = numbers
    known = pj.Noise(dof, sure, offset, spread, none, nu, found, jnp.array(0.0), jnp.zeros(1), "sum_of_squares")
    ends = found.predict(few, slider, hand).pose[:, -1]
    off = 1e-3 * np.random.default_rng(0).normal(size=ends.shape) / [1, 1, float(found.length)]
    off[:, 2] += 2 * np.pi * np.arange(len(off))  # full turns do not count
    density = known.log_density(jax.random.key(0), pj.Pushes(few.start, few.path, ends + off), slider, hand, 3)
    apart = off * [1, 1, float(found.length)]
    apart[:, 2] = float(found.length) * (off[:, 2] - 2 * np.pi * np.arange(len(off)))
    expected = multivariate_t(np.zeros(3), sigma**2 * np.eye(3), tails).logpdf(apart)
    np.testing.assert_allclose(density, expected, atol=0.05)
    # with an error that grows with the slider's translation and rotation
    growing = eqx.tree_at(lambda noise: noise.relative_error, known, jnp.array(relative))
    density = growing.log_density(jax.random.key(0), pj.Pushes(few.start, few.path, ends + off), slider, hand, 3)
    moved = np.asarray(ends - few.start) * [1, 1, float(found.length)]
    shares = relative[[0, 0, 1]] * moved
    assert np.all(np.max(np.abs(shares), axis=0) > 2 * sigma)
    shapes = (np.eye(3) * (sigma**2 + share @ share) for share in shares)
    expected = [multivariate_t(np.zeros(3), each, tails).logpdf(a) for each, a in zip(shapes, apart, strict=True)]
    np.testing.assert_allclose(density, expected, atol=0.05)
    # centered on what was identified from other pushes
    other = eqx.tree_at(lambda f: f.z, found, found.z + 0.1)
    moved = eqx.tree_at(lambda noise: noise.friction, known, sure + jnp.array([-0.05, 0.05]))
    again = moved.transferred_to(other)
    np.testing.assert_allclose(again.friction, other.friction + jnp.array([-0.05, 0.05]), atol=1e-12)
    np.testing.assert_array_equal(again.identified.z, other.z)
    twice = jnp.stack([moved.friction, moved.friction])
    several = eqx.tree_at(lambda noise: noise.friction, moved, twice)  # two conditions with the same spread
    np.testing.assert_array_equal(several.transferred_to(other).friction, again.friction)
    # identify the noise again
    friction = found.friction + 0.1 * jnp.array([-1.0, 1.0])
    values = (jnp.array(30.0), friction, jnp.array(2e-4))
    truth = eqx.tree_at(lambda noise: (noise.surface_dof, noise.friction, noise.hand_offset), growing, values)
    # Short pushes are needed too: the two kinds of error can be distinguished only by comparing short and long pushes.
    first = few.path[:, :1]
    short = eqx.tree_at(lambda pushes: pushes.path, few, first + 0.2 * (few.path - first))
    many = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *[few] * 3, *[short] * 2)
    seen = pj.Pushes(many.start, many.path, truth.predict(jax.random.key(1), many, slider, hand, 1)[:, 0])
    noise = pj.identify_noise(jax.random.key(2), found, seen, slider, hand, samples=16, steps=90, score="density")
    assert noise.score < noise.history[:5].mean()
    assert 0.5 * sigma < float(noise.sigma) < 2 * sigma
    shares = np.asarray(noise.relative_error)
    assert np.all((0.5 * relative < shares) & (shares < 2 * relative))
    # for other pushes from the same truth, the density of the identified noise is only a little lower than that of the
    # truth
    fresh = truth.predict(jax.random.key(3), many, slider, hand, 1)[:, 0]
    other = pj.Pushes(many.start, many.path, fresh)
    best, ours, first = (
        float(jnp.mean(one.log_density(jax.random.key(4), other, slider, hand, 64))) for one in (truth, noise, known)
    )
    assert first + 1 < best
    assert best - 0.3 < ours
