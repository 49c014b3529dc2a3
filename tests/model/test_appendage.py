"""Wings against Gauss points, Pinocchio, MuJoCo models written by hand and closed forms."""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ET
from itertools import pairwise

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from random_robots import random_state, random_urdf

import ssm_decouple as ssm

WING = {
    "name": "wing",
    "mount": [0.0, 1.45, 0.0],
    "span_direction": [0, 1, 0],
    "normal": [1, 0, 0],
    "span": 6.5,
    "chord": 2.4,
    "mass": 50.0,
    "frequency": 0.15,
    "damping_ratio": 0.005,
}
SEEDS = range(6)


def wing(**changes) -> ssm.Appendage:
    return ssm.Appendage(**(WING | changes))


def pair(**changes) -> list[ssm.Appendage]:
    right = {"name": "right", "mount": [0, -1.45, 0], "span_direction": [0, -1, 0]}
    return [wing(name="left", **changes), wing(**(right | changes))]


def random_wing(rng: np.random.Generator, name: str, segments: int | None = None) -> ssm.Appendage:
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return ssm.Appendage(
        name=name,
        mount=rng.uniform(-1, 1, 3),
        span_direction=axes[:, 0],
        normal=axes[:, 1],
        span=rng.uniform(0.5, 8),
        chord=rng.uniform(0.2, 3),
        mass=rng.uniform(1, 80),
        frequency=10 ** rng.uniform(-2, 1),
        damping_ratio=rng.uniform(0, 0.2),
        segments=segments or int(rng.integers(1, 5)),
        turn=rng.uniform(-3, 3),
    )


