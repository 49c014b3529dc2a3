from __future__ import annotations

import itertools
import json

import numpy as np
import pinocchio as pin
import pytest
from random_robots import random_robot, random_state

import ssm_decouple as ssm
from ssm_decouple import Protection, SelectiveLaw
from ssm_decouple.simulation.motion import judge
from ssm_decouple.simulation.replay import integral_along

START = np.deg2rad([150, -20, -10, 0, 0, 0])
TARGET = [-1.8, -0.3, 1.2]
LIMIT = np.deg2rad(5)


@pytest.fixture(scope="module")
def motion(ets_vii):
    law = SelectiveLaw(ets_vii, Protection("yaw"), gain=0.05)
    return ssm.simulate(law, ets_vii.configuration(START), TARGET, duration=150.0, dt=0.1)


def plain_simulation(robot, U_c, q, target, duration, dt, gain=0.05, limit=LIMIT):
    """The paper's law and step in plain NumPy: Moore-Penrose inverses, one explicit step a sample."""
    model, data, fid = robot.model, robot.model.createData(), robot.end_effector_id
    rows = []
    for _ in range(round(duration / dt) + 1):
        pin.computeCentroidalMap(model, data, q)
        pin.updateFramePlacement(model, data, fid)
        J = pin.getFrameJacobian(model, data, fid, pin.LOCAL_WORLD_ALIGNED)
        J_base = -np.linalg.solve(data.Ag[:, :6], data.Ag[:, 6:])
        J_g, J_sub = (J[:, 6:] + J[:, :6] @ J_base)[:3], U_c.T @ J_base[3:]
        N = np.eye(6) - np.linalg.pinv(J_sub) @ J_sub
        error = target - data.oMf[fid].translation
        rates = N @ np.linalg.pinv(J_g @ N) @ (gain * error)
        rates *= min(1.0, limit / np.abs(rates).max())
        rows.append([*q, *rates, np.linalg.norm(error)])
        q = pin.integrate(model, q, np.r_[J_base @ rates, rates] * dt)
    return np.array(rows)


def test_it_is_the_paper_s_simulation(ets_vii, motion):
    plain = plain_simulation(
        ets_vii, np.array([[0, 0, 1.0]]).T, ets_vii.configuration(START), np.array(TARGET), 150, 0.1
    )
    np.testing.assert_allclose(motion.configuration, plain[:, :13], atol=1e-11)
    np.testing.assert_allclose(motion.joint_rates, plain[:, 13:19], atol=1e-11)
    np.testing.assert_allclose(motion.end_effector_error, plain[:, 19], atol=1e-11)


def test_the_record_is_consistent(ets_vii, motion):
    assert motion.sizes["time"] == 1501
    assert list(motion.joint.values) == list(ets_vii.joint_names)
    for i in (0, 700, 1500):
        q = motion.configuration.values[i]
        at = motion.isel(time=i)
        np.testing.assert_allclose(at.end_effector_position, ets_vii.frame_pose(q).translation, atol=1e-14)
        np.testing.assert_allclose(at.joint_positions, ets_vii.joint_positions(q), atol=1e-15)
        np.testing.assert_allclose(pin.rpy.rpyToMatrix(*at.base_rpy.values), ets_vii.base_pose(q).rotation, atol=1e-14)
        twist = np.r_[at.base_linear_velocity, at.base_angular_velocity]
        np.testing.assert_allclose(twist, ets_vii.coupling(q).J_base @ at.joint_rates.values, atol=1e-16)
        np.testing.assert_allclose(at.centre_of_mass, ets_vii.coupling(q).centre_of_mass, atol=1e-14)
    assert np.abs(np.linalg.norm(motion.base_quaternion, axis=1) - 1).max() < 4e-16
    for name, variable in motion.data_vars.items():
        assert {"units", "frame", "long_name"} <= variable.attrs.keys(), name


