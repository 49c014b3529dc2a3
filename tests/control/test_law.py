"""The law against the paper's formula, independent solvers, exact arithmetic and a mirrored world."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ET
from fractions import Fraction

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from random_robots import random_robot, random_state

import ssm_decouple as ssm
from ssm_decouple import Protection, SelectiveLaw
from ssm_decouple.control import kernel

EPS = np.finfo(float).eps
PROTECTIONS = ["none", "yaw", "roll+yaw", "all"]


def unlimited(robot: ssm.Robot, protection: Protection, **options) -> SelectiveLaw:
    return SelectiveLaw(robot, protection, rate_limit=np.inf, **options)


def random_protection(rng: np.random.Generator, k: int, frame: str = "base") -> Protection:
    return Protection(np.linalg.qr(rng.normal(size=(3, 3)))[0][:, :k], frame)


@pytest.mark.parametrize("frame", ["base", "inertial"])
@pytest.mark.parametrize("k", [0, 1, 2, 3])
def test_the_paper_s_formula(robot, rng, k, frame):
    """q_dot = (J_gt N_sub)^+ v_cmd, eq. 17, with Moore-Penrose inverses by singular value decomposition."""
    for _ in range(5):
        protection = random_protection(rng, k, frame)
        law = unlimited(robot, protection, gain=0.3, damping=0.0)
        q, target, velocity = random_state(robot, rng), rng.uniform(-2, 2, 3), rng.normal(size=3)
        command, coupling = law(q, target, velocity), robot.coupling(q)
        J, N = coupling.J_gt, protection.N_sub(coupling)
        v_cmd = velocity + 0.3 * (target - robot.frame_pose(q).translation)
        JN = J @ N
        singular = np.linalg.svd(JN, compute_uv=False)
        freedom = min(3, robot.n_joints - min(k, robot.n_joints))
        expected = np.linalg.pinv(JN, rcond=1e-10) @ v_cmd if freedom else np.zeros(robot.n_joints)
        condition = singular[0] / singular[freedom - 1] if freedom else 1.0
        np.testing.assert_allclose(
            command.joint_rates, expected, atol=1e-13 * condition**2 * (1 + np.linalg.norm(expected))
        )
        # The identities that the paper states.
        np.testing.assert_allclose(N, N.T, atol=1e-15)
        np.testing.assert_allclose(N @ N, N, atol=1e-14)
        np.testing.assert_allclose(
            N @ np.linalg.pinv(JN, rcond=1e-10), np.linalg.pinv(JN, rcond=1e-10), atol=1e-12 * condition
        )
        assert command.smallest_singular_value == pytest.approx(singular[2] if freedom == 3 else 0, abs=1e-13)
        # And what follows from the rates.
        np.testing.assert_allclose(command.base_twist, coupling.J_base @ command.joint_rates, rtol=1e-9, atol=1e-13)
        np.testing.assert_array_equal(command.base_angular_velocity_body, command.base_twist[3:])
        np.testing.assert_allclose(command.end_effector_position, robot.frame_pose(q).translation, atol=1e-13)
        np.testing.assert_allclose(command.end_effector_error, target - robot.frame_pose(q).translation, atol=1e-13)
        np.testing.assert_array_equal(command.velocity, [*command.base_twist, *command.joint_rates])
        assert (command.rate_scale, command.damping, command.regularised) == (1.0, 0.0, False)
        assert command.protected_rate.shape == (k,)
        assert command.rank == min(k, robot.n_joints)


@pytest.mark.parametrize("k", [0, 1, 2])
def test_it_is_optimal_by_an_independent_solver(robots, rng, k):
    """The KKT system of min |q_dot|^2 / 2 with J_g q_dot = v and J_sub q_dot = 0, solved whole."""
    for name in ("ets_vii", "ets_vii_flight", "composed"):
        robot, protection = robots[name], random_protection(rng, k)
        law = unlimited(robot, protection, gain=1.0, damping=0.0)
        for _ in range(20):
            q, target = random_state(robot, rng), rng.uniform(-2, 2, 3)
            command, coupling = law(q, target), robot.coupling(q)
            rows = np.vstack([coupling.J_gt, protection.J_sub(coupling)])
            n, m = robot.n_joints, len(rows)
            system = np.block([[np.eye(n), rows.T], [rows, np.zeros((m, m))]])
            right = np.r_[np.zeros(n), target - robot.frame_pose(q).translation, np.zeros(k)]
            solution = np.linalg.solve(system, right)
            error = np.linalg.norm(command.joint_rates - solution[:n]) / np.linalg.norm(solution[:n])
            assert error < 1e-13 * np.linalg.cond(system)
            stationarity = command.joint_rates + rows.T @ solution[n:]
            assert np.linalg.norm(stationarity) < 1e-13 * np.linalg.cond(system) * np.linalg.norm(solution[:n])


@pytest.mark.parametrize("k", [0, 1, 2, 3])
def test_the_regularised_form_minimises_the_paper_s_objective(robots, rng, k):
    """Eq. 11 as a stacked least-squares problem, solved by LAPACK."""
    for name in ("ets_vii", "ets_vii_flight", "random_3"):
        robot, protection = robots[name], random_protection(rng, k)
        law = unlimited(robot, protection, gain=1.0, damping=3e-3, damping_threshold=50.0)  # always on
        for _ in range(20):
            q, target = random_state(robot, rng), rng.uniform(-2, 2, 3)
            command, coupling = law(q, target), robot.coupling(q)
            assert command.regularised
            N = protection.N_sub(coupling)
            stacked = np.vstack([coupling.J_gt @ N, np.sqrt(command.damping) * np.eye(robot.n_joints)])
            right = np.r_[target - robot.frame_pose(q).translation, np.zeros(robot.n_joints)]
            auxiliary = np.linalg.lstsq(stacked, right, rcond=None)[0]
            np.testing.assert_allclose(command.joint_rates, N @ auxiliary, atol=1e-11 * np.linalg.norm(auxiliary))


def test_damping_enters_smoothly_below_the_threshold(ets_vii):
    """Bring the arm to a straight line: sigma falls through the threshold, rho rises from zero smoothly."""
    law = unlimited(ets_vii, Protection("none"), damping=1e-4, damping_threshold=0.05)
    bends = np.linspace(0.4, 1e-9, 4001)
    commands = [law(ets_vii.configuration([0, 0, np.pi / 2 - bend, 0, 0, 0]), [1.0, 1.0, 1.0]) for bend in bends]
    sigma = np.array([command.smallest_singular_value for command in commands])
    rho = np.array([command.damping for command in commands])
    assert sigma[0] > 0.05 > sigma[-1]
    assert np.all((rho > 0) == (sigma < 0.05))
    np.testing.assert_allclose(
        rho, np.where(sigma < 0.05, 1e-4 * (1 - (sigma / 0.05) ** 2) ** 2, 0), rtol=1e-12, atol=0
    )
    slopes = np.diff(rho) / np.diff(sigma)
    assert np.abs(np.diff(slopes)).max() < 0.01 * np.abs(slopes).max()
    rates = np.array([command.joint_rates for command in commands])
    assert np.all(np.isfinite(rates))
    assert np.linalg.norm(np.diff(rates, axis=0), axis=1).max() < 0.01 * np.linalg.norm(rates, axis=1).max()


def exact_residual(J_sub: np.ndarray, rates: np.ndarray, wanted: np.ndarray | None = None) -> float:
    """|J_sub q_dot - b| in rational arithmetic, free of rounding; b is zero if it is not given."""
    sums = [sum(Fraction(float(a)) * Fraction(float(b)) for a, b in zip(row, rates, strict=True)) for row in J_sub]
    if wanted is not None:
        sums = [value - Fraction(float(b)) for value, b in zip(sums, wanted, strict=True)]
    return float(sum(float(value) ** 2 for value in sums) ** 0.5)


def kernel_J_sub(robot: ssm.Robot, protection: Protection, q: np.ndarray) -> np.ndarray:
    """J_sub in the very floating-point numbers that the kernel forms, from the same functions uncompiled."""
    data = robot.model.createData()
    pin.computeCentroidalMap(robot.model, data, q)
    J_base = np.empty((6, robot.n_joints))
    kernel.base_twist_map.py_func(data.Ag, J_base)
    J_sub = np.zeros((protection.k, robot.n_joints))
    for row, direction in zip(J_sub, protection.U_twist.T, strict=True):
        for factor, base_row in zip(direction, J_base, strict=True):
            row += factor * base_row
    return J_sub


@pytest.mark.parametrize("k", [1, 2, 3])
@pytest.mark.parametrize("damping", [0.0, 1e-4])
@pytest.mark.parametrize("limit", [np.deg2rad(5.0), np.inf])
def test_the_protected_rate_is_rounding_in_exact_arithmetic(robots, rng, k, damping, limit):
    worst = 0.0
    for name, robot in robots.items():
        if robot.n_joints <= k:
            continue
        for _ in range(25):
            protection = random_protection(rng, k)
            law = SelectiveLaw(robot, protection, gain=1.0, rate_limit=limit, damping=damping)
            q = random_state(robot, rng)
            command = law(q, rng.uniform(-3, 3, 3))
            J_sub = kernel_J_sub(robot, protection, q)
            size = np.linalg.norm(J_sub, 2) * np.linalg.norm(command.joint_rates)
            residual = exact_residual(J_sub, command.joint_rates)
            assert residual <= 2 * EPS * size, name
            worst = max(worst, residual / (EPS * size)) if size else worst
            assert np.linalg.norm(command.protected_rate) <= 4 * EPS * size
    assert 0 < worst <= 2


@pytest.mark.parametrize("bend", [1e-3, 1e-6, 1e-9, 1e-12, 0.0])
@pytest.mark.parametrize("damping", [0.0, 1e-4])
def test_the_protected_rate_is_rounding_next_to_a_singularity(ets_vii, bend, damping):
    """The straight arm: J_gt N_sub is singular there, which is where a pseudo-inverse of it loses the protection."""
    for axes in ("yaw", "roll+yaw", "all"):
        protection = Protection(axes)
        law = SelectiveLaw(ets_vii, protection, damping=damping)
        q = ets_vii.configuration([0.3, 0.2, np.pi / 2 - bend, bend, -bend, 0.1])
        command = law(q, [0.5, 1.0, -2.0])
        J_sub = kernel_J_sub(ets_vii, protection, q)
        assert np.all(np.isfinite(command.values))
        assert np.abs(command.joint_rates).max() <= np.deg2rad(5.0)
        size = np.linalg.norm(J_sub, 2) * np.linalg.norm(command.joint_rates)
        assert exact_residual(J_sub, command.joint_rates) <= 2 * EPS * size
        assert np.linalg.norm(command.protected_rate) < 1e-18


@given(st.integers(0, 10**6), st.integers(1, 3), st.sampled_from(["base", "inertial"]))
@example(269276, 3, "base")  # J_sub so ill-conditioned that taking out the leak lifts a rate above its limit
@settings(max_examples=150)
def test_any_protection_any_state(seed, k, frame):
    """With J_rc formed by another route, the protected rate is the rounding of J_rc itself."""
    rng = np.random.default_rng(seed)
    robot = ssm.load_robot("ets_vii")
    protection = random_protection(rng, k, frame)
    law = SelectiveLaw(robot, protection)
    q = random_state(robot, rng)
    command = law(q, rng.uniform(-3, 3, 3))
    coupling = robot.coupling(q)
    assert np.abs(command.joint_rates).max() <= np.deg2rad(5.0)
    size = np.linalg.norm(coupling.J_rc, 2) * np.linalg.norm(command.joint_rates)
    assert np.linalg.norm(protection.J_sub(coupling) @ command.joint_rates) <= 8 * EPS * size
    assert np.linalg.norm(command.protected_rate) <= 4 * EPS * size


def test_scaling_keeps_the_direction_and_every_limit(robot, rng):
    limits = rng.uniform(0.01, 0.2, robot.n_joints)
    for _ in range(10):
        protection, q, target = random_protection(rng, 1), random_state(robot, rng), rng.uniform(-3, 3, 3)
        free = unlimited(robot, protection, gain=2.0)(q, target).joint_rates
        command = SelectiveLaw(robot, protection, gain=2.0, rate_limit=limits)(q, target)
        assert np.all(np.abs(command.joint_rates) <= limits)
        np.testing.assert_allclose(command.joint_rates, command.rate_scale * free, rtol=1e-9, atol=1e-15)
        if command.rate_scale < 1:
            assert np.max(np.abs(command.joint_rates) / limits) == pytest.approx(1, rel=1e-12)


def test_limits_from_the_urdf_are_the_default(ets_vii):
    np.testing.assert_array_equal(SelectiveLaw(ets_vii, Protection("yaw")).rate_limits, np.full(6, np.deg2rad(5)))


@pytest.mark.parametrize("axes", PROTECTIONS)
def test_the_kernel_uncompiled_gives_the_same(robot, rng, axes):
    """The same Python, run by the interpreter: equal up to the order in which a compiler may add."""
    for frame in ("base", "inertial"):
        law = SelectiveLaw(robot, Protection(axes, frame), gain=0.4)
        for _ in range(3):
            q, target, velocity = random_state(robot, rng), rng.uniform(-3, 3, 3), rng.normal(size=3)
            compiled = np.empty(law.size)
            law.evaluate(q, target, velocity, compiled)
            plain = np.full(law.size, np.nan)
            model, data, *_, fixed = law._prepared
            pin.computeCentroidalMap(model, data, q)
            status = uncompiled_command(*fixed, target, velocity, np.zeros(robot.n_joints), plain, q)
            assert status == kernel.OK
            np.testing.assert_allclose(plain, compiled, rtol=1e-9, atol=1e-13)


def uncompiled_command(*arguments):
    """Run the kernel with every function that it calls uncompiled too."""
    names = [name for name, value in vars(kernel).items() if hasattr(value, "py_func") and name != "selective_command"]
    assert len(names) > 10
    compiled = {name: getattr(kernel, name) for name in names}
    try:
        for name, function in compiled.items():
            setattr(kernel, name, function.py_func)
        return kernel.selective_command.py_func(*arguments)
    finally:
        for name, function in compiled.items():
            setattr(kernel, name, function)


def test_it_runs_where_no_compiled_code_can_be_kept():
    """As in a read-only installation without a home folder, where Numba refuses to cache.

    The machine code is that of the other tests, taken from where they keep it: compiling it anew takes half a minute.
    """
    code = """
