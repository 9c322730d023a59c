"""Options of the command line. Importing this module does not import JAX."""

from typing import Any

import tyro


def cli_option(metavar: str) -> Any:
    """Return the tyro settings of an option with the placeholder `metavar`, whose help text states the default."""
    # the empty hint keeps tyro from adding the default to the help text
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="")
