"""A progress bar that shows the current task, the rate and the remaining time."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text


class _Rate(ProgressColumn):
    """Column of the bar with the parts done per second."""

    def render(self, task: Task) -> Text:
        return Text("" if task.speed is None else f"{task.speed:,.0f}/s")


class Reporter:
    """Reports progress: a bar on a terminal, or lines on standard error without a terminal.

    Call it with `(done, total)` to report how far the work has come.
    """

    def __init__(self, bar: Progress):
        self.bar = bar
        self.task = bar.add_task("", total=None)

    def __call__(self, done: int, total: int) -> None:
        self.bar.update(self.task, completed=done, total=total)

    def say(self, words: str) -> None:
        """Show `words` as the description of the task that begins now."""
        if self.bar.disable:
            print(f"pushjax: {words}", file=sys.stderr, flush=True)
        else:
            self.bar.update(self.task, description=words)

    def note(self, words: str) -> None:
        """Print a line that stays, above the bar."""
        if self.bar.disable:
            print(f"pushjax: {words}", file=sys.stderr, flush=True)
        else:
            self.bar.console.print(words, markup=False, highlight=False)


@contextmanager
def progress_bar() -> Iterator[Reporter]:
    """Show a progress bar on the terminal and yield its `Reporter`; the bar disappears at the end."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), _Rate(), TimeRemainingColumn())
    console = Console()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        yield Reporter(bar)
