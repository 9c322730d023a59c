"""A progress bar with the rate and the time that remains, and what is being done."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

Report = Callable[[int, int], None]  # (done, of so many)


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        return Text("" if task.speed is None else f"{task.speed:,.0f}/s")


class Reporter:
    """Tells how far work has come: a bar on a terminal, lines on standard error where there is none."""

    def __init__(self, bar: Progress):
        self.bar = bar
        self.task = bar.add_task("", total=None)

    def __call__(self, done: int, total: int) -> None:
        self.bar.update(self.task, completed=done, total=total)

    def say(self, words: str) -> None:
        """What is being done from now on."""
        if self.bar.disable:
            print(f"pushjax: {words}", file=sys.stderr, flush=True)
        else:
            self.bar.update(self.task, description=words)


@contextmanager
def progress_bar() -> Iterator[Reporter]:
    """A bar on the terminal, gone when done; yields what to tell it."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), _Rate(), TimeRemainingColumn())
    console = Console()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        yield Reporter(bar)
