"""The commands `ssm-decouple campaign ..`."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from ssm_decouple.cli.shared import (
    INTERRUPTED,
    AsJson,
    Force,
    NoProgress,
    Output,
    complain,
    escape_markup,
    keep_motion,
    print_table,
)
from ssm_decouple.errors import DecoupleError, FileError, InputError

if TYPE_CHECKING:
    from ssm_decouple.studies.campaign import Campaign
    from ssm_decouple.studies.store import Store, Tally

campaign = typer.Typer(
    no_args_is_help=True,
    help="Campaigns: cases crossed with protections, drawn thousands of times, results in a Zarr store that survives "
    "whatever stops the run.",
)

StorePath = Annotated[Path, typer.Argument(metavar="STORE", help="Folder of the campaign's store.")]
LOG_EVERY = 30.0  # s between lines where there is no terminal


@campaign.command("run")
def run_campaign(
    file: Annotated[Path, typer.Argument(help="The campaign, a TOML file.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="STORE", help="Folder of the store.")],
    workers: Annotated[int | None, typer.Option(help="Processes; one a processor if not given.")] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Dask scheduler, 'tcp://HOST:PORT': its workers compute.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a store that is there.")] = False,
    no_progress: NoProgress = False,
) -> None:
    """Compute every sample of a campaign that the store does not hold yet.

    Whatever ends it, what is finished is kept and --resume goes on; the store is then the same, bit for bit.

    Examples: ssm-decouple campaign run my.toml --output my.zarr; the same with --resume
    """
    from ssm_decouple.studies.campaign import Campaign

    if workers is not None and scheduler is not None:
        raise InputError("give --workers for processes here or --scheduler for a cluster, not both")
    found = Campaign.load(file)
    there = 0
    with _progress(no_progress) as show:

        def tell(done: int, size: int) -> None:
            nonlocal there
            there = done
            show(done, size)

        try:
            found.run(
                output,
                workers=(os.cpu_count() or 1) if workers is None else workers,
                scheduler=scheduler,
                resume=resume,
                progress=tell,
                note=lambda line: complain(escape_markup(line)),
            )
            interrupted = False
        except KeyboardInterrupt:
            interrupted = True
    if interrupted:
        complain(
            f"[bold yellow]interrupted:[/] {there} of {found.size} samples are kept in {escape_markup(output)}; "
            "--resume goes on"
        )
        raise typer.Exit(INTERRUPTED)
    typer.echo(f"{found.size} samples are in {output}; next: ssm-decouple campaign summary {output}")


@campaign.command()
def status(store: StorePath, as_json: AsJson = False) -> None:
    """Say how far a campaign has come."""
    from ssm_decouple.studies.store import Store

    found = Store.open(store).status()
    if as_json:
        typer.echo(json.dumps(dataclasses.asdict(found) | {"left": found.left}, indent=2))
        return
    typer.echo(f"{found.title}")
    typer.echo(f"{found.done} of {found.samples} samples are there, {found.left} are left, {found.failed} failed")
    typer.echo(f"cases {', '.join(found.cases)}; protections {', '.join(found.protections)}")
    typer.echo(f"computed by {', '.join(f'{name} {version}' for name, version in found.versions.items())}")
    typer.echo(f"campaign {found.sha256}")
    for fault in found.damaged:
        typer.echo(f"damaged: {fault}")
    if found.damaged:
        typer.echo(_mend(store))


@campaign.command()
def verify(store: StorePath, as_json: AsJson = False) -> None:
    """Read all that a store holds and say what of it is damaged or lost. Exit status 1 if anything is.

    'campaign run' with --resume mends it: it computes again what is not as it was written.
    """
    from ssm_decouple.studies.store import Store

    found = Store.open(store)
    faults, there = found.damage(), found.rows_there()
    if as_json:
        told = {"checksums": found.checked, "samples": len(there), "there": int(there.sum()), "damaged": faults}
        typer.echo(json.dumps(told, indent=2))
    else:
        for fault in faults:
            typer.echo(f"damaged: {fault}")
        how = "as they were written" if found.checked else "readable; without checksums no more can be said"
        typer.echo(_mend(store) if faults else f"{there.sum()} of {len(there)} samples are there, all {how}")
    if faults:
        raise typer.Exit(1)


@campaign.command()
def summary(
    store: StorePath,
    csv: Annotated[Path | None, typer.Option(help="Write the table to this CSV file too.")] = None,
    as_json: AsJson = False,
) -> None:
    """Print what came of it, by case and protection: who arrived, how fast, how far the base turned."""
    from ssm_decouple.studies.comparison import write_csv
    from ssm_decouple.viewing.table import plain

    kept = _whole(store)
    tallies, there = kept.tallies(), kept.rows_there()
    if not there.all():
        complain(f"{len(there) - there.sum()} of {len(there)} samples are not there; --resume goes on with them")
    if csv is not None and csv.suffix.lower() != ".csv":
        raise InputError(f"--csv is '{csv}'; its name must end in .csv")
    if csv is not None and tallies:
        write_csv(tallies, csv)
    if as_json:
        rows = [{key: _plain(value) for key, value in dataclasses.asdict(tally).items()} for tally in tallies]
        typer.echo(json.dumps(rows, indent=2))
    elif tallies:
        print_table(plain(tally_table(tallies)))
    else:
        typer.echo(f"no sample is in {store} yet")


@campaign.command()
def plot(store: StorePath, output: Output = Path("results")) -> None:
    """Draw what came of it: who arrived, how far off, how far the base turned. Writes a PDF and a PNG.

    Samples that are not there yet are left out, so that a campaign can be looked at while it runs.
    """
    from ssm_decouple.viewing.campaign import campaign_sheet
    from ssm_decouple.viewing.style import save

    for path in save(campaign_sheet(_whole(store)), output, store.resolve().stem):
        typer.echo(path)


@campaign.command()
def rerun(
    store: StorePath,
    sample: Annotated[int, typer.Argument(help="Number of the sample, from 0.")],
    output: Output = Path("results"),
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Compute one sample alone, from what the store holds, write its whole motion and compare.

    Writes OUTPUT/sample_NUMBER.nc. The row is computed again as it was, which has to give the same bits, and from the
    motion, which in a kinematic case another code computes: equal to rounding.
    """
    from ssm_decouple.studies.campaign import versions
    from ssm_decouple.studies.store import Store

    kept = Store.open(store)
    found = kept.campaign
    case, protection, draw = found.place(sample)
    fault = kept.fault_of(sample)
    if fault is not None:
        complain(f"[bold yellow]warning:[/] the chunk is not as it was written: {escape_markup(fault)}")
    stored = kept.row(sample, though_damaged=fault is not None)
    again = {name: values[0] for name, values in found.rows([sample]).items()}
    same = all(_same(stored[name], again[name]) for name in stored)
    computed, path = _motion_of(found, sample, output, force)
    told = _compared(stored, computed)
    if as_json:
        rows = {name: {"stored": _plain(old), "computed": _plain(new)} for name, old, new in told}
        typer.echo(
            json.dumps({"sample": sample, "same_bits": same, "motion": path and str(path), "rows": rows}, indent=2)
        )
        return
    typer.echo(f"sample {sample}: {case.name}, protection '{protection}', draw {draw}")
    _print_compared(told)
    typer.echo(f"computed again as it was: {'the same bits' if same else 'other bits'}")
    if not same and kept.versions != versions():
        typer.echo(f"the store was computed by {kept.versions}, this is {versions()}")
    if path is not None:
        typer.echo(f"the motion is in {path}")


