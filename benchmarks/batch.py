"""The batch engines against plain Python loops and frax: matrices and singular values, and whole motions.

All candidates take turns in one process, so that the ratios hold whatever the machine does meanwhile. JAX is kept to
one core, as its figures are compared with those of one thread.

    python benchmarks/batch.py [largest N, 1000000 by default] [--plot FILE]
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import tempfile
import time
from collections.abc import Callable
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # threads for 6 x 6 matrices would only hurt the loops
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# What frax asks for.
os.environ.setdefault("JAX_ENABLE_X64", "1")
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_cpu_multi_thread_eigen=false --xla_cpu_scheduler_type=CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED",
)

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
from control_step import plain_numpy
from matplotlib.figure import Figure
from numpy.typing import NDArray

import ssm_decouple as ssm
from ssm_decouple.batch import Batch, JaxBatch
from ssm_decouple.viewing.style import COLUMN, styled

CORES = os.sched_getaffinity(0)
os.sched_setaffinity(0, {min(CORES)})
jax.devices("cpu")  # starts the threads of JAX, which inherit this
os.sched_setaffinity(0, CORES)

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


def with_frax(robot: ssm.Robot, singular_values: bool) -> Callable[[Floats], Any]:
    """Return J_rc, J_gt and, if wanted, four smallest singular values of many configurations, with frax.

    frax has no centroidal map, but knows free-floating bases: the first six rows of its joint-space inertia matrix are
    the momentum, whose zero gives J_base.
    """
    import frax

    placement = robot.model.frames[robot.end_effector_id].placement
    with tempfile.NamedTemporaryFile("w", suffix=".urdf") as file:
        file.write(robot.urdf)
        file.flush()
        arm = frax.Manipulator(file.name, floating_base="quaternion", ee_offset=placement.homogeneous)
    pose = jnp.array([0.0, 0, 0, 1, 0, 0, 0])

    def one(joints: jax.Array) -> Any:
        frames = arm.joint_to_world_transforms(jnp.concatenate([pose, joints]))
        M, J = arm._mass_matrix(frames), arm._ee_jacobian(frames)
        J_base = -jnp.linalg.solve(M[:6, :6], M[:6, 6:])
        J_rc, J_gt = J_base[3:], J[:3, 6:] + J[:3, :6] @ J_base
        if not singular_values:
            return J_rc, J_gt
        lost = jnp.einsum("ri,ki,kj->krj", J_gt, J_rc, J_rc) / jnp.sum(J_rc * J_rc, axis=1)[:, None, None]
        left = jnp.concatenate([J_gt[None], J_gt - lost])
        return J_rc, J_gt, jnp.linalg.svd(left, compute_uv=False)[:, -1]

    run = jax.jit(jax.vmap(one))
    return lambda joints: [np.asarray(array) for array in run(joints)]


def compare_matrices() -> None:
    """Print how much quicker the engines are than a loop, on one core and on more."""
    robot = ssm.load_robot("ets_vii")
    joints = np.random.default_rng(0).uniform(-3, 3, (CONFIGURATIONS, robot.n_joints))
    plain, one, all_cores = plain_matrices(robot), Batch(robot, threads=1), Batch(robot)
    found, many = one.matrices(joints[:LOOPED], PROTECTED), np.tile(joints, (8, 1))
    off = max(np.abs(found.smallest_singular_values[i] - plain(row)[2]).max() for i, row in enumerate(joints[:LOOPED]))

    on_jax, frax, frax_matrices = JaxBatch(robot, device="cpu"), with_frax(robot, True), with_frax(robot, False)
    values = found.smallest_singular_values
    for name, other in (
        ("frax", frax(joints[:LOOPED])[2]),
        ("JAX", on_jax.singular_values(joints[:LOOPED], PROTECTED)),
    ):
        print(f"largest difference of a singular value, {name}: {np.abs(other - values).max():.1e} m")

    def loop() -> None:
        for row in joints[:LOOPED]:
            plain(row)

    few = f"{all_cores.threads} threads"
    times = in_turns(
        {
            "plain loop over Pinocchio and NumPy": (LOOPED, loop),
            "frax (JAX), 1 core, matrices alone": (CONFIGURATIONS, lambda: frax_matrices(joints)),
            "frax (JAX), 1 core": (CONFIGURATIONS, lambda: frax(joints)),
            "JaxBatch, 1 core": (CONFIGURATIONS, lambda: on_jax.matrices(joints, PROTECTED)),
            "JaxBatch, 1 core, singular values alone": (
                CONFIGURATIONS,
                lambda: on_jax.singular_values(joints, PROTECTED),
            ),
            "1 thread, results in memory": (len(many), lambda: one.matrices(many, PROTECTED)),
            "1 thread, in blocks": (len(many), lambda: [None for _ in one.blocks(many, PROTECTED, 8192)]),
            "1 thread, singular values alone": (len(many), lambda: one.singular_values(many, PROTECTED)),
            f"{few}, singular values alone": (len(many), lambda: all_cores.singular_values(many, PROTECTED)),
        }
    )
    print(f"J_rc, J_gt and the smallest singular values for {', '.join(PROTECTED)}; {robot.name}, 6 joints")
    print(f"largest difference of a singular value: {off:.1e} m")
    print(f"{'':<40} {'us each':>9} {'thousand/s':>11} {'loop / it':>10} {'frax / it':>10}")
    for name, took in times.items():
        each = statistics.median(took)
        ratios = [ratio(times, slow, name) for slow in (next(iter(times)), "frax (JAX), 1 core")]
        print(f"{name:<40} {1e6 * each:9.3f} {1e-3 / each:11.0f} {ratios[0]:10.0f} {ratios[1]:10.2f}")
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
            moving[:] = pin.integrate(model, moving, STEP * step())

    one, all_cores, on_jax = Batch(case.robot, threads=1), Batch(case.robot), JaxBatch(case.robot, device="cpu")
    duration = SAMPLES * STEP
    reached = one.motions(law, q, target, duration, STEP).configuration[0]
    loop()
    few, count = f"{all_cores.threads} threads", MOTIONS * SAMPLES
    times = in_turns(
        {
            "plain NumPy law in a loop": (SAMPLES, loop),
            "simulate(..), one at a time": (SAMPLES, lambda: ssm.simulate(law, q, target, duration, STEP)),
            "motions, 1 thread": (count, lambda: one.motions(law, q, targets, duration, STEP)),
            "motions, JaxBatch, 1 core": (count, lambda: on_jax.motions(law, q, targets, duration, STEP)),
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


def scale(largest: int) -> dict[str, dict[int, float]]:
    """Print what a configuration costs against the number of joints and of configurations; return it, s."""
    engines = {n: Batch(chain(n), threads=1) for n in JOINTS}
    rng = np.random.default_rng(2)
    joints = {n: rng.uniform(-3, 3, (CONFIGURATIONS, n)) for n in JOINTS}

    def run(n: int) -> Callable[[], object]:
        return lambda: engines[n].singular_values(joints[n], PROTECTED)

    times = in_turns({str(n): (CONFIGURATIONS, run(n)) for n in JOINTS})
    found = {"joints": {int(name): statistics.median(values) for name, values in times.items()}}
    sizes = [10**e for e in range(2, 9) if 10**e <= largest]
    robot = ssm.load_robot("ets_vii")
    one, many = Batch(robot, threads=1), rng.uniform(-3, 3, (max(sizes), robot.n_joints))

    def take(count: int) -> Callable[[], object]:
        return lambda: one.singular_values(many[:count], PROTECTED)

    times = in_turns({str(count): (count, take(count)) for count in sizes})
    found["configurations"] = {int(name): statistics.median(values) for name, values in times.items()}
    for what, each in found.items():
        print(f"{what:<20}  us a configuration, 1 thread, four singular values")
        for number, value in each.items():
            print(f"{number:<20} {1e6 * value:8.3f}")
    return found


def memory(largest: int) -> None:
    """Print the most memory that the process has held after more and more configurations, taken in blocks."""
    robot = ssm.load_robot("ets_vii")
    one = Batch(robot)
    row = np.linspace(-1, 1, robot.n_joints)
    print("configurations        peak memory of the process, MiB, results taken in blocks")
    for count in (10**e for e in range(4, 9) if 10**e <= largest):
        for _ in one.blocks(np.broadcast_to(row, (count, robot.n_joints)), PROTECTED):
            pass
        print(f"{count:<20} {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:8.0f}")


def on_devices(largest: int) -> None:
    """Print how many configurations a second the engine on JAX does, on the device that JAX takes."""
    device = jax.devices()[0]
    robot = ssm.load_robot("ets_vii")
    engine, compiled = JaxBatch(robot), Batch(robot)
    many = np.random.default_rng(3).uniform(-3, 3, (largest, robot.n_joints))
    print(f"thousand/s            JaxBatch on {device.device_kind}, Batch on {compiled.threads} threads")
    for count in (10**e for e in range(4, 8) if 10**e <= largest):
        rates = []
        for each in (engine, compiled):
            each.singular_values(many[:count], PROTECTED)
            start = time.perf_counter()
            each.singular_values(many[:count], PROTECTED)
            rates.append(1e-3 * count / (time.perf_counter() - start))
        print(f"{count:<20} {rates[0]:9.0f} {rates[1]:9.0f}")


@styled
def plot(found: dict[str, dict[int, float]]) -> Figure:
    """Draw what a configuration costs against the number of joints and of configurations."""
    figure = Figure(figsize=(COLUMN, 4.2))
    for axes, (what, each) in zip(figure.subplots(2), found.items(), strict=True):
        axes.plot(list(each), [1e6 * value for value in each.values()], ".-", color="#0072B2", linewidth=0.8)
        axes.set(xlabel=what, ylabel="each (us)")
        axes.set_ylim(bottom=0)
        if what == "configurations":
            axes.set_xscale("log")
    return figure


def main(largest: int, file: str | None) -> None:
    """Print all tables, and draw the last ones if asked to."""
    memory(largest)  # first: a peak never falls
    compare_matrices()
    compare_motions()
    on_devices(largest)
    found = scale(largest)
    if file is not None:
        plot(found).savefig(file)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("largest", nargs="?", type=float, default=1e6, help="most configurations, 1000000 by default")
    parser.add_argument("--plot", metavar="FILE", help="draw the cost, for example to batch.png")
    given = parser.parse_args()
    main(int(given.largest), given.plot)
