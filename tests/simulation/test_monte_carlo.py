"""Monte Carlo runs: the same bits on any devices and processes, checkpoints, summaries, bad input."""

import json
import os
import resource
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from monte_carlo_process import setting

import pushjax as pj
from pushjax.simulation.checkpoint import CheckpointError
from pushjax.simulation.monte_carlo_result import MonteCarlo

KEY, N = 3, 500
SCRIPT = Path(__file__).with_name("monte_carlo_process.py")


def run(**changed):
    return pj.monte_carlo(jax.random.key(KEY), **({"n": N} | setting() | {"trajectories": True} | changed))


@pytest.fixture(scope="module")
def whole():
    return run()


def test_under_a_transformation_it_says_what_to_use():
    with pytest.raises(TypeError, match="use random_rollout"):
        jax.grad(lambda mu: run(model=pj.FrictionModel(20, mu)).pose.sum())(0.2)


def arrays(result) -> dict[str, np.ndarray]:
    return {name: value for name, value in vars(result).items() if isinstance(value, np.ndarray)}


def same(result, other) -> bool:
    return result.keys() == other.keys() and all(np.array_equal(result[name], other[name]) for name in result)


def start(out: Path, *options: str, devices: int = 1) -> subprocess.Popen:
    environment = os.environ | {
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    }
    command = [sys.executable, str(SCRIPT), str(out), *options]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen) -> str:
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err[-2000:]
    return out


@pytest.mark.slow
def test_a_push_is_that_of_its_key(whole):
    """A push is the one of its key, and its friction is the sample of the model for that key."""
    given = setting()
    rest = {name: given[name] for name in ("slider", "hand", "path", "pose", "model")}
    for i in (0, 77, N - 1):
        key = jax.random.fold_in(jax.random.key(KEY), i)
        one = pj.random_rollout(key, **rest)
        _, mu = given["model"].sample(key, given["slider"].surface)
        np.testing.assert_allclose(one.push.pose, whole.trajectory[i], atol=1e-7)
        np.testing.assert_allclose(one.draws.friction, whole.friction[i], rtol=1e-6)
        np.testing.assert_allclose(mu, whole.friction[i, 0], rtol=1e-6)


def test_what_comes_back(whole):
    assert len(whole) == N
    assert whole.trajectory.shape == (N, 11, 3)
    assert whole.pose.dtype == np.float32
    np.testing.assert_array_equal(whole.trajectory[:, -1], whole.pose)
    np.testing.assert_array_equal(whole.delta, whole.pose)
    assert whole.friction.shape == (N, 1)
    assert np.all((whole.friction >= 0.1) & (whole.friction <= 0.4))
    assert np.all(whole.steps_in_mode.sum(axis=2) == 10)
    assert whole.outcomes() == {"grasped": 0, "jammed": 0, "free": N, "failed": 0}
    summary = whole.summary()
    json.dumps(summary, allow_nan=False)
    assert summary["pose"]["y"]["mean"] == pytest.approx(whole.pose[:, 1].mean(), rel=1e-5)
    assert summary["pose"]["y"]["std"] > 1e-4
    assert sum(summary["modes"][0].values()) == pytest.approx(1)
    counted = whole.histogram(whole.pose[:, 2], bins=7)
    assert counted["counts"].sum() == N
    assert len(counted["edges"]) == 8


def test_fewer_pushes_and_other_tiles_draw_the_same(whole):
    """A push does not depend on the number of others; it depends on the batch size only by roundoff."""
    assert same(arrays(run(n=70)), {name: value[:70] for name, value in arrays(whole).items()})
    other = run(batch_size=128)
    np.testing.assert_allclose(other.friction, whole.friction, rtol=1e-6)
    np.testing.assert_allclose(other.pose, whole.pose, atol=1e-6)
    assert not np.array_equal(pj.monte_carlo(jax.random.key(4), N, **setting()).pose, whole.pose)


def test_old_style_keys(whole):
    old = pj.monte_carlo(jax.random.PRNGKey(KEY), N, **setting())
    np.testing.assert_array_equal(old.pose, whole.pose)
    assert old.trajectory is None


def test_float64():
    result = pj.monte_carlo(jax.random.key(KEY), 64, **setting(np.float64))
    assert result.pose.dtype == result.friction.dtype == np.float64
    assert result.outcomes()["free"] == 64


def test_every_push_from_its_own_start(whole):
    poses = np.zeros((N, 3), np.float32)
    poses[:, 0] = np.linspace(0, 0.01, N)
    result = run(pose=poses)
    np.testing.assert_array_equal(result.start, poses)
    np.testing.assert_array_equal(result.pose[0], whole.pose[0])
    assert np.all(np.diff(result.delta[:, 0]) != 0)