import numba
real = numba.njit
def refusing(*arguments, cache=False, **options):
    if cache:
        raise RuntimeError("cannot cache function: no locator available")
    return real(*arguments, cache=True, **options)
numba.njit = refusing
import ssm_decouple as ssm
robot = ssm.load_robot("ets_vii")
print(ssm.SelectiveLaw(robot, ssm.Protection("yaw"))(robot.configuration(), [1, 0, 2]).rank)
"""
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "1"


def mirrored(urdf: str) -> str:
    """Mirror a URDF at the xz plane: y of positions, x and z of axes, xy and yz of inertias turn sign."""
    root = ET.fromstring(urdf)
    for link in root.findall("link"):
        for kind in ("visual", "collision"):
            for shape in link.findall(kind):
                link.remove(shape)
    for element in root.iter():
        if element.tag == "origin":
            x, y, z = map(float, element.get("xyz", "0 0 0").split())
            roll, pitch, yaw = map(float, element.get("rpy", "0 0 0").split())
            element.set("xyz", f"{x!r} {-y!r} {z!r}")
            element.set("rpy", f"{-roll!r} {pitch!r} {-yaw!r}")
        if element.tag == "axis":
            x, y, z = map(float, element.get("xyz", "1 0 0").split())
            element.set("xyz", f"{-x!r} {y!r} {-z!r}")
        if element.tag == "inertia":
            for key in ("ixy", "iyz"):
                element.set(key, repr(-float(element.get(key, "0"))))
    return ET.tostring(root, encoding="unicode")


@pytest.mark.parametrize("name", ["ets_vii", "ets_vii_flight", "composed"])
def test_a_mirrored_spacecraft_moves_in_the_mirror(robots, rng, name):
    """Directions mirror as (x, -y, z), rotations as (-x, y, -z), and the joint rates stay what they are."""
    robot = robots[name]
    image = ssm.Robot(mirrored(robot.urdf), name="image", end_effector=robot.end_effector)
    line, turn = np.array([1, -1, 1]), np.array([-1, 1, -1])
    for k in (0, 1, 2, 3):
        protection = random_protection(rng, k)
        reflected = Protection(turn[:, None] * protection.U_c)
        joints, target = rng.uniform(-2, 2, robot.n_joints), rng.uniform(-2, 2, 3)
        here = SelectiveLaw(robot, protection)(robot.configuration(joints), target)
        there = SelectiveLaw(image, reflected)(image.configuration(joints), line * target)
        tolerance = 1e-13 / max(here.smallest_singular_value, 1e-3) ** 2
        np.testing.assert_allclose(there.joint_rates, here.joint_rates, atol=tolerance)
        np.testing.assert_allclose(there.base_twist, np.r_[line, turn] * here.base_twist, atol=tolerance)
        assert there.smallest_singular_value == pytest.approx(here.smallest_singular_value, abs=1e-13)


def planar_robot(write) -> ssm.Robot:
    """Three joints about z in the bus's xy plane: they cannot turn it about x or y at all."""
    body = (
        '<inertial><origin xyz="0.5 0 0"/><mass value="5"/>'
        '<inertia ixx=".1" ixy="0" ixz="0" iyy=".4" iyz="0" izz=".4"/></inertial>'
    )
    text = (
        '<robot name="p"><link name="l0"><inertial><mass value="80"/>'
        '<inertia ixx="9" ixy="0" ixz="0" iyy="8" iyz="0" izz="7"/></inertial></link>'
    )
    for i in range(1, 4):
        text += (
            f'<link name="l{i}">{body}</link><joint name="j{i}" type="continuous"><parent link="l{i - 1}"/>'
            f'<child link="l{i}"/><origin xyz="{0.8 if i > 1 else 0.3} 0 0"/><axis xyz="0 0 1"/></joint>'
        )
    return ssm.load_robot(write(text + "</robot>"))