def test_momentum_stays_zero(ets_vii, motion):
    """Against the size of the parts that cancel: the arm's own momentum, base held."""
    parts = [
        ets_vii.momentum(q, np.r_[np.zeros(6), v])
        for q, v in zip(motion.configuration.values, motion.joint_rates.values, strict=True)
    ]
    linear, angular = np.linalg.norm(np.array(parts)[:, :3], axis=1), np.linalg.norm(np.array(parts)[:, 3:], axis=1)
    assert np.all(np.linalg.norm(motion.linear_momentum, axis=1) <= 1e-14 * linear.max())
    assert np.all(np.linalg.norm(motion.angular_momentum, axis=1) <= 1e-14 * angular.max())


def test_the_protected_axis_does_not_turn_but_its_euler_angle_does(motion):
    assert np.abs(motion.protected_rate).max() < 1.5e-19
    assert np.abs(motion.protected_angle).max() < 1e-17
    yaw = np.rad2deg(np.ptp(motion.base_rpy.values[:, 2]))
    assert yaw == pytest.approx(0.0018, abs=5e-5)  # roll and pitch turn it at second order


def smooth_law(robot):
    return SelectiveLaw(robot, Protection([0.5, 0, 0.866]), gain=0.2, rate_limit=np.inf)


def end_state(robot, method, dt, duration=4.0):
    motion = ssm.simulate(smooth_law(robot), robot.configuration(START), TARGET, duration, dt, method=method)
    return motion.configuration.values[-1]


@pytest.mark.parametrize(
    ("method", "order", "steps"), [("explicit", 1, (0.1, 0.05, 0.025)), ("rk4", 4, (0.8, 0.4, 0.2))]
)
def test_order_of_convergence(ets_vii, method, order, steps):
    truth = end_state(ets_vii, "rk4", 0.02)
    errors = [np.linalg.norm(pin.difference(ets_vii.model, truth, end_state(ets_vii, method, dt))) for dt in steps]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, order, atol=0.25)


def test_runge_kutta_keeps_its_order_on_a_tree_with_continuous_joints(rng):
    robot = random_robot(11, joints=6)
    assert robot.model.nq > robot.model.nv + 1
    q = random_state(robot, rng)
    target = robot.frame_pose(q).translation + [0.15, -0.1, 0.1]

    def end(dt):
        law = SelectiveLaw(robot, Protection("yaw", "inertial"), gain=0.5, rate_limit=np.inf, damping=0.0)
        return ssm.simulate(law, q, target, 2.0, dt, method="rk4").configuration.values[-1]

    truth = end(0.01)
    errors = [np.linalg.norm(pin.difference(robot.model, truth, end(dt))) for dt in (0.4, 0.2, 0.1)]
    np.testing.assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), 4, atol=0.5)


def test_the_centre_of_mass_stays_where_it_is(ets_vii):
    """Physics says so; what drifts is the integrator's error, which shrinks at its order."""
    drift = {}
    for method, dt in (("explicit", 0.1), ("explicit", 0.05), ("rk4", 0.2), ("rk4", 0.1)):
        motion = ssm.simulate(smooth_law(ets_vii), ets_vii.configuration(START), TARGET, 20.0, dt, method=method)
        centre = motion.centre_of_mass.values
        drift[method, dt] = np.linalg.norm(centre - centre[0], axis=1).max()
    assert drift["explicit", 0.1] / drift["explicit", 0.05] == pytest.approx(2, abs=0.1)
    assert np.log2(drift["rk4", 0.2] / drift["rk4", 0.1]) == pytest.approx(4, abs=0.4)
    assert drift["rk4", 0.1] < 1e-4 * drift["explicit", 0.1]


def test_protection_fixed_in_inertial_axes(ets_vii):
    pose = pin.SE3(pin.rpy.rpyToMatrix(0.4, -0.3, 1.1), np.array([0.5, -1.0, 2.0]))
    q = ets_vii.configuration(START, pose)
    target = pose.act(np.array(TARGET))
    law = SelectiveLaw(ets_vii, Protection("pitch", "inertial"))
    motion = ssm.simulate(law, q, target, 60.0, 0.1)
    R = np.array([ets_vii.base_pose(q).rotation for q in motion.configuration.values])
    inertial = np.einsum("tij,tj->ti", R, motion.base_angular_velocity.values)
    assert np.abs(inertial[:, 1]).max() < 1e-18
    assert np.abs(inertial[:, [0, 2]]).max() > 1e-5
    assert np.abs(motion.protected_rate).max() < 1e-18
    assert np.abs(motion.protected_angle).max() < 1e-14


