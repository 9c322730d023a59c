"""Compiler options of the tests: fast compilation, except for tests of roundoff on thousands of problems."""

import os
from importlib.metadata import version

# XLA ends a process that sets an option that it does not know. Since JAX 0.12 the fusion emitters are no longer an
# option.
WITHOUT_CHOICE = (0, 11)

# Nearly every program runs once, and the test waits for it to compile. With these options that takes three fifths of
# the time. The level is not 0: with level 0, without fusion emitters, and in batches that are split over two cores, one
# solve in a hundred does not converge (JAX 0.10; on one core all converge, as they do at all other levels).
_QUICK = {
    "xla_backend_optimization_level": "1",
    # newer compilers make one function of a loop over small arrays, which runs twice as fast but takes three times as
    # long to compile
    "xla_backend_extra_options": "xla_cpu_small_while_loop_byte_threshold=1024",
}
# Options of `jax.jit` that compile as a user's process does (except for small loops, where the compiler is new). They
# change which values are recomputed where, and therefore how they are rounded.
AS_USERS: dict[str, str | bool | int] = {"xla_backend_optimization_level": 3}
if tuple(int(part) for part in version("jax").split(".")[:2]) < WITHOUT_CHOICE:
    _QUICK["xla_cpu_use_fusion_emitters"] = "false"
    AS_USERS["xla_cpu_use_fusion_emitters"] = True


def set_quick() -> None:
    """Set the options for this process and its child processes, before JAX is imported; options in XLA_FLAGS stay."""
    said = os.environ.get("XLA_FLAGS", "")
    more = [f"--{option}={value}" for option, value in _QUICK.items() if option not in said]
    os.environ["XLA_FLAGS"] = " ".join([said, *more]).strip()