def test_a_direction_that_the_arm_cannot_turn_costs_nothing(write):
    """Protecting what never moves must leave the command as it is, not spend a freedom on rounding noise."""
    robot = planar_robot(write)
    q = robot.configuration([0.3, 0.8, -0.6])
    target = robot.frame_pose(q).translation + [0.1, -0.2, 0.0]
    free = unlimited(robot, Protection("none"))(q, target)
    tilted = unlimited(robot, Protection("roll+pitch"))(q, target)
    np.testing.assert_allclose(tilted.joint_rates, free.joint_rates, rtol=1e-12)
    assert (tilted.rank, free.rank) == (0, 0)
    everything = unlimited(robot, Protection("all"), damping=0.0)(q, target)
    yaw = unlimited(robot, Protection("yaw"), damping=0.0)(q, target)
    assert (everything.rank, yaw.rank) == (1, 1)
    np.testing.assert_allclose(everything.joint_rates, yaw.joint_rates, rtol=1e-9)
    assert np.linalg.norm(yaw.joint_rates) > 0


@pytest.mark.parametrize("joints", [1, 2, 3, 4])
@pytest.mark.parametrize("axes", PROTECTIONS)
def test_fewer_joints_than_rows(rng, joints, axes):
    """An arm too short of joints for its task still gets a finite, protected command; without freedom, none."""
    robot = random_robot(40 + joints, joints=joints, branching=0.0)
    protection = Protection(axes)
    law = SelectiveLaw(robot, protection, rate_limit=0.1)
    q = random_state(robot, rng)
    command = law(q, rng.uniform(-2, 2, 3))
    assert np.all(np.isfinite(command.values))
    if protection.k >= joints:
        np.testing.assert_allclose(command.joint_rates, 0, atol=1e-16)
    J_sub = kernel_J_sub(robot, protection, q)
    assert exact_residual(J_sub, command.joint_rates) <= 2 * EPS * np.linalg.norm(J_sub) * np.linalg.norm(
        command.joint_rates
    )