# Directions of the whole base twist.


def modes(robot) -> Protection:
    """Two made-up modes of appendages: one feels the base's z acceleration, one its x and yaw."""
    return Protection.from_modes(np.array([[0, 0, 8.0, 3.0, 0, 0], [5.0, 0, 0, 0, -1.0, 4.0]]).T)


@pytest.mark.parametrize("method", ["explicit", "held", "rk4"])
def test_the_integral_of_the_twist_is_what_it_says(ets_vii, method):
    """Against the poses: an explicit step is its own logarithm, the others are up to commutators of third order."""
    law = SelectiveLaw(ets_vii, Protection("none"), gain=0.2, rate_limit=np.inf)
    motion = ssm.simulate(law, ets_vii.configuration(START), TARGET, 4.0, 0.02, method=method)
    assert motion.base_twist_integral.dims == ("time", "twist")
    assert list(motion.twist.values) == ["vx", "vy", "vz", "wx", "wy", "wz"]
    poses = [ets_vii.base_pose(q) for q in motion.configuration.values]
    steps = np.array([pin.log6(a.actInv(b)).vector for a, b in itertools.pairwise(poses)])
    summed = np.vstack([np.zeros(6), np.cumsum(steps, axis=0)])
    size = np.abs(summed).max(axis=0)
    assert size.min() > 1e-6
    np.testing.assert_allclose(
        motion.base_twist_integral, summed, atol=1e-15 if method == "explicit" else 1e-6 * size.max()
    )


@pytest.mark.filterwarnings("ignore:the commanded rates reverse")
@pytest.mark.parametrize("method", ["explicit", "held", "rk4"])
def test_modes_of_appendages_are_not_excited(ets_vii, method):
    protection = modes(ets_vii)
    law = SelectiveLaw(ets_vii, protection)
    if method == "held":
        law = SelectiveLaw(ets_vii, protection, sample_time=0.1, hold_nodes=3)
    motion = ssm.simulate(law, ets_vii.configuration(START), TARGET, 60.0, 0.1, method=method)
    assert motion.U_c.dims == ("twist", "protected")
    np.testing.assert_array_equal(motion.U_c, protection.U_twist)
    assert json.loads(motion.attrs["law"])["U_c"] == protection.U_c.tolist()
    assert np.abs(motion.protected_rate).max() < 1e-17
    np.testing.assert_array_equal(motion.protected_angle, motion.base_twist_integral.values @ protection.U_twist)
    assert np.abs(motion.base_twist_integral.values).max() > 1e-3
    # rk4 takes the integral by its own quadrature, on stages that are each protected.
    assert np.abs(motion.protected_angle).max() < 1e-14


def test_twists_fixed_in_inertial_axes(ets_vii, rng):
    pose = pin.SE3(pin.rpy.rpyToMatrix(0.4, -0.3, 1.1), np.array([0.5, -1.0, 2.0]))
    q, target = ets_vii.configuration(START, pose), pose.act(np.array(TARGET))
    protection = Protection([0, 1, 0, 0, 0, 0], "inertial")
    motion = ssm.simulate(SelectiveLaw(ets_vii, protection), q, target, 60.0, 0.1, method="rk4")
    way = motion.base_position.values - motion.base_position.values[0]
    assert np.abs(way[:, [0, 2]]).max() > 1e-3
    assert np.abs(way[:, 1]).max() < 1e-9  # the base origin keeps its inertial y
    np.testing.assert_array_equal(motion.protected_angle.values[:, 0], way[:, 1])
    assert np.abs(motion.protected_rate).max() < 1e-17
    # A mixed direction under another law: the integral of its rate.
    mixed = np.linalg.qr(rng.normal(size=(6, 2)))[0]
    free = ssm.simulate(SelectiveLaw(ets_vii, Protection("none")), q, target, 20.0, 0.05, method="rk4")
    along = integral_along(free, mixed, "inertial")
    R = np.array([ets_vii.base_pose(q).rotation for q in free.configuration.values])
    twist = np.hstack(
        [np.einsum("tij,tj->ti", R, free[name].values) for name in ("base_linear_velocity", "base_angular_velocity")]
    )
    trapezoids = np.cumsum(0.025 * (twist[1:] + twist[:-1]), axis=0) @ mixed
    np.testing.assert_allclose(along[1:], trapezoids, atol=1e-6)
    assert np.abs(along).max() > 1e-3


