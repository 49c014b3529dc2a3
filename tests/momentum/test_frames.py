"""Directions fixed in the axes of a frame of the robot: the law, the records and Pink against frame placements."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from random_robots import random_robot, random_state
from scipy.integrate import quad

import ssm_decouple as ssm
from ssm_decouple import Protection, SelectiveLaw
from ssm_decouple.studies.comparison import largest_rotation_deg

EPS = np.finfo(float).eps
START = np.deg2rad([150, -20, -10, 0, 0, 0])
TARGET = [-1.8, -0.3, 1.2]
UR5 = "ur_description/urdf/ur5_robot.urdf"


def base_to(robot: ssm.Robot, frame: str, q) -> np.ndarray:
    """Base axes to those of a frame, by Pinocchio's placements."""
    return robot.frame_pose(q, frame).rotation.T @ robot.base_pose(q).rotation


@pytest.mark.parametrize("rows", [3, 6])
def test_the_law_has_the_rows_that_the_protection_tells(robot, rng, rows):
    for frame in (robot.end_effector, robot.link_names[len(robot.link_names) // 2]):
        for k in (1, 2):
            if robot.n_joints <= k:
                continue
            protection = Protection(np.linalg.qr(rng.normal(size=(rows, rows)))[0][:, :k], frame)
            law = SelectiveLaw(robot, protection, gain=0.3, rate_limit=np.inf, damping=0.0)
            q, target = random_state(robot, rng), rng.uniform(-2, 2, 3)
            command, coupling, R = law(q, target), robot.coupling(q), base_to(robot, frame, q)
            turned = np.vstack([R @ coupling.J_base[:3], R @ coupling.J_base[3:]])
            J_sub = protection.J_sub(coupling)
            np.testing.assert_allclose(J_sub, protection.U_twist.T @ turned, atol=1e-13 * np.linalg.norm(turned))
            np.testing.assert_allclose(
                protection.J_sub(coupling.inertial()), J_sub, atol=1e-13 * np.linalg.norm(turned)
            )
            size = np.linalg.norm(turned[-rows:]) * np.linalg.norm(command.joint_rates)
            assert np.linalg.norm(J_sub @ command.joint_rates) <= 64 * EPS * size
            assert np.linalg.norm(command.protected_rate) <= 4 * EPS * size
            N, v = protection.N_sub(coupling), 0.3 * command.end_effector_error
            if robot.n_joints >= k + 3:
                condition = np.linalg.cond(np.vstack([J_sub, coupling.J_gt]))
                expected = np.linalg.pinv(coupling.J_gt @ N, rcond=1e-10) @ v
                atol = 1e-13 * condition**2 * np.linalg.norm(expected)
                np.testing.assert_allclose(command.joint_rates, expected, atol=atol)


def test_a_frame_fixed_to_the_base_is_base_axes_turned(rng):
    mount = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.4, 1.2), np.array([-0.79, -0.29, 1.0]))
    robot = ssm.compose("ets_vii_bus", ssm.example_robot(UR5), mount, prefix="a_", end_effector="tool0")
    q, U = random_state(robot, rng), np.linalg.qr(rng.normal(size=(3, 3)))[0][:, :2]
    for frame, R in (("bus", np.eye(3)), ("a_world", mount.rotation)):
        np.testing.assert_allclose(base_to(robot, frame, q).T, R, atol=1e-12)
        target = robot.frame_pose(q).translation + [0.1, -0.1, 0.1]
        one, other = (SelectiveLaw(robot, p) for p in (Protection(U, frame), Protection(R @ U)))
        np.testing.assert_allclose(one(q, target).joint_rates, other(q, target).joint_rates, rtol=1e-9, atol=1e-14)
        motions = [ssm.simulate(law, q, target, 2.0, 0.1) for law in (one, other)]
        np.testing.assert_allclose(motions[0].configuration, motions[1].configuration, atol=1e-12)
        np.testing.assert_allclose(motions[0].protected_angle, motions[1].protected_angle, atol=1e-12)


