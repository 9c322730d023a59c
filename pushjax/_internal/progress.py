"""Progress callbacks, and a progress bar that shows the current task, the rate and the remaining time."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

ProgressCallback = Callable[[int, int], None]  # is called with the number of parts done and their total
# Without a terminal, a line is printed after so many s without one: at first, and after minutes of the same work.
SILENCE, LONGEST_SILENCE = 10.0, 60.0


def no_progress(done: int, total: int) -> None:
    """Report nothing."""


class _Rate(ProgressColumn):
    """Column of the bar with the parts done per second."""

    def render(self, task: Task) -> Text:
        return Text("" if task.speed is None else f"{task.speed:,.0f}/s")


class Reporter:
    """Report progress as a bar on a terminal, or as lines on standard error without a terminal."""

    def __init__(self, bar: Progress, words: str):
        self.bar = bar
        self.task = bar.add_task("", total=None)
        self.done, self.total, self.tenth = 0, 0, 0
        # `begin` is when the present words were first shown, `time` when the last line was printed.
        self.begin = self.time = time.monotonic()
        self.say(words)

    def __call__(self, done: int, total: int) -> None:
        self.bar.update(self.task, completed=done, total=total)
        self.done, self.total = done, total
        tenth = 10 * done // total if total else 0
        if self.bar.disable and tenth > self.tenth:  # without a terminal
            self._print_line(f"{self.words}: {100 * done // total}%")
        self.tenth = tenth

    def say(self, words: str) -> None:
        """Show `words` as the description of the work that begins now."""
        self.words, self.begin = words, time.monotonic()
        if self.bar.disable:
            self._print_line(words)
        else:
            self.bar.update(self.task, description=words)

    def note(self, words: str) -> None:
        """Print a line that stays, above the bar."""
        if self.bar.disable:
            self._print_line(words)
        else:
            self.bar.console.print(words, markup=False, highlight=False)

    def break_silence(self) -> None:
        """Say what is being done, and for how long, if the last line is old: 10 s, later up to a minute."""
        now = time.monotonic()
        if now - self.time >= max(SILENCE, min(LONGEST_SILENCE, (now - self.begin) / 6)):
            parts = f" ({self.done} of {self.total} done)" if self.done < self.total else ""
            self._print_line(f"{self.words}: {now - self.begin:.0f} s{parts}")

    def _print_line(self, words: str) -> None:
        """Print a line that a pipe shows at once."""
        self.time = time.monotonic()
        print(f"pushjax: {words}", file=sys.stderr, flush=True)


@contextmanager
def progress_bar(words: str) -> Iterator[Reporter]:
    """Show a progress bar on the terminal while the context is open, and yield its `Reporter`, which says `words`."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), _Rate(), TimeRemainingColumn())
    console = Console()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        reporter, ended = Reporter(bar, words), threading.Event()

        def watch() -> None:
            while not ended.wait(SILENCE / 10):
                reporter.break_silence()

        if bar.disable:
            # a daemon, so that an interrupted program ends
            threading.Thread(target=watch, daemon=True).start()
        try:
            yield reporter
        finally:
            ended.set()
