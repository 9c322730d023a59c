"""A Monte Carlo run in its own process.

`python monte_carlo_process.py OUT [--checkpoint DIR] [--kill-after N] [--process I --of N --port P]`. XLA_FLAGS sets
the number of host devices.
"""

import argparse
import os
import signal
from pathlib import Path

import jax
import numpy as np

parser = argparse.ArgumentParser()
parser.add_argument("out", type=Path)
parser.add_argument("--checkpoint", type=Path)
parser.add_argument("--kill-after", type=int)
parser.add_argument("--n", type=int, default=500)
parser.add_argument("--process", type=int, default=0)
parser.add_argument("--of", type=int, default=1)
parser.add_argument("--port", type=int)


def setting(dtype=np.float32):
    """Return a finger that pushes a disk with random friction, in tiles of 64."""
    import pushjax as pj
    from pushjax.simulation import monte_carlo as engine

    engine.BLOCK_PUSHES, engine.BLOCK_SECONDS = 128, 1e9  # a file for this number of pushes, however slow they are
    slider = pj.Slider(pj.Disk(np.asarray(0.05, dtype)), pj.Ellipsoid(np.eye(3, dtype=dtype), np.asarray(0.035, dtype)))
    path = np.linspace((-0.06, 0.02), (-0.03, 0.02), 11).astype(dtype)
    model = pj.FrictionModel(dof=np.asarray(10, dtype), friction=np.asarray((0.1, 0.4), dtype))
    hand = pj.Hand.finger(np.asarray(0.002, dtype))
    return {"slider": slider, "hand": hand, "path": path, "pose": np.zeros(3, dtype), "model": model, "batch_size": 64}


def main() -> None:
    options = parser.parse_args()
    if options.of > 1:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(f"127.0.0.1:{options.port}", options.of, options.process)
    import pushjax as pj

    def progress(done: int, total: int) -> None:
        if options.kill_after is not None and done >= options.kill_after:
            os.kill(os.getpid(), signal.SIGKILL)

    run = pj.monte_carlo(
        jax.random.key(3), options.n, **setting(), checkpoint=options.checkpoint, progress=progress, trajectories=True
    )
    fields = {name: value for name, value in vars(run).items() if isinstance(value, np.ndarray)}
    np.savez(options.out, allow_pickle=False, **fields)
    print(jax.device_count(), "devices")


if __name__ == "__main__":
    main()
