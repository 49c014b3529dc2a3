from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from random_robots import random_state

import ssm_decouple as ssm
from ssm_decouple import Protection

EPS = np.finfo(float).eps


def test_names_and_directions_mean_the_same():
    np.testing.assert_array_equal(Protection("yaw").U_c, Protection([0, 0, 1]).U_c)
    np.testing.assert_array_equal(Protection("roll+yaw").U_c, Protection([[1, 0], [0, 0], [0, 1]]).U_c)
    np.testing.assert_array_equal(Protection("all").U_c, np.eye(3))
    assert [Protection(name).k for name in ("none", "pitch", "roll+yaw", "all")] == [0, 1, 2, 3]
    assert Protection(np.zeros((3, 0))).k == 0


def test_the_paper_s_tilted_axis_is_made_unit_and_its_angle_told():
    protection = Protection([0.5, 0, 0.866])
    assert abs(np.linalg.norm(protection.U_c) - 1) <= EPS
    assert protection.correction == 0.0  # scaling turns nothing
    assert "30.0007 deg from yaw" in protection.describe()


def unit_vectors():
    return (
        arrays(float, 3, elements=st.floats(-1, 1))
        .filter(lambda v: np.linalg.norm(v) > 0.1)
        .map(lambda v: v / np.linalg.norm(v))
    )


@given(unit_vectors(), unit_vectors(), st.floats(-9e-4, 9e-4), st.floats(-4e-4, 4e-4), st.integers(1, 3))
def test_nearly_orthonormal_becomes_orthonormal_to_machine_precision(a, b, stretch, shear, k):
    second = np.cross(a, b)
    if np.linalg.norm(second) < 0.1:
        return
    second /= np.linalg.norm(second)
    exact = np.column_stack([a, second, np.cross(a, second)])[:, :k]
    given_axes = exact @ ((1 + stretch) * np.eye(k) + shear * np.ones((k, k)) * (1 - np.eye(k)))
    protection = Protection(given_axes)
    assert np.abs(protection.U_c.T @ protection.U_c - np.eye(k)).max() <= 4 * EPS
    # The span stays, and the correction is the largest angle between a given direction and the one used.
    np.testing.assert_allclose(
        protection.U_c @ protection.U_c.T @ given_axes, given_axes, atol=2e-15 if k == 3 else 1e-14
    )
    cosines = np.sum(given_axes * protection.U_c, axis=0) / np.linalg.norm(given_axes, axis=0)
    assert protection.correction == pytest.approx(np.arccos(np.clip(cosines, -1, 1)).max(), abs=3e-8)


@pytest.mark.parametrize(
    ("axes", "says"),
    [
        ([0, 0, 0], "direction 1 of U_c is zero; drop it"),
        ([0, 0, 2], r"has length 2; did you mean \(0, 0, 1\)"),
        ([0, 0, 1.002], "has length 1.002"),
        ([0, np.nan, 1], "is not finite"),
        (np.eye(3)[:, [0, 0]], "directions 1 and 2 of U_c are the same"),
        (np.column_stack([[1, 0, 0], [np.sqrt(0.5), np.sqrt(0.5), 0]]), "stand at 45 deg; make them orthogonal"),
        (np.eye(4)[:3], "k = 4 directions; space has 3"),
        (np.eye(7)[:6], "k = 7 directions; a twist has 6"),
        (np.eye(6)[:3], r"shape \(3, 6\).*its transpose would do"),
        (np.eye(6)[:2], r"shape \(2, 6\).*its transpose would do"),
        ([0, 0, 0, 0, 0, 0], "direction 1 of U_c is zero"),
        ([0, 0, 1, 0, 0, 1], r"has length 1.41421; did you mean \(0, 0, 0.707107, 0, 0, 0.707107\)"),
        ([0, 0, np.nan, 0, 0, 1], "is not finite"),
        (np.eye(6)[:, [4, 4]], "directions 1 and 2 of U_c are the same"),
        ([[1, 0, 0], [0, 0, 1]], r"shape \(2, 3\).*its transpose would do"),
        (np.zeros((3, 3, 3)), r"shape \(3, 3, 3\)"),
        ([1, 0], r"shape \(2,\)"),
        ("roll and yaw", "unknown protection 'roll and yaw': give a name"),
        ([object()], "cannot be read as numbers"),
    ],
)
def test_what_is_no_protection_is_refused(axes, says):
    with pytest.raises(ssm.InputError, match=says):
        Protection(axes)


