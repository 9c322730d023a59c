"""How the help shows options of commands."""

from typing import Any

import tyro


def option(metavar: str) -> Any:
    """Of an option whose text says what it is by default. metavar: what stands for its value."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="")
