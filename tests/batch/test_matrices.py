"""The batch engine's matrices against Pinocchio's, one at a time, and its singular values against known ones."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from random_robots import random_robot

import ssm_decouple as ssm
from ssm_decouple.batch import Batch, lanes
from ssm_decouple.model.tree import Tree

NAMES = ["none", "roll", "pitch", "yaw", "roll+pitch", "pitch+yaw", "all"]
# A planar arm whose plane is square to no base axis, of round bodies: J_rc has rank 1, J_gt rank 2, but for rounding.
NORMAL, ALONG = np.array([0.36, 0.48, 0.8]), np.array([0.8, -0.6, 0.0])


def planar_arm(joints=4):
    def body(name, mass, centre):
        inertia = f'<inertia ixx="{0.02 * mass}" iyy="{0.02 * mass}" izz="{0.02 * mass}" ixy="0" ixz="0" iyz="0"/>'
        return (
            f'<link name="{name}"><inertial><origin xyz="{centre}"/><mass value="{mass}"/>{inertia}</inertial></link>'
        )

    def words(vector):
        return " ".join(map(repr, vector.tolist()))

    parts = [body("l0", 50.0, "0 0 0")]
    for i in range(joints):
        origin, axis = words(0.7 * ALONG), words(NORMAL)
        parts += [
            body(f"l{i + 1}", 4.0, words(0.3 * ALONG)),
            f'<joint name="j{i}" type="continuous"><parent link="l{i}"/><child link="l{i + 1}"/>'
            f'<origin xyz="{origin}"/><axis xyz="{axis}"/></joint>',
        ]
    return ssm.Robot(f'<robot name="planar">{"".join(parts)}</robot>', name="planar")


def some_protections(rng):
    turned = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    twists = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    return [
        *map(ssm.Protection, NAMES),
        ssm.Protection(turned[:, :1]),
        ssm.Protection(turned[:, :2]),
        ssm.Protection(turned),
        ssm.Protection(twists[:, :1]),
        ssm.Protection(twists[:, :4]),
        ssm.Protection(twists),
    ]


def test_matrices_are_those_of_the_coupling(robot, rng):
    joints = rng.uniform(-4, 4, (37, robot.n_joints))
    found = Batch(robot).matrices(joints)
    for i, row in enumerate(joints):
        coupling = robot.coupling(robot.configuration(row))
        for name in ("J_base", "J_rc", "J_gt", "H_ww", "H_wq", "centre_of_mass"):
            wanted = getattr(coupling, name)
            off = np.abs(getattr(found, name)[i] - wanted).max()
            assert off <= 1e-13 * max(1.0, np.abs(wanted).max()), (name, off)
        reached = robot.frame_pose(robot.configuration(row)).translation
        assert found.end_effector_position[i] == pytest.approx(reached, abs=1e-13)


def test_singular_values_are_those_of_the_coupling(robot, rng):
    protections = some_protections(rng)
    joints = rng.uniform(-4, 4, (5, robot.n_joints))
    found = Batch(robot).matrices(joints, protections)
    for i, row in enumerate(joints):
        coupling = robot.coupling(robot.configuration(row))
        for p, protection in enumerate(protections):
            ellipsoid = coupling.manipulability(protection)
            scale = max(1.0, ellipsoid.largest)
            assert abs(found.smallest_singular_values[i, p] - ellipsoid.smallest) <= 2e-14 * scale
            assert abs(found.manipulability[i, p] - ellipsoid.volume) <= 1e-13 * scale**3
    assert np.array_equal(Batch(robot).singular_values(joints, protections), found.smallest_singular_values)


@pytest.mark.parametrize("name", NAMES)
def test_singular_values_are_those_of_the_law(ets_vii, rng, name):
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection(name))
    joints = rng.uniform(-3, 3, (20, 6))
    found = Batch(ets_vii).singular_values(joints, [name])[:, 0]
    wanted = [law(ets_vii.configuration(row), [1, 0, 2]).smallest_singular_value for row in joints]
    assert found == pytest.approx(wanted, abs=5e-15)


def spread(values):
    """Return a scratch array with the same numbers in every lane."""
    return np.repeat(np.array(values, dtype=float)[:, None], lanes.LANES, axis=1)


@pytest.mark.parametrize(
    "singular",
    [
        (1, 1, 1),
        (2, 2, 1e-9),
        (2, 1e-9, 1e-9),
        (3, 1, 1),
        (1, 1, 0),
        (5, 2, 1e-15),
        (4, 4 - 1e-9, 1),
        (1, 0, 0),
        (0, 0, 0),
    ],
)
def test_the_smallest_singular_value_is_exact(rng, singular):
    """Triangles made from known singular values: equal ones, tiny ones, none."""
    smallest, volume = np.empty(lanes.LANES), np.empty(lanes.LANES)
    for _ in range(20):
        left, right = (np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2))
        L = np.linalg.qr((left * singular @ right).T)[1].T
        lanes.smallest_of(spread(L[np.tril_indices(3)]), np.zeros(lanes.TOTALS_SIZE * lanes.LANES), smallest, volume)
        assert smallest == pytest.approx(singular[2], abs=1e-15 * max(singular[0], 1))
        assert volume == pytest.approx(np.prod(singular), abs=1e-14 * max(singular[0], 1) ** 3)


def test_at_a_singularity_no_digits_are_lost(ets_vii, rng):
    """Bisect for it on the sign of det [J_rc; J_gt]. Eigenvalues of J_gt N_sub J_gt^T would stop at 1e-8."""

    def sign(joints):
        coupling = ets_vii.coupling(ets_vii.configuration(joints))
        return np.sign(np.linalg.det(np.vstack([coupling.J_rc, coupling.J_gt])))

    found = 0
    for _ in range(12):
        low, high = rng.uniform(-2, 2, (2, 6))
        if sign(low) == sign(high):
            continue
        for _ in range(55):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if sign(middle) == sign(low) else (low, middle)
        assert Batch(ets_vii).singular_values(low[None], ["all"])[0, 0] < 5e-15
        found += 1
    assert found > 2


def test_a_rank_that_is_missing(rng):
    """Three rows of J_sub of which two depend on the other, and are a thousand times longer than the first."""
    robot = planar_arm()
    joints, basis = rng.uniform(-3, 3, (40, 4)), np.column_stack([ALONG, np.cross(NORMAL, ALONG), NORMAL])
    tilted = pin.exp3(np.array([1e-3, -2e-3, 0.0])) @ basis
    protections = [ssm.Protection("all"), ssm.Protection(tilted), ssm.Protection(NORMAL)]
    assert np.abs(Batch(robot).singular_values(joints, protections)).max() < 1e-14
    for row in joints:
        assert freedoms_left(robot, row, protections) == [3, 3, 3]


def freedoms_left(robot, joints, protections):
    """Return how many `factor` says each protection leaves."""
    left = []
    n = robot.n_joints
    coupling = robot.coupling(robot.configuration(joints))
    for protection in protections:
        k = protection.k
        rows = np.zeros((9, n * lanes.LANES))
        for r, row in enumerate(np.vstack([protection.J_sub(coupling), coupling.J_gt])):
            rows[r] = np.repeat(row, lanes.LANES)
        noise = np.full(lanes.LANES, (lanes.NOISE * np.linalg.norm(coupling.J_rc)) ** 2)
        lengths, L = np.zeros((3, lanes.LANES)), np.zeros((6, lanes.LANES))
        lanes.factor(n, k, rows, noise, lengths, L)
        left.append(int(lengths[2, 0]))
    return left


def test_too_few_joints_leave_nothing():
    robot = random_robot(3, joints=2)
    found = Batch(robot).matrices(np.array([[0.3, -0.4]]), ["none", "yaw", "all"])
    assert not found.smallest_singular_values.any()


def test_a_row_that_is_not_finite_disturbs_no_other(ets_vii, rng):
    joints = rng.uniform(-3, 3, (70, 6))
    clean = Batch(ets_vii).matrices(joints, ["none", "all"])
    spoilt = joints.copy()
    spoilt[[3, 40, 69], [0, 5, 2]] = np.nan, np.inf, -np.inf
    found = Batch(ets_vii).matrices(spoilt, ["none", "all"])
    bad = np.isin(np.arange(70), [3, 40, 69])
    for name in ("values", "smallest_singular_values", "manipulability"):
        assert np.array_equal(getattr(found, name)[~bad], getattr(clean, name)[~bad])
        assert np.isnan(getattr(found, name)[bad]).all(), name


def test_neither_threads_nor_neighbours_change_a_number(ets_vii, rng, monkeypatch):
    monkeypatch.setattr("ssm_decouple.batch.engine.CONFIGURATIONS", 16)
    joints, told = rng.uniform(-3, 3, (333, 6)), []
    whole = Batch(ets_vii, threads=3).matrices(joints, ["yaw"], told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0
    alone = np.vstack([Batch(ets_vii, threads=1).matrices(row[None], ["yaw"]).values for row in joints])
    assert np.array_equal(alone, whole.values)
    parts = np.empty_like(whole.smallest_singular_values)
    for place, part in Batch(ets_vii).blocks(joints, ["yaw"], size=100):
        parts[place] = part.smallest_singular_values
    assert np.array_equal(parts, whole.smallest_singular_values)


def test_an_interruption_ends_it(ets_vii, monkeypatch):
    monkeypatch.setattr("ssm_decouple.batch.engine.CONFIGURATIONS", 16)

    def stop(share):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Batch(ets_vii, threads=2).singular_values(np.zeros((400, 6)), ["none"], stop)


def test_any_array_will_do(ets_vii, rng):
    joints = rng.uniform(-3, 3, (40, 12))
    strided = joints[:, ::2]
    wanted = Batch(ets_vii).singular_values(strided.copy(), ["yaw"])
    fixed = strided.copy()
    fixed.flags.writeable = False
    for given in (strided, fixed, strided.tolist(), np.asfortranarray(strided)):
        assert np.array_equal(Batch(ets_vii).singular_values(given, ["yaw"]), wanted)
    whole = Batch(ets_vii).singular_values(np.zeros((2, 6), dtype=int), ["yaw"])
    assert np.array_equal(whole, Batch(ets_vii).singular_values(np.zeros((2, 6)), ["yaw"]))


def test_no_rows_give_empty_results(ets_vii):
    found = Batch(ets_vii).matrices(np.empty((0, 6)), ["none", "yaw"])
    assert found.J_rc.shape == (0, 3, 6)
    assert found.H_ww.shape == (0, 3, 3)
    assert found.smallest_singular_values.shape == (0, 2)


def test_another_end_effector(ets_vii, rng):
    link = ets_vii.link_names[3]
    joints = rng.uniform(-3, 3, (3, 6))
    other = ssm.Robot(ets_vii.urdf, name="other", end_effector=link)
    wanted = [other.coupling(other.configuration(row)).J_gt for row in joints]
    assert Batch(ets_vii, link).matrices(joints).J_gt == pytest.approx(np.array(wanted), abs=1e-13)


def test_what_makes_no_sense_is_refused(ets_vii):
    engine = Batch(ets_vii)
    with pytest.raises(ssm.InputError, match=r"shape \(4, 5\); 'ets_vii' needs \(N, 6\)"):
        engine.matrices(np.zeros((4, 5)))
    with pytest.raises(ssm.InputError, match=r"shape \(6,\)"):
        engine.matrices(np.zeros(6))
    with pytest.raises(ssm.InputError, match="real numbers"):
        engine.matrices([["a"] * 6])
    with pytest.raises(ssm.InputError, match="give a list"):
        engine.singular_values(np.zeros((1, 6)), "yaw")
    with pytest.raises(ssm.InputError, match="protection 2 is fixed in 'inertial' axes"):
        engine.singular_values(np.zeros((1, 6)), ["yaw", ssm.Protection("yaw", "inertial")])
    with pytest.raises(ssm.InputError, match="protection 1 is 3"):
        engine.singular_values(np.zeros((1, 6)), [3])
    with pytest.raises(ssm.InputError, match="no frame 'hand'"):
        Batch(ets_vii, "hand")
    with pytest.raises(ssm.InputError, match="threads is 0"):
        Batch(ets_vii, threads=0)
    with pytest.raises(ssm.InputError, match="size is 0"):
        next(engine.blocks(np.zeros((1, 6)), size=0))
    with pytest.raises(ssm.InputError, match="has no joints"):
        Batch(ssm.load_robot("ets_vii_bus"))


def test_a_joint_that_is_not_supported_is_named():
    model = pin.Model()
    base = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root")
    model.addJoint(base, pin.JointModelSpherical(), pin.SE3.Identity(), "shoulder")
    with pytest.raises(ssm.InputError, match="joint 'shoulder' has 3 degrees of freedom"):
        Tree.of(model)


def test_coupling_factors_are_those_of_the_coupling(robot, rng):
    protections = some_protections(rng)
    joints = rng.uniform(-4, 4, (5, robot.n_joints))
    found = Batch(robot).coupling_factors(joints, protections)
    for i, row in enumerate(joints):
        coupling = robot.coupling(robot.configuration(row))
        for p, protection in enumerate(protections):
            rows = np.vstack([protection.J_sub(coupling), coupling.J_gt])
            if np.linalg.cond(rows) > 300.0:  # there rounding is amplified
                continue
            wanted = coupling.coupling_factor(protection)
            assert found[i, p] == pytest.approx(wanted, rel=1e-12, abs=1e-14), (i, protection)


def test_coupling_factors_leave_out_what_is_rounding(rng):
    robot = planar_arm()
    joints = rng.uniform(-3, 3, (40, 4))
    found = Batch(robot).coupling_factors(joints, ["none", "all"])
    for row, factors in zip(joints, found, strict=True):
        coupling = robot.coupling(robot.configuration(row))
        wanted = [coupling.coupling_factor(ssm.Protection(name)) for name in ("none", "all")]
        assert factors == pytest.approx(wanted, rel=1e-10)
    assert found[:, 1].max() == 0.0
    joints[3, 1] = np.nan
    assert np.isnan(Batch(robot).coupling_factors(joints, ["none"])[3]).all()
