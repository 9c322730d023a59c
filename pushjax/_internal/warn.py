"""Warnings that point at the user's own line of code."""

import sys
import warnings

OWN = ("pushjax.", "equinox.")  # equinox makes the instances of our classes


def warn(message: str) -> None:
    """Show a UserWarning at the line of code outside the package that made the call."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith(OWN):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, UserWarning, stacklevel=level)
