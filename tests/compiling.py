"""How programs are compiled in tests: quickly, but for those that are about rounding by the thousand."""

import os
from importlib.metadata import version

# XLA ends a process that sets an option which it does not know: JAX 0.12 has no choice of emitters any more.
WITHOUT_CHOICE = (0, 11)

# Nearly every program is run once, and waited for while it compiles: these take three fifths of the time. Not level 0:
# without fusion emitters, and in batches that are split over two cores, one in a hundred solves then does not converge
# (JAX 0.10; on one core all do, as at all other levels).
_QUICK = {
    "xla_backend_optimization_level": "1",
    # newer compilers make one function of a loop over small arrays: twice as fast, three times as long to compile
    "xla_backend_extra_options": "xla_cpu_small_while_loop_byte_threshold=1024",
}
# Options of `jax.jit` that compile as a user's process does (but for small loops, where the compiler is new): which
# values are worked out anew where, and so how they are rounded, is another matter there.
AS_USERS: dict[str, str | bool | int] = {"xla_backend_optimization_level": 3}
if tuple(int(part) for part in version("jax").split(".")[:2]) < WITHOUT_CHOICE:
    _QUICK["xla_cpu_use_fusion_emitters"] = "false"
    AS_USERS["xla_cpu_use_fusion_emitters"] = True


def set_quick() -> None:
    """For this process and those that it starts, before JAX is imported. What XLA_FLAGS says already stays."""
    said = os.environ.get("XLA_FLAGS", "")
    more = [f"--{option}={value}" for option, value in _QUICK.items() if option not in said]
    os.environ["XLA_FLAGS"] = " ".join([said, *more]).strip()
