"""Options of the command line. Importing this module does not import JAX."""

from typing import Any

import tyro


def cli_option(metavar: str) -> Any:
    """Return the tyro settings of an option whose help text states the default itself.

    tyro then does not add the default to the help text.

    Args:
        metavar: Placeholder that the help shows for the option's value.
    """
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="")
