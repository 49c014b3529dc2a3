"""The commands that run and compare cases, draw motions and look at robots."""

from __future__ import annotations

import dataclasses
import json
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import ssm_decouple
from ssm_decouple.cli.campaign import campaign
from ssm_decouple.cli.shared import (
    INTERRUPTED,
    NOT_ARRIVED,
    AsJson,
    Cases,
    Force,
    NoFigures,
    NoProgress,
    Output,
    Products,
    complain,
    escape_markup,
    file_name,
    load,
    print_table,
    progress_bar,
    telling_what_is_replaced,
)
from ssm_decouple.cli.study import Study, study
from ssm_decouple.cli.view import add_viewer
from ssm_decouple.errors import DecoupleError, DecoupleWarning

if TYPE_CHECKING:
    import xarray as xr

    from ssm_decouple.studies.case import Case

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Selective decoupling for free-floating space manipulators: the arm reaches its target while the base "
    "directions that matter do not turn.\n\nStart with [bold]ssm-decouple compare all[/bold].",
    epilog="Exit status: 0 all well; 1 bad input, one line says what and how to mend it; 2 wrong usage; "
    f"{NOT_ARRIVED} a motion of 'run' did not reach its target; {INTERRUPTED} interrupted, what was done is kept.",
)

app.add_typer(study, name="study")
app.add_typer(campaign, name="campaign")
add_viewer(app)

_PROTECT = (
    "Protect this instead of the case's own axes: none, roll, pitch, yaw, all, several as 'roll+yaw', or numbers as "
    "'0.5,0,0.866' or '1,0,0;0,0,1', six each for the base twist [linear; angular]; add '@inertial' for inertial axes."
)
Dynamics = Annotated[
    bool, typer.Option("--dynamic", help="Solve the equations of motion, the joints driven by torques.")
]
TimeStep = Annotated[float | None, typer.Option("--dt", help="Time between samples, s, instead of the case's own.")]
Protect = Annotated[str | None, typer.Option("--protect", "-p", help=_PROTECT)]
Damping = Annotated[
    float | None, typer.Option(help="rho at a singularity, m2, instead of the case's own; 0 for the plain inverse.")
]
NumberOfTargets = Annotated[
    int | None, typer.Option("--targets", help="Move to so many random targets instead of the case's own.")
]
TargetSeed = Annotated[int, typer.Option("--seed", help="Of the random targets.")]


def main() -> None:
    """Run the command; an expected error is one line on standard error and exit status 1."""
    warnings.showwarning = _show_warning
    try:
        with telling_what_is_replaced():
            app()
    except DecoupleError as error:
        complain(f"[bold red]error:[/] {escape_markup(error)}")
        sys.exit(1)


