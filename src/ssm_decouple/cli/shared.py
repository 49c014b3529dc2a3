"""What the commands have in common: options, progress, tables and complaints."""

from __future__ import annotations

import dataclasses
import json
import logging
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from ssm_decouple.errors import DecoupleWarning, FileError, InputError

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
Force = Annotated[bool, typer.Option("--force", help="Replace files that hold motions of another law, method or --dt.")]
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
    """What a command has produced so far: rows of results and files.

    A file that holds a motion of other settings is not replaced, unless it shall be.
    """

    def __init__(self, folder: Path, no_figures: bool, as_json: bool, force: bool = False) -> None:
        from ssm_decouple.files import writable_folder

        self.folder = writable_folder(folder)
        self.no_figures = no_figures
        self.as_json = as_json
        self.force = force
        self.rows: list[Any] = []
        self.files: list[Path] = []
        self.interrupted = False

    def keep_motion(self, case: Case, name: str, motion: xr.Dataset) -> None:
        """Write a motion into its case's folder.

        Raises:
            FileError: it cannot be written, or a motion of other settings is there.
        """
        from ssm_decouple.files import writable_folder

        writable_folder(self.folder / case.name)
        self.files.append(keep_motion(motion, self._place(case, name), self.force))

    def refuse_another(self, case: Case, name: str, dt: float | None) -> None:
        """Refuse, before a motion is computed, a place that holds one of other settings.

        Raises:
            FileError: it does.
        """
        with suppress(InputError):  # of what cannot be run the run tells
            method = case.simulation.get("method", "explicit")
            law = json.loads(json.dumps(case.make_law(dt=dt).describe()))
            planned = {"dt": case.dt if dt is None else dt, **_flat("law", law)}
            planned["method"] = method if isinstance(method, str) else "dynamic"
            _refuse_another(self._place(case, name), planned, self.force)

    def _place(self, case: Case, name: str) -> Path:
        return self.folder / case.name / f"{file_name(name)}.nc"

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


def keep_motion(motion: xr.Dataset, path: Path, force: bool) -> Path:
    """Write a motion, unless one of another law, method or time between samples is there.

    Raises:
        FileError: it is, or the place cannot be written.
    """
    from ssm_decouple.simulation.motion import save_motion

    _refuse_another(path, _settings(motion), force)
    return save_motion(motion, path)


def _refuse_another(path: Path, planned: Mapping[str, Any], force: bool) -> None:
    from ssm_decouple.simulation.motion import load_motion

    if force or not path.is_file():
        return
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DecoupleWarning)  # that an older file has no checksum
            there = _settings(load_motion(path))
    except FileError as error:
        raise FileError(f"{error}; --force replaces it, or choose another --output") from None
    told = [
        f"{key} is {there.get(key)} there, {value} here" for key, value in planned.items() if there.get(key) != value
    ]
    if told:
        listed = "; ".join(told[:3]) + (f"; and {len(told) - 3} more" if told[3:] else "")
        raise FileError(f"'{path}' holds another motion: {listed}. --force replaces it, or choose another --output")


def _settings(motion: xr.Dataset) -> dict[str, Any]:
    """Return under which settings a motion came about."""
    time = motion.time.values
    found = {"dt": float(f"{time[1] - time[0]:.9g}") if len(time) > 1 else None, "method": motion.attrs.get("method")}
    for name in ("law", "physics"):
        found |= _flat(name, json.loads(motion.attrs.get(name, "{}")))
    return found


def _flat(name: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    return {f"{name}.{key}": value for key, value in settings.items()}


@contextmanager
def telling_what_is_replaced() -> Iterator[None]:
    """Say at the end in one line which files held something else before."""
    from ssm_decouple.files import LOG

    told: list[str] = []
    handler, level = logging.Handler(), LOG.level
    handler.emit = lambda record: told.append(record.getMessage())  # type: ignore[method-assign]
    LOG.addHandler(handler)
    LOG.setLevel(logging.INFO)
    try:
        yield
    finally:
        LOG.removeHandler(handler)
        LOG.setLevel(level)
        if told:
            more = f" and {len(told) - 3} more files" if told[3:] else ""
            complain(f"replaced {escape_markup(', '.join(told[:3]))}{more}, which held something else")


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
