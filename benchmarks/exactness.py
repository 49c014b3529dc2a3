"""How exact the protected rate is: the worst of 10,000 random states, robots and protections, in exact arithmetic.

For each command the protected rate J_sub q_dot is summed in rational numbers, without any rounding, from the law's
own J_sub and q_dot, and compared with eps |J_sub| |q_dot|: what rounding q_dot to doubles alone can leave is about 0.5
of that.

    python benchmarks/exactness.py [states]
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.progress import track
from scipy.optimize import brentq

import ssm_decouple as ssm
from ssm_decouple.control import kernel

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from random_robots import random_robot, random_state

Floats = NDArray[np.float64]
Trial = tuple[ssm.SelectiveLaw, Floats, Any, dict[str, Any]]  # law, configuration, target, further arguments

EPS = float(np.finfo(float).eps)
ROBOTS = 40  # random ones, 3 to 12 joints
NEAR = 1e-9  # rad, how close to singular


def random_protection(rng: np.random.Generator, robot: ssm.Robot, most: int) -> ssm.Protection:
    """Return up to `most` random directions of rotations or twists, in base or inertial axes or those of a link."""
    frame = ("base", "inertial", str(rng.choice(robot.link_names)))[rng.integers(3)]
    size = 3 if most <= 3 and rng.random() < 0.5 else 6
    k = int(rng.integers(1, min(most, size) + 1))
    return ssm.Protection(np.linalg.qr(rng.normal(size=(size, k)))[0], frame)


def random_tasks(rng: np.random.Generator, robot: ssm.Robot, q: Floats) -> tuple[Any, Any]:
    """Return tasks of one or two levels and targets a good way off."""
    pose = robot.frame_pose(q).homogeneous
    pose[:3, 3] += rng.normal(size=3)
    way = pose[:3, 3].copy()
    return (
        (None, way),
        (ssm.PoseTask(), pose),
        ([ssm.PositionTask(), ssm.PostureTask(level=2)], [way, rng.uniform(-2, 2, robot.n_joints)]),
        ([ssm.BoresightTask((0, 0, 1)), ssm.PositionTask(weight=3.0)], [rng.normal(size=3), way]),
    )[rng.integers(4)]


def anywhere(rng: np.random.Generator, robot: ssm.Robot) -> Trial:
    """Return a law with random tasks, weights and rate limits at a random state."""
    q = random_state(robot, rng)
    tasks, target = random_tasks(rng, robot, q)
    weights = np.exp(rng.normal(size=robot.n_joints)) if rng.random() < 0.5 else None
    limit = np.deg2rad(5.0) if rng.random() < 0.7 else np.inf
    protection = random_protection(rng, robot, min(6, robot.n_joints - 1))
    return ssm.SelectiveLaw(robot, protection, rate_limit=limit, tasks=tasks, joint_weights=weights), q, target, {}


def every_limit(rng: np.random.Generator, robot: ssm.Robot) -> Trial:
    """Return the same with an acceleration limit that acts, from rates that move the protected axes too."""
    law, q, target, _ = anywhere(rng, robot)
    limited = ssm.SelectiveLaw(
        robot, law.protection, rate_limit=0.05, acceleration_limit=0.05, sample_time=0.1, tasks=law.tasks
    )
    return limited, q, target, {"previous_rates": rng.uniform(-0.05, 0.05, robot.n_joints)}


def joint_by_joint(rng: np.random.Generator, robot: ssm.Robot) -> Trial:
    """Return a law that keeps position, rate and acceleration limits by quadratic programs, all of them acting."""
    law, q, target, _ = anywhere(rng, robot)
    positions = robot.joint_positions(q)
    room = rng.uniform(1e-4, 0.2, size=(robot.n_joints, 2))
    limits = ssm.Limits(position=np.column_stack([positions - room[:, 0], positions + room[:, 1]]))
    limited = ssm.SelectiveLaw(
        robot, law.protection, rate_limit=0.05, acceleration_limit=0.05, sample_time=0.1, tasks=law.tasks, limits=limits
    )
    slow = limited(q, target, previous_rates=np.zeros(robot.n_joints)).joint_rates
    return limited, q, target, {"previous_rates": rng.uniform(0.0, 2.0) * slow}


def near_singular(rng: np.random.Generator, robot: ssm.Robot) -> Trial | None:
    """Return a position law within NEAR of where J_gt N_sub is singular: one freedom for each row of both."""
    k = robot.n_joints - 3
    if not 1 <= k <= 6:
        return None
    protection = ssm.Protection(np.linalg.qr(rng.normal(size=(6, k)))[0])
    start, turn = robot.joint_positions(random_state(robot, rng)), rng.normal(size=robot.n_joints)

    def determinant(x: float) -> float:
        coupling = robot.coupling(robot.configuration(start + x * turn))
        return float(np.linalg.det(np.vstack([protection.J_sub(coupling), coupling.J_gt])))

    grid = np.linspace(0.0, 3.0, 40)
    values = [determinant(x) for x in grid]
    crossing = np.flatnonzero(np.diff(np.sign(values)))
    if crossing.size == 0:
        return None
    root = brentq(determinant, grid[crossing[0]], grid[crossing[0] + 1], xtol=1e-14)
    q = robot.configuration(start + (root + rng.uniform(-NEAR, NEAR)) * turn)
    damping = 0.0 if rng.random() < 0.5 else 1e-4
    law = ssm.SelectiveLaw(robot, protection, rate_limit=np.deg2rad(5.0), damping=damping)
    return law, q, robot.frame_pose(q).translation + rng.normal(size=3), {}


def own_J_sub(law: ssm.SelectiveLaw, q: Floats) -> Floats:
    """Return J_sub (k, n) as the kernel sums it."""
    matrices, (U_c, _, _, parameters) = law._matrices_at(q), law._prepared[3]
    source = kernel.J_PROTECTED if parameters[kernel.AXES_JOINT] >= 0.0 else kernel.J_BASE
    first = 0 if np.any(U_c[:3]) else 3
    J_sub = np.zeros((U_c.shape[1], law.robot.n_joints))
    for b in range(first, 6):
        J_sub += U_c[b][:, None] * matrices[source + b][None]
    return J_sub


def exact_rate(J_sub: Floats, rates: Floats) -> float:
    """Return the largest |J_sub q_dot| of the rows, summed without rounding."""
    exact = [Fraction(rate) for rate in rates.tolist()]
    totals = [sum((Fraction(a) * x for a, x in zip(row, exact, strict=True)), Fraction(0)) for row in J_sub.tolist()]
    return max(abs(float(total)) for total in totals)


def measure(trial: Trial) -> tuple[float, float]:
    """Return the protected rate that is left, and eps |J_sub| |q_dot|."""
    law, q, target, further = trial
    command = law(q, target, **further)
    J_sub = own_J_sub(law, q)
    scale = EPS * float(np.linalg.norm(J_sub, 2) * np.linalg.norm(command.joint_rates))
    return exact_rate(J_sub, command.joint_rates), scale


def states(make: Callable[[np.random.Generator, ssm.Robot], Trial | None], count: int) -> Iterator[Trial]:
    """Give `count` trials on random robots."""
    rng = np.random.default_rng(0)
    robots = [random_robot(seed, 3 + seed % 10) for seed in range(ROBOTS)]
    while count > 0:
        trial = make(rng, robots[rng.integers(ROBOTS)])
        if trial is not None:
            count -= 1
            yield trial


def main(count: int) -> None:
    """Measure each kind of trial and print the worst."""
    warnings.simplefilter("ignore", ssm.DecoupleWarning)  # of tasks that nothing is left for: that is meant here
    kinds = {
        "random tasks, weights and limits": anywhere,
        "every limit active, as a whole": every_limit,
        "every limit active, joint by joint": joint_by_joint,
        f"within {NEAR:g} rad of singular": near_singular,
    }
    print(f"{'states':<40} {'number':>7} {'median':>8} {'worst':>8}   |J_sub q_dot| / (eps |J_sub| |q_dot|)")
    for name, make in kinds.items():
        share = count // len(kinds)
        found = [measure(trial) for trial in track(states(make, share), name, total=share, transient=True)]
        ratios = [left / scale for left, scale in found if scale > 0.0]
        print(f"{name:<40} {share:>7} {np.median(ratios):8.3f} {max(ratios):8.3f}")
    robot, rng, worst = ssm.load_robot("ets_vii"), np.random.default_rng(1), 0.0
    for _ in range(1000):
        q = random_state(robot, rng)
        law = ssm.SelectiveLaw(robot, ssm.Protection("yaw"), rate_limit=np.deg2rad(5.0))
        left, _ = measure((law, q, robot.frame_pose(q).translation + 10.0 * rng.normal(size=3), {}))
        worst = max(worst, left)
    print(f"ETS-VII, yaw protected, joints at up to 5 deg/s, 1000 states: at most {worst:.1e} rad/s")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10_000)
