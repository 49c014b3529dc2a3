"""The law as functions of arrays."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pinocchio as pin
import pytest
from random_robots import random_robot, random_state

import ssm_decouple as ssm

EPS = np.finfo(float).eps


def exact(J, x):
    """J x without any rounding but the last."""
    return np.array([float(sum(Fraction(a) * Fraction(b) for a, b in zip(row, x, strict=True))) for row in J])


@pytest.mark.parametrize("seed", range(4))
def test_they_give_the_numbers_of_the_law(seed):
    rng = np.random.default_rng(seed)
    robot = random_robot(seed, 7)
    q = random_state(robot, rng)
    protection = ssm.Protection(np.linalg.qr(rng.normal(size=(3, seed % 3 + 1)))[0])
    law = ssm.SelectiveLaw(robot, protection, gain=0.05, rate_limit=0.05, joint_weights=rng.uniform(0.5, 2.0, 7))
    target = robot.frame_pose(q).translation + rng.normal(size=3)
    command = law(q, target)

    model, data = robot.model, robot.model.createData()
    J_base = ssm.base_twist_map(pin.computeCentroidalMap(model, data, q))
    np.testing.assert_allclose(J_base, robot.coupling(q).J_base, rtol=0, atol=1e-13)
    pin.updateFramePlacement(model, data, robot.end_effector_id)
    J = pin.getFrameJacobian(model, data, robot.end_effector_id, pin.LOCAL_WORLD_ALIGNED)[:3]
    J_sub, J_gt = protection.U_c.T @ J_base[3:], J[:, 6:] + J[:, :6] @ J_base
    velocity = 0.05 * (target - data.oMf[robot.end_effector_id].translation)
    rates = ssm.selective_rates(J_sub, J_gt, velocity, rate_limits=0.05, joint_weights=law.joint_weights)
    np.testing.assert_allclose(rates, command.joint_rates, rtol=0, atol=1e-12)
    assert np.abs(exact(J_sub, rates)).max() <= 2 * EPS * np.linalg.norm(J_sub, 2) * np.linalg.norm(rates)


@pytest.mark.parametrize(("k", "m", "n"), [(0, 3, 6), (1, 3, 6), (3, 6, 12), (6, 2, 9), (2, 9, 5), (4, 1, 3)])
def test_rates_of_any_shape(k, m, n):
    rng = np.random.default_rng(100 * k + m)
    J_sub, J_task, v = rng.normal(size=(k, n)), rng.normal(size=(m, n)), rng.normal(size=m)
    b, w = rng.normal(size=k), rng.uniform(0.1, 10.0, n)
    S = np.diag(1.0 / np.sqrt(w))
    rates = ssm.selective_rates(J_sub, J_task, v, b, joint_weights=w, damping=0.0)
    fixed = S @ np.linalg.pinv(J_sub @ S) @ b
    Z = S @ np.linalg.svd(J_sub @ S)[2][k:].T if k < n else np.zeros((n, 0))
    rest = Z @ np.linalg.pinv(J_task @ Z) @ (v - J_task @ fixed) if Z.size else 0.0
    np.testing.assert_allclose(rates, fixed + rest, rtol=0, atol=1e-11)


def test_results_go_where_they_are_wanted():
    robot = ssm.load_robot("ets_vii")
    A_g = pin.computeCentroidalMap(robot.model, robot.model.createData(), robot.configuration(np.full(6, 0.4)))
    J_base = np.empty((6, 6))
    assert ssm.base_twist_map(A_g, out=J_base) is J_base
    rates = np.empty(6)
    assert ssm.selective_rates(J_base[5:], J_base[:3], np.ones(3), out=rates) is rates


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"J_sub": np.ones(6)}, r"J_sub has shape \(6,\); it needs two dimensions"),
        ({"J_sub": np.ones((7, 6))}, "at most 6 rows"),
        ({"J_task": np.ones((3, 5))}, "the same number of joints"),
        ({"task_velocity": np.ones(2)}, r"task_velocity has shape \(2,\); it needs \(3,\)"),
        ({"task_velocity": [1.0, np.nan, 0.0]}, "is not finite"),
        ({"protected_rate": [1.0, 2.0]}, r"protected_rate has shape \(2,\); it needs \(1,\)"),
        ({"rate_limits": 0.0}, "above zero"),
        ({"joint_weights": np.inf}, "the weights finite"),
        ({"damping": -1.0}, "damping is -1.0"),
        ({"damping_threshold": 0.0}, "damping_threshold 0.0"),
        ({"out": np.empty(5)}, r"out must be a writable, contiguous float64 array \(6,\)"),
        ({"J_task": "rows"}, "J_task"),
    ],
)
def test_what_does_not_fit_is_refused(change, says):
    rng = np.random.default_rng(3)
    given = {"J_sub": rng.normal(size=(1, 6)), "J_task": rng.normal(size=(3, 6)), "task_velocity": np.ones(3)}
    with pytest.raises(ssm.InputError, match=says):
        ssm.selective_rates(**(given | change))


@pytest.mark.parametrize(
    ("A_g", "says"),
    [(np.ones((6, 6)), r"shape \(6, 6\)"), (np.zeros((6, 8)), "regular inertia"), (np.full((6, 8), np.nan), "finite")],
)
def test_a_map_that_is_none_is_refused(A_g, says):
    with pytest.raises(ssm.InputError, match=says):
        ssm.base_twist_map(A_g)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_protected_rows_that_are_not_finite_are_refused(value):
    J_sub, J_task = np.array([[0.1, 0.2, 0.3, 0.4]]), np.eye(3, 4)
    ssm.selective_rates(J_sub, J_task, [0.1, 0.0, 0.0])
    for column in range(4):
        damaged = J_sub.copy()
        damaged[0, column] = value
        with pytest.raises(ssm.InputError, match="J_sub"):
            ssm.selective_rates(damaged, J_task, [0.1, 0.0, 0.0])
    with pytest.raises(ssm.InputError, match="protected_rate"):
        ssm.selective_rates(J_sub, J_task, [0.1, 0.0, 0.0], protected_rate=[value])
