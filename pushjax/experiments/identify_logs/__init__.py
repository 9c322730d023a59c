"""Identification from a user's own logs: `experiment` builds on `options`, `setting`, `findings` and `picture`."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
