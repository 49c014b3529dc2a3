"""One control step against the number of joints: 3 to 24 of them, random arms put on one bus by `compose`.

All take turns in one process, so that the ratios hold whatever the machine does meanwhile. The tasks are for the last
arm's hand; where its joints are too few for all that they ask, the law meets them in the least-squares sense.

    python benchmarks/arms.py [--plot FILE]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial

import numpy as np
from control_step import ROUNDS, bare_pinocchio, medians
from matplotlib.figure import Figure
from numpy.typing import NDArray

import ssm_decouple as ssm
from ssm_decouple.viewing.style import COLUMN, styled

Floats = NDArray[np.float64]

JOINTS, ARMS = (3, 4, 5, 6), (1, 2, 3, 4)  # of an arm, on a bus
KINDS = {
    "bare": "Pinocchio's bare calls",
    "position": "law.evaluate, a position",
    "pose": "law.evaluate, a pose",
}


def random_arm(joints: int, rng: np.random.Generator) -> ssm.Robot:
    """Return a serial arm of revolute joints about random axes, its links rods of 10 kg."""
    parts = ['<robot name="arm"><link name="root"/>']
    for i in range(joints):
        axis, length = rng.normal(size=3), rng.uniform(0.3, 0.8)
        axis /= np.linalg.norm(axis)
        across = 10 * length**2 / 12
        parts.append(
            f'<link name="link_{i}"><inertial><origin xyz="0 0 {length / 2}"/><mass value="10"/>'
            f'<inertia ixx="{across}" iyy="{across}" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="joint_{i}" type="revolute"><parent link="{f"link_{i - 1}" if i else "root"}"/>'
            f'<child link="link_{i}"/><origin xyz="0 0 {length if i else 0}"/>'
            f'<axis xyz="{axis[0]} {axis[1]} {axis[2]}"/><limit lower="-3" upper="3" effort="10" velocity="1"/></joint>'
        )
    return ssm.Robot("".join([*parts, "</robot>"]), name=f"arm of {joints}")


def spacecraft(joints: int, arms: int, rng: np.random.Generator) -> ssm.Robot:
    """Return the bus of ETS-VII with random arms at random places."""
    robot = ssm.load_robot("ets_vii_bus")
    for i in range(arms):
        robot = ssm.compose(robot, random_arm(joints, rng), rng.uniform(-1, 1, 3), prefix=f"arm_{i}_")
    return robot


def candidates(robot: ssm.Robot, rng: np.random.Generator) -> dict[str, Callable[[], object]]:
    """Return what is timed: the bare calls, and the law with yaw protected for two tasks of the last arm's hand."""
    q = robot.configuration(rng.uniform(-1, 1, robot.n_joints))
    found: dict[str, Callable[[], object]] = {"bare": bare_pinocchio(robot, q)}
    pose = robot.frame_pose(q)
    pose.translation += [0.1, -0.1, 0.2]
    for kind, task, target in (
        ("position", ssm.PositionTask(), pose.translation.copy()),
        ("pose", ssm.PoseTask(), pose.homogeneous.ravel()),
    ):
        law = ssm.SelectiveLaw(robot, ssm.Protection("yaw"), tasks=task)
        at_rest, out = np.zeros(law.layout.target_sizes[1]), np.empty(law.size)
        found[kind] = partial(law.evaluate, q, target, at_rest, out)
    return found


def power(joints: Floats, times: Floats) -> float:
    """Return the power of the number of joints with which a time grows."""
    return float(np.polyfit(np.log(joints), np.log(times), 1)[0])


@styled
def plot(subject: tuple[Floats, dict[str, Floats]]) -> Figure:
    """Draw the times against the number of joints, with their straight lines."""
    joints, times = subject
    figure = Figure(figsize=(COLUMN, 2.6))
    axes = figure.subplots()
    for (kind, values), color in zip(times.items(), ("#8C8C8C", "#0072B2", "#CC79A7"), strict=True):
        axes.plot(joints, 1e6 * values, ".", color=color, label=KINDS[kind])
        axes.plot([0, 25], 1e6 * np.polyval(np.polyfit(joints, values, 1), [0, 25]), color=color, linewidth=0.8)
    axes.set(
        xlabel="joints",
        ylabel="one step (us)",
        xlim=(0, 25),
        ylim=(0, 1.4e6 * times["pose"].max()),
        xticks=range(0, 25, 6),
    )
    axes.legend(loc="upper left")
    return figure


def main(file: str | None) -> None:
    """Time all, print the table and the fits, and draw them if asked to."""
    rng = np.random.default_rng(0)
    robots = {(arms, joints): spacecraft(joints, arms, rng) for arms in ARMS for joints in JOINTS}
    found = medians(
        {f"{kind} {place}": call for place, robot in robots.items() for kind, call in candidates(robot, rng).items()}
    )
    joints = np.array([float(robot.n_joints) for robot in robots.values()])
    times = {kind: np.array([found[f"{kind} {place}"] for place in robots]) for kind in KINDS}
    print(f"median of {ROUNDS} rounds, us      bare position  / bare     pose  / bare")
    for i in np.argsort(joints, kind="stable"):
        arms, each = list(robots)[i]
        bare, position, pose = (1e6 * times[kind][i] for kind in KINDS)
        ratios = f"{position:8.2f} {position / bare:7.2f} {pose:8.2f} {pose / bare:7.2f}"
        print(f"{joints[i]:3.0f} joints, {arms} x {each} {bare:14.2f} {ratios}")
    print("\ntime = a + b joints        a (us)   b (us)  farthest off (%)   as a power  from 9 joints on")
    many = joints >= 9
    for kind, values in times.items():
        slope, offset = np.polyfit(joints, values, 1)
        off = 100 * np.abs(values / (offset + slope * joints) - 1).max()
        powers = f"{power(joints, values):12.2f} {power(joints[many], values[many]):17.2f}"
        print(f"{KINDS[kind]:<25} {1e6 * offset:7.2f} {1e6 * slope:8.3f} {off:17.0f} {powers}")
    if file is not None:
        plot((joints, times)).savefig(file)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--plot", metavar="FILE", help="draw the times, for example to arms.png")
    main(parser.parse_args().plot)