def test_what_does_not_carry_the_end_effector_moves_only_the_base(rng):
    """A joint on another branch acts through momentum alone."""
    robot = random_robot(5, joints=7, branching=0.5)
    q = random_state(robot, rng)
    coupling = robot.coupling(q)
    frame = robot.model.frames[robot.end_effector_id]
    carrying = {robot.model.joints[j].idx_v - 6 for j in robot.model.supports[frame.parentJoint] if j > 1}
    assert 0 < len(carrying) < robot.n_joints
    command = unlimited(robot, Protection("yaw"), gain=1.0, damping=0.0)(
        q, robot.frame_pose(q).translation + [0.1, 0, 0]
    )
    np.testing.assert_allclose(coupling.J_gt @ command.joint_rates, [0.1, 0, 0], atol=1e-12)


def test_any_array_that_holds_the_numbers_is_taken(ets_vii):
    law = SelectiveLaw(ets_vii, Protection("yaw"))
    q, target = ets_vii.configuration(np.deg2rad([150, -20, -10, 0, 0, 0])), np.array([-1.8, -0.3, 1.2])
    expected = law(q, target).values
    frozen = target.copy()
    frozen.flags.writeable = False
    strided = np.repeat(target, 2)[::2]
    for other in ([-1.8, -0.3, 1.2], (-1.8, -0.3, 1.2), frozen, strided):
        np.testing.assert_array_equal(law(q, other).values, expected)
    np.testing.assert_array_equal(law(list(q), target).values, expected)
    np.testing.assert_allclose(law(q.astype(np.float32), target).values, expected, atol=1e-5)
    np.testing.assert_array_equal(law(np.repeat(q, 2)[::2], target).values, expected)
    np.testing.assert_array_equal(law(q, target, [0, 0, 0]).values, expected)


