"""One control step: the law against plain NumPy, Pink with hard constraints, and Pinocchio's bare calls.

The steps with limits keep position, rate and acceleration limits joint by joint, from rates at which some act.

All candidates take turns in one process, so that the ratios hold whatever the machine does meanwhile.

    python benchmarks/control_step.py [case1|case2|case3]
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # threads for 6 x 6 matrices would only hurt the competitors
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

import ssm_decouple as ssm
from ssm_decouple.control import paper

Floats = NDArray[np.float64]

ROUNDS = 25
ROUND_TIME = 0.02  # s, how long each candidate runs in a round
SAMPLE_TIME = 0.1  # s
ACCELERATION = np.deg2rad(1.0)  # rad/s2, of the steps with limits


def medians(candidates: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Return the median time of one call of each candidate, s, measured in turns."""
    counts = {}
    for name, call in candidates.items():
        call()  # may compile
        start, count = time.perf_counter(), 0
        while time.perf_counter() - start < ROUND_TIME:
            call()
            count += 1
        counts[name] = count
    times: dict[str, list[float]] = {name: [] for name in candidates}
    for _ in range(ROUNDS):
        for name, call in candidates.items():
            repeat = range(counts[name])
            start = time.perf_counter()
            for _ in repeat:
                call()
            times[name].append((time.perf_counter() - start) / counts[name])
    return {name: statistics.median(values) for name, values in times.items()}


def plain_numpy(case: ssm.Case, q: Floats) -> Callable[[], Floats]:
    """Return the paper's law as one writes it from the paper, `ssm_decouple.control.paper`; it gives v (6 + n,)."""
    robot, law = case.robot, case.make_law()
    model, data, frame = robot.model, robot.model.createData(), robot.end_effector_id
    U_c, x_des, still = law.protection.U_c, np.array(case.target), np.zeros(3)

    def step() -> Floats:
        pin.computeCentroidalMap(model, data, q)
        pin.updateFramePlacement(model, data, frame)
        J = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
        J_base = -np.linalg.solve(data.Ag[:, :6], data.Ag[:, 6:])
        J_gt = (J[:, 6:] + J[:, :6] @ J_base)[:3]
        v_cmd = paper.task_velocity(still, law.gain, x_des, data.oMf[frame].translation)
        rates = paper.selective_law(J_base[3:], J_gt, U_c, v_cmd, law.damping, law.damping_threshold)
        rates = paper.scaled_to_limits(rates, law.rate_limits)
        return np.concatenate([J_base @ rates, rates])

    return step


def pink_step(case: ssm.Case, q: Floats, limited: bool = False) -> Callable[[], Floats]:
    """Return the same velocity problem as Pink states it: zero momentum and zero protected rate as hard constraints.

    With `limited` also Pink's own position, velocity and acceleration limits, from rest.
    """
    import pink
    from pink.tasks import Task

    robot, law = case.robot, case.make_law()
    target, U_c, frame = np.array(case.target), law.protection.U_c, robot.end_effector_id
    model, data = robot.model, robot.model.createData()
    select = np.hstack([np.zeros((law.protection.k, 3)), U_c.T, np.zeros((law.protection.k, robot.n_joints))])

    class Position(Task):  # type: ignore[misc]
        def __repr__(self) -> str:
            return "Position()"

        def compute_error(self, configuration: pink.Configuration) -> Floats:
            return configuration.data.oMf[frame].translation - target

        def compute_jacobian(self, configuration: pink.Configuration) -> Floats:
            return pin.getFrameJacobian(model, configuration.data, frame, pin.LOCAL_WORLD_ALIGNED)[:3]

    class Momentum(Task):  # type: ignore[misc]
        def __repr__(self) -> str:
            return "Momentum()"

        def compute_error(self, configuration: pink.Configuration) -> Floats:
            return np.zeros(6 + law.protection.k)

        def compute_jacobian(self, configuration: pink.Configuration) -> Floats:
            pin.computeCentroidalMap(model, configuration.data, configuration.q)
            return np.vstack([configuration.data.Ag, select])

    limits: list[Any] = []
    if limited:
        accelerations = np.r_[np.zeros(6), np.full(robot.n_joints, ACCELERATION)]
        limits = [
            pink.limits.ConfigurationLimit(model),
            pink.limits.VelocityLimit(model),
            pink.limits.AccelerationLimit(model, accelerations),
        ]
    dt = SAMPLE_TIME
    task, constraint = Position(cost=np.ones(3), gain=law.gain * dt), Momentum(cost=np.ones(6 + law.protection.k))
    configuration = pink.Configuration(model, data, q)

    def step() -> Floats:
        configuration.update(q)
        return pink.solve_ik(
            configuration,
            [task],
            dt,
            solver="daqp",
            damping=1e-9,
            limits=limits,
            constraints=[constraint],
            safety_break=False,
        )

    return step


