"""The command `ssm-decouple study workspace`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ssm_decouple.cli.shared import AsJson, NoFigures, NoProgress, Output, progress_bar
from ssm_decouple.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ssm_decouple.studies.workspace import Workspace

Robots = Annotated[
    list[str] | None,
    typer.Argument(help="Names of the catalogue, URDF, MJCF or TOML files; without any, ets_vii.", show_default=False),
]


def study_workspace(
    robots: Robots = None,
    output: Output = Path("results"),
    samples: Annotated[
        int, typer.Option(help="Postures to draw, rounded to 16 times a power of two; four times as many are searched.")
    ] = 2**20,
    margin: Annotated[float, typer.Option(help="Smallest singular value of J_gt N_sub that is enough, m.")] = 0.02,
    voxel: Annotated[float | None, typer.Option(help="Edge of a voxel, m.", show_default="reach / 20")] = None,
    targets: Annotated[
        int, typer.Option(help="Random targets to move to under each protection, from random starts; 0 for none.")
    ] = 0,
    seed: Annotated[int, typer.Option(help="Of the postures and the targets.")] = 0,
    no_figures: NoFigures = False,
    no_progress: NoProgress = False,
    as_json: AsJson = False,
) -> None:
    """How much of joint space and of the reachable volume each protection leaves fit for work.

    Nothing, each axis, each pair and all three protected. Writes OUTPUT/workspace.csv, a figure of all robots and
    figures of each. Half a minute a robot. With --targets the law also moves to so many random targets under each
    protection, which gives OUTPUT/targets.csv and a figure; a thousand take half a minute a robot.

    Examples: ssm-decouple study workspace ets_vii seven_joint; ssm-decouple study workspace two_arms --targets 1000
    """
    from ssm_decouple.cli.study import Study
    from ssm_decouple.model.catalogue import load_robot
    from ssm_decouple.studies.comparison import write_csv
    from ssm_decouple.studies.targets import STEPS, workspace_trials
    from ssm_decouple.studies.workspace import Workspace, arm_joints, joint_slice
    from ssm_decouple.viewing import targets as moving
    from ssm_decouple.viewing import workspace as viewing

    named = robots or ["ets_vii"]
    studies = {
        Path(name).stem: Workspace(load_robot(name), margin=margin, samples=samples, voxel=voxel, seed=seed)
        for name in named
    }
    if len(studies) < len(named):
        raise InputError("two robots have the same name: their results would overwrite each other")
    trials = [workspace_trials(found.robot, targets, seed) for found in studies.values()] if targets else []
    work = Study("workspace", output, no_figures, as_json)
    with work.collecting(), progress_bar(no_progress or as_json) as show:
        for name, found in studies.items():
            try:
                found.run(partial(show, name, "postures"))
            finally:  # what was done before Ctrl-C counts
                work.rows += found.rows()
            for kind, figure in viewing.FIGURES.items():
                work.draw(f"{name}/{kind}", figure, found)
            first, second = arm_joints(found.robot)[1:3]
            posture, rest = _posture(found)
            cut = joint_slice(found.robot, posture, (first, second), found.protections)
            work.draw(f"{name}/joint_plane", viewing.joint_plane, (found.robot, cut, margin, rest))
        for tried in trials:
            tried.run(partial(show, tried.targets.robot.name))
    work.draw("workspace", viewing.distributions, [found for found in studies.values() if found.blocks])
    counted = ", ".join(f"{name} {found.drawn.samples}" for name, found in studies.items() if found.drawn)
    tried_out = [tried for tried in trials if tried.found]
    arrivals = [row for tried in tried_out for row in tried.rows()]
    if arrivals:
        work.files.append(write_csv(arrivals, work.folder / "targets.csv"))
        work.draw("targets", moving.protections, tried_out)
    at_margin = [row for row in work.rows if row.margin_m == margin]
    work.report(
        {
            f"smallest singular value above {margin:g} m: share of joint space, of postures at a typical place, and "
            f"of the volume with a fit posture; postures drawn: {counted}": viewing.kept_table(at_margin),
            "share of joint space / of the volume (%), by margin": viewing.margin_table(work.rows),
            f"{targets} random targets within reach, from random starts": moving.arrival_table(arrivals),
            "one more protected direction at a time, at the same targets": moving.pair_table(
                [row for tried in tried_out for row in tried.pairs(STEPS)]
            ),
            "what holds the stalled motions": moving.stop_table([row for tried in tried_out for row in tried.stops()]),
        }
    )


def _posture(study: Workspace) -> tuple[NDArray[np.float64], str]:
    """Return the joint positions at which the other joints of a plane stand, and words for them."""
    from ssm_decouple.studies.case import cases, load_case

    for case in map(load_case, cases()):
        if case.robot.urdf == study.robot.urdf:
            return study.robot.joint_positions(case.start()), f"the other joints as {case.name} starts"
    protection = study.protections[-1]
    return study.best_posture(protection)[0], f"the other joints as in the best posture found for '{protection}'"