def test_an_unknown_frame_is_refused():
    with pytest.raises(ssm.InputError, match="frame is 'base', 'inertial' or the name of a frame of the robot, not ''"):
        Protection("yaw", frame="")


def test_parsing_one_word():
    np.testing.assert_array_equal(Protection.parse("roll+yaw").U_c, Protection("roll+yaw").U_c)
    np.testing.assert_array_equal(Protection.parse("1,0,0;0,0,1").U_c, Protection("roll+yaw").U_c)
    np.testing.assert_array_equal(Protection.parse("0.5,0,0.866").U_c, Protection([0.5, 0, 0.866]).U_c)
    np.testing.assert_array_equal(Protection.parse("1e0,0,0").U_c, Protection("roll").U_c)
    assert Protection.parse("yaw@inertial").frame == "inertial"
    np.testing.assert_array_equal(Protection.parse("1,0,0,0,0,0;0,0,0,0,0,1").U_c, np.eye(6)[:, [0, 5]])
    assert Protection.parse("0,0,1,0,0,0@inertial").frame == "inertial"
    for text, says in (
        ("1,0,0,0,0,0;0,0,1", "cannot read"),
        ("yew", "unknown protection 'yew'"),
        ("1,0", "shape"),
        ("1,0,0;1", "cannot read"),
        ("nan,0,1", "finite"),
    ):
        with pytest.raises(ssm.InputError, match=says):
            Protection.parse(text)


@pytest.mark.parametrize("frame", ["base", "inertial"])
@pytest.mark.parametrize("axes", ["none", "yaw", "roll+yaw", "all"])
def test_projector_and_basis(robot, rng, axes, frame):
    protection = Protection(axes, frame)
    coupling = robot.coupling(random_state(robot, rng))
    J_sub, N, Z = protection.J_sub(coupling), protection.N_sub(coupling), protection.null_space_basis(coupling)
    n = robot.n_joints
    turn = coupling.base_rotation if frame == "inertial" else np.eye(3)
    np.testing.assert_allclose(J_sub, protection.U_c.T @ turn @ coupling.J_rc, atol=1e-15)
    # The paper's projector, symmetric and idempotent.
    expected = np.eye(n) - (np.linalg.pinv(J_sub) @ J_sub if protection.k else 0)
    np.testing.assert_allclose(N, expected, atol=1e-12)
    np.testing.assert_allclose(N, N.T, atol=1e-15)
    np.testing.assert_allclose(N @ N, N, atol=1e-14)
    np.testing.assert_allclose(Z.T @ Z, np.eye(Z.shape[1]), atol=1e-14)
    assert Z.shape == (n, n - min(protection.k, n))
    assert np.abs(J_sub @ Z).max(initial=0) <= 8 * EPS * np.linalg.norm(J_sub)
    # The matrices do not depend on the axes in which the coupling is written.
    np.testing.assert_allclose(
        protection.J_sub(coupling.inertial()), J_sub, atol=1e-14 * max(1, np.abs(J_sub).max(initial=0))
    )


def test_protected_directions_are_fixed_in_their_frame(ets_vii, rng):
    pose = pin.SE3(pin.rpy.rpyToMatrix(0, 0, np.pi / 2), np.zeros(3))
    coupling = ets_vii.coupling(ets_vii.configuration(rng.uniform(-1, 1, 6), pose))
    # With the base turned by 90 deg about z, inertial x is the base's -y.
    np.testing.assert_allclose(
        Protection("roll", "inertial").J_sub(coupling), -Protection("pitch").J_sub(coupling), atol=1e-16
    )


@pytest.mark.parametrize("direction", [[0, 1, 0], [0, -3, 0], [0.3, -0.2, 0.9], [1e-9, 0, 1]])
def test_a_boresight_may_only_turn_about_itself(direction):
    protection = Protection.boresight(direction)
    line = np.array(direction) / np.linalg.norm(direction)
    assert protection.k == 2
    np.testing.assert_allclose(protection.U_c.T @ line, 0, atol=1e-15)
    # Where omega has no protected part it is along the line, and the line of sight stays: omega x line = 0.
    omega = np.random.default_rng(1).normal(size=3)
    free = omega - protection.U_c @ (protection.U_c.T @ omega)
    np.testing.assert_allclose(np.cross(free, line), 0, atol=1e-15)