def gauss_points(a: ssm.Appendage) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return masses, places in base axes and distances from the root: exact for every integral used here."""
    turned = pin.AngleAxis(a.turn, np.array(a.span_direction)).toRotationMatrix() @ np.array(a.normal)
    across = np.cross(a.span_direction, turned)
    nodes, weights = np.polynomial.legendre.leggauss(3)
    edges = np.linspace(0, a.span, a.segments + 1)
    along = np.concatenate([(low + high) / 2 + (high - low) / 2 * nodes for low, high in pairwise(edges)])
    share = np.tile(weights / 2, a.segments) / a.segments
    masses = a.mass * np.outer(share, weights / 2).ravel()
    y, z = (grid.ravel() for grid in np.meshgrid(along, a.chord / 2 * nodes, indexing="ij"))
    return masses, np.array(a.mount) + np.outer(y, a.span_direction) + np.outer(z, across), y


def bus_with(seed: int, wings: list[ssm.Appendage]) -> tuple[ssm.Robot, pin.Inertia]:
    """Return a random robot whose root link has taken the wings in, point by point, and the bus without them."""
    root = ET.fromstring(random_urdf(seed, joints=3 + seed))
    inertial = root.find("link/inertial")
    origin, tensor = inertial.find("origin"), inertial.find("inertia").attrib
    R = pin.rpy.rpyToMatrix(*map(float, origin.get("rpy").split()))
    parts = [[float(tensor["i" + "".join(sorted(i + j))]) for j in "xyz"] for i in "xyz"]
    place = np.array([float(x) for x in origin.get("xyz").split()])
    bus = pin.Inertia(float(inertial.find("mass").get("value")), place, R @ np.array(parts) @ R.T)
    whole = bus.copy()
    for a in wings:
        for mass, at in zip(*gauss_points(a)[:2], strict=True):
            whole += pin.Inertia(mass, at, np.zeros((3, 3)))
    turned = R.T @ whole.inertia @ R  # the origin keeps its rpy
    origin.set("xyz", " ".join(repr(float(x)) for x in whole.lever))
    inertial.find("mass").set("value", repr(whole.mass))
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        inertial.find("inertia").set(f"i{'xyz'[i]}{'xyz'[j]}", repr(float(turned[i, j])))
    return ssm.Robot(ET.tostring(root, encoding="unicode"), name=f"random_{seed}", appendages=wings), bus


def winged(seed: int) -> ssm.Robot:
    rng = np.random.default_rng(100 + seed)
    return bus_with(seed, [random_wing(rng, name) for name in ("a_wing", "k_wing", "z_wing")[: 1 + seed % 3]])[0]


def mass_matrix(model: pin.Model, q: np.ndarray) -> np.ndarray:
    upper = np.triu(pin.crba(model, model.createData(), q))
    return upper + np.triu(upper, 1).T


def relative(actual, expected) -> float:
    return float(np.linalg.norm(np.asarray(actual) - expected) / np.linalg.norm(expected))


def hand_written(a: ssm.Appendage) -> np.ndarray:
    """Return the mass matrix [base twist; hinges] of one wing on a weightless base, from MuJoCo."""
    turned = pin.AngleAxis(a.turn, np.array(a.span_direction)).toRotationMatrix() @ np.array(a.normal)
    length = a.span / a.segments
    x, y = np.array(a.span_direction), np.cross(turned, a.span_direction)
    axes = " ".join(map(repr, map(float, [*x, *y])))  # z is the normal: turning about -y lifts x towards z
    body = ""
    for i in reversed(range(a.segments)):
        at = f'pos="{length!r} 0 0"' if i else f'pos="{" ".join(map(repr, a.mount))}" xyaxes="{axes}"'
        box = f'size="{length / 2!r} {a.chord / 2!r} 1e-6" pos="{length / 2!r} 0 0" mass="{a.mass / a.segments!r}"'
        body = f'<body {at}><joint type="hinge" axis="0 -1 0" name="h{i}"/><geom type="box" {box}/>{body}</body>'
    base = '<freejoint/><inertial pos="0 0 0" mass="1e-12" diaginertia="1e-12 1e-12 1e-12"/>'
    text = f'<mujoco><option gravity="0 0 0"/><worldbody><body>{base}{body}</body></worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    M = np.empty((model.nv, model.nv))
    for i, unit in enumerate(np.eye(model.nv)):
        mujoco.mj_mulM(model, data, M[i], unit)
    return M


def hertz(K: np.ndarray, M: np.ndarray) -> np.ndarray:
    return np.sqrt(scipy.linalg.eigh(np.diag(K), M, eigvals_only=True)) / (2 * np.pi)


@pytest.mark.parametrize("segments", range(1, 7))
@pytest.mark.parametrize("frequency", [0.15, 3.0, 1e5])
def test_the_clamped_frequency_is_the_one_asked_for(ets_vii, segments, frequency):
    a = wing(segments=segments, frequency=frequency, turn=0.4)
    plant = ssm.Plant.of(ets_vii.with_appendages([a]))
    places = 6 + plant.hinges
    M = mass_matrix(plant.robot.model, plant.robot.configuration())[np.ix_(places, places)]
    for oracle in (M, hand_written(a)[6:, 6:]):
        np.testing.assert_allclose(hertz(plant.stiffness[plant.hinges], oracle)[0], frequency, rtol=1e-9)
        np.testing.assert_allclose(a.frequencies, hertz(a.stiffness, oracle), rtol=1e-8)
    np.testing.assert_array_equal(plant.stiffness[plant.driven], 0)
    np.testing.assert_array_equal(plant.damping[plant.driven], 0)
    np.testing.assert_array_equal(plant.damping[plant.hinges], a.damping)


def test_the_first_mode_has_the_damping_asked_for():
    a = wing(segments=4, damping_ratio=0.03)
    C, K, shapes = np.diag(a.damping), np.diag(a.stiffness), a.shapes
    w = 2 * np.pi * a.frequencies
    np.testing.assert_allclose(shapes.T @ a.mass_matrix @ shapes, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(shapes.T @ K @ shapes, np.diag(w**2), atol=1e-9 * w[-1] ** 2)
    np.testing.assert_allclose(np.diag(shapes.T @ C @ shapes), 2 * (0.03 * w / w[0]) * w, rtol=1e-9)
    np.testing.assert_array_equal(wing(damping_ratio=0).damping, 0)


def test_many_segments_become_a_cantilever():
    """Frequency ratios and the stiffness against the Euler-Bernoulli beam."""
    off = []
    for segments in (2, 4, 8, 16, 32):
        a = wing(segments=segments)
        off.append(abs(a.frequencies[1] / a.frequencies[0] / 6.2669 - 1))
    assert all(finer < 0.35 * coarser for coarser, finer in pairwise(off))
    assert off[-1] < 2e-3
    assert a.frequencies[2] / a.frequencies[0] == pytest.approx(17.5475, rel=5e-3)
    EI = (2 * np.pi * 0.15 / 1.8751041**2) ** 2 * 50 / 6.5 * 6.5**4
    assert a.stiffness[1] * 6.5 / 32 == pytest.approx(EI, rel=5e-3)
    np.testing.assert_allclose(a.stiffness / a.stiffness[1], [2.0] + [1.0] * 31)


@pytest.mark.parametrize("seed", SEEDS)
def test_mass_matrix_and_base_coupling_are_integrals_over_the_plate(seed):
    a = random_wing(np.random.default_rng(seed), "wing")
    masses, places, y = gauss_points(a)
    lifts = np.maximum(y[:, None] - np.arange(a.segments) * a.span / a.segments, 0)
    turned = pin.AngleAxis(a.turn, np.array(a.span_direction)).toRotationMatrix() @ np.array(a.normal)
    weighed = masses[:, None] * lifts
    momentum = np.vstack([weighed.sum(0) * turned[:, None], np.cross(places, turned).T @ weighed])
    np.testing.assert_allclose(a.mass_matrix, lifts.T @ weighed, rtol=1e-12)
    np.testing.assert_allclose(a.coupling, momentum, atol=1e-12 * np.abs(a.coupling).max())
    np.testing.assert_allclose(hand_written(a)[:6, 6:], a.coupling, atol=1e-10 * np.abs(a.coupling).max())
    np.testing.assert_allclose(hand_written(a)[6:, 6:], a.mass_matrix, rtol=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_whole_at_rest_is_the_rigid_robot(seed, rng):
    robot = winged(seed)
    plant = ssm.Plant.of(robot)
    kept = np.r_[np.arange(6), 6 + plant.driven]
    assert plant.robot.mass == pytest.approx(robot.mass, rel=1e-14)
    for _ in range(5):
        q = random_state(robot, rng)
        M = mass_matrix(plant.robot.model, plant.configuration(q))
        assert relative(M[np.ix_(kept, kept)], mass_matrix(robot.model, q)) < 1e-12
        whole, rigid = plant.robot.coupling(plant.configuration(q)), robot.coupling(q)
        assert relative(whole.H_ww, rigid.H_ww) < 1e-12
        assert relative(whole.H_wq[:, plant.driven], rigid.H_wq) < 1e-12
        np.testing.assert_allclose(whole.centre_of_mass, rigid.centre_of_mass, atol=1e-13)


@pytest.mark.parametrize("seed", range(40))
def test_mujoco_takes_every_plate(seed):
    """It refuses an inertia that breaks the triangle inequality by a rounding."""
    body = random_wing(np.random.default_rng(seed), "wing").segment_body
    tensor = " ".join(repr(float(body.inertia[i])) for i in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
    inertial = f'<inertial pos="0 0 0" mass="{body.mass!r}" fullinertia="{tensor}"/>'
    mujoco.MjModel.from_xml_string(f"<mujoco><worldbody><body><freejoint/>{inertial}</body></worldbody></mujoco>")


@pytest.mark.parametrize("seed", SEEDS)
def test_the_bus_that_remains_is_the_one_that_took_the_wings_in(seed):
    rng = np.random.default_rng(seed)
    robot, bus = bus_with(seed, [random_wing(rng, "one"), random_wing(rng, "two")])
    root = ET.fromstring(ssm.Plant.of(robot).robot.urdf)
    for joint in root.findall("joint"):
        root.remove(joint)
    for link in root.findall("link")[1:]:
        root.remove(link)
    alone = pin.buildModelFromXML(ET.tostring(root, encoding="unicode"), pin.JointModelFreeFlyer()).inertias[1]
    assert relative(alone.matrix(), bus.matrix()) < 1e-10  # what is taken out is up to a thousand times what stays


@pytest.mark.parametrize("seed", SEEDS)
def test_participation_is_the_base_hinge_block(seed, rng):
    robot = winged(seed)
    plant = ssm.Plant.of(robot)
    fewest = min(a.segments for a in robot.appendages)
    modes = robot.modes(fewest)
    assert modes.names == tuple(f"{a.name} {j + 1}" for a in robot.appendages for j in range(fewest))
    q = plant.configuration(random_state(robot, rng))
    M = mass_matrix(plant.robot.model, q)
    places = 6 + plant.hinges
    assert relative(modes.participation, M[:6, places] @ modes.shapes) < 1e-11
    np.testing.assert_allclose(
        modes.shapes.T @ M[np.ix_(places, places)] @ modes.shapes, np.eye(len(modes.names)), atol=1e-10
    )
    tips = plant.tip_deflections(1e-9 * modes.shapes.T).sum(axis=1)  # only the mode's own wing moves
    assert np.all(tips > 0)


def test_modes_answer_a_base_acceleration_as_they_say(ets_vii, rng):
    """Newton-Euler: with the hinges moving as the modal equations have it, no torque acts on them but the springs'."""
    robot = ets_vii.with_appendages(pair(segments=3, turn=0.3, damping_ratio=0.02))
    plant, modes = ssm.Plant.of(robot), robot.modes(3)
    model = plant.robot.model.copy()
    model.gravity.setZero()
    base, eta, rate = 1e-7 * rng.normal(size=(3, 6))  # small: what is not linear in them is far smaller
    w = 2 * np.pi * modes.frequencies
    acceleration = -modes.participation.T @ base - 2 * modes.damping_ratios * w * rate - w**2 * eta
    q = plant.configuration(robot.configuration(), modes.shapes @ eta)
    v, a = np.zeros(model.nv), np.zeros(model.nv)
    a[:6], a[6 + plant.hinges], v[6 + plant.hinges] = base, modes.shapes @ acceleration, modes.shapes @ rate
    torque = pin.rnea(model, model.createData(), q, v, a)[6 + plant.hinges]
    sprung = -(plant.stiffness * plant.robot.joint_positions(q) + plant.damping * v[6:])[plant.hinges]
    np.testing.assert_allclose(torque, sprung, atol=1e-5 * np.abs(plant.damping * v[6:]).max())


