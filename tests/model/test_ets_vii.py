"""The shipped models against the paper's Table 1, read back by two parsers that know nothing of each other."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
import yourdfpy

import ssm_decouple as ssm

MASSES = (35.0, 22.5, 21.9, 16.5, 26.0, 18.5)
LENGTHS = (0.35, 0.87, 0.63, 0.26, 0.28, 0.53)
RADIUS = 0.1
MOUNT = (-0.79, -0.29, 1.0)
X, Y, Z = np.eye(3)

AXES = {"ets_vii": (Z, Y, -Y, Y, Z, X), "ets_vii_flight": (Z, -Y, -Y, -Y, Z, X)}
RUNS = {"ets_vii": (Z, Z, X, X, X, X), "ets_vii_flight": (Z, Z, X, -Y, Z, X)}
# From each joint to the next, the last to the end-effector: along the link, with the flight arm's one lateral offset.
LATERAL = {"ets_vii": np.zeros(3), "ets_vii_flight": np.array([0, 0.275, 0])}
ARMS = ("ets_vii", "ets_vii_flight")


def offsets(name: str) -> list[np.ndarray]:
    """Where each joint, then the end-effector, stands in the frame before it."""
    steps = [length * run for length, run in zip(LENGTHS, RUNS[name], strict=True)]
    steps[0] = steps[0] + LATERAL[name]
    return [np.array(MOUNT), *steps]


def cylinder(mass: float, length: float, run: np.ndarray) -> np.ndarray:
    along, across = mass * RADIUS**2 / 2, mass * (3 * RADIUS**2 + length**2) / 12
    return across * np.eye(3) + (along - across) * np.outer(run, run)


@pytest.mark.parametrize("name", ARMS)
def test_yourdfpy_reads_the_paper_s_table(name):
    urdf = yourdfpy.URDF.load(str(ssm.models()[name]), load_meshes=False, build_scene_graph=True)
    base = urdf.link_map["bus"].inertial
    assert base.mass == 2550.0
    assert np.array_equal(base.inertia, np.diag([6200.0, 3540.0, 7090.0]))
    assert np.array_equal(base.origin, np.eye(4))
    for i, (joint_offset, axis, run) in enumerate(zip(offsets(name), AXES[name], RUNS[name], strict=False)):
        joint, link = urdf.joint_map[f"joint_{i + 1}"], urdf.link_map[f"link_{i + 1}"]
        assert joint.type == "revolute"
        assert joint.limit.velocity == np.deg2rad(5.0)
        np.testing.assert_array_equal(joint.axis, axis)
        np.testing.assert_array_equal(joint.origin[:3, 3], joint_offset)
        np.testing.assert_array_equal(joint.origin[:3, :3], np.eye(3))
        assert link.inertial.mass == MASSES[i]
        np.testing.assert_allclose(link.inertial.origin[:3, 3], LENGTHS[i] / 2 * run, rtol=1e-15)
        np.testing.assert_allclose(link.inertial.inertia, cylinder(MASSES[i], LENGTHS[i], run), rtol=1e-14)
        (shape,) = link.collisions
        assert (shape.geometry.cylinder.radius, shape.geometry.cylinder.length) == (RADIUS, LENGTHS[i])
        np.testing.assert_allclose(np.abs(shape.origin[:3, :3] @ Z), np.abs(run), atol=1e-15)
    tool = urdf.joint_map["end_effector_mount"]
    assert (tool.type, tool.parent, tool.child) == ("fixed", "link_6", "end_effector")
    np.testing.assert_array_equal(tool.origin[:3, 3], offsets(name)[-1])


@pytest.mark.parametrize("name", ARMS)
def test_pinocchio_reads_the_paper_s_table(name):
    robot = ssm.load_robot(name)
    model = robot.model
    assert (model.nq, model.nv) == (13, 12)
    assert robot.joint_names == tuple(f"joint_{i}" for i in range(1, 7))
    assert model.inertias[1].mass == 2550.0
    np.testing.assert_allclose(model.inertias[1].inertia, np.diag([6200, 3540, 7090]), rtol=1e-15)
    np.testing.assert_array_equal(model.inertias[1].lever, 0)
    data = model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    positions = np.cumsum(offsets(name), axis=0)
    for i in range(6):
        inertia = model.inertias[2 + i]
        assert inertia.mass == pytest.approx(MASSES[i], rel=1e-15)
        np.testing.assert_allclose(inertia.lever, LENGTHS[i] / 2 * RUNS[name][i], rtol=1e-14, atol=1e-16)
        np.testing.assert_allclose(
            inertia.inertia, cylinder(MASSES[i], LENGTHS[i], RUNS[name][i]), rtol=1e-12, atol=1e-15
        )
        np.testing.assert_allclose(data.oMi[2 + i].translation, positions[i], atol=1e-15)
        unit = np.zeros(model.nv)
        unit[6 + i] = 1.0
        pin.forwardKinematics(model, data, pin.neutral(model), unit)
        spin = data.oMi[2 + i].rotation @ data.v[2 + i].angular
        np.testing.assert_allclose(spin, AXES[name][i], atol=1e-15)
    np.testing.assert_allclose(robot.frame_pose(pin.neutral(model)).translation, positions[-1], atol=1e-15)
    np.testing.assert_array_equal(robot.rate_limits, np.full(6, np.deg2rad(5.0)))
    assert robot.mass == pytest.approx(2550.0 + sum(MASSES))


@pytest.mark.parametrize("name", [*ARMS, "ets_vii_bus"])
def test_the_satellite_has_its_shapes(name):
    urdf = yourdfpy.URDF.load(str(ssm.models()[name]), load_meshes=False)
    bus = urdf.link_map["bus"]
    names = {visual.name for visual in bus.visuals}
    assert {"bus_body", "wing_left", "wing_right", "antenna_dish"} <= names
    assert {shape.name for shape in bus.collisions} == {
        "bus_collision",
        "wing_left_collision",
        "wing_right_collision",
        "antenna_collision",
    }
    wing = next(visual for visual in bus.visuals if visual.name == "wing_left")
    np.testing.assert_array_equal(wing.geometry.box.size, [0.04, 6.5, 2.4])  # the panel's normal is x
    assert wing.origin[1, 3] > 0
    dish = next(visual for visual in bus.visuals if visual.name == "antenna_dish")
    np.testing.assert_allclose(np.abs(dish.origin[:3, :3] @ Z), Y, atol=1e-15)  # its boresight is y


def test_nothing_is_suspicious_in_what_we_ship():
    for name in ssm.models():
        assert ssm.load_robot(name).report().findings == ()