def test_every_push_along_its_own_path(whole):
    """Pushes that share a path go as with a path each; another path of one push changes that push only."""
    shared = np.asarray(setting()["path"])
    paths = np.repeat(shared[None], N, axis=0)
    same = run(path=paths)
    np.testing.assert_array_equal(same.friction, whole.friction)
    np.testing.assert_allclose(same.pose, whole.pose, atol=1e-6)
    paths[7, :, 1] += 0.002
    other = run(path=paths)
    changed = np.flatnonzero(np.any(other.pose != same.pose, axis=1))
    assert changed.tolist() == [7]
    drawn = jax.random.fold_in(jax.random.key(KEY), 7)
    given = {name: value for name, value in setting().items() if name != "batch_size"}
    alone = pj.random_rollout(drawn, **given | {"path": paths[7]})
    np.testing.assert_allclose(other.pose[7], alone.push.pose[-1], atol=1e-6)


def test_friction_drawn_every_few_steps(whole):
    """Ten steps with a new sample every four steps have three samples, each with its own key."""
    given = setting()
    model, slider, path = given["model"], given["slider"], given["path"]
    often = pj.FrictionModel(dof=model.dof, friction=model.friction, resample_every=4)
    result = run(model=often)
    assert result.friction.shape == (N, 3)
    assert len(np.unique(result.friction)) == 3 * N
    assert result.pose[:, 1].std() < 0.9 * whole.pose[:, 1].std()  # independent samples average out
    key, pose = jax.random.fold_in(jax.random.key(KEY), 5), jnp.zeros(3, jnp.float32)
    for k, first in enumerate((0, 4, 8)):
        surface, mu = model.sample(jax.random.fold_in(key, k), slider.surface)
        part = path[first : first + 5]
        pose = pj.rollout(pj.Slider(slider.shape, surface), given["hand"], part, pose=pose, friction=mu).pose[-1]
    np.testing.assert_allclose(result.pose[5], pose, atol=1e-7)


@pytest.mark.slow
def test_bits_do_not_depend_on_devices(whole, tmp_path):
    each = {devices: start(tmp_path / f"{devices}.npz", devices=devices) for devices in (2, 8)}
    for devices, process in each.items():
        assert f"{devices} devices" in finish(process)
        assert same(dict(np.load(tmp_path / f"{devices}.npz")), arrays(whole))


