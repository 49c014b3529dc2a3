"""The batch engine against plain Python loops: matrices and singular values, and whole motions.

All candidates take turns in one process, so that the ratios hold whatever the machine does meanwhile.

    python benchmarks/batch.py [largest N, 1000000 by default]
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from collections.abc import Callable

os.environ.setdefault("OMP_NUM_THREADS", "1")  # threads for 6 x 6 matrices would only hurt the loops
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pinocchio as pin
from control_step import plain_numpy
from numpy.typing import NDArray

import ssm_decouple as ssm
from ssm_decouple.batch import Batch

Floats = NDArray[np.float64]

ROUNDS = 9
PROTECTED = ["none", "roll", "pitch", "yaw"]
CONFIGURATIONS = 32768  # a turn of the engine
LOOPED = 400  # a turn of the plain loop
JOINTS = (3, 4, 6, 7, 8, 10, 12, 14)
MOTIONS, SAMPLES = 512, 100
STEP = 0.1  # s


def in_turns(candidates: dict[str, tuple[int, Callable[[], object]]]) -> dict[str, list[float]]:
    """Return the times of one item of each candidate, s, a round each; a candidate does so many items a call."""
    times: dict[str, list[float]] = {name: [] for name in candidates}
    for _, call in candidates.values():
        call()  # may compile
    for _ in range(ROUNDS):
        for name, (count, call) in candidates.items():
            start = time.perf_counter()
            call()
            times[name].append((time.perf_counter() - start) / count)
    return times


def ratio(times: dict[str, list[float]], slow: str, quick: str) -> float:
    """Return the median over the rounds of how many times quicker one is."""
    return statistics.median(a / b for a, b in zip(times[slow], times[quick], strict=True))


def plain_matrices(robot: ssm.Robot) -> Callable[[Floats], tuple[Floats, Floats, list[float]]]:
    """Return J_rc, J_gt and four smallest singular values of one configuration, as one would write it."""
    model, data, frame = robot.model, robot.model.createData(), robot.end_effector_id
    start, identity, base = robot.configuration(), np.eye(robot.n_joints), np.eye(3)

    def compute(joints: Floats) -> tuple[Floats, Floats, list[float]]:
        q = start.copy()
        q[7:] = joints
        pin.computeCentroidalMap(model, data, q)
        pin.updateFramePlacement(model, data, frame)
        J = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
        A_g = data.Ag
        J_base = -np.linalg.solve(A_g[:, :6], A_g[:, 6:])
        J_rc, J_gt = J_base[3:], (J[:, 6:] + J[:, :6] @ J_base)[:3]
        smallest = [np.linalg.svd(J_gt, compute_uv=False)[-1]]
        for axis in base:
            J_sub = axis[None] @ J_rc
            N_sub = identity - np.linalg.pinv(J_sub) @ J_sub
            smallest.append(np.linalg.svd(J_gt @ N_sub, compute_uv=False)[-1])
        return J_rc, J_gt, smallest

    return compute


def compare_matrices() -> None:
    """Print how much quicker the engine is than a loop, on one core and on more."""
    robot = ssm.load_robot("ets_vii")
    joints = np.random.default_rng(0).uniform(-3, 3, (CONFIGURATIONS, robot.n_joints))
    plain, one, all_cores = plain_matrices(robot), Batch(robot, threads=1), Batch(robot)
    found, many = one.matrices(joints[:LOOPED], PROTECTED), np.tile(joints, (8, 1))
    off = max(np.abs(found.smallest_singular_values[i] - plain(row)[2]).max() for i, row in enumerate(joints[:LOOPED]))

    def loop() -> None:
        for row in joints[:LOOPED]:
            plain(row)

    few = f"{all_cores.threads} threads"
    times = in_turns(
        {
            "plain loop over Pinocchio and NumPy": (LOOPED, loop),
            "1 thread, results in memory": (len(many), lambda: one.matrices(many, PROTECTED)),
            "1 thread, in blocks": (len(many), lambda: [None for _ in one.blocks(many, PROTECTED, 8192)]),
            "1 thread, singular values alone": (len(many), lambda: one.singular_values(many, PROTECTED)),
            f"{few}, singular values alone": (len(many), lambda: all_cores.singular_values(many, PROTECTED)),
        }
    )
    print(f"J_rc, J_gt and the smallest singular values for {', '.join(PROTECTED)}; {robot.name}, 6 joints")
    print(f"largest difference of a singular value: {off:.1e} m")
    print(f"{'':<40} {'us each':>9} {'thousand/s':>11} {'loop / it':>10}")
    for name, values in times.items():
        each = statistics.median(values)
        print(f"{name:<40} {1e6 * each:9.3f} {1e-3 / each:11.0f} {ratio(times, next(iter(times)), name):10.0f}")
    gain = ratio(times, "1 thread, singular values alone", f"{few}, singular values alone")
    print(f"{few} are {gain:.2f} times as quick as one\n")


def compare_motions() -> None:
    """Print how much quicker motions go than a loop over the plain law and Pinocchio's integration."""
    case = ssm.load_case("case1")
    law, q, target, model = case.make_law(), case.start(), np.array(case.target), case.robot.model
    targets = target + np.random.default_rng(1).uniform(-0.2, 0.2, (MOTIONS, 3))
    moving = q.copy()
    step = plain_numpy(case, moving)

    def loop() -> None:
        moving[:] = q
        for _ in range(SAMPLES):
            told = step()
            moving[:] = pin.integrate(
                model, moving, STEP * np.hstack([np.asarray(told["base_twist"]), np.asarray(told["joint_rates"])])
            )

    one, all_cores = Batch(case.robot, threads=1), Batch(case.robot)
    duration = SAMPLES * STEP
    reached = one.motions(law, q, target, duration, STEP).configuration[0]
    loop()
    few, count = f"{all_cores.threads} threads", MOTIONS * SAMPLES
    times = in_turns(
        {
            "plain NumPy law in a loop": (SAMPLES, loop),
            "simulate(..), one at a time": (SAMPLES, lambda: ssm.simulate(law, q, target, duration, STEP)),
            "motions, 1 thread": (count, lambda: one.motions(law, q, targets, duration, STEP)),
            f"motions, {few}": (count, lambda: all_cores.motions(law, q, targets, duration, STEP)),
        }
    )
    apart = np.abs(reached - moving).max()
    print(f"{MOTIONS} motions of {SAMPLES} steps, {case.name}; one of them ends {apart:.1e} from the loop's")
    print(f"{'':<40} {'us a step':>9} {'thousand/s':>11} {'loop / it':>10}")
    for name, values in times.items():
        each = statistics.median(values)
        print(f"{name:<40} {1e6 * each:9.3f} {1e-3 / each:11.0f} {ratio(times, next(iter(times)), name):10.0f}")
    print(f"{few} are {ratio(times, 'motions, 1 thread', f'motions, {few}'):.2f} times as quick as one\n")


