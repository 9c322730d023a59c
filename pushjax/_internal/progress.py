"""The type of a progress callback: a function that is called with the number of parts done and their total."""

from collections.abc import Callable

ProgressCallback = Callable[[int, int], None]


def no_progress(done: int, total: int) -> None:
    """Report nothing."""
