"""Animations: the content of a frame, and the files that they are written to."""

import re
import shutil
from dataclasses import replace
from itertools import pairwise

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pytest
from PIL import Image

mpl.use("Agg")

import matplotlib.pyplot as plt
from drawn import MM, RADIUS, SIDE, in_world, legend
from pushes import trajectory

import pushjax as pj
from pushjax import plot
from pushjax.datasets import Recording
from pushjax.plot.style import GREEN

BLOCK, FINGER = pj.Polygon.rectangle(SIDE, SIDE), pj.Hand.finger(RADIUS)


@pytest.fixture(scope="module")
def push():
    """Return a simulated push: the finger arrives, slides along the side, and rotates the square."""
    slider = pj.Slider(BLOCK, pj.Ellipsoid(jnp.eye(3), 0.024))
    path = pj.line((-0.042, 0.012), (-0.007, 0.012), 20)
    return pj.rollout(slider, FINGER, path, pose=jnp.array([0.0, 0.0, 0.1]), friction=0.15)


def recorded(points: int = 8) -> Recording:
    pose = np.linspace(0, 1, points)[:, None] * np.array([0.03, -0.01, 0.4])
    return Recording(0, pose[:, :2] - [0.035, 0], pose)


def lines(axes) -> dict[str, np.ndarray]:
    return {line.get_label(): np.asarray(line.get_xydata()) for line in axes.lines}


def test_several_sliders():
    """The force of a contact is drawn in the frame of the slider that it names."""
    pose = np.array([[[0, 0, 0], [0.1, 0, 0]], [[0.01, 0, 0], [0.1, 0.02, np.pi / 2]]])
    one = trajectory(
        pose,
        [[0.0, -0.1], [0.0, -0.1]],
        force=[[[2.0, 0.0]]],
        contact_point=[[[0.01, 0.0]]],
        contact_normal=[[[1.0, 0.0]]],
    )
    one = replace(one, twist=jnp.zeros((1, 2, 3)), contacts=(("slider 1", "slider 0"),))
    moving = plot.animate((BLOCK, BLOCK), FINGER, one, frames=2)
    (axes,) = moving.figure.axes
    moving.draw(1)
    places = [line.get_xydata() for line in axes.lines]
    for expected in (in_world(pose[1, 0]), in_world(pose[1, 1])):
        assert any(place.shape == expected.shape and np.allclose(place, expected) for place in places)
    (arrows,) = axes.collections
    np.testing.assert_allclose(arrows.get_offsets(), [[100.0, 30.0]], atol=1e-9)
    np.testing.assert_allclose(arrows.U, 0, atol=1e-9)
    assert arrows.V[0] > 0
    picture = plot.push_figure((BLOCK, BLOCK), FINGER, {"two": one})
    drawn = [line.get_xydata() for line in picture.axes[0].lines]
    assert any(place.shape == expected.shape and np.allclose(place, expected) for place in drawn)
    plt.close("all")


def test_frames_show_the_push(push):
    moving = plot.animate(BLOCK, FINGER, {"push": push}, frames=21)
    (axes,) = moving.figure.axes
    assert (axes.get_title(), axes.get_xlabel(), axes.get_ylabel()) == ("push", "x / mm", "y / mm")
    found = plot.contact_forces(push)
    largest = np.linalg.norm(found.force, axis=-1).max()
    (arrows,) = axes.collections
    for k in (0, 3, 12, 20):
        moving.draw(k)
        drawn, pose = lines(axes), np.asarray(push.pose[k])
        np.testing.assert_allclose(drawn["slider"], in_world(pose), atol=1e-9)
        np.testing.assert_allclose(drawn["start"], in_world(push.pose[0]), atol=1e-9)
        np.testing.assert_allclose(drawn["its centroid"], MM * np.asarray(push.pose[: k + 1, :2]), atol=1e-9)
        center = MM * np.asarray(push.configuration[k])
        np.testing.assert_allclose(np.linalg.norm(drawn["hand"] - center, axis=1), MM * RADIUS, atol=1e-9)
        (words,) = axes.texts
        assert words.get_text().startswith(pj.Status(int(push.status[k - 1])).name.lower() if k else "")
        if k >= 12:
            mode = pj.ContactMode(int(push.mode[k - 1, 0])).name.lower().replace("_", " ")
            assert words.get_text() == f"moving: {mode}"
            c, s = np.cos(pose[2]), np.sin(pose[2])
            world = np.array([[c, -s], [s, c]]) @ found.force[k - 1, 0]
            np.testing.assert_allclose([arrows.U[0], arrows.V[0]], 0.4 * MM * 0.0657 / largest * world, rtol=2e-2)
            at = np.asarray(arrows.get_offsets())[0]
            assert np.linalg.norm(at - center) == pytest.approx(MM * RADIUS, abs=0.2)  # half a step of slip
        elif k == 0:
            assert np.isnan(np.ma.filled(arrows.get_offsets(), np.nan)).all()  # no arrow
    force = f"force on the slider, up to {largest:.2g} N"
    assert legend(moving.figure) == ["start", "slider", "its centroid", "hand", force]


