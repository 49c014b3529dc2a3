"""The tables and figures of docs/workspace.md."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np
from matplotlib.figure import Figure

import ssm_decouple as ssm
from ssm_decouple.studies.postures import MARGIN
from ssm_decouple.studies.targets import STEPS, Trials, workspace_trials
from ssm_decouple.studies.workspace import Workspace, arm_joints, joint_slice
from ssm_decouple.viewing import targets as moving
from ssm_decouple.viewing import workspace as viewing
from ssm_decouple.viewing.table import markdown

SAMPLES = 2**22
START = np.deg2rad([150.0, -20.0, -10.0, 0.0, 0.0, 0.0])  # case 1
TARGETS = 2_500
SOME = ("none", "yaw", "roll+yaw", "all")


def robots() -> list[ssm.Robot]:
    """Return the robots of the tables: the last but one is the last with its second arm locked."""
    two = ssm.load_robot("two_arms")
    locked = two.with_locked({f"second_joint_{i + 1}": angle for i, angle in enumerate(START)})
    return [*map(ssm.load_robot, ("ets_vii", "ets_vii_flight", "seven_joint")), locked, two]


@cache
def studied() -> list[Workspace]:
    """Return the finished studies, done once for tables and figures: some minutes."""
    studies = [Workspace(robot, samples=SAMPLES) for robot in robots()]
    for study in studies:
        study.run()
    return studies


def table() -> str:
    """Return what each protection leaves at the usual margin."""
    return markdown(viewing.kept_table([row for study in studied() for row in study.rows() if row.margin_m == MARGIN]))


def margins() -> str:
    """Return how that depends on the margin."""
    rows = [row for study in studied() for row in study.rows() if row.protection in SOME]
    return markdown(viewing.margin_table(rows))


def variants() -> Iterator[tuple[str, ssm.Robot]]:
    """Yield changes of ets_vii, and what they are."""
    robot = ssm.load_robot("ets_vii")
    yield "as it is", robot
    heavy = robot.urdf
    for key, value in {"value": 2550, "ixx": 6200, "iyy": 3540, "izz": 7090}.items():
        heavy = heavy.replace(f'{key}="{value}"', f'{key}="{10 * value}"')
    yield "base ten times as heavy", ssm.Robot(heavy, name="heavy")
    yield "wrist roll locked", robot.with_locked({"joint_6": 0.0})
    ball = 0.02 * np.eye(3)  # kg m2 for each kg
    for mass, offset in ((10.0, 0.0), (10.0, 0.3), (50.0, 0.3)):
        where = "on the roll axis" if offset == 0 else f"{offset:g} m off the roll axis"
        yield f"{mass:g} kg in hand, {where}", robot.with_payload(mass, [0.3, offset, 0.0], mass * ball)


def changes() -> str:
    """Return the share of joint space above the usual margin for changes of ets_vii."""
    lines = [["ets_vii", "joints", *SOME]]
    for what, robot in variants():
        study = Workspace(robot, samples=2**18, voxel=1.0, protections=SOME)
        study.run()
        shares = [f"{100 * row.share:.1f}" for row in study.rows() if row.margin_m == MARGIN]
        lines.append([what, str(robot.n_joints), *shares])
    return markdown(lines)


@cache
def tried() -> list[Trials]:
    """Return the finished motions to random targets: some minutes on two processors."""
    trials = [workspace_trials(robot, TARGETS) for robot in robots() if "locked" not in robot.name]
    for trial in trials:
        trial.run(lambda law, share, name=trial.targets.robot.name: print(f"\r{name}, {law}: {share:4.0%}   ", end=""))
    return trials


def arrivals() -> str:
    """Return how many of random targets the law arrives at under each protection."""
    return markdown(moving.arrival_table([row for trial in tried() for row in trial.rows()]))


def steps() -> str:
    """Return what one more protected row costs, at the same targets."""
    return markdown(moving.pair_table([row for trial in tried() for row in trial.pairs(STEPS)]))


def stops() -> str:
    """Return what holds the motions that stall."""
    return markdown(moving.stop_table([row for trial in tried() for row in trial.stops()]))


def targets_figure() -> Figure:
    """Return how those motions end."""
    return moving.protections(tried())


def figures() -> dict[str, Figure]:
    """Return the figures of postures and places by name."""
    first = studied()[0]
    cut = joint_slice(first.robot, START, (arm_joints(first.robot)[1], arm_joints(first.robot)[2]))
    return {
        "workspace_distributions": viewing.distributions(studied()),
        "workspace_slices": viewing.slices(first),
        "workspace_volumes": viewing.volumes(first),
        "workspace_joint_plane": viewing.joint_plane((first.robot, cut, MARGIN, "the other joints as case1 starts")),
    }