@pytest.mark.parametrize("segments", [1, 2, 5])
def test_free_flying_frequencies_from_mujoco(ets_vii, rng, segments):
    """The whole at rest from the rigid robot, the wings alone from MuJoCo."""
    robot = ets_vii.with_appendages(pair(segments=segments, turn=0.3))
    q = random_state(ets_vii, rng)
    oracles = [hand_written(a) for a in robot.appendages]
    M_bb = mass_matrix(ets_vii.model, q)[:6, :6]
    M_bh = np.hstack([oracle[:6, 6:] for oracle in oracles])
    M_hh = scipy.linalg.block_diag(*(oracle[6:, 6:] for oracle in oracles))
    expected = hertz(
        np.concatenate([a.stiffness for a in robot.appendages]), M_hh - M_bh.T @ np.linalg.solve(M_bb, M_bh)
    )
    plant = ssm.Plant.of(robot)
    np.testing.assert_allclose(plant.frequencies(plant.configuration(q)), expected, rtol=1e-9)
    assert plant.stiffest_frequency(plant.configuration(q)) == pytest.approx(expected[-1], rel=1e-9)
    assert np.all(plant.frequencies() > 0.15)  # a floating base is stiffer than a held one


def test_free_flying_frequencies_from_the_equations_of_motion(ets_vii, rng):
    """Differentiate forward dynamics: no mass matrix is formed."""
    robot = ets_vii.with_appendages(pair(segments=2, turn=-0.5))
    plant = ssm.Plant.of(robot)
    q = plant.configuration(random_state(robot, rng))
    locked = [plant.robot.model.getJointId(name) for name in robot.joint_names]
    model = pin.buildReducedModel(plant.robot.model, locked, q)
    model.gravity.setZero()
    data, at = model.createData(), np.r_[q[:7], np.zeros(4)]
    K = plant.stiffness[plant.hinges]

    def accelerations(angles):
        return pin.aba(model, data, np.r_[at[:7], angles], np.zeros(10), np.r_[np.zeros(6), -K * angles])[6:].copy()

    h = 1e-4
    J = np.transpose([(accelerations(h * e) - accelerations(-h * e)) / (2 * h) for e in np.eye(4)])
    expected = np.sort(np.sqrt(-np.linalg.eigvals(J).real)) / (2 * np.pi)
    np.testing.assert_allclose(plant.frequencies(q), expected, rtol=1e-6)


