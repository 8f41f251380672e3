"""Progress of a registration or a cohort: a bar on a terminal, a cohort's lines elsewhere."""

from contextlib import ExitStack
from datetime import timedelta
from typing import Self

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeElapsedColumn

from torchdeform.cohort.run import BEGIN, END, SKIPPED, Event
from torchdeform.cohort.task import FAILED
from torchdeform.core.stages import heard_by
from torchdeform.registration.result import Progress as Step

# Where on the bar a stage of a registration begins; the levels lie between two of them.
_STAGES = {
    "reading": 0.0, "aligning": 0.05, "searching": 0.2, "inverting": 0.8, "judging": 0.85, "writing": 0.9,
    "drawing": 0.93,
}  # fmt: skip
_LEVELS = (0.25, 0.8)


class _Bar:
    """A progress bar on stderr while a block runs, on a terminal only. It redraws itself, so that its clock runs."""

    def __init__(self, quiet: bool, title: str, detail: str, total: float | None, *columns: ProgressColumn) -> None:
        console = Console(stderr=True, highlight=False)
        shown = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[detail]}"), *columns)
        self._on_terminal = console.is_terminal and not quiet
        self._progress = Progress(*shown, console=console, transient=True, disable=not self._on_terminal)
        self._task = self._progress.add_task(title, total=total, detail=detail)

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()


class StepProgress(_Bar):
    """Shows the stages and steps of one registration.

    Args:
        quiet: show nothing.
    """

    def __init__(self, quiet: bool = False) -> None:
        super().__init__(quiet, "reading", "", 1.0, TimeElapsedColumn())
        self._open = ExitStack()

    def __enter__(self) -> Self:
        self._open.enter_context(heard_by(self.begin))
        return super().__enter__()

    def __exit__(self, *how: object) -> None:
        super().__exit__(*how)
        self._open.close()

    def begin(self, stage: str) -> None:
        """Show the name of a stage, and how much of the work lies before it."""
        self._progress.update(self._task, completed=_STAGES.get(stage), description=stage, detail="", refresh=True)

    def show(self, step: Step) -> None:
        """Show one step of the optimisation. Every level is the same share of the bar."""
        start, end = _LEVELS
        done = start + (end - start) * (step.level + step.step / max(step.steps, 1)) / step.levels
        title = f"level {step.level + 1}/{step.levels} {'×'.join(map(str, step.shape))}"
        detail = f"step {step.step}, similarity {step.similarity.mean().item():.4g}"
        self._progress.update(self._task, completed=done, description=title, detail=detail)


class CohortProgress(_Bar):
    """Shows the events of a run on stderr, failures with their sentences.

    Args:
        quiet: show failures only.
        title: what runs; the bar and every line start with it.
    """

    def __init__(self, quiet: bool = False, title: str = "pairs") -> None:
        super().__init__(quiet, title, "looking for finished work", None)
        self._quiet, self._title, self._skipped = quiet, title, 0

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
            self._say(f"{self._title}: {self._skipped} already done (skipped)")

    def _say(self, line: str, *, always: bool = False) -> None:
        if self._on_terminal:
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
    """Return pairs per second, minute, hour or day, whichever is the first with at least one."""
    for seconds, name in ((1, "s"), (60, "min"), (3600, "h")):
        if per_second * seconds >= 1:
            return f"{per_second * seconds:.1f} per {name}"
    return f"{per_second * 86400:.1f} per day"


def _left(event: Event) -> str:
    return "" if event.left is None else f", {timedelta(seconds=round(event.left))} left"
