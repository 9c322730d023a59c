"""Options of the command line."""

from typing import Any

import tyro


def cli_option(metavar: str) -> Any:
    """Return the tyro settings of an option with the placeholder `metavar`; a default of None stays unsaid."""
    return tyro.conf.arg(
        metavar=metavar, help_behavior_hint=lambda text: "" if text in ("", "None") else f"(default: {text})"
    )
