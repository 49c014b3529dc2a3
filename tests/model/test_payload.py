"""A body in the hand against Pinocchio's own way of appending one."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from random_robots import random_state

import ssm_decouple as ssm

BOX = {"mass": 120.0, "centre_of_mass": [0.4, -0.1, 0.2], "inertia": np.diag([20.0, 30.0, 25.0])}


def random_body(rng: np.random.Generator) -> tuple[float, np.ndarray, np.ndarray]:
    points = rng.normal(size=(5, 3)) * rng.uniform(0.1, 1, 3)
    points -= points.mean(axis=0)
    mass = rng.uniform(1, 300)
    second = mass * points.T @ points / 5
    return mass, rng.uniform(-1, 1, 3), np.trace(second) * np.eye(3) - second


def appended(robot: ssm.Robot, frame: str, mass: float, centre: np.ndarray, inertia: np.ndarray) -> pin.Model:
    model = robot.model.copy()
    place = model.frames[model.getFrameId(frame, pin.FrameType.BODY)]
    model.appendBodyToJoint(place.parentJoint, pin.Inertia(mass, np.array(centre), inertia), place.placement)
    return model


def mass_matrix(model: pin.Model, q: np.ndarray) -> np.ndarray:
    upper = np.triu(pin.crba(model, model.createData(), q))
    return upper + np.triu(upper, 1).T


def test_the_mass_matrix_is_that_of_an_appended_inertia(robot, rng):
    for frame in (None, *rng.choice(robot.link_names, 2)):
        body, q = random_body(rng), random_state(robot, rng)
        loaded, oracle = robot.with_payload(*body, frame), appended(robot, frame or robot.end_effector, *body)
        M = mass_matrix(oracle, q)
        np.testing.assert_allclose(mass_matrix(loaded.model, q), M, rtol=1e-12, atol=1e-12 * np.abs(M).max())
        assert loaded.mass == pytest.approx(robot.mass + body[0])
        assert (loaded.joint_names, loaded.end_effector) == (robot.joint_names, robot.end_effector)
        assert loaded.frame_pose(q).isApprox(robot.frame_pose(q))


def test_a_step_of_the_law_conserves_the_momentum_of_the_whole(ets_vii, rng):
    loaded = ets_vii.with_payload(**BOX)
    oracle = appended(ets_vii, "end_effector", *BOX.values())
    law, blind = (ssm.SelectiveLaw(robot, ssm.Protection("yaw")) for robot in (loaded, ets_vii))
    for _ in range(5):
        q = random_state(ets_vii, rng)
        target = ets_vii.frame_pose(q).translation + rng.uniform(-0.3, 0.3, 3)
        data, left = oracle.createData(), []
        for command in (law(q, target), blind(q, target)):
            pin.computeCentroidalMomentum(oracle, data, q, command.velocity)
            moving = np.linalg.norm(mass_matrix(oracle, q)[:6, 6:] @ command.joint_rates)
            left.append(np.linalg.norm(data.hg.vector) / moving)
        assert left[0] < 1e-13
        assert left[1] > 1e-2  # the arm that does not know what it holds
        M = mass_matrix(oracle, q)
        twist = -np.linalg.solve(M[:6, :6], M[:6, 6:] @ law(q, target).joint_rates)
        assert abs(twist[5]) < 1e-16


def test_plant_report_and_wings_see_it(rng):
    robot = ssm.load_robot("ets_vii_flexible")
    loaded = robot.with_payload(**BOX)
    plant = ssm.Plant.of(loaded)
    assert loaded.appendages == robot.appendages
    assert plant.robot.mass == pytest.approx(robot.mass + 120)
    q = loaded.configuration(rng.uniform(-1, 1, 6))
    oracle = appended(ssm.Plant.of(robot).robot, "end_effector", *BOX.values())
    bent = plant.configuration(q, rng.uniform(-0.1, 0.1, plant.hinges.size))
    M = mass_matrix(oracle, bent)
    np.testing.assert_allclose(mass_matrix(plant.robot.model, bent), M, rtol=1e-12, atol=1e-12 * M.max())
    report = loaded.report()
    assert report.mass == pytest.approx(robot.mass + 120)
    assert {joint.name: joint.mass for joint in report.joints}["joint_6"] == pytest.approx(18.5 + 120)
    assert "payload" in report.frames
    assert loaded.name == "ets_vii_flexible + payload"


def test_a_second_one_and_its_names(ets_vii):
    twice = ets_vii.with_payload(**BOX).with_payload(**BOX, frame="joint_1")
    assert {"payload", "payload_2"} <= set(twice.link_names)
    assert twice.mass == pytest.approx(ets_vii.mass + 240)
    one = twice.model.inertias[twice.model.getJointId("joint_1")].mass
    assert one == pytest.approx(35 + 120)  # a joint stands for the link that it moves
    text = ets_vii.urdf.replace('"joint_1"', '"payload_grasp"')
    named = ssm.Robot(text, name="clash").with_payload(**BOX)
    assert "payload_2" in named.link_names


def test_a_robot_that_has_warned_warns_no_more(ets_vii):
    text = ets_vii.urdf.replace('ixx="6200"', 'ixx="62000"')
    assert text != ets_vii.urdf
    with pytest.warns(ssm.DecoupleWarning, match="triangle"):
        strange = ssm.Robot(text, name="strange")
    strange.with_payload(**BOX)


@pytest.mark.parametrize("mass", [0.0, -1.0, np.nan, np.inf, [1.0, 2.0], "heavy"])
def test_no_mass_is_no_payload(ets_vii, mass):
    with pytest.raises(ssm.InputError, match="payload mass"):
        ets_vii.with_payload(**BOX | {"mass": mass})


def test_impossible_inertias(ets_vii):
    turned = pin.rpy.rpyToMatrix(0.3, -0.5, 1.0)
    bad = {
        "1, 2, 4 kg m2, which no body has": np.diag([2.0, 1.0, 4.0]),
        "-1, 2, 2 kg m2; each must be above zero": turned @ np.diag([2.0, -1.0, 2.0]) @ turned.T,
        "0, 0, 0 kg m2; each must be above zero": np.zeros((3, 3)),
    }
    for message, inertia in bad.items():
        with pytest.raises(ssm.ModelError, match=message):
            ets_vii.with_payload(**BOX | {"inertia": inertia})
    flat = turned @ np.diag([1.0, 2.0, 3.0]) @ turned.T
    assert ets_vii.with_payload(**BOX | {"inertia": flat}).mass > ets_vii.mass


def test_bad_shapes_and_frames(ets_vii):
    for key, value, message in (
        ("inertia", [1.0, 2.0, 3.0], r"\(3, 3\)"),
        ("inertia", np.full((3, 3), np.nan), "finite"),
        ("inertia", [[1, 0.1, 0], [0, 1, 0], [0, 0, 1]], "not symmetric"),
        ("centre_of_mass", [0.0, 1.0], "3 finite numbers"),
        ("frame", "hand", "robot 'ets_vii': the robot has no frame 'hand'"),
    ):
        with pytest.raises(ssm.InputError, match=message):
            ets_vii.with_payload(**BOX | {key: value})


def test_numbers_that_leave_floating_point_are_refused_by_name():
    robot = ssm.load_robot("ets_vii")
    with pytest.raises(ssm.InputError, match="payload inertia"):
        robot.with_payload(1.0, [0, 0, 0], np.full((3, 3), 1e308))
    with pytest.raises(ssm.InputError, match="target inertia"):
        ssm.TumblingTarget(np.eye(3) * 1e308, np.eye(3), [0, 0, 1], [0, 0, 0])
    with pytest.raises(ssm.InputError, match="target angular_velocity"):
        ssm.TumblingTarget(np.diag([1.0, 2, 2.5]), np.eye(3), [1e308, 1e308, 1e308], [0, 0, 0])
    with pytest.raises(ssm.InputError, match="velocity"):
        robot.momentum(robot.configuration(), np.full(12, 1e308))
