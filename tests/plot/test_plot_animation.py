"""Animations: the content of a frame, where forces act, and that the files play."""

import base64
import dataclasses
import importlib.util
import io
import re
import shutil
from itertools import pairwise
from pathlib import Path

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pytest
from PIL import Image

mpl.use("Agg")

import matplotlib.pyplot as plt
from drawn import MM, RADIUS, SIDE

import pushjax as pj
from pushjax import plot

LENGTH = 0.024


@pytest.fixture(scope="module")
def block():
    return pj.Polygon.rectangle(SIDE, SIDE)


@pytest.fixture(scope="module")
def finger():
    return pj.Hand.finger(RADIUS)


@pytest.fixture(scope="module")
def push(block, finger):
    """Return a simulated push: the finger arrives, slides along the side, and rotates the square."""
    slider = pj.Slider(block, pj.Ellipsoid(jnp.eye(3), LENGTH))
    path = pj.line((-0.042, 0.012), (-0.007, 0.012), 20)
    return pj.rollout(slider, finger, path, pose=jnp.array([0.0, 0.0, 0.1]), friction=0.15)


def recorded(points: int = 8, dof: int = 2) -> plot.RecordedPush:
    t = np.linspace(0, 1, points)[:, None]
    pose = t * np.array([0.03, -0.01, 0.4])
    return plot.RecordedPush(pose, np.concatenate([pose[:, :2] - [0.035, 0], np.zeros((points, dof - 2))], axis=1))


def lines(axes) -> dict[str, np.ndarray]:
    return {line.get_label(): np.asarray(line.get_xydata()) for line in axes.lines}


def square(pose) -> np.ndarray:
    corners = SIDE / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return MM * (corners @ np.array([[c, s], [-s, c]]) + np.asarray(pose)[:2])


def torque(point, force):
    return point[..., 0] * force[..., 1] - point[..., 1] * force[..., 0]


def test_forces_of_a_finger_add_up_to_the_wrench(push):
    found = plot.contact_forces(push)
    moving = np.asarray(push.status) == pj.Status.MOVING
    assert moving.sum() > 10
    wrench = np.asarray(push.wrench)
    np.testing.assert_allclose(found.force.sum(axis=1), wrench[:, :2], atol=1e-9)
    np.testing.assert_allclose(torque(found.point, found.force).sum(axis=1), wrench[:, 2], atol=1e-9 * LENGTH)
    np.testing.assert_allclose(found.point[moving, 0, 0], -SIDE / 2, atol=1e-6)
    free = np.asarray(push.status) == pj.Status.FREE
    assert free.any()
    assert not found.force[free].any()


def test_forces_along_normal_and_tangent():
    """The first number of a force is along the normal, the second along the normal turned by +90 degrees."""
    turned = np.array([np.cos(0.3), np.sin(0.3)])
    normal = np.array([[0.0, -1.0], [1.0, 0.0], turned])
    point, force = np.array([[0.01, 0.03], [-0.03, 0.0], [0.0, -0.02]]), np.array([[3.0, 0.2], [1.0, -0.1], [2.0, 0.5]])
    given = trajectory(np.zeros((2, 3)), np.zeros((2, 2)), force[None], point[None], normal[None])
    found = plot.contact_forces(given)
    np.testing.assert_allclose(found.point[0], point)
    wanted = [[0.2, -3.0], [1.0, -0.1], 2 * turned + 0.5 * np.array([-turned[1], turned[0]])]
    np.testing.assert_allclose(found.force[0], wanted)


def trajectory(pose, configuration, force, point=None, normal=None) -> pj.Trajectory:
    """Return a trajectory of given forces; without contacts, these are at the origin, with normals of zero."""
    steps, contacts = force.shape[:2]
    point, normal = (np.zeros_like(force) if part is None else part for part in (point, normal))
    still = np.zeros((steps, 3))
    mode = jnp.full((steps, contacts), pj.ContactMode.STICKING, jnp.int8)
    parts = (jnp.asarray(part) for part in (pose, configuration, still, still, force, point, normal))
    return pj.Trajectory(*parts, mode=mode, status=jnp.zeros(steps, jnp.int8), overlap=jnp.zeros(steps))