def _mend(store: Path) -> str:
    return f"'ssm-decouple campaign run FILE --output {store} --resume' computes it again"


def _whole(path: Path) -> Store:
    """Return a store of which nothing is damaged: what is not is no matter for statistics.

    Raises:
        FileError: something is.
    """
    from ssm_decouple.studies.store import Store

    found = Store.open(path)
    faults = found.damage()
    if faults:
        more = f", and {len(faults) - 1} more" if faults[1:] else ""
        raise FileError(
            f"'{path}' is damaged: {faults[0]}{more}. 'ssm-decouple campaign verify {path}' lists all that is, and "
            f"{_mend(path)}"
        )
    return found


def tally_table(tallies: Sequence[Tally]) -> list[list[str]]:
    """Return the figures of a campaign as rows of texts, headings first."""
    lines = [
        [
            "case",
            "protection",
            "k",
            "samples",
            "arrived (%)",
            "stalled",
            "running",
            "failed",
            "time (s)",
            "left (mm)",
            "roll, pitch, yaw (deg)",
            "protected (rad/s)",
        ]
    ]
    for one in tallies:
        share = f"{100 * one.arrived:.1f} ({100 * one.arrived_low:.1f} to {100 * one.arrived_high:.1f})"
        counts = [str(count) for count in (one.stalled, one.running, one.failed)]
        turned = "  ".join(f"{angle:.3f}" for angle in (one.roll_deg, one.pitch_deg, one.yaw_deg))
        figures = [
            f"{one.median_time_s:.0f}",
            f"{1e3 * one.median_left_m:.2f}",
            turned,
            f"{one.protected_rate_max:.1e}",
        ]
        lines.append([one.case, one.protection, str(one.k), str(one.samples), share, *counts, *figures])
    return lines


