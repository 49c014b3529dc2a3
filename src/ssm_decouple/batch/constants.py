"""What the compiled batch algebra reads of a robot: its constants, in frames whose z axis is the joint's."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ssm_decouple.batch import lanes
from ssm_decouple.model.robot import Robot
from ssm_decouple.model.tree import Tree

Floats = NDArray[np.float64]


def constants_of(robot: Robot, frame: int) -> tuple[NDArray[np.int64], Floats, Floats]:
    """Return parents, table and tool, as `lanes.evaluate` wants them, of a robot and the frame of its end-effector.

    Raises:
        InputError: a joint with more than one degree of freedom; it is named.
    """
    tree, held = Tree.of(robot.model), robot.model.frames[frame]
    table: Floats = np.zeros((len(tree.masses), lanes.TABLE_SIZE))
    turned = np.array([np.eye(3), *map(_axes_with_z, tree.axes)])  # own axes in those of the model's joint frames
    holders = turned[tree.parents]
    rotations = np.swapaxes(holders, 1, 2) @ tree.rotations @ turned[1:]
    table[1:, lanes.ROTATION : lanes.TRANSLATION] = rotations.reshape(-1, 9)
    table[1:, lanes.TRANSLATION : lanes.SLIDES] = np.einsum("ija,ij->ia", holders, tree.translations)
    table[1:, lanes.SLIDES] = tree.slides
    carrying = [joint - 1 for joint in robot.model.supports[held.parentJoint] if joint > 1]
    table[carrying, lanes.CARRIES] = 1.0
    table[:, lanes.MASS] = table[:, lanes.CARRIED] = tree.masses
    for body in range(len(tree.masses) - 1, 0, -1):
        table[tree.parents[body - 1], lanes.CARRIED] += table[body, lanes.CARRIED]
    table[:, lanes.CENTRE : lanes.SECOND] = np.einsum("ija,ij->ia", turned, tree.centres)
    # Second moments of mass: the inertia is their trace less them.
    traces = np.trace(tree.inertias, axis1=1, axis2=2)
    second = 0.5 * traces[:, None, None] * np.eye(3) - tree.inertias
    rows, columns = np.triu_indices(3)
    table[:, lanes.SECOND :] = (np.swapaxes(turned, 1, 2) @ second @ turned)[:, rows, columns]
    holder = held.parentJoint - 1
    return tree.parents, table, np.array([holder, *(turned[holder].T @ held.placement.translation)])


def _axes_with_z(axis: Floats) -> Floats:
    """Return a rotation (3, 3) whose third column is the axis; one along an own axis only permutes."""
    z = axis / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])