def test_free_flying_frequencies_of_one_segment_have_a_closed_form():
    """Two equal wings on a bare bus: together they shake it along x, against each other they turn it about z."""
    bus = ssm.load_robot("ets_vii_bus").with_appendages(pair())
    inertia, first = 50 * 6.5**2 / 3, 50 * 6.5 / 2
    along = 0.15 / np.sqrt(1 - 2 * first**2 / (2550 * inertia))
    about = 0.15 / np.sqrt(1 - 2 * (first * 1.45 + inertia) ** 2 / (7090 * inertia))
    np.testing.assert_allclose(ssm.Plant.of(bus).frequencies(), sorted([along, about]), rtol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_configurations_go_there_and_back(seed, rng):
    """Wings whose names sort before, among and behind the joints', continuous joints among them."""
    robot = winged(seed)
    plant = ssm.Plant.of(robot)
    for _ in range(3):
        q, angles = random_state(robot, rng), rng.uniform(-1, 1, plant.hinges.size)
        whole = plant.configuration(q, angles)
        np.testing.assert_array_equal(plant.rigid_configuration(whole), q)
        values = dict(zip(plant.robot.joint_names, plant.robot.joint_positions(whole), strict=True))
        expected = dict(zip(robot.joint_names, robot.joint_positions(q), strict=True))
        named = [f"{a.name}_hinge_{i}" for a in robot.appendages for i in range(a.segments)]
        assert values == pytest.approx(expected | dict(zip(named, angles, strict=True)))
        np.testing.assert_allclose(
            plant.robot.frame_pose(whole).homogeneous, robot.frame_pose(q).homogeneous, atol=1e-12
        )
    assert plant.robot.end_effector == robot.end_effector
    assert [plant.robot.joint_names[i] for i in plant.driven] == list(robot.joint_names)
    assert sorted([*plant.driven, *plant.hinges]) == list(range(plant.robot.n_joints))


@pytest.mark.parametrize("seed", SEEDS)
def test_the_tip_is_where_the_chain_ends(seed, rng):
    robot = winged(seed)
    plant, model = ssm.Plant.of(robot), ssm.Plant.of(robot).robot.model
    angles = rng.uniform(-1.5, 1.5, (2, 3, plant.hinges.size))
    tips = plant.tip_deflections(angles)
    assert tips.shape == (2, 3, len(robot.appendages))
    data = model.createData()
    for index in np.ndindex(2, 3):
        pin.forwardKinematics(model, data, plant.configuration(random_state(robot, rng), angles[index]))
        for i, a in enumerate(robot.appendages):
            last = data.oMi[model.getJointId(f"{a.name}_hinge_{a.segments - 1}")]
            tip = data.oMi[1].actInv(last.act(np.array(a.span_direction) * a.span / a.segments))
            turned = pin.AngleAxis(a.turn, np.array(a.span_direction)).toRotationMatrix() @ np.array(a.normal)
            assert tips[index][i] == pytest.approx((tip - a.mount) @ turned, abs=1e-12)
    one = ssm.Plant.of(robot).tip_deflections(np.full(plant.hinges.size, 1e-3))
    assert np.all(one > 0)  # positive angles lift the tip along the normal


@given(
    turn=st.floats(-4, 4),
    segments=st.integers(1, 5),
    frequency=st.floats(1e-3, 1e4),
    scale=st.floats(0.1, 10),
)
def test_a_wing_scales_as_beams_do(turn, segments, frequency, scale):
    """Stiffness goes with m L^2 f^2, participation with sqrt(m); the axes stay a right-handed frame."""
    a = wing(turn=turn, segments=segments, frequency=frequency)
    axes = np.column_stack([a.span_direction, a.turned_normal, a.hinge_axis])
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    np.testing.assert_allclose(np.cross(a.hinge_axis, a.span_direction), a.turned_normal, atol=1e-12)
    other = wing(turn=turn, segments=segments, frequency=2 * frequency, mass=50 * scale, span=3 * 6.5)
    np.testing.assert_allclose(other.stiffness, a.stiffness * 4 * 9 * scale, rtol=1e-9)
    np.testing.assert_allclose(other.frequencies, 2 * a.frequencies, rtol=1e-9)
    heavier = dataclasses.replace(a, mass=50 * scale)
    np.testing.assert_allclose(
        heavier.coupling @ heavier.shapes, np.sqrt(scale) * a.coupling @ a.shapes, rtol=1e-9, atol=1e-9
    )


def test_turned_to_the_sun_the_shipped_wings_bend_about_the_axis_of_case_2():
    axis = np.array([0.5, 0, np.sqrt(0.75)])
    for a, turn in zip(ssm.load_robot("ets_vii_flexible").appendages, (30, -30), strict=True):
        np.testing.assert_allclose(np.abs(a.hinge_axis), [0, 0, 1], atol=1e-15)
        turned = dataclasses.replace(a, turn=np.deg2rad(turn))
        assert abs(turned.hinge_axis @ axis) == pytest.approx(1, abs=1e-15)


def test_a_robot_without_wings_is_its_own_plant(robot, rng):
    plant = ssm.Plant.of(robot)
    q = random_state(robot, rng)
    assert plant.robot is robot
    assert plant.rigid is robot
    np.testing.assert_array_equal(plant.driven, range(robot.n_joints))
    np.testing.assert_array_equal(plant.configuration(q), q)
    np.testing.assert_array_equal(plant.rigid_configuration(q), q)
    np.testing.assert_array_equal(plant.stiffness, np.zeros(robot.n_joints))
    assert plant.hinges.size == plant.frequencies(q).size == plant.stiffest_frequency() == 0
    assert plant.tip_deflections(np.empty((4, 0))).shape == (4, 0)
    with pytest.raises(ssm.InputError, match=r"has no appendage and so no modes; give it some with robot.with_append"):
        robot.modes()


def test_wings_change_nothing_of_the_rigid_robot(ets_vii, rng):
    robot = ets_vii.with_appendages(pair())
    assert ets_vii.appendages == ()
    assert robot.appendages == tuple(pair())
    assert robot.urdf == ets_vii.urdf
    assert "2 appendages" in repr(robot)
    assert robot.with_appendages([]).appendages == ()
    q = random_state(robot, rng)
    np.testing.assert_array_equal(robot.coupling(q).H_ww, ets_vii.coupling(q).H_ww)


def test_appendages_are_values():
    assert wing() == wing(mount=np.array([0, 1.45, 0]), span_direction=(0.0, 2.0, 0.0))
    assert hash(wing()) == hash(wing())
    assert wing(normal=[1, 5e-7, 0]).normal == (1.0, 0.0, 0.0)  # within tolerance: made perpendicular
    assert dataclasses.asdict(wing(segments=np.int64(2)))["segments"] == 2
    with pytest.raises(ValueError, match="read-only"):
        wing().hinge_axis[0] = 1


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"name": " "}, "an appendage's name is ' '; give it a text"),
        ({"name": 3}, "name is 3"),
        ({"mass": 0}, "appendage 'wing': mass is 0.0; it must be above zero and finite, in kg"),
        ({"mass": "50"}, "mass is '50'; it must be a number"),
        ({"span": -6.5}, "span is -6.5; it must be above zero"),
        ({"chord": np.nan}, "chord is nan; it must be above zero"),
        ({"frequency": 0.0}, "frequency is 0.0; it must be above zero and finite, in Hz"),
        ({"frequency": np.inf}, "frequency is inf; .* a rigid wing is no appendage, leave it in the URDF"),
        ({"frequency": True}, "frequency is True; it must be a number"),
        ({"damping_ratio": -0.1}, "damping_ratio is -0.1; it must be from 0 to below 1"),
        ({"damping_ratio": 1}, "damping_ratio is 1.0"),
        ({"damping_ratio": np.nan}, "damping_ratio is nan"),
        ({"segments": 0}, "segments is 0; it must be a whole number from 1"),
        ({"segments": 1.5}, "segments is 1.5"),
        ({"segments": True}, "segments is True"),
        ({"turn": np.inf}, "turn is inf; it must be a finite angle"),
        ({"mount": [0, 1]}, r"mount is \[0, 1\]; it needs 3 finite numbers"),
        ({"mount": [0, 1, "2"]}, "mount is .* needs 3 finite numbers"),
        ({"mount": [0, 1, [2]]}, "mount is .* needs 3 finite numbers"),
        ({"mount": [0, np.nan, 0]}, "mount is .* needs 3 finite numbers"),
        ({"span_direction": [0, 0, 0]}, r"span_direction is \[0, 0, 0\]; it needs a direction"),
        ({"normal": [0, 0, 0]}, "normal is .* it needs a direction"),
        ({"normal": [1, 1, 0]}, "it must be perpendicular to span_direction, it is 45 deg off"),
        ({"normal": [1, 2e-6, 0]}, "normal is .* perpendicular"),
    ],
)
def test_a_wing_that_makes_no_sense_is_refused(changes, says):
    with pytest.raises(ssm.InputError, match=says):
        wing(**changes)