def pose_law(case: ssm.Case, q: Floats) -> tuple[ssm.SelectiveLaw, pin.SE3]:
    """Return the case's law for a pose, and one at the case's target, half a radian turned."""
    law = ssm.SelectiveLaw(case.robot, case.make_law().protection, tasks=ssm.PoseTask())
    turn = pin.exp3(np.array([0.3, 0.2, 0.4]))
    return law, pin.SE3(turn @ case.robot.frame_pose(q).rotation, np.array(case.target))


def limited_law(case: ssm.Case) -> ssm.SelectiveLaw:
    """Return the case's law with position, rate and acceleration limits, joint by joint."""
    return ssm.SelectiveLaw(
        case.robot,
        case.make_law().protection,
        acceleration_limit=ACCELERATION,
        sample_time=SAMPLE_TIME,
        limits=ssm.Limits(),
    )


def bare_pinocchio(robot: ssm.Robot, q: Floats) -> Callable[[], object]:
    """Return the floor: the Pinocchio calls that any such law needs, from Python, and nothing else."""
    model, data, frame = robot.model, robot.model.createData(), robot.end_effector_id

    def step() -> object:
        pin.computeCentroidalMap(model, data, q)
        pin.updateFramePlacement(model, data, frame)
        return pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)

    return step


def main(name: str) -> None:
    """Check that all answer the same question, then time them and print the table."""
    case = ssm.load_case(name)
    law, q, target = case.make_law(), case.start(), np.array(case.target)
    out, at_rest = np.empty(law.size), np.zeros(3)
    plain, floor = plain_numpy(case, q), bare_pinocchio(case.robot, q)
    candidates: dict[str, Callable[[], object]] = {
        "Pinocchio's bare calls": floor,
        "law.evaluate(q, target, velocity, out)": lambda: law.evaluate(q, target, at_rest, out),
        "law(q, target)": lambda: law(q, target),
        "the paper in plain NumPy": plain,
    }
    for nodes in (1, 2, 3):
        planned = ssm.SelectiveLaw(
            case.robot, law.protection, law.gain, law.rate_limits, sample_time=0.1, hold_nodes=nodes
        )
        candidates[f"law(q, target), hold_nodes={nodes}"] = partial(planned, q, target)
    posing, pose = pose_law(case, q)
    candidates["law(q, pose), a PoseTask"] = lambda: posing(q, pose)
    limiting, at_rest_joints = limited_law(case), np.zeros(case.robot.n_joints)
    candidates["law(q, target), limits by QP"] = lambda: limiting(q, target, previous_rates=at_rest_joints)
    acting = limiting(q, target, previous_rates=at_rest_joints).active_limits
    command = law(q, target)
    difference = np.abs(plain() - command.velocity).max()
    print(f"{name}, {case.robot.name}, k = {law.protection.k}: plain NumPy differs by {difference:.1e} m/s and rad/s")
    try:
        pink = pink_step(case, q)
    except ImportError:
        print("Pink is not installed (pip install 'ssm-decouple[bench]'): left out")
    else:
        candidates["Pink, hard constraints, DAQP"] = pink
        candidates["Pink, the same with limits"] = pink_step(case, q, limited=True)
        v = np.asarray(pink())
        reached = case.robot.coupling(q).J_gt @ v[6:]
        asked = law.gain * command.end_effector_error
        print(
            f"Pink: end-effector velocity differs from the one asked for by {np.abs(reached - asked).max():.1e} m/s, "
            f"protected rate {np.abs(law.protection.U_c.T @ v[3:6]).max():.1e} rad/s"
        )
    times = medians(candidates)
    whole, array = times["law(q, target)"], times["law.evaluate(q, target, velocity, out)"]
    base = times["Pinocchio's bare calls"]
    print(f"\n{'median of ' + str(ROUNDS) + ' rounds':<42} {'us':>8} {'/ bare':>9} {'/ law(..)':>10}")
    for label, value in times.items():
        print(f"{label:<42} {1e6 * value:8.2f} {value / base:9.2f} {value / whole:10.2f}")
    print(f"\nlaw(q, target) is {times['the paper in plain NumPy'] / whole:.1f} times faster than plain NumPy", end="")
    if "Pink, hard constraints, DAQP" in times:
        print(f", {times['Pink, hard constraints, DAQP'] / whole:.1f} times faster than Pink", end="")
    print(f",\nand takes {whole / base:.2f} times the bare Pinocchio calls; its array form {array / base:.2f} times.")
    bounded = times["law(q, target), limits by QP"]
    print(f"With {acting} limits that act a step takes {bounded / whole:.1f} times as long", end="")
    if "Pink, the same with limits" in times:
        print(f", and Pink {times['Pink, the same with limits'] / bounded:.1f} times that", end="")
    print(".")
    print(f"A pose task takes {times['law(q, pose), a PoseTask'] / whole:.2f} times the position task.")

    for _ in range(3):
        case.run()
    runs = []
    for _ in range(15):
        start = time.perf_counter()
        case.run()
        runs.append(time.perf_counter() - start)
    steps = round(case.duration / case.dt)
    print(f"\nThe whole case, {steps} steps with its record: {1e3 * statistics.median(runs):.1f} ms.")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "case1")
