"""Random spacecraft: trees with branches, fixed, revolute, continuous and prismatic joints, offset inertias."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from ssm_decouple.model.robot import Robot

KINDS = ("revolute", "continuous", "prismatic", "fixed")


def random_urdf(seed: int, joints: int = 6, branching: float = 0.35) -> str:
    """Return URDF text of a random tree with `joints` moving joints and the frame "end_effector" on the last."""
    rng = np.random.default_rng(seed)
    parts = [f'<robot name="random_{seed}">', _link("bus", rng, rng.uniform(20, 200))]
    links, moving, count = ["bus"], 0, 0
    while moving < joints:
        kind = KINDS[rng.choice(4, p=(0.45, 0.2, 0.2, 0.15))]
        parent = links[rng.integers(len(links))] if rng.random() < branching else links[-1]
        child = f"body_{count}"
        # Names out of order, as Pinocchio sorts sibling branches by name.
        parts += [_link(child, rng, rng.uniform(0.5, 20)), _joint(f"j{(7 * count) % 31:02d}", kind, parent, child, rng)]
        links.append(child)
        count += 1
        moving += kind != "fixed"
    parts += ['<link name="end_effector"/>', _joint("tool", "fixed", links[-1], "end_effector", rng), "</robot>"]
    return "\n".join(parts)


def random_robot(seed: int, joints: int = 6, branching: float = 0.35) -> Robot:
    return Robot(random_urdf(seed, joints, branching), name=f"random_{seed}")


def random_state(robot: Robot, rng: np.random.Generator) -> np.ndarray:
    """Return a configuration with random joints and a random base pose."""
    pose = pin.SE3(pin.Quaternion(*_unit(rng, 4)).matrix(), rng.uniform(-2, 2, 3))
    return robot.configuration(rng.uniform(-np.pi, np.pi, robot.n_joints), pose)


def _unit(rng: np.random.Generator, size: int) -> np.ndarray:
    vector = rng.normal(size=size)
    return vector / np.linalg.norm(vector)


def _numbers(values: np.ndarray) -> str:
    return " ".join(repr(float(x)) for x in values)


def _origin(rng: np.random.Generator, spread: float) -> str:
    return f'<origin xyz="{_numbers(rng.uniform(-spread, spread, 3))}" rpy="{_numbers(rng.uniform(-3, 3, 3))}"/>'


def _link(name: str, rng: np.random.Generator, mass: float) -> str:
    # The inertia of a random cloud of points: any real body's is one.
    points = rng.normal(size=(6, 3)) * rng.uniform(0.1, 0.5, 3)
    points -= points.mean(axis=0)
    second = mass * points.T @ points / 6
    inertia = np.trace(second) * np.eye(3) - second
    xx, xy, xz, yy, yz, zz = (repr(float(inertia[i, j])) for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    tensor = f'<inertia ixx="{xx}" ixy="{xy}" ixz="{xz}" iyy="{yy}" iyz="{yz}" izz="{zz}"/>'
    return f'<link name="{name}"><inertial>{_origin(rng, 0.3)}<mass value="{mass!r}"/>{tensor}</inertial></link>'


def _joint(name: str, kind: str, parent: str, child: str, rng: np.random.Generator) -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>{_origin(rng, 0.8)}'
    axis = f'<axis xyz="{_numbers(_unit(rng, 3))}"/>' if kind != "fixed" else ""
    limit = '<limit lower="-3" upper="3" effort="10" velocity="0.5"/>' if kind != "fixed" else ""
    return f'<joint name="{name}" type="{kind}">{ends}{axis}{limit}</joint>'