def test_wings_that_do_not_fit_the_robot_are_refused(ets_vii):
    with pytest.raises(ssm.InputError, match="two appendages are called 'wing'; rename one"):
        ets_vii.with_appendages([wing(), wing(mount=[0, 0, 1])])
    with pytest.raises(ssm.InputError, match="'wing'; put it in a list"):
        ets_vii.with_appendages(wing())
    with pytest.raises(ssm.InputError, match=r"'wing' is no appendage; build it with ssm_decouple.Appendage"):
        ets_vii.with_appendages(["wing"])
    with pytest.raises(ssm.ModelError, match="'ets_vii': the appendages wing weigh 2550 kg of the 2550 kg of"):
        ets_vii.with_appendages([wing(mass=2550)])
    with pytest.raises(ssm.ModelError, match=r"without the appendages left, right .* the principal moments -1"):
        ets_vii.with_appendages(pair(mass=400))
    with pytest.raises(ssm.InputError, match="'left' has 1 segments and so as many modes, not 2"):
        ets_vii.with_appendages(pair()).modes(2)
    for count in (0, 1.5):
        with pytest.raises(ssm.InputError, match=f"per_appendage is {count}; it must be a whole number from 1"):
            ets_vii.with_appendages(pair()).modes(count)


@pytest.mark.parametrize(("kind", "name"), [("link", "link_1_segment_0"), ("joint", "link_1_hinge_0")])
def test_a_name_that_the_robot_has_is_refused(ets_vii, kind, name):
    text = ets_vii.urdf.replace('"link_1"' if kind == "link" else '"joint_1"', f'"{name}"')
    with pytest.raises(ssm.ModelError, match=f"has a {kind} '{name}' already; call appendage 'link_1' something else"):
        ssm.Robot(text, name="clash", appendages=[wing(name="link_1")])


