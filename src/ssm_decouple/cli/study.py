"""The commands `ssm-decouple study ..`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ssm_decouple.cli.shared import (
    INTERRUPTED,
    AsJson,
    Cases,
    Force,
    NoFigures,
    NoProgress,
    Output,
    Products,
    complain,
    load,
    print_table,
    progress_bar,
)
from ssm_decouple.cli.workspace import study_workspace
from ssm_decouple.errors import DecoupleError, InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


study = typer.Typer(no_args_is_help=True, help="Parameter studies of cases.")
study.command("workspace")(study_workspace)

SmoothStart = Annotated[float, typer.Option("--smooth-start", help="Time over which the motion gathers pace, s.")]


@study.command("sampling")
def study_sampling(
    cases: Cases,
    output: Output = Path("results"),
    no_figures: NoFigures = False,
    no_progress: NoProgress = False,
    as_json: AsJson = False,
) -> None:
    """How far the protected axis really turns when commands are held between samples.

    Each case under four ways of planning for the hold and five sample times. Writes OUTPUT/sampling.csv and a figure.

    Example: ssm-decouple study sampling case1 case2 case3
    """
    from ssm_decouple.studies.sampling import PLANS, sampling
    from ssm_decouple.viewing import figures
    from ssm_decouple.viewing.table import drift_table

    work = Study("sampling", output, no_figures, as_json)
    with work.collecting(), progress_bar(no_progress or as_json) as show:

        def tick(case: str, nodes: int, dt: float, share: float) -> None:
            show(case, f"{PLANS[nodes]}, {dt:g} s", share)

        for case in load(cases):
            work.rows += list(sampling(case, progress=partial(tick, case.name)))
    work.draw("sampling", figures.sampling, work.rows)
    work.report({"largest true rotation about a protected axis over the motion, deg": drift_table(work.rows)})


@study.command("bending")
def study_bending(
    cases: Cases,
    output: Output = Path("results"),
    smooth_start: SmoothStart = 8.0,
    torque: Annotated[
        bool, typer.Option("--torque", help="Drive the joints by torques; without, they follow each command at once.")
    ] = False,
    force: Force = False,
    no_figures: NoFigures = False,
    no_progress: NoProgress = False,
    as_json: AsJson = False,
) -> None:
    """How far flexible appendages bend: nothing, the case's own axes, the bending modes, all rotation protected.

    Cases on the rigid ETS-VII run on ets_vii_flexible. Writes OUTPUT/bending.csv and, for each case, motions and a
    figure.

    Example: ssm-decouple study bending case1 case2 case3
    """
    from ssm_decouple.simulation.dynamic import Servo
    from ssm_decouple.studies.bending import bending, flexible
    from ssm_decouple.viewing import figures
    from ssm_decouple.viewing.table import bending_table

    bendable = [flexible(case) for case in load(cases)]
    work = Study("bending", output, no_figures, as_json, force)
    with work.collecting(), progress_bar(no_progress or as_json) as show:
        for case in bendable:
            motions = {}
            runs = bending(case, Servo() if torque else None, smooth_start, progress=partial(show, case.name))
            for row, motion in runs:
                motions[row.protection] = motion
                work.rows.append(row)
                work.keep_motion(case, f"bending_{row.protection}", motion)
            work.draw(f"{case.name}/bending", figures.bending, (case, motions))
    work.report({"deflection of the appendages' tips": bending_table(work.rows)})


@study.command("pointing")
def study_pointing(
    cases: Cases,
    output: Output = Path("results"),
    boresight: Annotated[str, typer.Option(help="Where the instrument looks, base axes, 'x,y,z'.")] = "0,1,0",
    step: Annotated[float, typer.Option(help="Physics step, s.")] = 1e-3,
    force: Force = False,
    no_figures: NoFigures = False,
    no_progress: NoProgress = False,
    as_json: AsJson = False,
) -> None:
    """How far a line of sight wanders while torques move the arm: nothing, the line of sight, all axes protected.

    Writes OUTPUT/pointing.csv and, for each case, motions and a figure.

    Example: ssm-decouple study pointing case3
    """
    from ssm_decouple.simulation.dynamic import Dynamic
    from ssm_decouple.studies.pointing import pointing
    from ssm_decouple.viewing import figures
    from ssm_decouple.viewing.table import pointing_table

    line = _numbers("boresight", boresight)
    work = Study("pointing", output, no_figures, as_json, force)
    with work.collecting(), progress_bar(no_progress or as_json) as show:
        for case in load(cases):
            motions = {}
            for row, motion in pointing(case, line, Dynamic(step=step), partial(show, case.name)):
                motions[row.law] = motion
                work.rows.append(row)
                work.keep_motion(case, f"pointing_{row.law}", motion)
            work.draw(f"{case.name}/pointing", figures.pointing, motions)
    work.report({f"angle between the line of sight ({boresight}) and where it looked": pointing_table(work.rows)})


@study.command("robustness")
def study_robustness(
    cases: Cases,
    output: Output = Path("results"),
    runs: Annotated[int, typer.Option(help="Random plants at each level.")] = 200,
    levels: Annotated[str, typer.Option(help="Errors of the model, per cent.")] = "1,2,5,10",
    feedback_gain: Annotated[float, typer.Option(help="K of the runs with feedback, 1/s.")] = 1.0,
    seed: Annotated[int, typer.Option(help="Of the random plants.")] = 0,
    workers: Annotated[int, typer.Option(help="Processes.")] = 2,
    no_figures: NoFigures = False,
    no_progress: NoProgress = False,
    as_json: AsJson = False,
) -> None:
    """What is left of the protection when masses, inertias, centres of mass and mounts are off; and single causes.

    At p per cent, masses are off by up to p per cent, inertias by up to p per cent beside their mass, and lengths by
    up to p mm. Without feedback and with J_sub q_dot = -K theta. Writes OUTPUT/robustness.csv, effects.csv and a
    figure. Some minutes a case.

    Example: ssm-decouple study robustness case1 --runs 20
    """
    from ssm_decouple.studies.comparison import write_csv
    from ssm_decouple.studies.robustness import Robustness, effects
    from ssm_decouple.viewing import figures
    from ssm_decouple.viewing.table import effect_table, leak_table

    shares = [0.01 * level for level in _numbers("levels", levels)]
    campaigns = [Robustness(case, shares, runs, feedback_gain, seed, workers) for case in load(cases)]
    work, single = Study("robustness", output, no_figures, as_json), []
    with work.collecting(), progress_bar(no_progress or as_json) as show:
        for campaign in campaigns:
            case = campaign.case
            try:
                campaign.run(partial(show, case.name, "random plants"))
            finally:  # what was done before Ctrl-C counts
                work.rows += campaign.leaks()
            for effect in effects(case, feedback_gain):
                show(case.name, effect.cause, 1.0)
                single.append(effect)
    if single:
        work.files.append(write_csv(single, work.folder / "effects.csv"))
    work.draw("robustness", figures.robustness, work.rows)
    work.report(
        {
            "largest true rotation about a protected axis, random errors in the model": leak_table(work.rows),
            "the same, one imperfection at a time, the model right": effect_table(single),
        }
    )


class Study(Products):
    """Rows of a study, with its motions, so that an interruption or an error keeps them."""

    def __init__(self, name: str, folder: Path, no_figures: bool, as_json: bool, force: bool = False) -> None:
        super().__init__(folder, no_figures, as_json, force)
        self.name = name
        self.error: DecoupleError | None = None

    @contextmanager
    def collecting(self) -> Iterator[None]:
        """Turn Ctrl-C and errors into an orderly end: what was finished before is written first."""
        from ssm_decouple.simulation.simulate import DivergenceError

        try:
            yield
        except KeyboardInterrupt:
            self.interrupted = True
        except DivergenceError as stopped:
            from ssm_decouple.simulation.motion import save_motion

            self.files.append(save_motion(stopped.motion, self.folder / "diverged.nc"))
            self.error = stopped
        except DecoupleError as error:
            self.error = error

    def draw(self, name: str, figure: Callable[[Any], Figure], subject: Any) -> None:
        """Draw a figure, if there is anything to draw."""
        if self.rows:
            self.draw_sheet(name, figure, subject)

    def report(self, tables: Mapping[str, Sequence[Sequence[str]]]) -> None:
        """Write the rows, print the tables and where the files are; leave with the interrupted status if it was."""
        from ssm_decouple.studies.comparison import write_csv
        from ssm_decouple.viewing.table import plain

        if self.rows:
            self.files.insert(0, write_csv(self.rows, self.folder / f"{self.name}.csv"))
        if self.as_json:
            self.print_json()
        elif self.rows:
            for heading, lines in tables.items():
                if len(lines) > 1:
                    typer.echo(heading)
                    print_table(plain(lines))
            typer.echo(f"{len(self.files)} files in {self.folder}")
        if self.error is not None:
            raise self.error
        if self.interrupted:
            kept = "what was finished before is kept" if self.files else "nothing was finished before"
            complain(f"[bold yellow]interrupted:[/] {kept}")
            raise typer.Exit(INTERRUPTED)


def _numbers(name: str, text: str) -> list[float]:
    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        raise InputError(f"--{name} is '{text}'; give numbers with commas between them") from None
