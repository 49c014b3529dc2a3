"""What the commands have in common: options, progress, tables and complaints."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from ssm_decouple.errors import InputError

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure
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


class Products:
    """What a command has produced so far: rows of results and files."""

    def __init__(self, folder: Path, no_figures: bool, as_json: bool) -> None:
        from ssm_decouple.files import writable_folder

        self.folder = writable_folder(folder)
        self.no_figures = no_figures
        self.as_json = as_json
        self.rows: list[Any] = []
        self.files: list[Path] = []
        self.interrupted = False

    def keep_motion(self, case: Case, name: str, motion: xr.Dataset) -> None:
        """Write a motion into its case's folder."""
        from ssm_decouple.files import writable_folder
        from ssm_decouple.simulation.motion import save_motion

        place = writable_folder(self.folder / case.name)
        self.files.append(save_motion(motion, place / f"{file_name(name)}.nc"))

    def draw_sheet(self, name: str, figure: Callable[[Any], Figure], subject: Any) -> None:
        """Draw one figure, its name being a path under the folder, unless none are wanted."""
        if not self.no_figures:
            from ssm_decouple.viewing.style import save

            place = self.folder / name
            self.files += save(figure(subject), place.parent, place.name)

    def print_json(self) -> None:
        """Print rows and files as JSON."""
        rows = [dataclasses.asdict(row) for row in self.rows]
        found = {"interrupted": self.interrupted, "rows": rows, "files": [str(path) for path in self.files]}
        typer.echo(json.dumps(found, indent=2))


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