@pytest.mark.parametrize("panels", [1, 2])
def test_nothing_leaves_the_range_or_is_cut_off(tmp_path, push, panels):
    """All text is inside of the figure and apart, also in one flat panel with a legend of two rows."""
    away = np.linspace(0, 0.12, 8)[:, None] * np.array([1.0, 0.0, 0.0])
    shown = {"": push} if panels == 1 else {"a push": push, "again": push}
    moving = plot.animate(BLOCK, FINGER, shown, measured={"": away} if panels == 1 else None, frames=3)
    plot.save(moving, tmp_path / "push.gif")
    figure, box = moving.figure, moving.figure.bbox
    for axes in figure.axes:
        (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
        assert (x0, x1) == figure.axes[0].get_xlim()
        corners = np.concatenate([in_world(pose) for pose in np.asarray(push.pose)])
        assert np.all((corners > [x0, y0]) & (corners < [x1, y1]))
        texts = (axes.title, *axes.texts, axes.xaxis.label, *figure.legends)
        boxes = [text.get_window_extent() for text in texts if text in figure.legends or text.get_text().strip()]
        for one, other in pairwise(boxes):
            assert not one.overlaps(other)
        for part in boxes:
            assert box.x0 - 1 <= part.x0 < part.x1 <= box.x1 + 1
            assert box.y0 - 1 <= part.y0 < part.y1 <= box.y1 + 1


def test_a_recording_beside_its_simulation(push):
    """Both go from start to end, whatever their number of points; a recording has no forces and no text."""
    real, over = recorded(points=8), np.linspace([0, 0, 0], [0.02, 0, 0.2], 5)
    moving = plot.animate(BLOCK, FINGER, {"real": real, "model": push}, measured={"model": over}, frames=9)
    left, right = moving.figure.axes
    moving.draw(8)
    np.testing.assert_allclose(lines(left)["slider"], in_world(real.pose[-1]), atol=1e-9)
    np.testing.assert_allclose(lines(right)["slider"], in_world(push.pose[-1]), atol=1e-9)
    np.testing.assert_allclose(lines(right)["measured"], in_world(over[-1]), atol=1e-9)
    assert left.texts[0].get_text() == ""
    assert not left.collections
    assert not lines(left)["measured"].size
    assert "measured" in legend(moving.figure)
    moving.draw(4)
    np.testing.assert_allclose(lines(right)["slider"], in_world(push.pose[10]), atol=1e-9)
    np.testing.assert_allclose(lines(right)["measured"], in_world(over[2]), atol=1e-9)


def test_pads_and_words_of_several_contacts():
    """Pads are outlines; steps after the last motion are left out, except the one that says why it stopped."""
    jaw = pj.Hand.parallel_jaw(0.02, 0.01)
    opening = np.concatenate([np.linspace(SIDE + 0.01, SIDE, 6), np.full(30, SIDE)])
    configuration = np.column_stack([np.zeros((36, 3)), opening])
    mode = np.zeros((35, 4), np.int8)
    mode[4] = pj.ContactMode.STICKING, pj.ContactMode.SLIDING_LEFT, pj.ContactMode.SLIDING_LEFT, 0
    status = np.where(np.arange(35) < 5, pj.Status.MOVING, pj.Status.GRASPED).astype(np.int8)
    given = trajectory(np.zeros((36, 3)), configuration, 4, mode=mode, status=status)
    moving = plot.animate(BLOCK, jaw, given, forces=False, frames=7)
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


def test_cloud():
    ends = np.array([0.03, 0.0, 0.2]) + 0.003 * np.random.default_rng(0).normal(size=(12, 3))
    poses = np.linspace(0, 1, 5)[None, :, None] * ends[:, None]
    path = np.linspace([-0.035, 0.0], [0.0, 0.0], 5)
    moving = plot.animate_cloud(BLOCK, FINGER, path, poses, title="cloud", frames=5)
    (axes,) = moving.figure.axes
    assert (axes.get_title(), axes.get_xlabel(), axes.get_ylabel()) == ("cloud", "x / mm", "y / mm")
    assert legend(moving.figure) == ["centroids", "start", "12 pushes"]
    for k in (1, 4):
        moving.draw(k)
        outlines, ways = axes.collections
        np.testing.assert_allclose(outlines.get_segments(), [in_world(pose) for pose in poses[:, k]], atol=1e-9)
        np.testing.assert_allclose(ways.get_segments(), MM * poses[:, : k + 1, :2], atol=1e-9)
        np.testing.assert_allclose(lines(axes)["centroids"], MM * poses[:, k, :2], atol=1e-9)
    with pytest.raises(ValueError, match=r"trajectories have shape \(12, 4, 3\); expected \(pushes, 5, 3\)"):
        plot.animate_cloud(BLOCK, FINGER, path, poses[:, :4])


def test_refuses(tmp_path):
    with pytest.raises(ValueError, match="there is none"):
        plot.animate(BLOCK, FINGER, {})
    with pytest.raises(ValueError, match="no push is named 'b'"):
        plot.animate(BLOCK, FINGER, {"a": recorded()}, measured={"b": np.zeros((2, 3))})
    with pytest.raises(ValueError, match="frames must be at least 2; got 1"):
        plot.animate(BLOCK, FINGER, recorded(), frames=1)
    with pytest.raises(ValueError, match="push has 8 poses, but 7 configurations"):
        plot.animate(BLOCK, FINGER, replace(recorded(), hand=recorded().hand[1:]))
    moving = plot.animate(BLOCK, FINGER, recorded(), frames=2)
    with pytest.raises(ValueError, match=r"a.avi: motion is written as .gif, .html, .mp4; got .avi"):
        plot.save(moving, tmp_path / "a.avi")
    with mpl.rc_context({"animation.ffmpeg_path": str(tmp_path / "nothing")}):
        with pytest.raises(RuntimeError, match=r"a.mp4: .mp4 needs the program ffmpeg; .gif and .html need nothing"):
            plot.save(moving, tmp_path / "a.mp4")


def test_gif(tmp_path):
    """The GIF repeats forever, all frames differ, it pauses on the last one, and it is small."""
    moving = plot.animate(BLOCK, FINGER, {"a": recorded(61), "b": recorded(61)}, frames=12, seconds=0.6)
    path = plot.save(moving, tmp_path / "new" / "push.gif")
    assert path.stat().st_size < 2e5
    assert not plt.fignum_exists(moving.figure.number)
    with Image.open(path) as film:
        assert film.n_frames == 12
        assert film.info["loop"] == 0
        shown, durations = [], []
        for k in range(12):
            film.seek(k)
            durations.append(film.info["duration"])
            shown.append(np.asarray(film.convert("RGB"), float))
    assert durations == [50] * 11 + [1200]
    assert min(np.abs(a - b).max() for a, b in pairwise(shown)) > 50
    green = 255 * np.array(mpl.colors.to_rgb(GREEN))
    assert all(np.any(np.abs(frame - green).max(axis=-1) < 12) for frame in (shown[0], shown[-1]))  # the hand


def test_page(tmp_path):
    """The page has every frame, loads nothing from the network, and a notebook shows the same player."""
    moving = plot.animate(BLOCK, FINGER, recorded(), frames=6, seconds=1.2)
    text = plot.save(moving, tmp_path / "a push.html").read_text()
    assert "http" not in text
    assert "<title>a push</title>" in text
    assert not re.search(r"(src|href)=", text)
    assert len(re.findall(r'^"[\w+/=]+",?$', text, re.M)) == 6
    assert all(part in text for part in ("<button", 'max="5"', "=== 5 ? 1200.0 : 200.0"))
    assert "$" not in text
    assert text.endswith(moving._repr_html_() + "</html>\n")


@pytest.mark.skipif(shutil.which("sh") is None, reason="the stand-in is a shell script")
def test_film(tmp_path):
    """Every frame reaches the program, and the last one stays; a stand-in for ffmpeg writes its input to a file."""
    program = tmp_path / "ffmpeg"
    program.write_text('#!/bin/sh\nfor last; do :; done\ncat > "$last"\n')
    program.chmod(0o755)
    moving = plot.animate(BLOCK, FINGER, recorded(), frames=5, seconds=0.5)
    with mpl.rc_context({"animation.ffmpeg_path": str(program)}):
        raw = plot.save(moving, tmp_path / "a.mp4").read_bytes()
    width, height = (int(100 * inches) for inches in moving.figure.get_size_inches())
    assert len(raw) == pytest.approx((5 + 12) * width * height * 4, rel=0.02)  # even sizes; ten frames a second
    whole = np.frombuffer(raw, np.uint8).reshape(17, -1)
    assert np.any(whole[0] != whole[4])
    np.testing.assert_array_equal(whole[4], whole[16])