# Smooth starts.


@pytest.mark.parametrize(("method", "nodes"), [("explicit", 0), ("held", 0), ("held", 2), ("rk4", 0)])
def test_a_smooth_start_has_no_jump_and_keeps_the_protection(ets_vii, method, nodes):
    """Accelerations from rest on: their jumps shrink with the time between samples, those of a plain start grow."""

    def jump(dt: float, smooth_start: float) -> float:
        options = {"sample_time": dt, "hold_nodes": nodes} if nodes else {}
        law = SelectiveLaw(ets_vii, Protection("yaw"), gain=0.05, rate_limit=np.inf, **options)
        motion = ssm.simulate(
            law, ets_vii.configuration(START), TARGET, 16.0, dt, method=method, smooth_start=smooth_start
        )
        assert motion.attrs["smooth_start"] == smooth_start
        assert np.abs(motion.protected_rate).max() < 1e-17
        rates = np.vstack([np.zeros((2, 6)), motion.joint_rates.values])
        return float(np.abs(np.diff(rates, 2, axis=0)).max() / dt)

    assert jump(0.05, 8.0) < 0.002
    assert jump(0.05, 8.0) < 0.6 * jump(0.1, 8.0)
    assert jump(0.05, 0.0) > 1.9 * jump(0.1, 0.0) > 0.5


@pytest.mark.parametrize(("method", "lead"), [("explicit", 0.05), ("held", 0.05), ("rk4", 0.0)])
def test_the_pace_of_a_smooth_start(ets_vii, method, lead):
    law = SelectiveLaw(ets_vii, Protection("yaw"))
    motion = ssm.simulate(law, ets_vii.configuration(START), TARGET, 6.0, 0.1, method=method, smooth_start=4.0)
    for i in (0, 7, 20, 39, 40, 60):
        x = min(1.0, (motion.time.values[i] + lead) / 4.0)
        plain = law(motion.configuration.values[i], TARGET).joint_rates
        pace = 10 * x**3 - 15 * x**4 + 6 * x**5
        np.testing.assert_allclose(motion.joint_rates.values[i], pace * plain, atol=1e-14)


def test_a_smooth_start_keeps_the_order_of_runge_and_kutta(ets_vii):
    def end(dt):
        q = ets_vii.configuration(START)
        motion = ssm.simulate(smooth_law(ets_vii), q, TARGET, 4.0, dt, method="rk4", smooth_start=4.0)
        return motion.configuration.values[-1]

    truth = end(0.02)
    errors = [np.linalg.norm(pin.difference(ets_vii.model, truth, end(dt))) for dt in (0.8, 0.4, 0.2)]
    np.testing.assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), 4, atol=0.5)


def test_slow_on_purpose_is_not_stalled(ets_vii):
    law = SelectiveLaw(ets_vii, Protection("yaw"), gain=0.5)
    motion = ssm.simulate(law, ets_vii.configuration(START), TARGET, 150.0, 0.1, stop_early=True, smooth_start=100.0)
    assert motion.attrs["outcome"] == "converged"


def test_a_moving_target_is_followed_without_lag(ets_vii):
    """Feed-forward, x_dot_des in the paper's eq. 9: without it the error would settle at speed / gain = 0.1 m."""
    q = ets_vii.configuration(START)
    centre, speed = ets_vii.frame_pose(q).translation, 0.005

    def target(time):
        return centre + [speed * time, 0, 0], [speed, 0, 0]

    motion = ssm.simulate(SelectiveLaw(ets_vii, Protection("yaw"), gain=0.05), q, target, 40.0, 0.1, method="rk4")
    assert motion.end_effector_error.values.max() < 1e-6
    np.testing.assert_allclose(motion.target_position.values[-1], centre + [0.2, 0, 0])
    with pytest.raises(ssm.InputError, match="target velocity"):
        ssm.simulate(SelectiveLaw(ets_vii, Protection("yaw")), q, lambda time: (centre, [np.nan, 0, 0]), 1.0, 0.1)


