"""A progress bar that shows the current task, the rate and the remaining time."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

SILENCE = 10  # s


class _Rate(ProgressColumn):
    """Column of the bar with the parts done per second."""

    def render(self, task: Task) -> Text:
        return Text("" if task.speed is None else f"{task.speed:,.0f}/s")


class Reporter:
    """Reports progress: a bar on a terminal, or lines on standard error without a terminal.

    Call it with `(done, total)` to report how far the work has come. Without a terminal that is a line for every tenth
    of the work, and after `SILENCE` seconds without one.
    """

    def __init__(self, bar: Progress):
        self.bar = bar
        self.task = bar.add_task("", total=None)
        self.words = ""
        self.tenth, self.time = 0, time.monotonic()  # of the last line

    def __call__(self, done: int, total: int) -> None:
        self.bar.update(self.task, completed=done, total=total)
        tenth, now = 10 * done // total if total else 0, time.monotonic()
        if self.bar.disable and (tenth != self.tenth or (done and now - self.time > SILENCE)):
            self.tenth, self.time = tenth, now
            _print_line(f"{self.words}: {100 * done // total}%" if self.words else f"{100 * done // total}%")

    def say(self, words: str) -> None:
        """Show `words` as the description of the task that begins now."""
        self.words, self.tenth, self.time = words, 0, time.monotonic()
        if self.bar.disable:
            _print_line(words)
        else:
            self.bar.update(self.task, description=words)

    def note(self, words: str) -> None:
        """Print a line that stays, above the bar."""
        if self.bar.disable:
            _print_line(words)
        else:
            self.bar.console.print(words, markup=False, highlight=False)


def _print_line(words: str) -> None:
    """Print a line that a pipe shows at once."""
    print(f"pushjax: {words}", file=sys.stderr, flush=True)


@contextmanager
def progress_bar() -> Iterator[Reporter]:
    """Show a progress bar on the terminal and yield its `Reporter`; the bar disappears at the end."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), _Rate(), TimeRemainingColumn())
    console = Console()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        yield Reporter(bar)
