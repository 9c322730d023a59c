"""The size of compiled programs: nobody adds a hundred kernels unnoticed. Seconds are in the benchmark."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import AS_USERS

import pushjax as pj
from benchmarks.hlo import traffic
from pushjax.tasks import PushT

BATCH, STEPS = 300, 32
SLACK = 1.1  # with the JAX of the figures; other versions fuse differently
FIGURES_OF, SLACK_OF_OTHERS = "0.10.1", 1.5
T = [(-60, 0), (60, 0), (60, 30), (15, 30), (15, 120), (-15, 120), (-15, 30), (-60, 30)]  # mm
SURFACE = pj.Quartic(np.float32([10.0] * 3 + [0.0] * 6 + [20.0] * 3 + [0.0] * 3), np.float32(0.03))
RECTANGLE, TEE = pj.Polygon.rectangle(0.09, 0.06), pj.Polygon(np.array(T) * 1e-3)


def push(shape, hand, start, end):
    """The last pose of a push as a function of start and friction."""
    slider, path = pj.Slider(shape, SURFACE), pj.line(start, end, STEPS).astype(np.float32)

    def last_pose(pose, mu):
        return pj.rollout(slider, hand, path, pose=pose, friction=mu).pose[-1]

    return last_pose


ENV = PushT()


def step_of_task(pose, mu):
    """A control step of PushT that pushes the block."""
    _, state = ENV.reset(jax.random.key(0))
    return ENV.step(jax.random.key(1), state.replace(pose=pose + state.pose), 100 * mu + pose[:2])[1].pose


FINGER, JAW = pj.Hand.finger(0.005), pj.Hand.parallel_jaw(0.027, 0.01)
one = push(RECTANGLE, FINGER, (-0.06, 0.0), (-0.02, 0.0))
# kernels and instructions of each program
PROGRAMS = {
    "push": (one, 286, 7156),
    "gradient": (lambda pose, mu: jax.grad(lambda p, m: one(p, m).sum(), argnums=(0, 1))(pose, mu), 737, 20882),
    "T": (push(TEE, FINGER, (-0.08, 0.02), (-0.03, 0.02)), 872, 20923),
    "two fingers": (push(RECTANGLE, pj.Hand.two_fingers(0.005), (-0.08, 0, 0, 0.04), (-0.03, 0, 0, 0.04)), 922, 23004),
    "jaw": (push(RECTANGLE, JAW, (0, 0, 0, 0.13), (0, 0, 0, 0.05)), 1337, 33941),
    "PushT step": (step_of_task, 1152, 26475),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PROGRAMS)
def test_no_program_grows(name):
    program, kernels, instructions = PROGRAMS[name]
    pose, mu = jnp.zeros((BATCH, 3), jnp.float32), jnp.full(BATCH, 0.3, jnp.float32)
    text = jax.jit(jax.vmap(program)).lower(pose, mu).compile(compiler_options=AS_USERS).as_text()
    slack = SLACK if jax.__version__ == FIGURES_OF else SLACK_OF_OTHERS
    found = traffic(text).kernels, len(re.findall(r"^\s+(?:ROOT )?%?[\w.-]+ = ", text, re.MULTILINE))
    assert found[0] <= slack * kernels, found
    assert found[1] <= slack * instructions, found
    # a budget that is far too large holds nothing
    assert slack > SLACK or (found[0] >= 0.8 * kernels and found[1] >= 0.8 * instructions), found