def _motion_of(found: Campaign, sample: int, output: Path, force: bool) -> tuple[dict[str, Any], Path | None]:
    """Return what a store would keep of a sample's motion, and where the motion is written."""
    from ssm_decouple.files import writable_folder
    from ssm_decouple.studies.campaign import FAILED, results_of

    try:
        motion = found.motion(sample)
    except DecoupleError as error:
        return {"outcome": FAILED, "error": " ".join(str(error).split())}, None
    return results_of(motion), keep_motion(motion, writable_folder(output) / f"sample_{sample}.nc", force)


def _compared(stored: Mapping[str, Any], computed: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """Return name, stored value and the one computed now, None of what was drawn."""
    return [(name, value, computed.get(name)) for name, value in stored.items()]


def _print_compared(told: Sequence[tuple[str, Any, Any]]) -> None:
    from ssm_decouple.viewing.table import plain

    lines = [["", "stored", "from the motion", "apart"]]
    for name, old, new in told:
        apart = ""
        if new is not None and not isinstance(new, str):
            apart = f"{np.max(np.abs(np.asarray(old) - np.asarray(new))):.1e}"
        lines.append([name, _text(old), "" if new is None else _text(new), apart])
    print_table(plain(lines))


def _same(old: Any, new: Any) -> bool:
    if isinstance(new, str):
        return str(old) == new
    return bool(np.array_equal(old, new, equal_nan=True))


def _text(value: Any) -> str:
    if isinstance(value, str):
        return str(value)
    return "  ".join(f"{number:.6g}" for number in np.atleast_1d(value))


def _plain(value: Any) -> Any:
    """Return a value as JSON has it, which knows no NaN."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list):
        return [_plain(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@contextmanager
def _progress(hidden: bool) -> Iterator[Callable[[int, int], None]]:
    """Give a function that shows samples done, samples a second and the time left."""
    console = Console(stderr=True)
    columns = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[pace]}"), TimeElapsedColumn())
    begun: list[tuple[float, int]] = []
    told = 0.0
    with Progress(*columns, console=console, transient=True, disable=hidden or not console.is_terminal) as bars:
        task = bars.add_task("", total=None, pace="")

        def show(done: int, size: int) -> None:
            nonlocal told
            now = time.monotonic()
            if not begun:
                begun.append((now, done))
            pace = _pace(now - begun[0][0], done - begun[0][1], size - done)
            bars.update(task, completed=done, total=size, pace=pace)
            if not (hidden or console.is_terminal) and (now - told > LOG_EVERY or done == size):
                told = now
                typer.echo(f"{done} of {size} samples{pace and ', '}{pace}", err=True)

        yield show


def _pace(seconds: float, done: int, left: int) -> str:
    """Return in words how many samples a second, and the time left; nothing before the first."""
    if not (done and seconds > 0):
        return ""
    pace = done / seconds
    minutes, rest = divmod(round(left / pace), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{pace:.3g} samples/s, {hours}:{minutes:02}:{rest:02} left"