def test_a_command_keeps_its_numbers(ets_vii):
    law = SelectiveLaw(ets_vii, Protection("yaw"))
    q = ets_vii.configuration(np.deg2rad([150, -20, -10, 0, 0, 0]))
    first = law(q, [-1.8, -0.3, 1.2])
    before = first.values.copy()
    law(ets_vii.configuration(), [0, 0, 3])
    np.testing.assert_array_equal(first.values, before)
    assert "joint_rates=[-0.0430415" in repr(first)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"gain": 0.0}, "gain is 0.0; it must be a positive"),
        ({"gain": np.nan}, "gain is nan; it must be a positive number"),
        ({"gain": np.inf}, "gain is inf"),
        ({"gain": "a"}, "gain is 'a'; it needs real numbers"),
        ({"rate_limit": "x"}, "rate_limit is 'x'; it needs real numbers"),
        ({"rate_limit": 0.0}, "rate_limit is 0.0; every joint's must be above zero"),
        ({"rate_limit": [1, 1, 1, 1, 1, -1]}, "must be above zero"),
        ({"rate_limit": [1, 1]}, r"rate_limit has shape \(2,\); give one number or one for each of 6"),
        ({"rate_limit": np.nan}, "rate_limit is nan"),
        ({"damping": -1.0}, "damping is -1.0"),
        ({"damping_threshold": 0.0}, "damping_threshold is 0.0"),
    ],
)
def test_bad_settings_are_refused(ets_vii, options, says):
    with pytest.raises(ssm.InputError, match=says):
        SelectiveLaw(ets_vii, Protection("yaw"), **options)