def test_a_bus_that_no_body_has_warns_when_the_wings_are_given_and_only_then(ets_vii):
    says = r"link bus without its appendages: principal moments .* break the triangle inequality"
    with pytest.warns(ssm.DecoupleWarning, match=says) as said:
        robot = ets_vii.with_appendages(pair(mass=100))
    assert len(said) == 1
    ssm.Plant.of(robot)  # warnings are errors here


def test_hinge_angles_of_the_wrong_size_are_refused(ets_vii):
    plant = ssm.Plant.of(ets_vii.with_appendages(pair()))
    q = ets_vii.configuration()
    for bad in ([0.1], [0.1, np.nan], 0.1):
        with pytest.raises(ssm.InputError, match="needs 2 finite numbers: left_hinge_0, right_hinge_0"):
            plant.configuration(q, bad)
    with pytest.raises(ssm.InputError, match="needs 2 finite numbers"):
        plant.tip_deflections(np.zeros((4, 3)))
    with pytest.raises(ssm.InputError, match="needs 2 finite numbers"):
        plant.tip_deflections(0.0)
    with pytest.raises(ssm.InputError, match=r"shape \(13,\)"):
        plant.rigid_configuration(q)
    with pytest.raises(ssm.InputError, match=r"shape \(13,\)"):
        plant.frequencies(q)


def test_compose_carries_the_wings_of_the_bus(ets_vii):
    arm = ssm.example_robot("ur_description/urdf/ur5_robot.urdf")
    bus = ssm.load_robot("ets_vii_bus").with_appendages(pair())
    whole = ssm.compose(bus, arm, [-0.79, -0.29, 1.0], prefix="arm_", end_effector="tool0")
    assert whole.appendages == bus.appendages
    assert ssm.compose("ets_vii_flexible", arm, [0.5, 0, 1], prefix="b_", end_effector="tool0").appendages
    assert ssm.Plant.of(whole).robot.n_joints == 8
    with pytest.raises(ssm.ModelError, match=r"arm 'ets_vii_bus' has the appendages left, right, which would leave"):
        ssm.compose("ets_vii_bus", bus, [0, 0, 3.0], prefix="second_")
