"""Two arms on one bus: arm A brings its hand to a pose, arm B takes up the momentum about the protected axes.

ETS-VII's arm twice, A in its place, B half a turn further. The law is that of one arm: it takes the smallest of all
twelve joint rates, so that B helps without a task of its own. For comparison B is locked where it stands.

    python examples/two_arms.py [POSES]    # random poses, a few by default; 1000 take a quarter of an hour
"""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ET
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import xarray as xr
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from scipy.stats import binomtest

import ssm_decouple as ssm

Floats = NDArray[np.float64]

START = np.deg2rad([150.0, -20.0, -10.0, 0.0, 0.0, 0.0])  # of both arms
SHOWN = np.deg2rad([110.0, 0.0, 15.0, 20.0, 30.0, 40.0])  # A's joints where its hand has the pose that is shown
SPREAD = np.deg2rad(60.0)  # random poses: each joint of A up to so far from its start
DURATION, STEP = 300.0, 0.2  # s: 15 times 1 / gain, three times what a turn of 180 deg takes that nothing hinders
NEAR, ALIGNED = 0.01, np.deg2rad(1.0)  # m, rad: a pose is reached within both
SINGULAR = 0.02  # where the law's damping would set in
LEGS = 10  # of a tour
PROTECTIONS = ("none", "yaw", "roll+yaw", "all")
TASKS = {"pose": ssm.PoseTask(), "position": ssm.PositionTask()}
HALF_TURNS = ("roll", "pitch", "yaw")


@cache
def spacecraft(half_turn: str = "pitch") -> tuple[ssm.Robot, ssm.Robot]:
    """Return bus and arms with B free, and with B locked.

    B stands where A would after half a turn of the whole about an axis of the base.
    """
    whole = ET.fromstring(ssm.load_robot("ets_vii").urdf)
    whole.findall("link")[0][:] = []  # the bus without mass and shape, to carry the arm alone
    arm = ssm.Robot(ET.tostring(whole, encoding="unicode"), name="arm")
    turned = pin.SE3(pin.exp3(np.pi * np.eye(3)[HALF_TURNS.index(half_turn)]), np.zeros(3))
    with_b = ssm.compose("ets_vii_bus", arm, turned, prefix="b_")
    free = ssm.compose(with_b, arm, mount=[0, 0, 0], prefix="a_")
    return free, free.with_locked({f"b_joint_{i + 1}": angle for i, angle in enumerate(START)})


def stand(robot: ssm.Robot, a_joints: Floats = START, base: pin.SE3 | None = None) -> Floats:
    """Return the configuration with A's joints as given and B's, where they are free, at the start."""
    return robot.configuration(np.concatenate([a_joints, START])[: robot.n_joints], base)


class Attempt(NamedTuple):
    """How a motion to a pose ended."""

    motion: xr.Dataset
    away: float  # m
    turned: float  # rad
    arrival: float  # s: when it was reached for good; not a number where it was not


def attempt(robot: ssm.Robot, protection: str, q: Floats, pose: pin.SE3, task: str = "pose") -> Attempt:
    """Bring A's hand to a pose, or to its position alone."""
    law = ssm.SelectiveLaw(robot, ssm.Protection(protection), tasks=TASKS[task])
    motion = ssm.simulate(law, q, pose if task == "pose" else pose.translation, DURATION, STEP)
    away, turned = motion.end_effector_error.values, np.zeros(motion.sizes["time"])
    if task == "pose":
        turned = np.linalg.norm(motion.task_error.values[:, 3:], axis=1)
    missed = np.flatnonzero((away > NEAR) | (turned > ALIGNED))
    first = missed[-1] + 1 if missed.size else 0
    return Attempt(motion, away[-1], turned[-1], motion.time.values[first] if first < away.size else np.nan)


def show() -> None:
    """Print one motion under each protection, with B's help and without."""
    both = spacecraft()
    pose = both[0].frame_pose(stand(both[0], SHOWN))
    print(f"{'one pose':<10} {'left, B free':>22} {'left, B locked':>22} {'sigma (m), free':>18} {'locked':>8}")
    for protection in PROTECTIONS:
        found = [attempt(robot, protection, stand(robot), pose) for robot in both]
        left = [f"{1e3 * one.away:8.2f} mm {np.rad2deg(one.turned):6.2f} deg" for one in found]
        couplings = [robot.coupling(stand(robot)) for robot in both]
        sigmas = [coupling.manipulability(ssm.Protection(protection)).smallest for coupling in couplings]
        print(f"{protection:<10} {left[0]} {left[1]} {sigmas[0]:18.1e} {sigmas[1]:8.1e}")
        if protection != "none":
            print(told_momentum(both[0], protection, found[0].motion))


def told_momentum(robot: ssm.Robot, protection: str, motion: xr.Dataset) -> str:
    """Say what the arms exchange, at the sample at which A gives the protected axes most, and how fast they move."""
    rates, U_c = motion.joint_rates.values, ssm.Protection(protection).U_c
    given = np.empty((2, len(rates), U_c.shape[1]))
    for i, (q, rate) in enumerate(zip(motion.configuration.values, rates, strict=True)):
        momentum = U_c.T @ robot.coupling(q).H_wq * rate  # (k, 12), N m s
        given[:, i] = momentum[:, :6].sum(axis=1), momentum[:, 6:].sum(axis=1)
    a, b = given[:, np.argmax(np.linalg.norm(given[0], axis=1))]
    fastest = np.rad2deg(np.abs(rates).max(axis=0))
    return (
        f"    A gives up to {np.linalg.norm(a):.2f} N m s, of which B takes {-100 * a @ b / (a @ a):.0f} %; fastest "
        f"joint of A {fastest[:6].max():.2f} deg/s, of B {fastest[6:].max():.2f}"
    )


