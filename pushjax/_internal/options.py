"""How a command's help shows its options."""

from typing import Any

import tyro


def cli_option(metavar: str) -> Any:
    """Return the settings of an option whose help text states its own default.

    Args:
        metavar: Placeholder that the help shows for the option's value.
    """
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="")