def chain(joints: int) -> ssm.Robot:
    """Return an arm of so many joints, about z and y in turns, on a bus."""
    parts = ['<robot name="chain">', _body("l0", 500.0)]
    for i in range(joints):
        parts += [
            _body(f"l{i + 1}", 10.0),
            f'<joint name="j{i:02d}" type="continuous"><parent link="l{i}"/><child link="l{i + 1}"/>'
            f'<origin xyz="0.1 0 0.4"/><axis xyz="0 {i % 2} {1 - i % 2}"/></joint>',
        ]
    return ssm.Robot("".join([*parts, "</robot>"]), name=f"chain of {joints}")


def _body(name: str, mass: float) -> str:
    inertia = f'<inertia ixx="{mass / 9}" iyy="{mass / 10}" izz="{mass / 12}" ixy="0" ixz="0" iyz="0"/>'
    return f'<link name="{name}"><inertial><origin xyz="0 0 0.2"/><mass value="{mass}"/>{inertia}</inertial></link>'


def scale(largest: int) -> None:
    """Print what a configuration costs against the number of joints and of configurations."""
    engines = {n: Batch(chain(n), threads=1) for n in JOINTS}
    rng = np.random.default_rng(2)
    joints = {n: rng.uniform(-3, 3, (CONFIGURATIONS, n)) for n in JOINTS}

    def run(n: int) -> Callable[[], object]:
        return lambda: engines[n].singular_values(joints[n], PROTECTED)

    times = in_turns({str(n): (CONFIGURATIONS, run(n)) for n in JOINTS})
    print("joints                us a configuration, 1 thread, four singular values")
    for name, values in times.items():
        print(f"{name:<20} {1e6 * statistics.median(values):8.3f}")
    sizes = [10**e for e in range(2, 9) if 10**e <= largest]
    robot = ssm.load_robot("ets_vii")
    one, many = Batch(robot, threads=1), rng.uniform(-3, 3, (max(sizes), robot.n_joints))

    def take(count: int) -> Callable[[], object]:
        return lambda: one.singular_values(many[:count], PROTECTED)

    times = in_turns({str(count): (count, take(count)) for count in sizes})
    print("configurations        us a configuration, 1 thread, four singular values, 6 joints")
    for name, values in times.items():
        print(f"{name:<20} {1e6 * statistics.median(values):8.3f}")


def main(largest: int) -> None:
    """Print all tables."""
    compare_matrices()
    compare_motions()
    scale(largest)


if __name__ == "__main__":
    main(int(float(sys.argv[1])) if len(sys.argv) > 1 else 1_000_000)
