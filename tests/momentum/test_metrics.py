"""Metrics against a planar arm worked out by hand, invariance, the law's own number and routes without an SVD."""

from __future__ import annotations

import dataclasses

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_robots import random_state
from scipy.optimize import brentq

import ssm_decouple as ssm

PROTECTIONS = {
    "none": ssm.Protection("none"),
    "oblique": ssm.Protection([0.6, 0.0, 0.8]),
    "roll+yaw": ssm.Protection("roll+yaw"),
    "inertial": ssm.Protection([0.0, 0.8, 0.6], frame="inertial"),
    "all": ssm.Protection("all"),
    "modes": ssm.Protection.from_modes([2.0, 0.0, 1.0, 0.3, -5.0, 1.0]),
}


@dataclasses.dataclass(frozen=True)
class Planar:
    """Two uniform rods on a disk, all turning about z, with its momentum worked out in absolute angles."""

    m: tuple[float, float, float]
    base_inertia: float
    b: float
    l1: float
    l2: float

    def robot(self) -> ssm.Robot:
        def link(name, mass, izz, x):
            tensor = f'ixx="{izz!r}" ixy="0" ixz="0" iyy="{izz!r}" iyz="0" izz="{izz!r}"'
            return (
                f'<link name="{name}"><inertial><origin xyz="{x!r} 0 0"/><mass value="{mass!r}"/>'
                f"<inertia {tensor}/></inertial></link>"
            )

        def joint(name, parent, child, x, kind="continuous"):
            return (
                f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
                f'<origin xyz="{x!r} 0 0"/><axis xyz="0 0 1"/></joint>'
            )

        one, two = (m * length**2 / 12 for m, length in zip(self.m[1:], (self.l1, self.l2), strict=True))
        links = link("bus", self.m[0], self.base_inertia, 0.0)
        links += link("one", self.m[1], one, self.l1 / 2) + link("two", self.m[2], two, self.l2 / 2)
        joints = joint("q1", "bus", "one", self.b) + joint("q2", "one", "two", self.l1)
        tool = '<link name="end_effector"/>' + joint("tool", "two", "end_effector", self.l2, "fixed")
        return ssm.Robot(f'<robot name="planar">{links}{joints}{tool}</robot>', name="planar")

    def matrices(self, q1: float, q2: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Return J_rc about z (2,), J_g in the plane (2, 2) and det J_g after Papadopoulos and Dubowsky."""
        m, M, angles = np.array(self.m), sum(self.m), np.array([0.0, q1, q1 + q2])
        # Bodies' places from the centre of mass, as multiples of the unit vectors along base, rod 1 and rod 2.
        bodies = np.array([[0, 0, 0], [self.b, self.l1 / 2, 0], [self.b, self.l1, self.l2 / 2]])
        centre = m @ bodies / M
        A, B = bodies - centre, np.array([self.b, self.l1, self.l2]) - centre
        own = [self.base_inertia, m[1] * self.l1**2 / 12, m[2] * self.l2**2 / 12]
        D = (np.cos(angles[:, None] - angles) * (A.T @ (m[:, None] * A)) + np.diag(own)).sum(axis=0)
        J_rc = -np.array([D[1] + D[2], D[2]]) / D.sum()
        spins = np.array([J_rc, J_rc + [1, 0], J_rc + [1, 1]])
        J_g = (B * np.array([-np.sin(angles), np.cos(angles)])) @ spins
        determinant = (
            B[0] * B[1] * D[2] * np.sin(q1) - B[0] * B[2] * D[1] * np.sin(q1 + q2) + B[1] * B[2] * D[0] * np.sin(q2)
        ) / D.sum()
        return J_rc, J_g, determinant


SIZES = st.floats(0.2, 3.0)
ANGLES = st.floats(-3.0, 3.0)
SMALL_BASE = Planar((10.0, 5.0, 5.0), 2.0, 0.5, 1.0, 1.0)


@settings(max_examples=25)
@given(st.tuples(SIZES, SIZES, SIZES), SIZES, SIZES, SIZES, SIZES, ANGLES, ANGLES)
def test_a_planar_arm_worked_out_by_hand(masses, inertia, b, l1, l2, q1, q2):
    planar = Planar(masses, inertia, b, l1, l2)
    robot = planar.robot()
    coupling = robot.coupling(robot.configuration([q1, q2]))
    J_rc, J_g, determinant = planar.matrices(q1, q2)
    scale = l1 * l2
    speeds, turning = coupling.manipulability(), coupling.directional_coupling()
    np.testing.assert_allclose(coupling.J_gt, np.vstack([J_g, [0, 0]]), atol=1e-12 * (b + l1 + l2))
    assert speeds.semi_axes[0] * speeds.semi_axes[1] == pytest.approx(abs(determinant), abs=1e-12 * scale)
    assert speeds.semi_axes[2] == pytest.approx(0, abs=1e-14)
    assert (speeds.condition, speeds.volume) == (np.inf, pytest.approx(0, abs=1e-13))
    np.testing.assert_allclose(turning.semi_axes, [np.linalg.norm(J_rc), 0, 0], atol=1e-13)
    np.testing.assert_allclose(np.abs(turning.directions[:, 0]), [0, 0, 1], atol=1e-13)
    assert turning.rank == 1
    assert turning.entropy == pytest.approx(0, abs=1e-12)
    # One protected axis takes one of two freedoms: the reaction null space is the line across J_rc.
    line = J_g @ np.array([-J_rc[1], J_rc[0]]) / np.linalg.norm(J_rc)
    reactionless = coupling.manipulability(ssm.Protection("yaw"))
    np.testing.assert_allclose(reactionless.semi_axes, [np.linalg.norm(line), 0, 0], atol=1e-12)
    if abs(determinant) > 1e-2 * scale:
        factor = np.linalg.norm(J_rc @ np.linalg.inv(J_g))
        assert coupling.coupling_factor() == pytest.approx(factor, rel=1e-9)


def test_a_dynamic_singularity_is_where_the_closed_form_has_its_zero():
    """At q1 = 1 the arm is bent, and singular only because its base floats."""
    q1 = 1.0
    q2 = brentq(lambda angle: SMALL_BASE.matrices(q1, angle)[2], 0.05, 0.8, xtol=1e-15)
    robot = SMALL_BASE.robot()
    there, aside = (robot.coupling(robot.configuration([q1, angle])) for angle in (q2, q2 + 0.5))
    assert abs(np.sin(q2)) > 0.1
    assert there.dynamic_singularity_margin() < 1e-13
    J_arm = np.array([[-np.sin(q1) - np.sin(q1 + q2 + 0.5), -np.sin(q1 + q2 + 0.5)]])
    J_arm = np.vstack([J_arm, [np.cos(q1) + np.cos(q1 + q2 + 0.5), np.cos(q1 + q2 + 0.5)]])
    free = np.linalg.svd(SMALL_BASE.matrices(q1, q2 + 0.5)[1])[1][-1]
    assert aside.dynamic_singularity_margin() == pytest.approx(free / np.linalg.svd(J_arm)[1][-1], rel=1e-12)
    assert aside.dynamic_singularity_margin(ssm.Protection("all")) == pytest.approx(0, abs=1e-13)


def test_a_very_heavy_base_costs_nothing():
    heavy = dataclasses.replace(SMALL_BASE, m=(1e9, 5.0, 5.0), base_inertia=1e9)
    robot = heavy.robot()
    coupling = robot.coupling(robot.configuration([0.4, 0.9]))
    assert coupling.dynamic_singularity_margin() == pytest.approx(1, abs=1e-7)
    assert coupling.coupling_factor() < 1e-7
    straight = robot.coupling(robot.configuration([0.4, 0.0]))  # the arm alone loses a direction: the other is left
    assert straight.dynamic_singularity_margin() == pytest.approx(1, abs=1e-7)


def test_an_arm_that_moves_nothing_has_no_margin(write):
    text = SMALL_BASE.robot().urdf
    robot = ssm.Robot(text, name="planar", end_effector="bus")
    assert np.isnan(robot.coupling(robot.configuration()).dynamic_singularity_margin())


def test_the_arm_s_jacobian_is_that_of_a_held_base(robot, rng):
    q, h = random_state(robot, rng), 1e-5
    rates = rng.normal(size=robot.n_joints)
    coupling, held = robot.coupling(q), np.r_[np.zeros(6), rates]
    ahead, behind = (robot.frame_pose(pin.integrate(robot.model, q, sign * h * held)) for sign in (1, -1))
    turned = pin.log3(ahead.rotation @ behind.rotation.T)
    moved = np.r_[ahead.translation - behind.translation, turned] / (2 * h)
    np.testing.assert_allclose(coupling.J_arm @ rates, moved, atol=1e-8)
    np.testing.assert_array_equal(coupling.base_position, q[:3])


@pytest.mark.parametrize("protection", PROTECTIONS.values(), ids=PROTECTIONS)
def test_the_ellipsoid_is_the_map(robot, rng, protection):
    coupling = robot.coupling(random_state(robot, rng))
    J = np.vstack([coupling.J_g[:3], 0.7 * coupling.J_g[3:]])
    N = protection.N_sub(coupling)
    found = [
        (coupling.manipulability(protection), coupling.J_gt @ N),
        (coupling.manipulability(protection, characteristic_length=0.7), J @ N),
        (coupling.directional_coupling(), coupling.J_rc),
    ]
    for ellipsoid, matrix in found:
        size = max(np.linalg.norm(matrix), 1e-9)
        rates, directions = ellipsoid.joint_rates, ellipsoid.directions
        np.testing.assert_allclose(matrix @ rates, directions * ellipsoid.semi_axes, atol=1e-13 * size)
        np.testing.assert_allclose(directions.T @ directions, np.eye(len(matrix)), atol=1e-13)
        assert np.sum(ellipsoid.semi_axes**2) == pytest.approx(np.sum(matrix**2), rel=1e-12, abs=1e-24)
        assert np.all(np.diff(ellipsoid.semi_axes) <= 0)
        scaled = matrix / size
        # A Gram determinant keeps half the digits.
        volume = np.sqrt(max(np.linalg.det(scaled @ scaled.T), 0.0))
        assert ellipsoid.volume / size ** len(matrix) == pytest.approx(volume, abs=1e-7)
        if ellipsoid.rank == len(matrix):
            assert ellipsoid.condition == pytest.approx(np.linalg.svd(matrix)[1][0] / ellipsoid.smallest)
        else:
            assert ellipsoid.condition == np.inf
        assert 0 <= ellipsoid.entropy <= 1 + 1e-12
        with pytest.raises(ValueError, match="read-only"):
            ellipsoid.semi_axes[0] = 1.0


@pytest.mark.parametrize("protection", PROTECTIONS.values(), ids=PROTECTIONS)
def test_the_smallest_is_the_law_s(ets_vii, rng, protection):
    law = ssm.SelectiveLaw(ets_vii, protection)
    for _ in range(5):
        q = random_state(ets_vii, rng)
        found = ets_vii.coupling(q).manipulability(protection)
        assert found.smallest == pytest.approx(law(q, [0, 0, 3]).smallest_singular_value, rel=1e-9, abs=1e-14)


def test_no_frame_and_no_base_pose_matters(robot, rng):
    joints, rates = rng.uniform(-2, 2, robot.n_joints), rng.normal(size=robot.n_joints)
    pose = pin.SE3(pin.rpy.rpyToMatrix(*rng.uniform(-3, 3, 3)), rng.uniform(-5, 5, 3))
    here, there = robot.coupling(robot.configuration(joints)), robot.coupling(robot.configuration(joints, pose))
    for protection in (PROTECTIONS[name] for name in ("none", "oblique", "roll+yaw", "all", "modes")):
        for other in (there, there.inertial(), here.inertial()):
            for length in (None, 2.0):
                one, two = here.manipulability(protection, length), other.manipulability(protection, length)
                np.testing.assert_allclose(one.semi_axes, two.semi_axes, rtol=1e-9, atol=1e-12)
            assert other.coupling_factor(protection) == pytest.approx(here.coupling_factor(protection), rel=1e-6)
            margins = [c.dynamic_singularity_margin(protection) for c in (here, other)]
            assert margins[0] == pytest.approx(margins[1], rel=1e-6, abs=1e-9)
            shares = [c.protected_share(protection, rates) for c in (here, other)]
            assert shares[0] == pytest.approx(shares[1], abs=1e-12)
    base, turned = there.directional_coupling(), there.inertial().directional_coupling()
    np.testing.assert_allclose(base.semi_axes, turned.semi_axes, rtol=1e-12, atol=1e-15)
    spread = [ellipsoid.directions * ellipsoid.semi_axes for ellipsoid in (base, turned)]
    expected = pose.rotation @ spread[0] @ spread[0].T @ pose.rotation.T
    np.testing.assert_allclose(spread[1] @ spread[1].T, expected, atol=1e-14 * base.largest**2)


def test_the_factor_is_the_worst_velocity(robot, rng):
    coupling = robot.coupling(random_state(robot, rng))
    for name in ("none", "oblique"):
        N = PROTECTIONS[name].N_sub(coupling)
        J, factor = coupling.J_gt @ N, coupling.coupling_factor(PROTECTIONS[name])
        worst = 0.0
        for velocity in rng.normal(size=(300, 3)):
            rates = np.linalg.lstsq(J, velocity, rcond=1e-12)[0]
            speed = np.linalg.norm(J @ rates)
            if speed > 1e-9:
                worst = max(worst, np.linalg.norm(coupling.J_rc @ rates) / speed)
        assert worst <= factor * (1 + 1e-9)
        assert worst >= 0.7 * factor
    assert coupling.coupling_factor(PROTECTIONS["all"]) == 0


def locked_inertia(robot: ssm.Robot, q: np.ndarray) -> np.ndarray:
    upper = np.triu(pin.crba(robot.model, robot.model.createData(), q))
    return (upper + np.triu(upper, 1).T)[:6, :6]


@pytest.mark.parametrize("protection", PROTECTIONS.values(), ids=PROTECTIONS)
def test_the_share_is_one_of_energies(robot, rng, protection):
    """In coordinates whose square is the energy, the protected part is what the rows of the protection see."""
    q = random_state(robot, rng)
    coupling, rates = robot.coupling(q), rng.normal(size=robot.n_joints)
    U = protection.U_c_in(coupling)
    inertia, motion = coupling.H_ww, coupling.J_rc @ rates
    if len(U) == 6:
        inertia, motion = locked_inertia(robot, q), coupling.J_base @ rates
    root = np.linalg.cholesky(inertia)
    seen = np.linalg.solve(root, U).T
    y = root.T @ motion
    expected = np.linalg.norm(np.linalg.pinv(seen) @ (seen @ y)) ** 2 / (y @ y) if protection.k else 0.0
    share = coupling.protected_share(protection, rates)
    assert share == pytest.approx(expected, abs=1e-10)
    assert 0 <= share <= 1
    assert coupling.protected_share(protection, -1e4 * rates) == pytest.approx(share, abs=1e-12)
    still = protection.N_sub(coupling) @ rates
    if 0 < protection.k < 3 and np.linalg.norm(coupling.base_twist(still)) > 1e-9:
        assert coupling.protected_share(protection, still) < 1e-20
    if len(U) == 3 and protection.k == 3:
        assert share == pytest.approx(1, abs=1e-12)


def test_all_of_it_is_protected_where_the_momentum_is_along_the_axis(ets_vii, rng):
    coupling = ets_vii.coupling(random_state(ets_vii, rng))
    axis = np.array([0.6, 0.0, 0.8])
    along = np.linalg.lstsq(coupling.H_wq, axis)[0]
    assert coupling.protected_share(ssm.Protection(axis), along) == pytest.approx(1, abs=1e-12)
    assert coupling.protected_share(ssm.Protection(axis), np.zeros(6)) == 0


def test_a_ball_and_a_needle():
    ball = ssm.Ellipsoid.of(3.0 * np.eye(3))
    assert (ball.condition, ball.volume, ball.rank) == (1, pytest.approx(27), 3)
    assert ball.entropy == pytest.approx(1)
    nothing = ssm.Ellipsoid.of(np.zeros((3, 4)))
    assert (nothing.rank, nothing.entropy, nothing.condition) == (0, 0, np.inf)
    single = ssm.Ellipsoid.of(np.array([[0.0], [2.0], [0.0]]))
    np.testing.assert_array_equal(single.semi_axes, [2, 0, 0])
    np.testing.assert_array_equal(np.abs(single.joint_rates), [[1, 0, 0]])


def test_bad_inputs(ets_vii):
    coupling = ets_vii.coupling(ets_vii.configuration())
    for length in (0.0, -1.0, np.nan, [1.0, 2.0]):
        with pytest.raises(ssm.InputError, match="characteristic_length"):
            coupling.manipulability(characteristic_length=length)
    for rates in (np.zeros(5), np.full(6, np.nan)):
        with pytest.raises(ssm.InputError, match="joint_rates"):
            coupling.protected_share(ssm.Protection("yaw"), rates)