@pytest.mark.parametrize("direction", [[0, 0, 0], [0, np.nan, 1], [0, 1], "y"])
def test_what_is_no_boresight_is_refused(direction):
    with pytest.raises(ssm.InputError, match="boresight"):
        Protection.boresight(direction)


# Directions of the whole base twist.


def random_twists(rng: np.random.Generator, k: int) -> np.ndarray:
    return np.linalg.qr(rng.normal(size=(6, 6)))[0][:, :k]


def test_rotations_are_twists_without_a_linear_part():
    for axes in ("none", "pitch", "roll+yaw", "all"):
        rotations = Protection(axes)
        assert rotations.U_c.shape == (3, rotations.k)
        np.testing.assert_array_equal(rotations.U_twist, np.vstack([np.zeros((3, rotations.k)), rotations.U_c]))
        whole = Protection(rotations.U_twist)
        np.testing.assert_array_equal(whole.U_c, rotations.U_twist)
        np.testing.assert_array_equal(whole.U_twist, rotations.U_twist)
    for array in (rotations.U_c, rotations.U_twist, whole.U_twist):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1.0


def test_a_twist_is_described_in_its_six_parts():
    assert Protection([1, 0, 0, 0, 0, 0]).describe() == "k = 1, base axes: (1, 0, 0, 0, 0, 0), x"
    assert "(0, 0, 0.6, 0, 0, 0.8), 36.8699 deg from yaw" in Protection([0, 0, 0.6, 0, 0, 0.8]).describe()


@given(st.integers(0, 10**6), st.integers(1, 6), st.floats(-9e-4, 9e-4))
def test_twists_are_made_orthonormal(seed, k, stretch):
    rng = np.random.default_rng(seed)
    given_axes = random_twists(rng, k) @ (np.eye(k) + stretch * np.diag(rng.uniform(-1, 1, k)))
    protection = Protection(given_axes)
    assert np.abs(protection.U_c.T @ protection.U_c - np.eye(k)).max() <= 8 * EPS
    np.testing.assert_allclose(protection.U_c @ protection.U_c.T @ given_axes, given_axes, atol=1e-14)
    assert protection.correction < 1e-7


@pytest.mark.parametrize("frame", ["base", "inertial"])
@pytest.mark.parametrize("k", range(1, 7))
def test_projector_and_basis_of_twists(robot, rng, k, frame):
    protection = Protection(random_twists(rng, k), frame)
    coupling = robot.coupling(random_state(robot, rng))
    R = coupling.base_rotation if frame == "inertial" else np.eye(3)
    J_base = np.vstack([R @ coupling.J_base[:3], R @ coupling.J_base[3:]])
    J_sub, Z = protection.J_sub(coupling), protection.null_space_basis(coupling)
    size = np.abs(J_base).max()
    np.testing.assert_allclose(J_sub, protection.U_twist.T @ J_base, atol=1e-14 * size)
    np.testing.assert_allclose(protection.J_sub(coupling.inertial()), J_sub, atol=1e-14 * size)
    assert Z.shape == (robot.n_joints, robot.n_joints - min(k, robot.n_joints))
    np.testing.assert_allclose(Z.T @ Z, np.eye(Z.shape[1]), atol=1e-14)
    assert np.abs(J_sub @ Z).max(initial=0) <= 8 * EPS * np.linalg.norm(J_base)
    np.testing.assert_allclose(protection.N_sub(coupling), Z @ Z.T, atol=1e-15)