def test_frames_show_the_push(block, finger, push):
    moving = plot.animate(block, finger, {"push": push}, frames=21)
    (axes,) = moving.figure.axes
    assert (axes.get_title(), axes.get_xlabel(), axes.get_ylabel()) == ("push", "x / mm", "y / mm")
    found = plot.contact_forces(push)
    largest = np.linalg.norm(found.force, axis=-1).max()
    (arrows,) = axes.collections
    for k in (0, 3, 12, 20):
        moving.draw(k)
        drawn, pose = lines(axes), np.asarray(push.pose[k])
        np.testing.assert_allclose(drawn["slider"], square(pose), atol=1e-9)
        np.testing.assert_allclose(drawn["start"], square(push.pose[0]), atol=1e-9)
        np.testing.assert_allclose(drawn["its centroid"], MM * np.asarray(push.pose[: k + 1, :2]), atol=1e-9)
        center = MM * np.asarray(push.configuration[k])
        np.testing.assert_allclose(np.linalg.norm(drawn["hand"] - center, axis=1), MM * RADIUS, atol=1e-9)
        status = pj.Status(int(push.status[k - 1])).name.lower()
        (words,) = axes.texts
        assert words.get_text().startswith(status if k else "")
        if k >= 12:
            mode = pj.ContactMode(int(push.mode[k - 1, 0])).name.lower().replace("_", " ")
            assert words.get_text() == f"moving: {mode}"
            force = found.force[k - 1, 0]
            c, s = np.cos(pose[2]), np.sin(pose[2])
            world = np.array([c * force[0] - s * force[1], s * force[0] + c * force[1]])
            np.testing.assert_allclose([arrows.U[0], arrows.V[0]], 0.4 * MM * 0.0657 / largest * world, rtol=2e-2)
            at = np.asarray(arrows.get_offsets())[0]
            assert np.linalg.norm(at - center) == pytest.approx(MM * RADIUS, abs=0.2)  # half a step of slip
        elif k == 0:
            assert np.isnan(np.ma.filled(arrows.get_offsets(), np.nan)).all()  # no arrow
    text = [entry.get_text() for entry in moving.figure.legends[0].get_texts()]
    assert text == ["start", "slider", "its centroid", "hand", f"force on the slider, up to {largest:.2g} N"]


def test_nothing_leaves_the_range_or_is_cut_off(block, finger, push):
    moving = plot.animate(block, finger, {"a push": push, "again": push}, frames=5)
    pictures = moving.pictures()
    figure = moving.figure
    renderer_box = figure.bbox
    for axes in figure.axes:
        for text in (axes.title, *axes.texts, axes.xaxis.label):
            box = text.get_window_extent()
            assert box.y1 <= renderer_box.y1 + 1
            assert box.y0 >= renderer_box.y0 - 1
        assert not axes.title.get_window_extent().overlaps(axes.texts[0].get_window_extent())
    (x0, x1), (y0, y1) = figure.axes[0].get_xlim(), figure.axes[0].get_ylim()
    assert figure.axes[1].get_xlim() == (x0, x1)
    for pose in np.asarray(push.pose):
        corners = square(pose)
        assert x0 < corners[:, 0].min()
        assert corners[:, 0].max() < x1
        assert y0 < corners[:, 1].min()
        assert corners[:, 1].max() < y1
    assert len({picture.size for picture in pictures}) == 1


@pytest.mark.slow
def test_one_push_in_a_flat_panel_has_its_legend_and_words_whole(block, finger, push):
    away = np.linspace(0, 0.12, 8)[:, None] * np.array([1.0, 0.0, 0.0])
    moving = plot.animate(block, finger, push, measured={"": away})
    figure = moving.figure
    (axes,) = figure.axes
    assert np.ptp(axes.get_xlim()) > 2 * np.ptp(axes.get_ylim())
    moving.pictures()
    boxes = [part.get_window_extent() for part in (*figure.legends, *axes.texts, axes.xaxis.label)]
    for box in boxes:
        assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= box.y0 < box.y1 <= figure.bbox.y1
    for one, other in pairwise(boxes):
        assert not one.overlaps(other)


def test_a_recording_beside_its_simulation(block, finger, push):
    """Both go from start to end, whatever their number of points; a recording has no forces and no text."""
    real = recorded(points=8)
    over = np.linspace([0, 0, 0], [0.02, 0, 0.2], 5)
    moving = plot.animate(block, finger, {"real": real, "model": push}, measured={"model": over}, frames=9)
    left, right = moving.figure.axes
    moving.draw(8)
    np.testing.assert_allclose(lines(left)["slider"], square(real.pose[-1]), atol=1e-9)
    np.testing.assert_allclose(lines(right)["slider"], square(push.pose[-1]), atol=1e-9)
    np.testing.assert_allclose(lines(right)["measured"], square(over[-1]), atol=1e-9)
    assert left.texts[0].get_text() == ""
    assert not left.collections
    assert not lines(left)["measured"].size
    assert "measured" in [entry.get_text() for entry in moving.figure.legends[0].get_texts()]
    moving.draw(4)
    np.testing.assert_allclose(lines(right)["slider"], square(push.pose[10]), atol=1e-9)
    np.testing.assert_allclose(lines(right)["measured"], square(over[2]), atol=1e-9)


