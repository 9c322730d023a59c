"""How a command's help shows its options."""

from typing import Any

import tyro


def cli_option(metavar: str) -> Any:
    """Return the tyro settings of an option whose help text states the default in words, so that tyro does not add it.

    Args:
        metavar: Placeholder that the help shows for the option's value.
    """
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="")