@pytest.mark.slow
def test_bits_do_not_depend_on_processes(whole, tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    kept = tmp_path / "kept"
    both = [
        start(tmp_path / f"{i}.npz", "--process", str(i), "--of", "2", "--port", port, "--checkpoint", str(kept))
        for i in range(2)
    ]
    for process in both:
        assert "2 devices" in finish(process)
    for i in range(2):
        assert same(dict(np.load(tmp_path / f"{i}.npz")), arrays(whole))
    # one process continues where two stopped
    assert same(arrays(run(checkpoint=kept)), arrays(whole))


def test_a_killed_run_goes_on_to_the_same_bits(whole, tmp_path):
    kept, out = tmp_path / "kept", tmp_path / "out.npz"
    killed = start(out, "--checkpoint", str(kept), "--kill-after", "300")
    killed.communicate(timeout=300)
    assert killed.returncode == -9
    assert not out.exists()
    blocks = sorted(path.name for path in kept.glob("pushes-*"))
    assert blocks == ["pushes-000000000000-000000000128.npz", "pushes-000000000128-000000000256.npz"]
    told = []
    result = run(checkpoint=kept, progress=lambda done, total: told.append((done, total)))
    assert same(arrays(result), arrays(whole))
    assert told[0] == (256, N)
    assert told[-1] == (N, N)
    # when it is complete, there is nothing left to do
    again = run(checkpoint=kept, progress=lambda done, total: told.append(done))
    assert told[-1] == N
    assert same(arrays(again), arrays(whole))


def test_checkpoints_that_will_not_do(whole, tmp_path):
    kept = tmp_path / "kept"
    run(checkpoint=kept)
    for changed, part in (
        ({"n": 400}, "n"),
        ({"pose": np.array([0.001, 0, 0], np.float32)}, "pose"),
        ({"model": pj.FrictionModel(dof=np.float32(10), friction=0.3)}, "model"),
        ({"path": 0.99 * setting()["path"]}, "hand, path"),
        ({"batch_size": 128}, "batch_size"),
    ):
        with pytest.raises(CheckpointError, match=f"holds another run: {part} differ"):
            run(checkpoint=kept, **changed)
    with pytest.raises(CheckpointError, match="key differ"):
        pj.monte_carlo(jax.random.key(9), N, **setting(), trajectories=True, checkpoint=kept)
    torn = sorted(kept.glob("pushes-*"))[1]
    content = torn.read_bytes()
    for part in (content[: len(content) // 2], b""):
        torn.write_bytes(part)
        with pytest.raises(CheckpointError, match=r"pushes-000000000128-000000000256.npz is damaged .* remove it"):
            run(checkpoint=kept)
    torn.unlink()
    assert same(arrays(run(checkpoint=kept)), arrays(whole))
    (kept / "manifest.json").write_text("{")
    with pytest.raises(CheckpointError, match=r"manifest.json cannot be read \(it is damaged\)"):
        run(checkpoint=kept)
    (kept / "manifest.json").unlink()
    with pytest.raises(CheckpointError, match=r"has pushes but no manifest.json to say whose"):
        run(checkpoint=kept)


def test_a_full_disk(whole, tmp_path):
    """What was written before is kept, and the run continues from it."""
    kept = tmp_path / "kept"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fills_up(done, total):
        if done >= 256:
            resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))

    try:
        with pytest.raises(CheckpointError, match=r"cannot be written \(File too large\); what was written before is"):
            run(checkpoint=kept, progress=fills_up)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert len(list(kept.glob("pushes-*"))) == 2
    assert not list(kept.glob(".partial*"))
    assert same(arrays(run(checkpoint=kept)), arrays(whole))


def test_a_folder_that_cannot_be_one(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CheckpointError, match="cannot be written"):
        run(checkpoint=tmp_path / "file")


def test_progress_in_a_pipe_says_at_once_what_is_done(whole, capsys):
    assert same(arrays(run(progress=True)), arrays(whole))
    first, *tenths = capsys.readouterr().err.splitlines()
    assert first == "pushjax: compiling and making 500 pushes"
    assert tenths[-1] == f"{first}: 100%"


def test_many_repaired_surfaces_give_a_warning(whole, monkeypatch):
    monkeypatch.setattr("pushjax.simulation.monte_carlo.MANY_REPAIRS", -0.1)  # ellipsoids are never repaired
    with pytest.warns(UserWarning, match="model: 0% of the sampled .* origin of the body frame") as seen:
        run()
    assert [each.filename for each in seen] == [__file__]


def test_outcomes_add_up():
    """The outcomes add up, also if a step failed on the way and the hand jammed later."""
    none = np.zeros((4, 1, 4), np.int32)
    status = np.array([2, 4, 0, 2], np.int8)
    failed, index = np.array([0, 0, 0, 3]), np.array([5, 5, -1, 9])
    poses = np.zeros((4, 3))
    result = MonteCarlo(poses, poses, status, none[..., 0], none, failed, index, index, poses, poses, None, 0.0)
    assert result.outcomes() == {"grasped": 1, "jammed": 1, "free": 1, "failed": 1}
    assert result.summary()["statuses"] == {"MOVING": 1, "JAMMED": 2, "GRASPED": 1}


def test_keys_and_devices_that_will_not_do():
    for key in (0, jax.random.split(jax.random.key(0)), np.zeros(3, np.uint32)):
        with pytest.raises(ValueError, match="key must be one key"):
            pj.monte_carlo(key, N, **setting())
    with pytest.raises(ValueError, match="devices must not be empty"):
        run(devices=[])


def test_bad_input():
    for changed, message in (
        ({"n": 0}, "n must be a whole number, at least 1; got 0"),
        ({"n": 2.5}, "n must be a whole number"),
        ({"batch_size": 0}, "batch_size must be a whole number, at least 1"),
        ({"pose": np.zeros((3, 3))}, r"pose has shape \(3, 3\); expected \(3,\) or \(500, 3\)"),
        ({"pose": np.full(3, np.nan)}, "pose must be finite"),
        ({"path": np.zeros((4, 3))}, "path has 3 columns; a configuration of this hand has 2: x, y"),
        ({"path": np.zeros(4)}, "path has shape"),
        ({"path": np.zeros((3, 4, 2))}, r"path has shape \(3, 4, 2\); expected \(500, steps \+ 1, 2\)"),
        ({"path": np.full((N, 4, 2), np.nan)}, "path must be finite"),
        ({"path": np.zeros((N, 1, 2))}, "at least two configurations"),
        ({"path": np.zeros((4, 2))}, "inside the slider"),
        (
            {"pose": jnp.zeros((N, 3)).at[7, 0].set(-0.02)},
            r"path starts with the hand inside the slider in push 7: a finger",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            run(**changed)