def test_pads_and_words_of_several_contacts(block):
    """Pads are outlines; steps after the last motion are left out, except the one that says why it stopped."""
    jaw = pj.Hand.parallel_jaw(0.02, 0.01)
    opening = np.concatenate([np.linspace(SIDE + 0.01, SIDE, 6), np.full(30, SIDE)])
    configuration = np.column_stack([np.zeros((36, 3)), opening])
    given = trajectory(np.zeros((36, 3)), configuration, np.zeros((35, 4, 2)))
    mode = np.zeros((35, 4), np.int8)
    mode[4] = pj.ContactMode.STICKING, pj.ContactMode.SLIDING_LEFT, pj.ContactMode.SLIDING_LEFT, 0
    status = np.where(np.arange(35) < 5, pj.Status.MOVING, pj.Status.GRASPED).astype(np.int8)
    given = dataclasses.replace(given, mode=jnp.asarray(mode), status=jnp.asarray(status))
    moving = plot.animate(block, jaw, given, forces=False, frames=7)
    (axes,) = moving.figure.axes
    moving.draw(5)
    assert axes.texts[0].get_text() == "moving: 1 sticking, 2 sliding left"
    pads = [np.asarray(line.get_xydata()) for line in axes.lines if line.get_label() == "hand"]
    assert [len(pad) for pad in pads] == [5, 5]
    assert pads[0][:, 1].min() == pytest.approx(MM * SIDE / 2, abs=1e-3)
    assert pads[1][:, 1].max() == pytest.approx(-MM * SIDE / 2, abs=1e-3)
    moving.draw(6)
    assert axes.texts[0].get_text() == "held by every finger"
    assert not axes.collections


def test_cloud(block, finger):
    rng = np.random.default_rng(0)
    ends = np.array([0.03, 0.0, 0.2]) + 0.003 * rng.normal(size=(12, 3))
    poses = np.linspace(0, 1, 5)[None, :, None] * ends[:, None]
    path = np.linspace([-0.035, 0.0], [0.0, 0.0], 5)
    moving = plot.animate_cloud(block, finger, path, poses, title="cloud", frames=5)
    (axes,) = moving.figure.axes
    assert (axes.get_title(), axes.get_xlabel(), axes.get_ylabel()) == ("cloud", "x / mm", "y / mm")
    assert [entry.get_text() for entry in moving.figure.legends[0].get_texts()] == ["centroids", "start", "12 pushes"]
    for k in (1, 4):
        moving.draw(k)
        outlines, ways = axes.collections
        np.testing.assert_allclose(outlines.get_segments(), [square(pose) for pose in poses[:, k]], atol=1e-9)
        np.testing.assert_allclose(ways.get_segments(), MM * poses[:, : k + 1, :2], atol=1e-9)
        np.testing.assert_allclose(lines(axes)["centroids"], MM * poses[:, k, :2], atol=1e-9)
    with pytest.raises(ValueError, match=r"trajectories have shape \(12, 4, 3\); expected \(pushes, 5, 3\)"):
        plot.animate_cloud(block, finger, path, poses[:, :4])


def test_refuses(block, finger):
    with pytest.raises(ValueError, match="there is none"):
        plot.animate(block, finger, {})
    with pytest.raises(ValueError, match="no push is named 'b'"):
        plot.animate(block, finger, {"a": recorded()}, measured={"b": np.zeros((2, 3))})
    with pytest.raises(ValueError, match="frames must be at least 2; got 1"):
        plot.animate(block, finger, recorded(), frames=1)
    real = recorded()
    with pytest.raises(ValueError, match="push has 8 poses, but 7 configurations"):
        plot.animate(block, finger, plot.RecordedPush(real.pose, real.configuration[1:]))


@pytest.mark.slow
def test_gif(tmp_path, block, finger):
    """The GIF repeats forever, all frames differ, it pauses on the last one, and it is small."""
    moving = plot.animate(block, finger, {"a": recorded(61), "b": recorded(61)}, frames=60, seconds=3)
    path = plot.save(moving, tmp_path / "new" / "push.gif")
    assert path.stat().st_size < 1e6
    assert not plt.fignum_exists(moving.figure.number)
    with Image.open(path) as film:
        assert film.n_frames == 60
        assert film.info["loop"] == 0
        shown, durations = [], []
        for k in range(60):
            film.seek(k)
            durations.append(film.info["duration"])
            shown.append(np.asarray(film.convert("RGB"), float))
    assert durations[:-1] == [50] * 59
    assert durations[-1] == 1200
    assert min(np.abs(a - b).max() for a, b in pairwise(shown)) > 50
    ink = [np.any(np.abs(frame - to_rgb255(plot.GREEN)).max(axis=-1) < 12) for frame in (shown[0], shown[-1])]
    assert ink == [True, True]  # the palette keeps the hand's color