@pytest.mark.parametrize("frame", ["base", "inertial"])
def test_j_sub_is_what_the_base_does(robot, rng, frame):
    """Finite differences of a motion that keeps momentum: the way of the base origin and its turn, along six rows."""
    protection = Protection(random_twists(rng, 6), frame)
    q, rates, h = random_state(robot, rng), rng.normal(size=robot.n_joints), 1e-4

    def pose_after(time: float) -> pin.SE3:
        here, steps = q, 4
        for _ in range(steps):  # midpoint steps, each of third order
            v = np.r_[robot.coupling(here).base_twist(rates), rates]
            middle = pin.integrate(robot.model, here, 0.5 * time / steps * v)
            v = np.r_[robot.coupling(middle).base_twist(rates), rates]
            here = pin.integrate(robot.model, here, time / steps * v)
        return robot.base_pose(here)

    before, now, after = pose_after(-h), robot.base_pose(q), pose_after(h)
    linear = (after.translation - before.translation) / (2 * h)
    angular = pin.log3(after.rotation @ before.rotation.T) / (2 * h)
    if frame == "base":
        linear, angular = now.rotation.T @ linear, now.rotation.T @ angular
    moved = protection.U_c.T @ np.r_[linear, angular]
    expected = protection.J_sub(robot.coupling(q)) @ rates
    np.testing.assert_allclose(moved, expected, atol=1e-6 * np.linalg.norm(expected))


# Modes of flexible appendages.


@given(st.integers(0, 10**6), st.integers(1, 9), st.integers(1, 6))
def test_modes_protect_the_span_of_their_participation(seed, m, rank):
    rng = np.random.default_rng(seed)
    rank = min(m, rank)
    vectors = rng.normal(size=(6, rank)) @ rng.normal(size=(rank, m)) * 10.0 ** rng.uniform(-6, 6, m)
    protection = Protection.from_modes(vectors)
    assert protection.k == np.linalg.matrix_rank(vectors / np.linalg.norm(vectors, axis=0), 1e-9)
    assert np.abs(protection.U_c.T @ protection.U_c - np.eye(protection.k)).max() <= 8 * EPS
    left = vectors - protection.U_c @ (protection.U_c.T @ vectors)
    assert np.all(np.linalg.norm(left, axis=0) <= 1e-8 * np.linalg.norm(vectors, axis=0))


def test_modes_have_the_null_space_of_their_raw_vectors(robots, rng):
    for name in ("ets_vii_flight", "composed", "random_5"):
        robot = robots[name]
        coupling = robot.coupling(random_state(robot, rng))
        vectors = rng.normal(size=(6, 3)) * [1e-3, 1.0, 50.0]
        raw = vectors.T @ coupling.J_base
        N = np.eye(robot.n_joints) - np.linalg.pinv(raw, rcond=1e-12) @ raw
        np.testing.assert_allclose(Protection.from_modes(vectors).N_sub(coupling), N, atol=1e-7)
        # A motion in it excites none of the modes.
        rates = Protection.from_modes(vectors).N_sub(coupling) @ rng.normal(size=robot.n_joints)
        excited = vectors.T @ coupling.base_twist(rates) / np.linalg.norm(vectors, axis=0)
        assert np.abs(excited).max() < 1e-14 * np.linalg.norm(rates)


def test_what_modes_add_nothing():
    one = np.array([0.0, 3.0, 0.0, 1.0, 0.0, 2.0])
    single = Protection.from_modes(one)
    assert (single.k, single.frame) == (1, "base")
    np.testing.assert_allclose(np.abs(single.U_c[:, 0] @ one), np.linalg.norm(one), rtol=1e-15)
    for vectors in ([one, 7 * one], [one, -1e-5 * one, np.zeros(6)], [one, one + 1e-12]):
        assert Protection.from_modes(np.column_stack(vectors)).k == 1
    assert Protection.from_modes(1e-200 * one).k == 1
    assert Protection.from_modes(np.random.default_rng(0).normal(size=(6, 20)), "inertial").k == 6


@pytest.mark.parametrize(
    ("participation", "says"),
    [
        (np.zeros(6), "all zeros"),
        (np.zeros((6, 3)), "all zeros"),
        (np.zeros((6, 0)), "all zeros"),
        ([1, 0, 0, 0, 0, np.inf], "not finite"),
        ([1, 0, 0], r"shape \(3,\), it needs \(6,\) or \(6, m\)"),
        (np.ones((2, 6)), r"shape \(2, 6\)"),
        ("yaw", "cannot be read as numbers"),
    ],
)
def test_what_are_no_modes_is_refused(participation, says):
    with pytest.raises(ssm.InputError, match=says):
        Protection.from_modes(participation)