def test_the_last_step_is_shorter_where_dt_does_not_divide(ets_vii):
    motion = ssm.simulate(SelectiveLaw(ets_vii, Protection("yaw")), ets_vii.configuration(START), TARGET, 1.0, 0.3)
    np.testing.assert_allclose(motion.time, [0, 0.3, 0.6, 0.9, 1.0])


# How a motion ends.


def test_judging_a_motion():
    time = np.arange(0, 100.05, 0.1)
    decay = np.exp(-0.05 * time)
    assert judge(time, decay, 0.01, 20.0).name == "converged"
    assert judge(time, decay, 0.01, 20.0).time == pytest.approx(np.log(100) / 0.05, abs=0.1)
    stuck = np.maximum(decay, 0.3)
    verdict = judge(time, stuck, 0.01, 20.0)
    assert (verdict.name, verdict.error) == ("stalled", 0.3)
    assert verdict.time == pytest.approx(-np.log(0.3 / 0.95) / 0.05, abs=0.2)
    assert judge(time, decay, 1e-3, 20.0).name == "running"
    assert judge(time[:50], stuck[:50], 0.01, 20.0).name == "running"  # too soon to tell
    assert judge(time, np.full(time.size, 0.005), 0.01, 20.0).time == 0.0
    never = judge(time, np.full(time.size, 0.5), 0.01, 20.0)
    assert (never.name, never.time, never.error) == ("stalled", 0.0, 0.5)


def test_stopping_early(ets_vii):
    q = ets_vii.configuration(START)
    full = ssm.simulate(SelectiveLaw(ets_vii, Protection("yaw")), q, TARGET, 150.0, 0.1)
    early = ssm.simulate(SelectiveLaw(ets_vii, Protection("yaw")), q, TARGET, 150.0, 0.1, stop_early=True)
    assert early.attrs["outcome"] == full.attrs["outcome"] == "converged"
    assert early.attrs["outcome_time"] == full.attrs["outcome_time"]
    assert full.attrs["outcome_time"] <= early.time.values[-1] < full.attrs["outcome_time"] + 2
    np.testing.assert_array_equal(early.configuration, full.configuration[: early.sizes["time"]])
    stuck = ssm.simulate(SelectiveLaw(ets_vii, Protection("all")), q, TARGET, 150.0, 0.1, stop_early=True)
    assert stuck.attrs["outcome"] == "stalled"
    assert stuck.time.values[-1] < 100
    assert stuck.attrs["final_error"] > 0.4


def test_progress_is_told_and_ctrl_c_keeps_what_is_done(ets_vii):
    shares = []
    law, q = SelectiveLaw(ets_vii, Protection("yaw")), ets_vii.configuration(START)
    ssm.simulate(law, q, TARGET, 20.0, 0.1, progress=shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0

    def stop(share):
        if share > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(ssm.SimulationInterrupted, match="interrupted at 10") as caught:
        ssm.simulate(law, q, TARGET, 20.0, 0.1, progress=stop)
    kept = caught.value.motion
    whole = ssm.simulate(law, q, TARGET, 20.0, 0.1)
    np.testing.assert_array_equal(kept.configuration, whole.configuration[: kept.sizes["time"]])
    assert isinstance(caught.value, KeyboardInterrupt)


def test_a_target_out_of_reach_warns_by_how_much_and_runs(ets_vii):
    law = SelectiveLaw(ets_vii, Protection("yaw"))
    with pytest.warns(
        ssm.DecoupleWarning, match=r"the target \(-0.79, -0.29, 6\) m is 2.08 m beyond the arm's reach of 2.92 m"
    ):
        motion = ssm.simulate(law, ets_vii.configuration(START), [-0.79, -0.29, 6.0], 10.0, 0.1)
    assert motion.sizes["time"] == 101


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"dt": 0.0}, "dt is 0.0; it must be a positive time"),
        ({"dt": -0.1}, "dt is -0.1"),
        ({"dt": np.nan}, "dt is nan"),
        ({"duration": 0.0}, "duration is 0.0"),
        ({"dt": 1e-12}, "more than 1e\\+08 steps; take a longer dt"),
        ({"target": lambda time: TARGET}, "returns two things: position"),
        ({"dt": 20.0}, "dt is 20 s, longer than the duration of 10 s"),
        ({"method": "euler"}, "method 'euler' is unknown: use explicit, held, rk4"),
        ({"target": [0, 0, np.inf]}, r"target is \[0.0, 0.0, inf\]; it needs 3 finite numbers"),
        ({"target": [0, 0]}, "it needs 3 finite numbers"),
        ({"arrival_tolerance": 0.0}, "arrival_tolerance is 0.0"),
        ({"q": np.zeros(13)}, "length 0, not 1"),
        ({"smooth_start": -1.0}, "smooth_start is -1.0; it must be zero or a positive number"),
        ({"smooth_start": np.inf}, "smooth_start is inf"),
        ({"smooth_start": np.nan}, "smooth_start is nan"),
    ],
)
def test_bad_input_is_refused(ets_vii, options, says):
    arguments = {"q": ets_vii.configuration(START), "target": TARGET, "duration": 10.0, "dt": 0.1} | options
    with pytest.raises(ssm.InputError, match=says):
        ssm.simulate(SelectiveLaw(ets_vii, Protection("yaw")), **arguments)


