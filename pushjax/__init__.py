"""Quasi-static planar pushing and grasping in JAX.

The public names are listed in `__init__.pyi`. A name's module is imported when the name is first used, so that
`import pushjax` and `pushjax --help` take no time.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__version__ = "0.1.0"
