"""Quasi-static planar pushing and grasping in JAX.

The public names are listed in `__init__.pyi`. A name's module is imported when the name is first used, so that
`import pushjax` and `pushjax --help` take no time.
"""

import sys
from contextlib import nullcontext

import lazy_loader

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str):
    """Import the module of a public name; outside of the trace of the function that first uses it."""
    jax = sys.modules.get("jax")
    with nullcontext() if jax is None else jax.ensure_compile_time_eval():
        return _load(name)


__version__ = "0.1.0"