class Row(NamedTuple):
    """What is kept of an attempt."""

    arrival: float  # s
    margin: float  # smallest singular value of the task in what the protection leaves, at the end
    a_margin: float  # that of A's Jacobian, base held
    rate_scale: float  # at the end
    b_turn: float  # deg: how far B's farthest joint has turned


def keep(found: Attempt, robot: ssm.Robot) -> Row:
    """Return what is kept of an attempt."""
    motion, last = found.motion, found.motion.isel(time=-1)
    turns = np.abs(motion.joint_positions.values - motion.joint_positions.values[0])[:, 6:]
    a_margin = np.linalg.svd(robot.coupling(last.configuration.values).J_arm[:, :6])[1][-1]
    margin, scale = float(last.smallest_singular_value), float(last.rate_scale)
    return Row(found.arrival, margin, a_margin, scale, float(np.rad2deg(turns.max(initial=0.0))))


def attempts(offset: Floats) -> dict[tuple[str, str, str], Row]:
    """Return how A goes to a random pose, by task, protection and B."""
    found = {}
    for name, robot in zip(("free", "locked"), spacecraft(), strict=True):
        pose = robot.frame_pose(stand(robot, START + offset))
        for task in TASKS:
            for protection in PROTECTIONS:
                found[task, protection, name] = keep(attempt(robot, protection, stand(robot), pose, task), robot)
    for half_turn in HALF_TURNS:
        robot, _ = spacecraft(half_turn)
        pose = robot.frame_pose(stand(robot, START + offset))
        found["pose", "all", half_turn] = keep(attempt(robot, "all", stand(robot), pose), robot)
    return found


def tour(protection: str, offsets: Floats) -> list[bool]:
    """Visit random poses one after another, each given in base axes where the last ended; return which are reached."""
    robot, _ = spacecraft()
    q, reached = stand(robot), []
    for offset in offsets:
        found = attempt(robot, protection, q, robot.frame_pose(stand(robot, START + offset, robot.base_pose(q))))
        reached.append(bool(np.isfinite(found.arrival)))
        q = found.motion.configuration.values[-1]
    return reached


def share(reached: NDArray[np.bool_]) -> str:
    """Return a share with its Wilson 95 % interval, per cent."""
    low, high = binomtest(int(reached.sum()), reached.size).proportion_ci(method="wilson")
    return f"{100 * reached.mean():5.1f} ({100 * low:4.1f} to {100 * high:5.1f})"


def median(times: Floats) -> str:
    """Return the median of the times at which poses were reached, s."""
    reached = times[np.isfinite(times)]
    return f"{np.median(reached):.0f}" if reached.size else "-"


def tell(rows: list[dict[tuple[str, str, str], Row]]) -> None:
    """Print the shares of poses that are reached."""
    results = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    print(f"\nreached, % of {len(rows):<5} {'B free':>22} {'B locked':>22} only free  locked  median (s)  locked")
    for task in TASKS:
        for protection in PROTECTIONS:
            times, others = (results[task, protection, name][:, 0] for name in ("free", "locked"))
            free, locked = np.isfinite(times), np.isfinite(others)
            print(
                f"{task:<9} {protection:<9} {share(free):>22} {share(locked):>22} {np.sum(free & ~locked):9d} "
                f"{np.sum(locked & ~free):7d} {median(times):>11} {median(others):>7}"
            )
    print("\npose, B free: missed; of these at a singularity, of A alone, at a rate limit; B's farthest joint turns")
    for protection in PROTECTIONS:
        times, margins, of_a, scales, turns = results["pose", protection, "free"].T
        missed = np.isnan(times)
        why = [np.sum(missed & which) for which in (margins < SINGULAR, of_a < SINGULAR, scales < 1)]
        counts = "".join(f"{count:6d}" for count in (np.sum(missed), *why))
        print(f"    {protection:<9}{counts}   median {np.median(turns):4.0f} deg, at most {turns.max():4.0f}")
    print("\npose, all three axes protected, B half a turn from A about")
    for half_turn in HALF_TURNS:
        print(f"    {half_turn:<6} {share(np.isfinite(results['pose', 'all', half_turn][:, 0]))} %")


def main(poses: int) -> None:
    """Print one motion, then the shares of random poses that are reached, and of those of tours."""
    show()
    rng = np.random.default_rng(0)
    offsets = rng.uniform(-SPREAD, SPREAD, (poses, 6))
    legs = rng.uniform(-SPREAD, SPREAD, (poses // LEGS, LEGS, 6))
    console = Console(stderr=True)
    watched = partial(track, console=console, transient=True, disable=not console.is_terminal)
    with ProcessPoolExecutor() as pool:
        tell(list(watched(pool.map(attempts, offsets), f"{poses} poses", total=poses)))
        if len(legs):
            print(f"\n{len(legs)} tours, B never brought back: poses reached on leg 1 to {LEGS} (%)")
        for protection in PROTECTIONS if len(legs) else ():
            reached = list(watched(pool.map(partial(tour, protection), legs), protection, total=len(legs)))
            print(f"    {protection:<9}" + "".join(f"{100 * leg:5.0f}" for leg in np.mean(reached, axis=0)))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
