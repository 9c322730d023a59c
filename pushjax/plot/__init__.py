"""Figures and animations, in mm and degrees, in colors that color-blind readers can tell apart.

A function `..._figure` makes a whole figure. `animate` and `animate_cloud` make an animation. `save` writes either to a
file. A function `..._panel` draws into given axes, and so do the parts of pictures: `outline`, `hand_at` and `traces`.
Colors and the settings of matplotlib are in the module `style`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
