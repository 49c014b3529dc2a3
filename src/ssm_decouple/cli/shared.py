"""What the commands have in common: options, progress, tables and complaints."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from ssm_decouple.errors import InputError

if TYPE_CHECKING:
    from rich.table import Table

    from ssm_decouple.studies.case import Case

NOT_ARRIVED = 3
INTERRUPTED = 130

_CASES = "Names of cases ('ssm-decouple cases' lists them), TOML files, or 'all'."
Cases = Annotated[list[str], typer.Argument(help=_CASES, show_default=False)]
Output = Annotated[Path, typer.Option("--output", "-o", help="Folder for what is written.")]
NoFigures = Annotated[bool, typer.Option("--no-figures", help="Write no figures.")]
NoProgress = Annotated[bool, typer.Option("--no-progress", help="Show no progress.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON to standard output instead of tables.")]


def load(names: list[str], damping: float | None = None, dynamic: bool = False) -> list[Case]:
    """Return the cases of these names, with another damping or with torques instead of their own method if asked."""
    from ssm_decouple.studies.case import cases as catalogue
    from ssm_decouple.studies.case import load_case

    loaded = [load_case(name) for word in names for name in (catalogue() if word == "all" else [word])]
    twice = {case.name for case in loaded if [other.name for other in loaded].count(case.name) > 1}
    if twice:
        raise InputError(f"two cases are called {', '.join(sorted(twice))}: their results would overwrite each other")
    if damping is not None:
        loaded = [dataclasses.replace(case, law={**case.law, "damping": damping}) for case in loaded]
    if dynamic:
        from ssm_decouple.simulation.dynamic import Dynamic

        loaded = [
            case
            if isinstance(case.simulation.get("method"), Dynamic)
            else dataclasses.replace(case, simulation={**case.simulation, "method": Dynamic()})
            for case in loaded
        ]
    return loaded


def print_table(table: Table) -> None:
    """Print a table, wider than the terminal if it has to be."""
    console = Console()
    # Where the terminal is narrower, a line that wraps is easier to read than a number that is cut.
    console.width = max(console.width, Console(width=1000).measure(table).maximum)
    console.print(table)


def file_name(law: str) -> str:
    """Return what the files of a law's motion are called."""
    return re.sub(r"[^\w.+@-]+", "_", law)


@contextmanager
def progress_bar(hidden: bool) -> Iterator[Any]:
    """Give a function that shows case, law and the share done."""
    columns, console = (TextColumn("{task.description:<40}"), BarColumn(), TimeElapsedColumn()), Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=hidden or not console.is_terminal) as bars:
        task = bars.add_task("starting", total=1.0)
        told: set[str] = set()

        def show(case: str, law: str, share: float) -> None:
            now = f"{case}, {law}"
            bars.update(task, description=now, completed=share)
            if not (hidden or console.is_terminal or now in told):  # in a log, a line for each motion instead of a bar
                told.add(now)
                typer.echo(now, err=True)

        yield show


def complain(line: str) -> None:
    """Print a line on standard error."""
    Console(stderr=True).print(line, soft_wrap=True, highlight=False)


def escape_markup(text: object) -> str:
    """Return text as it is, where square brackets would mean a style."""
    from rich.markup import escape

    return escape(str(text))
