"""gymnax's own wrappers run on PushT, in a virtual environment of their own: gymnax excludes the latest Gymnasium."""

import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RUN = """
from importlib.metadata import version
import jax, jax.numpy as jnp, numpy as np
from gymnax.wrappers import FlattenObservationWrapper, LegacyStepAPIWrapper, LogWrapper
from pushjax.tasks import PushT

env = LegacyStepAPIWrapper(LogWrapper(FlattenObservationWrapper(PushT(walls=False, substeps=1))))
params = env.default_params.replace(max_steps_in_episode=2)
keys = jax.random.split(jax.random.key(0), 4)
_, state = jax.vmap(env.reset, in_axes=(0, None))(keys, params)
step = jax.vmap(env.step, in_axes=(0, 0, 0, None))
action = jnp.full((4, 2), 256.0)
total = np.zeros(4)
for k in range(3):
    observation, state, reward, done, info = step(keys, state, action, params)
    assert observation.shape == info["final_observation"].shape == (4, 5)
    assert np.all(np.isfinite(observation))
    assert np.array_equal(done, np.full(4, k == 1)), (k, done)
    assert np.array_equal(info["returned_episode"], done)
    if k < 2:
        total += np.asarray(reward)
assert np.array_equal(info["returned_episode_lengths"], np.full(4, 2))
assert np.allclose(info["returned_episode_returns"], total, atol=1e-5)
assert not np.allclose(observation[:, :2], 256.0, atol=5.0)  # a new episode has begun
print("gymnax", version("gymnax"))
"""


@pytest.mark.slow
def test_gymnax_wrappers_run(tmp_path):
    here = Path(sysconfig.get_paths()["purelib"])
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "env"], check=True)
    (packages,) = (tmp_path / "env" / "lib").glob("python*/site-packages")
    # Packages of this environment, and this one, come after those that are installed for gymnax.
    (packages / "beside.pth").write_text(f"{here}\n{ROOT}\n")
    python = tmp_path / "env" / "bin" / "python"
    # gymnax imports six, and does not say that it needs it.
    install = [python, "-m", "pip", "install", "-q", "gymnax==1.0.1", "gymnasium<1.4", "six"]
    installed = subprocess.run(install, capture_output=True, text=True)
    if installed.returncode:
        pytest.skip(f"gymnax cannot be installed: {installed.stderr[-300:]}")
    run = subprocess.run(
        [python, "-c", RUN], capture_output=True, text=True, cwd=tmp_path, env=os.environ | {"PYTHONPATH": ""}
    )
    assert run.returncode == 0, run.stderr[-3000:]
    assert run.stdout.startswith("gymnax 1.")