def test_the_joint_that_turns_the_axes_takes_them_along(ets_vii):
    """joint_1 turns about base yaw: link_1's yaw is the base's, its roll goes round with the joint."""
    q = ets_vii.configuration([0.7, 0.2, 0.1, 0, 0, 0])
    coupling = ets_vii.coupling(q)
    R = base_to(ets_vii, "link_1", q)
    angle = np.arctan2(*R[:2, 0][::-1])
    assert abs(angle) == pytest.approx(0.7)
    np.testing.assert_allclose(Protection("roll", "link_1").J_sub(coupling)[0], R[0] @ coupling.J_rc, atol=1e-15)
    np.testing.assert_allclose(
        Protection("yaw", "link_1").J_sub(coupling), Protection("yaw").J_sub(coupling), atol=1e-15
    )


def test_words_for_it():
    for text, frame, k in (("yaw@link_3", "link_3", 1), ("1,0,0;0,0,1@antenna", "antenna", 2), ("all@hand", "hand", 3)):
        protection = Protection.parse(text)
        assert (protection.frame, protection.k) == (frame, k)
        assert f"{frame} axes" in protection.describe()


def test_the_record_of_a_motion(ets_vii):
    protection = Protection("yaw", "link_3")
    motion = ssm.simulate(SelectiveLaw(ets_vii, protection), ets_vii.configuration(START), TARGET, 60.0, 0.5, "rk4")
    assert np.abs(motion.protected_rate).max() < 1e-17
    rates = [
        base_to(ets_vii, "link_3", q)[2] @ w
        for q, w in zip(motion.configuration.values, motion.base_angular_velocity.values, strict=True)
    ]
    assert np.abs(rates).max() < 1e-17
    assert np.abs(motion.base_angular_velocity).max() > 1e-5
    # Base yaw is not what is protected here.
    assert largest_rotation_deg(motion, Protection("yaw")) > 1e-3
    free = SelectiveLaw(ets_vii, Protection("none"))
    other = ssm.simulate(free, ets_vii.configuration(START), TARGET, 60.0, 0.5, "rk4")
    assert largest_rotation_deg(motion, protection) < 0.02 * largest_rotation_deg(other, protection)


@pytest.mark.parametrize("frame", ["link_3", "end_effector"])
def test_the_recorded_angle_is_of_second_order(ets_vii, frame):
    """Of the integral over the recorded motion, by splines through a much finer record."""
    protection, ends = Protection("roll", frame), []
    law = SelectiveLaw(ets_vii, Protection("none", frame))
    law_with_rows = SelectiveLaw(ets_vii, protection)
    for dt in (2.0, 1.0, 0.05):
        motion = ssm.simulate(law, ets_vii.configuration(START), TARGET, 40.0, dt, "rk4")
        ends.append(np.deg2rad(largest_rotation_deg(motion, protection)))
    assert law_with_rows.directions[1] == frame
    rates = [
        base_to(ets_vii, frame, q)[0] @ w
        for q, w in zip(motion.configuration.values, motion.base_angular_velocity.values, strict=True)
    ]
    angle = np.r_[0, np.cumsum(0.025 * (np.array(rates[1:]) + rates[:-1]))]
    assert ends[2] == pytest.approx(np.abs(angle).max(), rel=1e-3)
    errors = np.abs(np.array(ends[:2]) - ends[2])
    assert errors[1] < 0.4 * errors[0] + 1e-9


@pytest.mark.parametrize(("nodes", "order"), [(0, 2), (1, 3), (2, 5)])
def test_over_a_hold_the_rotation_vanishes_to_the_quadrature_s_order(ets_vii, nodes, order):
    """About an axis that the joints turn while they are held: its integral by adaptive quadrature."""
    protection, q, turned = Protection("yaw", "link_3"), ets_vii.configuration(START), []
    for hold in (1.0, 0.5):
        law = SelectiveLaw(ets_vii, protection, sample_time=hold, hold_nodes=nodes)
        rates = law(q, TARGET).joint_rates

        def rate(time, rates=rates):
            moved = pin.integrate(ets_vii.model, q, np.r_[np.zeros(6), time * rates])
            return float((base_to(ets_vii, "link_3", moved)[2] @ ets_vii.coupling(moved).J_rc) @ rates)

        turned.append(abs(quad(rate, 0, hold, epsabs=1e-16, epsrel=1e-12)[0]))
    assert np.log2(turned[0] / turned[1]) == pytest.approx(order, abs=0.2)