def test_bad_arguments_are_refused(ets_vii):
    law, q = SelectiveLaw(ets_vii, Protection("yaw")), ets_vii.configuration()
    broken = q.copy()
    broken[9] = np.nan
    with pytest.raises(ssm.InputError, match=r"configuration is not finite at q\[9\]"):
        law(broken, [0, 0, 1])
    with pytest.raises(ssm.InputError, match=r"configuration has shape \(3,\)"):
        law(q[:3], [0, 0, 1])
    with pytest.raises(ssm.InputError, match=r"target is not finite: \[0.0, inf, 1.0\]"):
        law(q, [0, np.inf, 1])
    with pytest.raises(ssm.InputError, match="target_velocity is not finite"):
        law(q, [0, 0, 1], [np.nan, 0, 0])
    for short in ([0, 0], np.zeros(2)):
        with pytest.raises(ssm.InputError, match=r"target has shape \(2,\)"):
            law(q, short)
    with pytest.raises(ssm.InputError, match=r"target_velocity has shape \(4,\)"):
        law(q, np.zeros(3), np.zeros(4))
    stretched = q.copy()
    stretched[3:7] = [0.9, 0, 0, 1.2]
    with pytest.raises(ssm.InputError, match=r"quaternion q\[3:7\] has length 1.5"):
        law(stretched, [0, 0, 1])
    with pytest.raises(ssm.InputError, match=r"out must be a writable, contiguous float64 array \(34,\)"):
        law.evaluate(q, np.zeros(3), np.zeros(3), np.zeros((30, 2))[:, 0])
    with pytest.raises(ssm.InputError, match="out must be"):
        law.evaluate(q, np.zeros(3), np.zeros(3), np.zeros(30, dtype=np.float32))
    with pytest.raises(ssm.InputError, match="out must be"):
        law.evaluate(q, np.zeros(3), np.zeros(3), np.zeros(26))