@app.callback(invoke_without_command=True)
def _version(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        typer.echo(ssm_decouple.__version__)
        raise typer.Exit


@app.command()
def run(
    cases: Cases,
    output: Output = Path("results"),
    dt: TimeStep = None,
    protect: Protect = None,
    damping: Damping = None,
    dynamic: Dynamics = False,
    force: Force = False,
    no_figures: NoFigures = False,
    no_progress: NoProgress = False,
    as_json: AsJson = False,
) -> None:
    """Simulate cases under their own protection and write motions and figures.

    Writes OUTPUT/CASE/LAW.nc and the figures beside it. Exit status 3 if one does not reach its target. A file with a
    motion of another law, method or time between samples is not replaced without --force.

    Examples: ssm-decouple run case1; ssm-decouple run my.toml --protect yaw --output somewhere
    """
    from ssm_decouple.momentum.protection import Protection
    from ssm_decouple.studies.comparison import summarise

    law = "selective"
    if protect is not None:
        law = {"none": "none", "all": "reactionless"}.get(protect, f"protect {protect}")
        chosen = Protection.parse(protect)
    work = _Work(output, no_figures, as_json, force)
    with work.collecting(), progress_bar(no_progress or as_json) as show:
        for case in load(cases, damping, dynamic):
            if protect is not None:  # it becomes the case's own, so that w_sub is about these axes
                case = dataclasses.replace(case, protection=chosen)
            work.refuse_another(case, law, dt)
            motion = case.run(dt=dt, progress=partial(show, case.name, law))
            work.keep_motion(case, law, motion)
            work.draw(case, law, motion)
            work.rows.append(summarise(motion, law))
    work.report()
    if any(row.outcome != "converged" for row in work.rows):
        raise typer.Exit(NOT_ARRIVED)


@app.command()
def compare(
    cases: Cases,
    output: Output = Path("results"),
    dt: TimeStep = None,
    damping: Damping = None,
    dynamic: Dynamics = False,
    targets: NumberOfTargets = None,
    seed: TargetSeed = 0,
    force: Force = False,
    no_figures: NoFigures = False,
    no_progress: NoProgress = False,
    as_json: AsJson = False,
) -> None:
    """Run cases under no protection, their own and full reactionless control, and print one table.

    Where the damping acted, the same law undamped is shown too. Writes OUTPUT/comparison.csv and, for each case,
    motions, the figures of its own protection and a sheet that compares the laws.

    With --targets, the laws move from each case's start to so many random targets within the arm's reach instead, and
    the tables say what share each reaches and what stops the others. Writes OUTPUT/targets.csv and a sheet for each
    case. A thousand targets take some seconds a law.

    Examples: ssm-decouple compare all; ssm-decouple compare case2 my.toml --json; ssm-decouple compare case1 --targets
    1000
    """
    from ssm_decouple.studies.comparison import compare_step_by_step, summarise, write_csv

    if targets is not None:
        loaded = load(cases, damping, dynamic)
        _compare_at_targets(Study("targets", output, no_figures, as_json), loaded, targets, seed, dt, no_progress)
        return
    work = _Work(output, no_figures, as_json, force)
    with work.collecting(), progress_bar(no_progress or as_json) as show:
        for case in load(cases, damping, dynamic):
            motions = {}
            for law, motion in compare_step_by_step(case, dt, partial(show, case.name)):
                motions[law] = motion
                work.keep_motion(case, law, motion)
                work.rows.append(summarise(motion, law))
            show(case.name, "figures", 1.0)
            own = "selective" if "selective" in motions else next(reversed(motions))
            work.draw(case, own, motions[own])
            work.draw_comparison(case, motions)
    if work.rows:
        work.files.append(write_csv(work.rows, work.folder / "comparison.csv"))
    work.report()


def _compare_at_targets(
    work: Study, cases: list[Case], targets: int, seed: int, dt: float | None, no_progress: bool
) -> None:
    from ssm_decouple.studies.targets import case_trials
    from ssm_decouple.viewing import targets as viewing

    pairs, stops, studies = [], [], [case_trials(case, targets, seed, dt) for case in cases]
    with work.collecting(), progress_bar(no_progress or work.as_json) as show:
        for trials in studies:
            try:
                trials.run(partial(show, trials.targets.start))
            finally:  # what was done before Ctrl-C counts
                work.rows += trials.rows()
                pairs += trials.pairs()
                stops += trials.stops()
                if trials.found:
                    work.draw(f"{trials.targets.start}/targets", viewing.sheet, trials)
    work.report(
        {
            f"{targets} random targets within reach: how each law does": viewing.arrival_table(work.rows),
            "two laws at the same targets": viewing.pair_table(pairs),
            "what holds the stalled motions": viewing.stop_table(stops),
        }
    )


@app.command()
def plot(
    motion: Annotated[Path, typer.Argument(help="A motion, netCDF, as 'run' and 'compare' write them.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder; the motion's own if not given.")
    ] = None,
) -> None:
    """Draw the figures of a motion again."""
    from ssm_decouple.simulation.motion import load_motion
    from ssm_decouple.viewing.figures import save_figures

    for path in save_figures(load_motion(motion), output or motion.parent, motion.stem):
        typer.echo(path)


@app.command()
def check(
    robot: Annotated[str, typer.Argument(help="A URDF, MJCF or TOML file, or the name of a robot of the catalogue.")],
    as_json: AsJson = False,
) -> None:
    """Say what a robot is made of and what is suspicious or impossible in its file.

    Exit status 1 if it cannot be used.
    """
    from ssm_decouple.model.catalogue import find_robot
    from ssm_decouple.model.report import Report

    report = Report.of_file(find_robot(robot))
    typer.echo(json.dumps(report.to_dict(), indent=2) if as_json else str(report))
    if not report.usable:
        raise typer.Exit(1)


@app.command()
def models(as_json: AsJson = False) -> None:
    """List the robots that come with the package."""
    from ssm_decouple.model.catalogue import find_urdf, load_robot
    from ssm_decouple.model.catalogue import models as catalogue

    paths = catalogue()
    robots = {name: load_robot(name) for name in paths}
    if as_json:
        listed = {
            name: {
                "joints": found.n_joints,
                "mass": found.mass,
                "urdf": str(find_urdf(name)),
                "appendages": [appendage.name for appendage in found.appendages],
            }
            for name, found in robots.items()
        }
        typer.echo(json.dumps(listed, indent=2))
        return
    for name, found in robots.items():
        bends = f"{len(found.appendages)} appendages" if found.appendages else ""
        typer.echo(f"{name:<16} {found.n_joints} joints  {found.mass:7.1f} kg  {bends:<12}  {paths[name]}")


@app.command()
def cases(as_json: AsJson = False) -> None:
    """List the cases that come with the package; copy one to start your own."""
    from ssm_decouple.studies.case import cases as catalogue
    from ssm_decouple.studies.case import load_case

    titles = {name: load_case(name).title for name in catalogue()}
    if as_json:
        listed = {name: {"title": titles[name], "toml": str(path)} for name, path in catalogue().items()}
        typer.echo(json.dumps(listed, indent=2))
        return
    for name, path in catalogue().items():
        typer.echo(f"{name:<13} {titles[name]}\n{'':<13} {path}")


class _Work(Products):
    """Motions under laws, with their summaries, so that an interruption keeps them."""

    @contextmanager
    def collecting(self) -> Iterator[None]:
        """Turn Ctrl-C into an orderly end: what is done stays, the motion in progress is kept apart."""
        from ssm_decouple.simulation.simulate import DivergenceError, SimulationInterrupted

        try:
            yield
        except DivergenceError as stopped:
            from ssm_decouple.simulation.motion import save_motion

            path = save_motion(stopped.motion, self.folder / "diverged.nc")
            raise DivergenceError(f"{stopped}; the motion until then is in {path}", stopped.motion) from None
        except SimulationInterrupted as stopped:
            self.interrupted = True
            from ssm_decouple.simulation.motion import save_motion

            self.files.append(save_motion(stopped.motion, self.folder / "interrupted.nc"))
        except KeyboardInterrupt:
            self.interrupted = True

    def draw(self, case: Case, law: str, motion: xr.Dataset) -> None:
        if not self.no_figures:
            from ssm_decouple.viewing.figures import save_figures

            self.files += save_figures(motion, self.folder / case.name, file_name(law))

    def draw_comparison(self, case: Case, motions: dict[str, xr.Dataset]) -> None:
        from ssm_decouple.viewing.figures import comparison

        self.draw_sheet(f"{case.name}/comparison", comparison, motions)

    def report(self) -> None:
        """Print the rows, the reasons and where the files are; leave with the interrupted status if it was."""
        from ssm_decouple.viewing.table import explain, not_kept, saturation, terminal_table

        if self.as_json:
            self.print_json()
        elif self.rows:
            print_table(terminal_table(self.rows))
            for row in self.rows:
                for remark in filter(None, (explain(row), saturation(row), not_kept(row))):
                    typer.echo(remark)
            typer.echo(f"\n{len(self.files)} files in {self.folder}")
        if self.interrupted:
            complain(
                f"[bold yellow]interrupted:[/] {len(self.rows)} finished motions are kept in "
                f"{escape_markup(self.folder)}"
            )
            raise typer.Exit(INTERRUPTED)


def _show_warning(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    if issubclass(category, DecoupleWarning):
        complain(f"[bold yellow]warning:[/] {escape_markup(message)}")
    else:
        complain(f"{category.__name__}: {escape_markup(message)}")