def test_a_held_motion(ets_vii):
    """The mean rate over the holds is zero; at the samples it is not, and the record's sums tell second order."""
    q, drift = ets_vii.configuration(START), []
    for nodes in (0, 2):
        law = SelectiveLaw(ets_vii, Protection("yaw", "link_3"), sample_time=0.5, hold_nodes=nodes)
        motion = ssm.simulate(law, q, TARGET, 30.0, 0.5, "held")
        assert np.abs(motion.protected_rate).max() < 1e-17
        drift.append(np.abs(motion.protected_angle.values).max())
    assert drift[1] < 0.2 * drift[0]


def test_a_dynamic_motion(ets_vii):
    law = SelectiveLaw(ets_vii, Protection("yaw", "link_3"))
    method = ssm.Dynamic(servo=ssm.Servo(frequency=4.0))
    motion = ssm.simulate(law, ets_vii.configuration(START), TARGET, 10.0, 0.1, method, smooth_start=8.0)
    rates = [
        base_to(ets_vii, "link_3", q)[2] @ w
        for q, w in zip(motion.configuration.values, motion.base_angular_velocity.values, strict=True)
    ]
    np.testing.assert_allclose(motion.protected_rate[:, 0], rates, atol=1e-15)
    assert 0 < np.abs(motion.protected_rate).max() < 0.02 * np.abs(motion.base_angular_velocity).max()


def test_feedback_brings_the_axis_back(ets_vii):
    law = SelectiveLaw(ets_vii, Protection("yaw", "link_3"))
    load = ssm.Load(torque=(2.0, -1.0, 3.0), duration=1.0)
    ends = []
    for gain in (0.0, 0.4):
        method = ssm.Dynamic(step=0.005, servo=ssm.Servo(frequency=4.0), load=load, feedback_gain=gain)
        motion = ssm.simulate(law, ets_vii.configuration(START), TARGET, 20.0, 0.1, method)
        ends.append(np.abs(motion.protected_angle.values[-1, 0]))
    assert ends[1] < 0.2 * ends[0]


def test_what_does_not_know_such_axes_says_so(ets_vii):
    with pytest.raises(ssm.InputError, match="no frame 'antenna'; its links are bus, link_1"):
        SelectiveLaw(ets_vii, Protection("yaw", "antenna"))
    with pytest.raises(ssm.InputError, match="no frame 'antenna'"):
        Protection("yaw", "antenna").J_sub(ets_vii.coupling(ets_vii.configuration(START)))
    method, law = ssm.Dynamic(servo=ssm.Servo(protects=True)), SelectiveLaw(ets_vii, Protection("yaw", "link_3"))
    with pytest.raises(ssm.InputError, match="fixed in base or inertial axes: no schedule and no axes of 'link_3'"):
        ssm.simulate(law, ets_vii.configuration(START), TARGET, 1.0, 0.1, method)
    for bad in ("", 3, None):
        with pytest.raises(ssm.InputError, match="frame is 'base', 'inertial' or the name of a frame"):
            Protection("yaw", bad)


@pytest.mark.parametrize("frame", ["link_3", "end_effector"])
def test_pink_protects_the_same_axes(ets_vii, rng, frame):
    pink = pytest.importorskip("pink")
    from ssm_decouple.control.pink import ProtectedRate

    protection = Protection(np.linalg.qr(rng.normal(size=(6, 6)))[0][:, :2], frame)
    for _ in range(3):
        q, v = random_state(ets_vii, rng), rng.normal(size=12)
        configuration = pink.Configuration(ets_vii.model, ets_vii.model.createData(), q)
        R = base_to(ets_vii, frame, q)
        turned = np.r_[R @ v[:3], R @ v[3:6]]
        rows = ProtectedRate(protection).compute_jacobian(configuration)
        np.testing.assert_allclose(rows @ v, protection.U_twist.T @ turned, atol=1e-13)


def test_any_tree(rng):
    """Frames on other branches than the end-effector's."""
    robot = random_robot(7, joints=8, branching=0.7)
    q = random_state(robot, rng)
    for frame in robot.link_names:
        command = SelectiveLaw(robot, Protection("roll+yaw", frame), rate_limit=np.inf)(q, rng.uniform(-1, 1, 3))
        rate = base_to(robot, frame, q) @ command.base_twist[3:]
        assert np.linalg.norm(rate[[0, 2]]) <= 1e-13 * np.linalg.norm(rate) + 1e-18, frame
