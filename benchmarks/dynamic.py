"""One physics step: a whole dynamic simulation against MuJoCo stepped from Python, on the same URDF and the same step.

All candidates take turns in one process, so that the ratios hold whatever the machine does meanwhile.

    python benchmarks/dynamic.py [case1|case2|case3]
"""

from __future__ import annotations

import os
import statistics
import sys
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable
from functools import partial
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

import ssm_decouple as ssm
from ssm_decouple.model.robot import Robot
from ssm_decouple.simulation.dynamic import Dynamic, Servo

Floats = NDArray[np.float64]

ROUNDS = 7
STEP = 1e-3  # s
REPLAYED = 15.0  # s of the case that MuJoCo replays in each round; a step costs the same all along


def mujoco_model(robot: Robot, integrator: str) -> Any:
    """Return the robot in MuJoCo, free to float, without gravity, contacts and joint limits."""
    import mujoco

    root = ET.fromstring(robot.urdf)
    for link in root.findall("link"):
        for shape in link.findall("visual") + link.findall("collision"):
            link.remove(shape)
    options = ET.SubElement(root, "mujoco")
    ET.SubElement(options, "compiler", fusestatic="true", strippath="false", boundmass="0", boundinertia="0")
    spec = mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
    spec.worldbody.first_body().add_freejoint(name="root")
    for joint in spec.joints:
        joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
    model = spec.compile()
    model.opt.gravity[:] = 0
    model.opt.timestep = STEP
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
    # The constraint solver has nothing to do; these take its checks out as well.
    unused = ("CONTACT", "CONSTRAINT", "LIMIT", "FRICTIONLOSS", "EQUALITY", "SENSOR", "WARMSTART")
    model.opt.disableflags = sum(int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")) for name in unused)
    return model


def mujoco_run(robot: Robot, q: Floats, torques: Floats, integrator: str) -> Callable[[], Floats]:
    """Return a call that replays torques (m, n), one a step, and returns the joints at the end (n,)."""
    import mujoco

    model = mujoco_model(robot, integrator)
    data = mujoco.MjData(model)
    columns = np.array([model.joint(name).dofadr[0] for name in robot.joint_names])
    places = np.array([model.joint(name).qposadr[0] for name in robot.joint_names])
    forces = np.zeros((len(torques), model.nv))
    forces[:, columns] = torques
    start = robot.joint_positions(q)

    def replay() -> Floats:
        mujoco.mj_resetData(model, data)
        data.qpos[places] = start
        applied, step = data.qfrc_applied, mujoco.mj_step
        for force in forces:
            applied[:] = force
            step(model, data)
        return np.array(data.qpos[places])

    return replay


def main(name: str) -> None:
    """Check that all make the same motion, then time them and print the table."""
    case = ssm.load_case(name)
    q, target = case.start(), np.array(case.target)

    def simulate(
        servo: Servo | None, robot: Robot | None = None, duration: float = case.duration, dt: float = case.dt
    ) -> Any:
        return ssm.simulate(case.make_law(), q, target, duration, dt, Dynamic(STEP, servo, robot))

    # Each torque acts for ten steps, as long as a sample, so that the record holds them all.
    recorded = simulate(Servo(period=0.01), None, REPLAYED, 0.01)
    torques = np.repeat(recorded.joint_torques.values[1:], 10, axis=0)
    wings = ssm.load_robot("ets_vii_flexible")
    steps, replayed = round(case.duration / STEP), len(torques)
    candidates: dict[str, tuple[int, Callable[[], Any]]] = {
        "ours, RK4, torques each 1 ms": (steps, partial(simulate, Servo())),
        "ours, RK4, torques each 10 ms": (steps, partial(simulate, Servo(period=0.01))),
        "ours, RK4, prescribed joints": (steps, partial(simulate, None)),
        "ours, RK4, torques each 1 ms, two wings": (steps, partial(simulate, Servo(), wings)),
    }
    try:
        for integrator in ("RK4", "EULER", "IMPLICITFAST"):
            call = mujoco_run(case.robot, q, torques, integrator)
            off = np.abs(call() - recorded.joint_positions.values[-1]).max()
            print(f"MuJoCo's {integrator} ends {off:.1e} rad from our joints after {REPLAYED:g} s of the same torques")
            candidates[f"MuJoCo, {integrator}, torques given"] = (replayed, call)
    except ImportError:
        print("MuJoCo is not installed (pip install 'ssm-decouple[dev]'): left out")
    times: dict[str, list[float]] = {label: [] for label in candidates}
    for _ in range(ROUNDS):
        for label, (count, call) in candidates.items():
            start = time.perf_counter()
            call()
            times[label].append((time.perf_counter() - start) / count)
    medians = {label: statistics.median(values) for label, values in times.items()}
    ours = medians["ours, RK4, torques each 1 ms"]
    print(f"\n{name}, {case.robot.name}, {case.robot.n_joints} joints, steps of {1e3 * STEP:g} ms")
    print(f"{'median of ' + str(ROUNDS) + ' rounds':<42} {'us a step':>10} {'/ ours':>8}")
    for label, value in medians.items():
        print(f"{label:<42} {1e6 * value:10.2f} {value / ours:8.2f}")
    print(
        f"\nThe whole case, {steps} steps of physics: {ours * steps:.2f} s. A step of ours is four evaluations of the\n"
        "dynamics, one inverse dynamics for the torques (where they change), energy and work, and a share of the law\n"
        "and the record of 1500 samples. A step of MuJoCo is four evaluations (RK4) or one (the others) and a line of\n"
        "Python that sets the torques, with nothing recorded and no controller: the least that one can ask of it."
    )


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "case1")
