"""Wheels against the robot without them, MuJoCo and the momentum of a spinning disk."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from mujoco_robots import mass_matrix as mujoco_mass_matrix
from mujoco_robots import mujoco_model
from random_robots import random_state

import ssm_decouple as ssm

START = np.deg2rad([150, -20, -10, 0, 0, 0])
TARGET = [-1.8, -0.3, 1.2]


def wheel(name="wheel_x", axis=(1, 0, 0), **changes) -> ssm.Wheel:
    return ssm.Wheel(
        **({"name": name, "axis": axis, "spin_inertia": 0.1, "max_speed": 600.0, "max_torque": 0.2} | changes)
    )


def three(**changes) -> list[ssm.Wheel]:
    return [wheel(f"wheel_{name}", axis, **changes) for name, axis in zip("xyz", np.eye(3), strict=True)]


def random_wheels(rng: np.random.Generator, count: int) -> list[ssm.Wheel]:
    axes = np.vstack([np.linalg.qr(rng.normal(size=(3, 3)))[0], [1, 2, 3]])
    return [
        # Names that sort before, between and after those of the joints.
        wheel(
            f"{'ajz'[i % 3]}_{i}",
            axes[i],
            spin_inertia=rng.uniform(0.001, 0.01),
            mass=rng.uniform(0.01, 0.1),  # small: the random buses are flat, and stay possible without them
            position=rng.uniform(-0.1, 0.1, 3),
        )
        for i in range(count)
    ]


def mass_matrix(robot: ssm.Robot, q: np.ndarray) -> np.ndarray:
    upper = np.triu(pin.crba(robot.model, robot.model.createData(), q))
    return upper + np.triu(upper, 1).T


def with_turned(robot: ssm.Robot, whole: ssm.Robot, q: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    angles = dict(zip(robot.joint_names, robot.joint_positions(q), strict=True))
    angles |= {name: rng.uniform(-3, 3) for name in whole.wheel_names}
    return whole.configuration(angles, robot.base_pose(q))


def test_the_whole_is_what_it_was_and_wheels_only_spin(robot, rng):
    q, wheels = random_state(robot, rng), random_wheels(rng, 4)
    whole = robot.with_wheels(wheels)
    assert set(whole.wheel_names) == {w.name for w in wheels}
    assert tuple(name for name in whole.joint_names if name in whole.wheel_names) == whole.wheel_names
    assert whole.mass == pytest.approx(robot.mass)
    M, before = mass_matrix(whole, with_turned(robot, whole, q, rng)), mass_matrix(robot, q)
    kept = [*range(6), *(6 + whole.joint_index(name) for name in robot.joint_names)]
    np.testing.assert_allclose(M[np.ix_(kept, kept)], before, atol=1e-12 * np.abs(before).max())
    for w in wheels:
        expected = np.zeros(len(M))
        expected[3:6], place = w.spin_inertia * np.array(w.axis), 6 + whole.joint_index(w.name)
        expected[place] = w.spin_inertia
        np.testing.assert_allclose(M[place], expected, atol=1e-13)


@pytest.mark.parametrize("name", ["ets_vii", "random_3"])
def test_mujoco_has_the_same_matrix(robots, rng, name):
    robot = robots[name]
    whole = robot.with_wheels(random_wheels(rng, 3))
    model = mujoco_model(whole)
    data = mujoco.MjData(model)
    places = [model.joint(joint).qposadr[0] for joint in whole.joint_names]
    rows = [*range(6), *(model.joint(joint).dofadr[0] for joint in whole.joint_names)]
    for _ in range(3):
        joints = rng.uniform(-3, 3, whole.n_joints)
        data.qpos[places] = joints
        mujoco.mj_forward(model, data)
        M = mass_matrix(whole, whole.configuration(joints))
        oracle = mujoco_mass_matrix(model, data)[np.ix_(rows, rows)]
        np.testing.assert_allclose(M, oracle, rtol=1e-9, atol=1e-10 * np.abs(M).max())


@pytest.mark.parametrize("protection", [ssm.Protection("yaw"), ssm.Protection([0.6, 0, 0.8]), ssm.Protection("all")])
def test_the_law_shares_out_the_momentum_by_the_smallest_rates(ets_vii, rng, protection):
    """Large wheels: the motion is the one of [J_sub; J_gt] without rate limits, and the wheels keep the axes still."""
    whole = ets_vii.with_wheels(three(spin_inertia=200.0, max_speed=np.pi))
    law = ssm.SelectiveLaw(whole, protection, gain=0.02, joint_weights=1.0)
    q = with_turned(ets_vii, whole, ets_vii.configuration(START), rng)
    command, coupling = law(q, TARGET), whole.coupling(q)
    assert command.rate_scale == 1
    rows = np.vstack([protection.J_sub(coupling), coupling.J_gt])
    asked = np.r_[np.zeros(protection.k), 0.02 * command.end_effector_error]
    np.testing.assert_allclose(command.joint_rates, np.linalg.pinv(rows) @ asked, rtol=1e-9, atol=1e-15)
    assert np.abs(command.protected_rate).max() < 1e-17
    assert np.abs(whole.momentum(q, command.velocity)).max() < 1e-12
    spins = [whole.joint_index(name) for name in whole.wheel_names]
    assert np.abs(command.joint_rates[spins]).max() > 1e-4
    if protection.k == 3:  # a base that does not turn: the wheels hold what the arm carries about the mass centre
        arm = [i for i in range(whole.n_joints) if i not in spins]
        carried = coupling.H_wq[:, arm] @ command.joint_rates[arm]
        np.testing.assert_allclose(200.0 * command.joint_rates[spins], -carried, rtol=1e-9, atol=1e-13)


@pytest.mark.filterwarnings("ignore:wheels need more torque")
def test_wheels_let_reactionless_control_arrive(ets_vii):
    """In case 1 it stalls without. All joints weigh the same here: rad/s of a wheel counts as rad/s of the arm."""
    whole = ets_vii.with_wheels(three(spin_inertia=100.0, max_speed=0.6))
    q = whole.configuration(dict(zip(ets_vii.joint_names, START, strict=True)))
    law = ssm.SelectiveLaw(whole, ssm.Protection("all"), gain=0.05, joint_weights=1.0)
    motion = ssm.simulate(law, q, TARGET, duration=150.0, dt=0.1)
    assert motion.attrs["outcome"] == "converged"
    assert float(abs(motion.base_rpy).max()) < 1e-14
    assert float(abs(motion.protected_rate).max()) < 1e-17
    spins = motion.joint_rates.sel(joint=list(whole.wheel_names)).values
    np.testing.assert_allclose(100.0 * np.abs(spins).max(axis=0), [4.32, 1.17, 2.78], atol=0.01)  # N m s
    np.testing.assert_allclose(motion.angular_momentum.values, 0, atol=1e-11)
    small = ets_vii.with_wheels(three())
    law = ssm.SelectiveLaw(small, ssm.Protection("all"), gain=0.05, joint_weights=1.0)
    motion = ssm.simulate(law, q, TARGET, duration=150.0, dt=0.1)
    assert motion.attrs["outcome"] != "converged"  # the smallest joint rates hardly use wheels that have to spin fast


def test_a_larger_and_slower_wheel_is_a_weight(ets_vii, rng):
    """The same rates as the smallest weighted ones of small wheels, to the scale."""
    small, large = (ets_vii.with_wheels(three(spin_inertia=J, max_speed=60 / J)) for J in (0.1, 100.0))
    scale = np.where([name in small.wheel_names for name in small.joint_names], 1000.0, 1.0)
    for _ in range(5):
        q = random_state(small, rng)
        target = small.frame_pose(q).translation + rng.uniform(-1e-3, 1e-3, 3)
        law, coupling = ssm.SelectiveLaw(large, ssm.Protection("roll+yaw"), joint_weights=1.0), small.coupling(q)
        command = law(q, target)
        rows = np.vstack([coupling.J_rc[[0, 2]], coupling.J_gt]) * scale
        rates = scale * (np.linalg.pinv(rows) @ np.r_[0, 0, 0.05 * command.end_effector_error])
        np.testing.assert_allclose(scale * command.joint_rates, rates, rtol=1e-7, atol=1e-9 * np.abs(rates).max())


@pytest.mark.parametrize("mass", [0.0, 5.0])
def test_torques_spin_them_and_momentum_stays(ets_vii, mass):
    whole = ets_vii.with_wheels(three(spin_inertia=100.0, max_speed=0.6, max_torque=50.0, mass=mass))
    q = whole.configuration(dict(zip(ets_vii.joint_names, START, strict=True)))
    law = ssm.SelectiveLaw(whole, ssm.Protection("all"), gain=0.05)
    motion = ssm.simulate(law, q, TARGET, duration=4.0, dt=0.1, method=ssm.Dynamic(step=0.005), smooth_start=2.0)
    assert motion.attrs["momentum_drift"] < 1e-12
    assert motion.attrs["energy_error"] < 1e-12
    without = ssm.simulate(
        ssm.SelectiveLaw(ets_vii, ssm.Protection("none"), gain=0.05),
        ets_vii.configuration(START),
        TARGET,
        duration=4.0,
        dt=0.1,
        method=ssm.Dynamic(step=0.005),
        smooth_start=2.0,
    )
    turned = [float(abs(each.base_rpy).max()) for each in (motion, without)]
    assert turned[0] < 1e-2 * turned[1]


def test_limits_are_each_wheel_s_own(ets_vii):
    whole = ets_vii.with_wheels([wheel(max_speed=123.0, max_torque=0.4)])
    assert whole.rate_limits[whole.joint_index("wheel_x")] == 123
    assert whole.model.effortLimit[6 + whole.joint_index("wheel_x")] == 0.4
    assert whole.rate_limits[whole.joint_index("joint_1")] == ets_vii.rate_limits[0]
    assert np.all(np.isinf(whole.position_limits[whole.joint_index("wheel_x")]))


def test_everything_else_still_knows_them(ets_vii, tmp_path):
    whole = ssm.load_robot("ets_vii_flexible").with_wheels(three(mass=5.0))
    names = ("wheel_x", "wheel_y", "wheel_z")
    assert whole.with_payload(10.0, [0, 0, 0], np.eye(3)).wheel_names == names
    assert ssm.perturbed(whole, ssm.Tolerances(mass=0.01, inertia=0.01), 1).wheel_names == names
    assert ssm.Plant.of(whole).robot.wheel_names == names
    assert ssm.compose(whole, ets_vii, [0, 0, 1], prefix="second_").wheel_names == names
    (tmp_path / "saved.urdf").write_text(whole.urdf, encoding="utf-8")
    assert ssm.load_robot(tmp_path / "saved.urdf").wheel_names == names
    report = ssm.Report.of_file(tmp_path / "saved.urdf")
    assert (report.usable, report.tips) == (True, ets_vii.report().tips)
    assert {joint.name: joint.type for joint in report.joints}["wheel_x"] == "continuous"
    assert ets_vii.wheel_names == ()
    unsuspicious = [finding.level for finding in ets_vii.with_wheels(three()).report().findings]
    assert "suspicious" not in unsuspicious  # a rotor may leave its mass in the root link


def test_more_wheels_beside_the_ones_it_has(ets_vii):
    one = ets_vii.with_wheels([wheel()])
    assert one.with_wheels([wheel("other", [1, 1, 0])]).wheel_names == ("other", "wheel_x")
    with pytest.raises(ssm.InputError, match=r"robot 'ets_vii \+ wheels': wheels 'wheel_x' and 'other' turn about the"):
        one.with_wheels([wheel("other", [-1, 0.001, 0])])


def test_parallel_wheels_are_refused(ets_vii):
    skew = [np.cos(np.deg2rad(0.5)), np.sin(np.deg2rad(0.5)), 0]
    with pytest.raises(ssm.InputError, match=r"wheels 'b' and 'c' turn about the same axis \(0.5 deg apart\)"):
        ets_vii.with_wheels([wheel("a", [0, 0, 1]), wheel("b"), wheel("c", skew)])
    assert len(ets_vii.with_wheels([wheel("b"), wheel("c", [1, 0.02, 0])]).wheel_names) == 2


def test_what_does_not_fit_the_root_link(ets_vii):
    for wheels, message in (
        ([wheel(mass=2550.0)], "the wheels wheel_x weigh 2550 kg of the 2550 kg of the root link"),
        ([wheel(axis=[0, 1, 0], spin_inertia=4000.0)], "keeps the principal moments -460"),
        ([wheel("joint_1")], "the robot has a joint 'joint_1' already"),
    ):
        with pytest.raises(ssm.ModelError, match=message):
            ets_vii.with_wheels(wheels)
    with pytest.warns(ssm.DecoupleWarning, match="triangle inequality"):
        ets_vii.with_wheels([wheel(axis=[0, 1, 0], spin_inertia=2700.0)])


def test_bad_wheels(ets_vii):
    for key, value, message in (
        ("name", " ", "a text that is not empty"),
        ("spin_inertia", 0.0, "spin_inertia is 0.0; it must be above zero and finite, in kg m2"),
        ("spin_inertia", np.nan, "above zero"),
        ("max_speed", -1.0, "in rad/s"),
        ("max_torque", np.inf, "finite, in N m"),
        ("max_torque", "strong", "real numbers"),
        ("mass", -1e-3, "zero or more"),
        ("axis", [0, 0, 0], "needs a direction"),
        ("axis", [0, 1], "3 finite numbers"),
        ("position", [0, np.nan, 0], "3 finite numbers"),
    ):
        with pytest.raises(ssm.InputError, match=message):
            wheel(**{key: value})
    for wheels, message in (
        ([], "no wheel is given"),
        (["wheel_x"], "'wheel_x' is no wheel"),
        ([wheel(), wheel(axis=[0, 1, 0])], "two wheels are called 'wheel_x'"),
    ):
        with pytest.raises(ssm.InputError, match=message):
            ets_vii.with_wheels(wheels)
    assert ets_vii.with_wheels(wheel()).wheel_names == ("wheel_x",)


def test_a_rotor_is_a_body():
    rotor = wheel(axis=[0, 3, 4], mass=2.0, position=[0.1, 0, 0]).body
    np.testing.assert_allclose(np.linalg.eigvalsh(rotor.inertia), [0.05, 0.05, 0.1])
    np.testing.assert_allclose(rotor.inertia @ [0, 0.6, 0.8], [0, 0.06, 0.08], atol=1e-17)
    root = ET.fromstring(ssm.load_robot("ets_vii").with_wheels(three(mass=1.0)).urdf)
    assert len(root.findall("joint/wheel")) == 3
