"""Pushes of a block from pose to pose, for a robot: `experiment` builds on `options` and `picture`."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
