"""A batch over several devices against one: of a CPU, so many "host devices", which share its cores.

XLA works on one core for a batch of pushes; a second host device brings the second core to it. What it gains is wall
time: the processor time of a push stays what it is, or grows by what two cores in one cache cost each other.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from pushjax.bench.cases import Work


def ask(count: int) -> None:
    """As many devices, of a CPU host devices, which must be said before JAX has any.

    Raises ValueError for less than two, or when it is too late.
    """
    if count < 2:
        raise ValueError(f"--devices must be at least 2; got {count}")
    try:
        jax.config.update("jax_num_cpu_devices", count)
    except RuntimeError:
        pass  # there are some already
    if len(jax.devices()) < count:
        raise ValueError(f"--devices: JAX has started with {len(jax.devices())}; got {count}")


def sharded(make: Callable[[str, int], Work], dtype: str, batch: int, count: int) -> Work:
    """The same work with its batch over `count` devices, each of which does its part as if it were alone.

    Raises ValueError for a batch that is no multiple of `count`.
    """
    if batch % count:
        raise ValueError(f"batch must be a multiple of the {count} devices; got {batch}")
    whole, part = make(dtype, batch), make(dtype, batch // count)
    mesh = Mesh(np.array(jax.devices()[:count]), ("batch",))
    over = PartitionSpec("batch")
    function = jax.shard_map(part.function, mesh=mesh, in_specs=over, out_specs=over, check_vma=False)
    args: Any = jax.device_put(whole.args, NamedSharding(mesh, over))
    return whole._replace(function=function, args=args)
