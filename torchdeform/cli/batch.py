"""``batch`` and ``schema``: many pairs from one file."""

import json
from pathlib import Path
from typing import Annotated

import typer

from torchdeform.cli.options import Quiet, flag, say_written, table
from torchdeform.cli.progress import CohortProgress
from torchdeform.cohort.estimate import Costs, estimate
from torchdeform.cohort.page import BADGES, VERDICTS
from torchdeform.cohort.plan import DESCRIPTION, Plan, description, plan
from torchdeform.cohort.run import review, run
from torchdeform.cohort.schema import cohort_schema, read_cohort
from torchdeform.cohort.settings import EngineSettings
from torchdeform.cohort.summary import FAILURES, PAGE, Summary
from torchdeform.core.memory import readable
from torchdeform.io.files import atomic_file
from torchdeform.report.record import write_json

CohortFile = Annotated[Path, typer.Argument(metavar="COHORT.yaml", help="What to register, and how.")]
DryRun = Annotated[bool, flag("--dry-run", "Show the pairs, missing files, time and memory; run nothing.")]
PrintConfig = Annotated[bool, flag("--print-config", "Print the file with all defaults; run nothing.")]
Only = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME", help="Only pairs with this name, or its start (sub-01), or like sub-0*; repeatable."),
]
Resume = Annotated[
    bool, typer.Option("--resume/--no-resume", help="Skip pairs that are done with the same files and settings.")
]
RetryFailed = Annotated[bool, flag("--retry-failed", "Also run pairs that failed before.")]
SchemaOut = Annotated[
    Path | None, typer.Option("--out", metavar="FILE.json", show_default="standard output", help="Where to write it.")
]


def batch(
    cohort_file: CohortFile,
    dry_run: DryRun = False,
    print_config: PrintConfig = False,
    only: Only = None,
    resume: Resume = True,
    retry_failed: RetryFailed = False,
    quiet: Quiet = False,
) -> None:
    """Register all pairs of a cohort: each MOVING is warped onto its FIXED, as register does it.

    Finished pairs are kept: the same command continues where a run ended, and repeats pairs that have changed.
    docs/cohorts.md describes the file; with torchdeform schema an editor can complete and check it.
    """
    cohort = read_cohort(cohort_file)
    if print_config:
        typer.echo(cohort.to_yaml(), nl=False)
        return
    whole = plan(cohort)
    work = whole.only(only) if only else whole
    if dry_run:
        typer.echo(overview(work, estimate(work.jobs)))
        return
    how = {"resume": resume, "retry_failed": retry_failed}
    with CohortProgress(quiet) as progress:
        summary = _run(work, whole, cohort.engine, progress, how)
    if not quiet:
        typer.echo(outcome(summary))
    if summary.failed:
        raise typer.Exit(1)


def _run(work: Plan, whole: Plan, engine: EngineSettings, progress: CohortProgress, how: dict[str, bool]) -> Summary:
    """Run a plan, which may be a part of the cohort, and write the summary of the whole cohort."""
    try:
        summary = run(work.jobs, work.out, engine, problems=work.problems, report=progress.show, **how)
        write_json(description(), work.out / DESCRIPTION)
        return summary
    finally:
        if work is not whole:  # `run` wrote the summary of some pairs only
            review(whole.jobs, whole.out, whole.problems)


def outcome(summary: Summary) -> str:
    """Return the outcome of a cohort in a few lines."""
    lines = {"pairs": f"{summary.done} done, {summary.failed} failed"}
    judged = [f"{summary.badges[kind]} {BADGES[kind][1]}" for kind in VERDICTS if summary.badges.get(kind)]
    if judged:
        lines["verdict"] = ", ".join(judged)
    lines |= {f"{title}, mean": text.replace("→", "->") for title, text in summary.means.items()}
    if summary.failed:
        lines["failures"] = str(summary.out / FAILURES)
    return table(lines | {"results": str(summary.out / PAGE)})


def schema(out: SchemaOut = None) -> None:
    """Print the JSON Schema of a cohort file, with which editors complete and check it."""
    text = json.dumps(cohort_schema(), indent=2) + "\n"
    if out is None:
        typer.echo(text, nl=False)
        return
    with atomic_file(out) as new:
        new.write_text(text, encoding="utf-8")
    say_written(out)


def overview(work: Plan, costs: Costs) -> str:
    """Return the pairs of a plan, those that cannot run, time and memory, as lines of text."""
    pairs = [f"{job.name}: {job.files.moving} -> {job.files.fixed}" for job in work.jobs]
    problems = [f"cannot run: {problem.name}: {problem.sentence}" for problem in work.problems]
    sums = {
        "pairs": f"{len(work.jobs)} to register, {len(work.problems)} cannot run",
        "time": f"about {costs.readable_time} one after another, on one core",
        "memory": f"about {readable(costs.memory)} for the largest pair",
        "results": str(work.out),
    }
    if costs.unknown:
        sums["unknown"] = f"{costs.unknown} pairs whose size is unknown before they run, not counted"
    unreadable = [f"likely to fail: {name}: {why}" for name, why in costs.unreadable.items()]
    return "\n".join([*pairs, *problems, *unreadable, table(sums)])
