"""The compiled equations of motion against Pinocchio, MuJoCo and closed forms."""

from __future__ import annotations

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mujoco_robots import mass_matrix, mujoco_model
from random_robots import random_robot, random_state
from scipy.spatial.transform import Rotation

import ssm_decouple as ssm
from ssm_decouple.simulation import physics
from ssm_decouple.simulation.dynamic import tree_of


def relative(actual, expected) -> float:
    return float(np.linalg.norm(np.asarray(actual) - expected) / np.linalg.norm(expected))


def without_gravity(robot: ssm.Robot) -> pin.Model:
    model = robot.model.copy()
    model.gravity = pin.Motion.Zero()
    return model


def equations(robot: ssm.Robot, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the whole mass matrix and the bias forces as the simulation has them."""
    parent, tree = tree_of(robot.model)
    n = robot.n_joints
    room = [np.full((n + 1, physics.BODIES_SIZE), np.nan), np.full((n + 6, n + 6), np.nan), np.full(n + 6, np.nan)]
    physics.equations(parent, tree, robot.joint_positions(q), v, *room)
    return np.tril(room[1]) + np.tril(room[1], -1).T, room[2]


def assert_pinocchio_agrees(robot: ssm.Robot, rng: np.random.Generator) -> None:
    model = without_gravity(robot)
    data = model.createData()
    q, v = random_state(robot, rng), rng.normal(size=model.nv)
    M, bias = equations(robot, q, v)
    upper = np.triu(pin.crba(model, data, q))
    assert relative(M, upper + np.triu(upper, 1).T) < 1e-12
    assert relative(bias, pin.nle(model, data, q, v)) < 1e-12


def test_pinocchio_agrees(robot, rng):
    for _ in range(5):
        assert_pinocchio_agrees(robot, rng)


@given(seed=st.integers(0, 10**6), joints=st.integers(1, 12), branching=st.floats(0, 1))
def test_pinocchio_agrees_on_any_tree(seed, joints, branching):
    assert_pinocchio_agrees(random_robot(seed, joints, branching), np.random.default_rng(seed))


def test_mujoco_agrees(robot, rng):
    """Mass matrix and bias forces, taken over into the axes that the base twist stands in there."""
    model, n = mujoco_model(robot), robot.n_joints
    data = mujoco.MjData(model)
    columns = [model.joint(name).dofadr[0] for name in robot.joint_names]
    addresses = [model.joint(name).qposadr[0] for name in robot.joint_names]
    for _ in range(5):
        q, v = random_state(robot, rng), rng.normal(size=6 + n)
        R = robot.base_pose(q).rotation
        data.qpos[:3], data.qpos[3:7], data.qpos[addresses] = q[:3], q[[6, 3, 4, 5]], robot.joint_positions(q)
        data.qvel[:3], data.qvel[3:6], data.qvel[columns] = R @ v[:3], v[3:6], v[6:]
        mujoco.mj_forward(model, data)
        # T takes our rates to MuJoCo's, whose linear velocity of the base stands in world axes.
        order = [*range(6), *columns]
        T = np.eye(6 + n)
        T[:3, :3] = R
        M_world = mass_matrix(model, data)[np.ix_(order, order)]
        M, bias = equations(robot, q, v)
        assert relative(M, T.T @ M_world @ T) < 1e-12
        turning = np.r_[np.cross(v[3:6], v[:3]), np.zeros(3 + n)]
        assert relative(bias, T.T @ data.qfrc_bias[order] + M @ turning) < 1e-12


@pytest.mark.parametrize("branches", [False, True])
def test_positive_systems_are_solved(rng, branches):
    for size in (1, 2, 6, 13):
        A = rng.normal(size=(size, size))
        M = A @ A.T + 0.1 * np.eye(size)
        if branches and size > 6:  # two branches on a base
            M[6:9, 9:] = M[9:, 6:9] = 0
            M += 10 * np.eye(size)
        x = rng.normal(size=size)
        room, solution = np.tril(M) + np.triu(np.full((size, size), np.nan), 1), M @ x
        assert physics.solve_positive(room, size, solution)
        np.testing.assert_allclose(solution, x, rtol=1e-9, atol=1e-9)
    for bad in (-1.0, 0.0, np.nan):
        assert not physics.solve_positive(np.diag([1.0, bad, 1.0]), 3, np.ones(3))


def test_some_velocities_may_be_given(robot, rng):
    """What is found and what is given solve the equations of motion together."""
    n = robot.n_joints
    M = np.tril(equations(robot, random_state(robot, rng), rng.normal(size=6 + n))[0])
    whole = M + np.tril(M, -1).T
    given = np.sort(rng.choice(6 + n, n, replace=False))
    free = np.setdiff1d(np.arange(6 + n), given)
    changes, forces = rng.normal(size=6 + n), rng.normal(size=6 + n)
    known = changes[given].copy()
    assert physics.complete(M, free, given, forces, np.empty((6 + n, 6 + n)), np.empty(6 + n), changes)
    np.testing.assert_array_equal(changes[given], known)
    assert relative((whole @ changes)[free], forces[free]) < 1e-9
    for i in range(6 + n):
        assert physics.row_times(M, i, changes) == pytest.approx(whole[i] @ changes, rel=1e-12, abs=1e-12)


def test_the_base_turns_on_the_rotation_group(rng):
    for size in (1e-9, 1e-4, 9e-4, 1.1e-3, 0.1, 2.0):
        R, u = Rotation.random(random_state=rng.integers(2**31)), size * rng.normal(size=3)
        out = np.empty(9)
        physics.turn(R.as_matrix().ravel(), u, out)
        np.testing.assert_allclose(out.reshape(3, 3), (R * Rotation.from_rotvec(u)).as_matrix(), atol=4e-16 * (1 + 9))


def test_the_rate_of_a_rotation_vector_is_right_to_third_order(rng):
    """Against Pinocchio's inverse of the exponential's derivative: the error falls with the fourth power."""
    u, w, out, off = rng.normal(size=3), rng.normal(size=3), np.empty(3), []
    for size in (0.2, 0.1, 0.05):
        physics.rotation_vector_rate(size * u, w, out)
        off.append(np.linalg.norm(out - pin.Jlog3(pin.exp3(size * u)) @ w))
    np.testing.assert_allclose(np.log2(np.divide(off[:-1], off[1:])), 4, atol=0.1)


def test_the_servo_asks_for_accelerations_and_gets_them(robot, rng):
    """Forward dynamics of a free base by Pinocchio, under the torques that inverse dynamics has given."""
    model, n = without_gravity(robot), robot.n_joints
    q, v, wanted = random_state(robot, rng), rng.normal(size=6 + n), rng.normal(size=n)
    torque, none = np.empty(n), np.full(n, np.inf)
    room = physics.scratch_of(n)
    own = (*tree_of(robot.model), robot.joint_positions(q), v, wanted, np.zeros((6, 0)), np.zeros(0))
    assert not physics.servo_torque(*own, none, room, torque)
    found = pin.aba(model, model.createData(), q, v, np.r_[np.zeros(6), torque])
    assert relative(found[6:], wanted) < 1e-10
    limits, cut = 0.5 * np.abs(torque), np.empty(n)
    assert physics.servo_torque(*own, limits, room, cut)
    np.testing.assert_allclose(cut, 0.5 * torque)


@pytest.mark.parametrize("k", [1, 2, 3])
def test_a_servo_that_protects_accelerates_the_base_as_asked(robot, rng, k):
    """By Pinocchio's forward dynamics; and of all joint accelerations that do it, it changes the wanted ones least."""
    model, n = without_gravity(robot), robot.n_joints
    k = min(k, n)
    q, v, wanted = random_state(robot, rng), rng.normal(size=6 + n), rng.normal(size=n)
    U, asked, torque = np.linalg.qr(rng.normal(size=(6, k)))[0].copy(), rng.normal(size=k), np.empty(n)
    given = wanted.copy()
    own = (*tree_of(robot.model), robot.joint_positions(q), v, given, U, asked)
    physics.servo_torque(*own, np.full(n, np.inf), physics.scratch_of(n), torque)
    found = pin.aba(model, model.createData(), q, v, np.r_[np.zeros(6), torque])
    J_sub = U.T @ robot.coupling(q).J_base
    scale = np.linalg.cond(J_sub) * (1 + np.abs(found).max())
    assert np.abs(U.T @ found[:6] - asked).max() < 1e-10 * scale
    assert np.abs(found[6:] - given).max() < 1e-10 * scale
    # The change lies in the rows of J_sub.
    change = given - wanted
    along = np.linalg.lstsq(J_sub.T, change, rcond=None)[0]
    assert np.abs(J_sub.T @ along - change).max() < 1e-9 * scale


def test_directions_that_no_joint_serves_are_left_out(ets_vii, rng):
    """The same direction twice, asked for two things: the first counts, and nothing overflows."""
    q, n = ets_vii.configuration(rng.normal(size=6)), 6
    U = np.zeros((6, 2))
    U[5] = 1.0
    given, torque = np.zeros(n), np.empty(n)
    own = (*tree_of(ets_vii.model), ets_vii.joint_positions(q), np.zeros(12), given, U, np.array([0.1, 0.2]))
    physics.servo_torque(*own, np.full(n, np.inf), physics.scratch_of(n), torque)
    found = pin.aba(without_gravity(ets_vii), ets_vii.model.createData(), q, np.zeros(12), np.r_[np.zeros(6), torque])
    assert found[5] == pytest.approx(0.1, rel=1e-9)
