"""Tasks to learn and to plan on: environments with the interface of gymnax 1.x, batched and differentiable."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
