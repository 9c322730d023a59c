"""Time, memory and bitwise reproducibility of a million pushes.

    python -m benchmarks million_pushes [--n 1000000] [--steps 200] [--same 100000]

Results are compared bit by bit between runs on one, two and eight devices, in two processes, and in a run that is
killed halfway by SIGKILL and resumed. Each run is a process of its own. `--same` is the number of pushes that are
compared.
"""

import argparse
import hashlib
import os
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--n", type=int, default=1_000_000)
parser.add_argument("--steps", type=int, default=200)
parser.add_argument("--same", type=int, default=100_000)
parser.add_argument("--run", type=int, help=argparse.SUPPRESS)
parser.add_argument("--checkpoint", help=argparse.SUPPRESS)
parser.add_argument("--kill-after", type=int, help=argparse.SUPPRESS)
parser.add_argument("--process", type=int, default=0, help=argparse.SUPPRESS)
parser.add_argument("--of", type=int, default=1, help=argparse.SUPPRESS)
parser.add_argument("--port", type=int, help=argparse.SUPPRESS)
arguments = parser.parse_args()


def run() -> None:
    """Do one run in this process.

    Prints the seconds of the run and of 2000 pushes, the peak memory in MB, a digest of every bit of the result, a
    digest of the friction that was drawn, and the number of pushes that failed.
    """
    import jax
    import jax.numpy as jnp
    import numpy as np

    if arguments.of > 1:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(f"127.0.0.1:{arguments.port}", arguments.of, arguments.process)
    import pushjax as pj
    from pushjax.experiments import stochastic_push

    slider, hand, path = stochastic_push.setting(0, arguments.steps)
    model = pj.FrictionModel(dof=20.0, friction=(0.15, 0.35))

    def progress(done: int, total: int) -> None:
        if arguments.kill_after is not None and done >= arguments.kill_after:
            os.kill(os.getpid(), signal.SIGKILL)

    def pushes(n: int, **options):
        return pj.monte_carlo(jax.random.key(1), n, slider, hand, path, pose=jnp.zeros(3), model=model, **options)

    if arguments.kill_after is None:
        pushes(2048)  # compiles
    small = (
        np.median([pushes(2000).seconds for _ in range(5)]) if arguments.of == 1 and not arguments.checkpoint else 0.0
    )
    result = pushes(arguments.run, checkpoint=arguments.checkpoint, progress=progress)
    found = hashlib.sha256()
    for name, value in sorted(vars(result).items()):
        if isinstance(value, np.ndarray):
            found.update(name.encode() + np.ascontiguousarray(value).tobytes())
    draws = hashlib.sha256(result.friction.tobytes() + result.shrinkage.tobytes()).hexdigest()[:12]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        "RESULT",
        result.seconds,
        float(small),
        peak,
        found.hexdigest()[:12],
        draws,
        result.outcomes()["failed"],
        flush=True,
    )


def start(n: int, *options: str, devices: int = 1) -> subprocess.Popen:
    """Start a run of `n` pushes in a process of its own, on so many devices."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    command = [
        sys.executable,
        "-m",
        "benchmarks.million_pushes",
        "--steps",
        str(arguments.steps),
        "--run",
        str(n),
        *options,
    ]
    return subprocess.Popen(command, env=os.environ | {"XLA_FLAGS": flags}, stdout=subprocess.PIPE, text=True)


def finished(process: subprocess.Popen) -> list[str]:
    """Wait for a run, and return the figures that it printed."""
    out, _ = process.communicate()
    return next(line for line in out.splitlines() if line.startswith("RESULT")).split()[1:]


def main() -> None:
    from benchmarks._measure import header

    print(header())
    seconds, small, peak, _, _, failed = finished(start(arguments.n))
    each, few = float(seconds) / arguments.n, float(small) / 2000
    print(
        f"{arguments.n} pushes of {arguments.steps} steps, float32, one device: {float(seconds):.1f} s, "
        f"{1e6 * each:.0f} us a push, {each / few:.2f} times that of 2000 at once ({1e6 * few:.0f} us); peak "
        f"{float(peak):.0f} MB; {failed} failed",
        flush=True,
    )
    n = arguments.same
    rows = {f"{devices} devices": finished(start(n, devices=devices)) for devices in (1, 2, 8)}
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    both = [start(n, "--process", str(i), "--of", "2", "--port", port) for i in range(2)]
    rows |= {f"process {i} of 2": finished(process) for i, process in enumerate(both)}
    with tempfile.TemporaryDirectory() as folder:
        kept = str(Path(folder) / "kept")
        killed = start(n, "--checkpoint", kept, "--kill-after", str(n // 2))
        killed.communicate()
        assert killed.returncode == -signal.SIGKILL
        begun = time.perf_counter()
        rows["killed halfway, resumed"] = finished(start(n, "--checkpoint", kept))
        print(f"resumed and finished in {time.perf_counter() - begun:.1f} s, imports and compiling included")
    _, _, _, bits, draws, _ = rows["1 devices"]
    for name, row in rows.items():
        print(
            f"{n} pushes, {name:24} {float(row[0]):6.1f} s, peak {float(row[2]):5.0f} MB; poses and all: "
            f"{'the same bits' if row[3] == bits else 'OTHER BITS'}; draws: {'same' if row[4] == draws else 'OTHER'}"
        )


if __name__ == "__main__":
    run() if arguments.run is not None else main()
