"""Time, memory and bitwise reproducibility of a million pushes.

Results are compared bit by bit between runs on one, two and eight devices, in two processes, and in a run that is
killed halfway by SIGKILL and resumed. Each run is a process of its own: `python -m benchmarks.million_pushes SETTINGS`,
with the arguments of `one_run` in JSON.
"""

import hashlib
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record


def one_run(
    n: int,
    steps: int,  # of each push
    checkpoint: str | None = None,  # folder in which the run is kept
    kill_after: int | None = None,  # number of pushes after which the process kills itself
    process: int = 0,  # which of the processes this is
    processes: int = 1,  # number of processes that share the run
    port: int = 0,  # at which they meet
) -> dict[str, Any]:
    """Do one run in this process; return times, peak memory, digests of its results, and failures."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    if processes > 1:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(f"127.0.0.1:{port}", processes, process)
    import pushjax as pj
    from pushjax.experiments import stochastic_push

    slider, hand, path = stochastic_push.push_setup(0, steps)
    model = pj.FrictionModel(dof=20.0, friction=(0.15, 0.35))

    def progress(done: int, total: int) -> None:
        if kill_after is not None and done >= kill_after:
            os.kill(os.getpid(), signal.SIGKILL)

    def pushes(n: int, **options):
        return pj.monte_carlo(jax.random.key(1), n, slider, hand, path, pose=jnp.zeros(3), model=model, **options)

    if kill_after is None:
        pushes(2048)  # compiles
    small = float(np.median([pushes(2000).seconds for _ in range(5)])) if processes == 1 and not checkpoint else 0.0
    result = pushes(n, checkpoint=checkpoint, progress=progress)
    found = hashlib.sha256()
    for name, value in sorted(vars(result).items()):
        if isinstance(value, np.ndarray):
            found.update(name.encode() + np.ascontiguousarray(value).tobytes())
    return {
        "run_s": result.seconds,
        "run_s_of_2000": small,  # 0 with several processes or a checkpoint
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "digest": found.hexdigest()[:12],  # of every bit of the result
        # of the random friction only
        "draws": hashlib.sha256(result.friction.tobytes() + result.shrinkage.tobytes()).hexdigest()[:12],
        "failed": int(result.outcomes()["failed"]),
    }


def _start(devices: int = 1, **settings: Any) -> subprocess.Popen:
    """Start `one_run` in a process of its own, on so many devices."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    command = [sys.executable, "-m", "benchmarks.million_pushes", json.dumps(settings)]
    return subprocess.Popen(command, env=os.environ | {"XLA_FLAGS": flags}, stdout=subprocess.PIPE, text=True)


def _finished(process: subprocess.Popen) -> dict[str, Any]:
    """Wait for a run, and return what it found."""
    out, _ = process.communicate()
    return json.loads(out.splitlines()[-1])


def run(
    n: int = 1_000_000, steps: int = 200, same: int = 100_000, progress: ProgressCallback = no_progress
) -> dict[str, Any]:
    """Run a million pushes, and fewer in several ways that have to give the same bits.

    Args:
        n: Number of pushes of the first run.
        steps: Number of steps of each push.
        same: Number of pushes of the runs that are compared.
        progress: Called with the number of runs done and their total.

    Returns:
        The record. `alone` is the first run; each row is one of the others, with whether its bits and draws are those
        of one device; `resumed_s` is the time of the resumed process, imports and compiling included.
    """
    alone = _finished(_start(n=n, steps=steps))
    progress(1, 7)
    few = {"n": same, "steps": steps}
    found = {}
    for devices in (1, 2, 8):
        found[f"{devices} devices"] = _finished(_start(devices, **few))
        progress(1 + len(found), 7)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    both = [_start(**few, process=i, processes=2, port=port) for i in range(2)]
    found |= {f"process {i} of 2": _finished(process) for i, process in enumerate(both)}
    progress(6, 7)
    with tempfile.TemporaryDirectory() as folder:
        kept = str(Path(folder) / "kept")
        killed = _start(**few, checkpoint=kept, kill_after=same // 2)
        killed.communicate()
        assert killed.returncode == -signal.SIGKILL
        begun = time.perf_counter()
        found["killed halfway, resumed"] = _finished(_start(**few, checkpoint=kept))
        resumed_s = time.perf_counter() - begun
    progress(7, 7)
    one = found["1 devices"]
    rows = [
        {"run": name} | each | {f"same_{part}": each[part] == one[part] for part in ("digest", "draws")}
        for name, each in found.items()
    ]
    settings = {"n": n, "steps": steps, "same": same}
    return result_record("million_pushes", settings, alone=alone, rows=rows, resumed_s=resumed_s)


def summary(record: dict[str, Any]) -> str:
    """Return what the command prints."""
    alone, settings = record["alone"], record["settings"]
    each, few = alone["run_s"] / settings["n"], alone["run_s_of_2000"] / 2000
    lines = [
        f"{settings['n']} pushes of {settings['steps']} steps, float32, one device: {alone['run_s']:.1f} s, "
        f"{1e6 * each:.0f} us a push, {each / few:.2f} times that of 2000 at once ({1e6 * few:.0f} us); peak "
        f"{alone['peak_mb']:.0f} MB; {alone['failed']} failed",
        f"resumed and finished in {record['resumed_s']:.1f} s, imports and compiling included",
    ]
    for row in record["rows"]:
        lines.append(
            f"{settings['same']} pushes, {row['run']:24} {row['run_s']:6.1f} s, peak {row['peak_mb']:5.0f} MB; poses "
            f"and all: {'the same bits' if row['same_digest'] else 'OTHER BITS'}; draws: "
            f"{'same' if row['same_draws'] else 'OTHER'}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    print(json.dumps(one_run(**json.loads(sys.argv[1]))))