def test_a_continuous_joint_needs_a_cosine_and_a_sine(write):
    robot = planar_robot(write)
    q = robot.configuration([0.3, 0.8, -0.6])
    q[7:9] = [2.0, 0.0]
    for use in (robot.coupling, lambda q: SelectiveLaw(robot, Protection("yaw"))(q, [1, 0, 0])):
        with pytest.raises(
            ssm.InputError, match=r"continuous joint 'j1' takes cosine and sine, q\[7:9\] is \[2.0, 0.0\]"
        ):
            use(q)


@pytest.mark.parametrize("distance", [0.0, 1e2, 1e4])
def test_what_cannot_turn_costs_nothing_far_from_the_origin_either(write, rng, distance):
    robot = planar_robot(write)
    for _ in range(20):
        attitude = pin.Quaternion(*(rng.normal(size=4))).normalized().matrix()
        pose = pin.SE3(attitude, distance * rng.uniform(-1, 1, 3))
        q = robot.configuration(rng.uniform(-1, 1, 3), pose)
        assert unlimited(robot, Protection("roll"))(q, pose.translation).rank == 0
        assert unlimited(robot, Protection("all"))(q, pose.translation).rank == 1
        coupling = robot.coupling(q)
        assert Protection("roll").null_space_basis(coupling).shape == (3, 3)
        assert Protection("all").null_space_basis(coupling).shape == (3, 2)


def test_the_rate_limit_comes_before_the_acceleration_limit(ets_vii):
    for axes in ("none", "yaw"):
        law = SelectiveLaw(ets_vii, Protection(axes), rate_limit=0.08, sample_time=0.1, acceleration_limit=0.1)
        command = law(ets_vii.configuration(), [1, 0, 2], previous_rates=[0.5] * 6)
        assert np.abs(command.joint_rates).max() <= 0.08
        assert command.rate_blend == 0


def test_a_robot_without_joints_has_no_law():
    with pytest.raises(ssm.InputError, match="'ets_vii_bus' has no joints to command"):
        SelectiveLaw(ssm.load_robot("ets_vii_bus"), Protection("yaw"))