def to_rgb255(color) -> np.ndarray:
    return 255 * np.array(mpl.colors.to_rgb(color))


def test_page(tmp_path, block, finger):
    """The page contains every frame and the player, and loads nothing from the network."""
    moving = plot.animate(block, finger, recorded(), frames=6, seconds=1.2)
    text = plot.save(moving, tmp_path / "a push.html").read_text()
    assert "http" not in text
    assert "<title>a push</title>" in text
    assert not re.search(r"(src|href)=", text.replace("image.src =", ""))
    for part in ("<button", 'type="range"', 'max="5"', "setTimeout(next, k === last ? 1200.0 : 200.0)", "onclick"):
        assert part in text, part
    frames = [Image.open(io.BytesIO(base64.b64decode(code))) for code in re.findall(r'^"(.+?)",?$', text, re.M)]
    assert len(frames) == 6
    assert len({frame.size for frame in frames}) == 1
    assert np.any(np.asarray(frames[0].convert("RGB")) != np.asarray(frames[5].convert("RGB")))
    assert "$" not in re.sub(r'^".+?",?$', "", text, flags=re.M)  # no placeholder is left
    fragment = plot.animate(block, finger, recorded(), frames=2)._repr_html_()
    assert fragment.startswith("<figure")


def test_no_film_without_ffmpeg(tmp_path, block, finger):
    with mpl.rc_context({"animation.ffmpeg_path": str(tmp_path / "nothing")}):
        with pytest.raises(RuntimeError, match=r"a.mp4: .mp4 needs the program ffmpeg; .gif and .html need nothing"):
            plot.save(plot.animate(block, finger, recorded(), frames=2), tmp_path / "a.mp4")


@pytest.mark.skipif(shutil.which("sh") is None, reason="the stand-in is a shell script")
def test_film(tmp_path, block, finger):
    """Every frame reaches the program, and the last one stays; a stand-in for ffmpeg writes its input to a file."""
    program = tmp_path / "ffmpeg"
    program.write_text('#!/bin/sh\nfor last; do :; done\ncat > "$last"\n')
    program.chmod(0o755)
    moving = plot.animate(block, finger, recorded(), frames=5, seconds=0.5)
    with mpl.rc_context({"animation.ffmpeg_path": str(program)}):
        raw = plot.save(moving, tmp_path / "a.mp4").read_bytes()
    width, height = (int(100 * inches) for inches in moving.figure.get_size_inches())
    assert len(raw) == pytest.approx((5 + 12) * width * height * 4, rel=0.02)  # even sizes; ten frames a second
    whole = np.frombuffer(raw, np.uint8).reshape(17, -1)
    assert np.any(whole[0] != whole[4])
    np.testing.assert_array_equal(whole[4], whole[16])


def test_other_suffixes(tmp_path, block, finger):
    with pytest.raises(ValueError, match=r"a.avi: motion is written as .gif, .html, .mp4; got .avi"):
        plot.save(plot.animate(block, finger, recorded(), frames=2), tmp_path / "a.avi")


def test_pictures_of_the_documentation(capsys, monkeypatch, tmp_path):
    """An unknown picture is an error in one line that lists the names, and the script draws what is asked for."""
    where = Path(__file__).parents[2] / "docs" / "pictures.py"
    spec = importlib.util.spec_from_file_location("pictures", where)
    pictures = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(pictures)
    monkeypatch.setattr("sys.argv", ["pictures.py", "pusch"])
    with pytest.raises(SystemExit):
        pictures.main()
    last = capsys.readouterr().err.splitlines()[-1]
    names = "push, grasp, stochastic, pusht, limit_surfaces, motion_cone, real"
    assert f"no picture is named pusch; there are {names}" in last
    monkeypatch.setattr(pictures, "MOVING", {"push": lambda: plot.animate(PLAIN, pj.Hand.finger(RADIUS), recorded(4))})
    monkeypatch.setattr(pictures, "STILL", {})
    monkeypatch.setattr("sys.argv", ["pictures.py", "--to", str(tmp_path), "--suffix", ".html"])
    pictures.main()
    assert re.search(r"drew .*push.html, \d+ kB", capsys.readouterr().out)
    assert [path.name for path in tmp_path.iterdir()] == ["push.html"]


PLAIN = pj.Polygon.rectangle(SIDE, SIDE)