# On disk.


@pytest.mark.parametrize("axes", ["none", "yaw", "all", np.eye(6)[:, [2, 4]]])
def test_a_motion_survives_the_round_trip(ets_vii, tmp_path, axes):
    law = SelectiveLaw(ets_vii, Protection(axes))
    motion = ssm.simulate(law, ets_vii.configuration(START), TARGET, 5.0, 0.1)
    path = ssm.save_motion(motion, tmp_path / "motion.nc")
    again = ssm.load_motion(path)
    assert again.identical(motion)
    assert json.loads(again.attrs["law"])["k"] == law.protection.k
    assert again.configuration.attrs["units"] == "m, 1, rad"
    assert [item.name for item in tmp_path.iterdir()] == ["motion.nc"]


def test_what_is_no_motion_is_refused(motion, tmp_path):
    with pytest.raises(ssm.FileError, match="not a file"):
        ssm.load_motion(tmp_path / "no.nc")
    (tmp_path / "text.nc").write_text("hello")
    with pytest.raises(ssm.FileError, match="is not a netCDF file"):
        ssm.load_motion(tmp_path / "text.nc")
    motion[["joint_rates"]].to_netcdf(tmp_path / "part.nc", engine="h5netcdf")
    with pytest.raises(ssm.FileError, match="netCDF but not a motion: it lacks configuration, joint_positions"):
        ssm.load_motion(tmp_path / "part.nc")
    motion.assign(end_effector_error=("joint", np.zeros(6))).to_netcdf(tmp_path / "other.nc", engine="h5netcdf")
    with pytest.raises(ssm.FileError, match="end_effector_error has dimensions"):
        ssm.load_motion(tmp_path / "other.nc")


def test_a_place_that_cannot_be_written_leaves_nothing_behind(motion, tmp_path):
    with pytest.raises(ssm.FileError, match="cannot write"):
        ssm.save_motion(motion, tmp_path / "missing" / "motion.nc")
    (tmp_path / "motion.nc").mkdir()
    with pytest.raises(ssm.FileError, match="cannot write"):
        ssm.save_motion(motion, tmp_path / "motion.nc")
    assert [item.name for item in tmp_path.iterdir()] == ["motion.nc"]


def test_what_ends_a_program_carries_the_motion_too():
    robot = ssm.load_robot("ets_vii")
    law = ssm.SelectiveLaw(robot, ssm.Protection("yaw"))

    def leaves(time):
        if time > 0.45:
            raise SystemExit(3)
        return [-1.8, -0.3, 1.2], [0.0, 0.0, 0.0]

    with pytest.raises(SystemExit) as left:
        ssm.simulate(law, robot.configuration(np.deg2rad([150, -20, -10, 0, 0, 0])), leaves, 1.0, 0.1)
    assert left.value.motion.sizes["time"] == 5
