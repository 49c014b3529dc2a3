"""Moving targets against differences, conservation, closed forms and Euler's equations in elliptic functions."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ellipj

import ssm_decouple as ssm

INERTIA = np.array([[30.0, 2.0, 1.0], [2.0, 50.0, 3.0], [1.0, 3.0, 60.0]])
TUMBLE = {
    "inertia": INERTIA,
    "attitude": pin.rpy.rpyToMatrix(0.3, -0.5, 1.0),
    "angular_velocity": [0.02, 0.05, -0.03],
    "position": [1.0, 2.0, 3.0],
    "velocity": [0.01, -0.02, 0.0],
    "grasp_point": [0.5, 0.2, -0.1],
}
WEIGHTS = np.array([-1, 9, -45, 0, 45, -9, 1]) / 60.0  # sixth-order central difference


def differences(pose, time: float, h: float) -> np.ndarray:
    """Return the twist (6,), inertial axes, of a motion of poses."""
    poses = [pose(time + step * h) for step in range(-3, 4)]
    turned = [pin.log3(each.rotation @ poses[3].rotation.T) for each in poses]
    moved = [each.translation - poses[3].translation for each in poses]
    return np.r_[WEIGHTS @ np.array(moved), WEIGHTS @ np.array(turned)] / h


def random_inertia(rng: np.random.Generator) -> np.ndarray:
    points = rng.normal(size=(6, 3)) * rng.uniform(0.2, 1, 3)
    second = points.T @ points
    return np.trace(second) * np.eye(3) - second


@pytest.mark.parametrize("speed", [np.deg2rad(2.0), 1.0])
def test_momentum_and_energy_stay(rng, speed):
    """From the poses alone: the angular velocity by differences, then I omega and omega^T I omega."""
    for _ in range(3):
        inertia, axis = random_inertia(rng), rng.normal(size=3)
        omega = speed * axis / np.linalg.norm(axis)
        target = ssm.TumblingTarget(**TUMBLE | {"inertia": inertia, "angular_velocity": omega})
        momenta, energies = [], []
        for time in np.r_[0.1 / speed, rng.uniform(0.1, 60, 20) / speed]:
            R, spin = target.pose(time).rotation, differences(target.pose, time, 0.01 / speed)[3:]
            momenta.append(R @ inertia @ R.T @ spin)
            energies.append(spin @ momenta[-1])
            np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-14)
        size = np.linalg.norm(momenta[0])
        np.testing.assert_allclose(momenta, [momenta[0]] * 21, atol=1e-9 * size)
        np.testing.assert_allclose(energies, energies[0], rtol=1e-9)
        start = TUMBLE["attitude"] @ inertia @ TUMBLE["attitude"].T @ omega
        np.testing.assert_allclose(momenta[0], start, atol=1e-9 * size)


def test_what_it_tells_is_conserved_to_rounding():
    target = ssm.TumblingTarget(**TUMBLE)
    energies = []
    for time in np.linspace(0, 3000, 50):  # 30 turns
        R, spin = target.pose(time).rotation, target.twist(time)[3:]
        np.testing.assert_allclose(R @ INERTIA @ R.T @ spin, target.angular_momentum, rtol=1e-12)
        energies.append(spin @ target.angular_momentum)
    np.testing.assert_allclose(energies, energies[0], rtol=1e-12)


@pytest.mark.parametrize("moments", [(40.0, 40.0, 70.0), (40.0, 40.0, 10.0)])
def test_an_axisymmetric_body_in_closed_form(moments):
    """It spins about its axis at a constant rate and is carried around the momentum by |L| / I_across."""
    across, along = moments[0], moments[2]
    R0, omega = TUMBLE["attitude"], np.array(TUMBLE["angular_velocity"])
    target = ssm.TumblingTarget(**TUMBLE | {"inertia": np.diag(moments)})
    L = R0 @ np.diag(moments) @ R0.T @ omega
    spin = (1 - along / across) * (R0.T @ omega)[2]
    for time in (0.0, 1.0, 77.7, 1000.0, 5000.0):
        expected = pin.exp3(time * L / across) @ R0 @ pin.exp3(time * spin * np.array([0, 0, 1.0]))
        np.testing.assert_allclose(target.pose(time).rotation, expected, atol=1e-11)


@pytest.mark.parametrize(("about_long", "about_short"), [(0.01, 0.05), (0.05, 0.01)])
def test_euler_s_equations_solved_by_jacobi_s_functions(about_long, about_short):
    """A body of three different moments: its rates along the principal axes are cn, sn and dn, or dn, sn and cn."""
    I1, I2, I3 = np.linalg.eigvalsh(INERTIA)
    axes = np.linalg.eigh(INERTIA)[1]
    axes *= np.linalg.det(axes)
    turned = I1 * (I2 - I1) * about_long**2 > I3 * (I3 - I2) * about_short**2
    if turned:
        I1, I3, about_long, about_short, axes = I3, I1, about_short, about_long, axes[:, ::-1] * [1, -1, 1]
    pace = about_short * np.sqrt((I3 - I1) * (I3 - I2) / (I1 * I2)) * (-1 if turned else 1)
    middle = (I3 - I1) * about_long * about_short / (I2 * pace)
    m = (I2 - I1) * about_long * middle / (I3 * pace * about_short)
    R0 = TUMBLE["attitude"]
    spin = R0 @ axes @ [about_long, 0, about_short]
    target = ssm.TumblingTarget(**TUMBLE | {"angular_velocity": spin})
    for time in (10.0, 100.0, 1000.0, 5000.0):
        sn, cn, dn, _ = ellipj(pace * time, m)
        body = axes @ [about_long * cn, middle * sn, about_short * dn]
        np.testing.assert_allclose(target.pose(time).rotation.T @ target.twist(time)[3:], body, atol=1e-12)


def test_velocities_are_derivatives():
    target = ssm.TumblingTarget(**TUMBLE)
    for time in (0.5, 33.0, 250.0):
        np.testing.assert_allclose(target.twist(time), differences(target.pose, time, 0.1), atol=1e-11)
        places = [target(time + step * 0.1)[0] for step in range(-3, 4)]
        np.testing.assert_allclose(target(time)[1], WEIGHTS @ np.array(places) / 0.1, atol=1e-11)
        np.testing.assert_allclose(target(time)[0], target.pose(time).act(np.array(TUMBLE["grasp_point"])), atol=1e-15)
    place, velocity = target(0.0)
    np.testing.assert_allclose(place, np.array([1, 2, 3]) + TUMBLE["attitude"] @ TUMBLE["grasp_point"], atol=1e-15)
    arm = place - [1, 2, 3]
    np.testing.assert_allclose(velocity, TUMBLE["velocity"] + np.cross(TUMBLE["angular_velocity"], arm), atol=1e-15)


def test_the_order_of_asking_does_not_matter():
    one, two = ssm.TumblingTarget(**TUMBLE), ssm.TumblingTarget(**TUMBLE)
    far, near = one(500.0), one(3.0)
    np.testing.assert_array_equal(near, two(3.0))
    np.testing.assert_array_equal(far, two(500.0))


def test_a_body_that_does_not_turn():
    target = ssm.TumblingTarget(**TUMBLE | {"angular_velocity": [0, 0, 0]})
    np.testing.assert_allclose(target.pose(1e4).rotation, TUMBLE["attitude"], atol=1e-15)
    np.testing.assert_allclose(target(1e4)[1], TUMBLE["velocity"], atol=1e-18)


def test_bad_tumbles():
    for key, value, message in (
        ("attitude", np.diag([1, 1, -1]), "no rigid pose"),
        ("attitude", [0, 0, 0, 1], "rotation matrix"),
        ("angular_velocity", [0, np.inf, 0], "angular_velocity"),
        ("position", [0, 0], "position"),
        ("velocity", "fast", "real numbers"),
        ("grasp_point", [1], "grasp_point"),
    ):
        with pytest.raises(ssm.InputError, match=message):
            ssm.TumblingTarget(**TUMBLE | {key: value})
    with pytest.raises(ssm.ModelError, match="target inertia has the principal moments 1, 2, 4 kg m2"):
        ssm.TumblingTarget(**TUMBLE | {"inertia": np.diag([1.0, 2.0, 4.0])})
    for time in (-1.0, np.nan, [1.0, 2.0]):
        with pytest.raises(ssm.InputError, match="time"):
            ssm.TumblingTarget(**TUMBLE)(time)


def random_poses(rng: np.random.Generator, count: int) -> list[pin.SE3]:
    return [pin.SE3(pin.exp3(rng.uniform(-1.5, 1.5, 3)), rng.uniform(-2, 2, 3)) for _ in range(count)]


@settings(max_examples=30)
@given(st.integers(0, 10**6), st.integers(2, 7))
def test_waypoints_are_hit_and_the_ends_are_at_rest(seed, count):
    rng = np.random.default_rng(seed)
    times, poses = np.cumsum(rng.uniform(0.5, 20, count)), random_poses(rng, count)
    path = ssm.Waypoints(times, poses)
    for time, pose in zip(times, poses, strict=True):
        np.testing.assert_allclose(path(time)[0], pose.translation, atol=1e-13)
        np.testing.assert_allclose(path.pose(time).homogeneous, pose.homogeneous, atol=1e-12)
    for end in (times[0] - 5, times[0], times[-1], times[-1] + 5):
        np.testing.assert_array_equal(path.twist(end), 0)
        np.testing.assert_array_equal(path(end)[1], 0)
    for end in (times[0] + 1e-7, times[-1] - 1e-7):
        np.testing.assert_allclose(path.twist(end), 0, atol=1e-4)
    np.testing.assert_array_equal(path(times[-1] + 5)[0], path(times[-1])[0])


def test_twists_are_derivatives_and_do_not_jump(rng):
    for count in (2, 3, 6):
        times = np.cumsum(rng.uniform(2, 8, count))
        path = ssm.Waypoints(times, random_poses(rng, count))
        for time in rng.uniform(times[0] + 0.1, times[-1] - 0.1, 20):
            if np.abs(times - time).min() < 0.1:
                continue
            twist = path.twist(time)
            np.testing.assert_allclose(twist, differences(path.pose, time, 0.02), atol=1e-6)
            np.testing.assert_array_equal(path(time)[1], twist[:3])
        for knot in times[1:-1]:  # twist and its derivative are the same from both sides
            before, after = path.twist(knot - 1e-6), path.twist(knot + 1e-6)
            np.testing.assert_allclose(before, after, atol=1e-4)
            left = (path.twist(knot - 1e-6) - path.twist(knot - 1.01e-3)) / 1.009e-3
            right = (path.twist(knot + 1.01e-3) - path.twist(knot + 1e-6)) / 1.009e-3
            np.testing.assert_allclose(left, right, atol=2e-2)


def test_points_have_a_place_but_no_attitude():
    path = ssm.Waypoints([0, 10], [[0, 0, 0], [1, 2, 3]])
    place, velocity = path(5.0)
    np.testing.assert_allclose(place, [0.5, 1, 1.5])
    np.testing.assert_allclose(velocity, [0.15, 0.3, 0.45])  # 1.5 times the mean, as a cubic at rest at both ends
    assert path.rotations is None
    for ask in (path.pose, path.twist):
        with pytest.raises(ssm.InputError, match="without an attitude"):
            ask(5.0)


def test_matrices_are_poses_too(rng):
    poses = random_poses(rng, 3)
    one, two = ssm.Waypoints([0, 1, 2], poses), ssm.Waypoints([0, 1, 2], [pose.homogeneous for pose in poses])
    np.testing.assert_array_equal(one.twist(0.7), two.twist(0.7))


def test_bad_waypoints():
    square = [[0, 0, 0], [1, 0, 0], [1, 1, 0]]
    for times, points, message in (
        ([0, 1, 1], square, "numbers that rise"),
        ([0], square[:1], "two or more"),
        ([0, 1, np.nan], square, "finite"),
        ([0, 1], square, "2 times need"),
        ([0, 1, 2], [[0, 0, 0], [1, 0, np.inf], [1, 1, 0]], "finite"),
        ([0, 1], [np.eye(4), 2 * np.eye(4)], "waypoint 1 is no rigid pose"),
        ([0, 1], [pin.SE3.Identity(), [0, 0, 0]], "waypoint 1 is a pinocchio.SE3"),
        ([0, 1], "there", "real numbers"),
    ):
        with pytest.raises(ssm.InputError, match=message):
            ssm.Waypoints(times, points)
    with pytest.raises(ssm.InputError, match="time"):
        ssm.Waypoints([0, 1, 2], square)(np.inf)


def test_the_arm_follows_waypoints(ets_vii):
    q = ets_vii.configuration(np.deg2rad([150, -20, -10, 0, 0, 0]))
    start = ets_vii.frame_pose(q).translation
    path = ssm.Waypoints(
        [5, 40, 80, 115], [start, start + [0.2, -0.3, -0.2], start + [0, -0.4, -0.5], [-1.8, -0.3, 1.8]]
    )
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw"), gain=0.2, sample_time=0.1, hold_nodes=2)
    motion = ssm.simulate(law, q, path, duration=120.0, dt=0.1, method="held")
    assert float(motion.end_effector_error.max()) < 1e-3
    assert float(motion.end_effector_error[-1]) < 2e-4
    assert float(abs(motion.protected_angle).max()) < 1e-14
    np.testing.assert_allclose(motion.target_position.sel(time=80).values, start + [0, -0.4, -0.5], atol=1e-12)
    assert float(abs(motion.joint_rates[:49]).max()) < 1e-12  # the path waits until its first time
