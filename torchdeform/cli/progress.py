"""How far a cohort is: a bar where a person sees it, plain lines where they are kept."""

from datetime import timedelta
from typing import Self

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn

from torchdeform.cohort.run import BEGIN, END, SKIPPED, Event
from torchdeform.cohort.task import FAILED


class CohortProgress:
    """Shows the events of a run on stderr, failures with their sentences.

    Args:
        quiet: show failures only.
        title: what runs, at the head of the bar and of every line.
    """

    def __init__(self, quiet: bool = False, title: str = "pairs") -> None:
        console = Console(stderr=True, highlight=False)
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[detail]}"))
        self._seen = console.is_terminal and not quiet
        self._quiet, self._title, self._skipped = quiet, title, 0
        self._progress = Progress(*columns, console=console, transient=True, disable=not self._seen)
        self._task = self._progress.add_task(title, total=None, detail="looking at what is done")

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def show(self, event: Event) -> None:
        """Show an event."""
        ended = event.done + event.failed
        self._progress.update(self._task, total=event.total, completed=ended, detail=_detail(event))
        if event.kind == SKIPPED:
            self._skipped += 1
        elif event.kind == FAILED:
            self._say(f"{self._title} {ended}/{event.total}: {event.name} failed: {event.sentence}", always=True)
        elif event.kind not in (BEGIN, END):
            self._say(
                f"{self._title} {ended}/{event.total}: {event.name} {event.kind} in {event.seconds:.1f} s{_left(event)}"
            )
        elif event.kind == END and self._skipped:
            self._say(f"{self._title}: {self._skipped} left as an earlier run settled them")

    def _say(self, line: str, *, always: bool = False) -> None:
        if self._seen:
            if always:
                self._progress.console.print(escape(line), soft_wrap=True)
        elif always or not self._quiet:
            typer.echo(line, err=True)


def _detail(event: Event) -> str:
    """Return counts, rate and time left."""
    ran = event.done + event.failed - event.skipped
    counts = f"{event.done + event.failed}/{event.total}" + (f", {event.failed} failed" if event.failed else "")
    return counts + (f", {_rate(ran / event.elapsed)}{_left(event)}" if ran > 0 and event.elapsed > 0 else "")


def _rate(per_second: float) -> str:
    """Return pairs per the shortest time that makes them at least one."""
    for seconds, name in ((1, "s"), (60, "min"), (3600, "h")):
        if per_second * seconds >= 1:
            return f"{per_second * seconds:.1f} a {name}"
    return f"{per_second * 86400:.1f} a day"


def _left(event: Event) -> str:
    return "" if event.left is None else f", {timedelta(seconds=round(event.left))} left"
