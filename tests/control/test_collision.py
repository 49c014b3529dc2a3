"""Distances between bodies against closed forms and finite differences, and clearances along motions."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from ssm_decouple import InputError, ModelError, Protection, Robot, load_robot
from ssm_decouple.control.collision import Clearance, Distances
from ssm_decouple.control.limits import LimitedStep, Limits

DT = 0.1
RATE = np.deg2rad(5)
START = np.deg2rad([150, -20, -40, 0, 20, 0])
INERTIA = '<inertial><mass value="{0}"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'


def collision(geometry: str, at: str = "0 0 0") -> str:
    return f'<collision><origin xyz="{at}"/><geometry>{geometry}</geometry></collision>'


def slider(geometry: str, base: str = '<box size="2 2 2"/>') -> Robot:
    """Return a base and a body that slides up z from 1.5 m above its centre and then turns about y."""
    links = {
        "base": collision(base),
        "carriage": "",
        "body": collision(geometry),
    }
    parts = [f'<link name="{name}">{INERTIA.format(9)}{shape}</link>' for name, shape in links.items()]
    for name, kind, parent, child, xyz, axis in (
        ("lift", "prismatic", "base", "carriage", "0 0 1.5", "0 0 1"),
        ("turn", "revolute", "carriage", "body", "0 0 0", "0 1 0"),
    ):
        parts.append(
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}"/>'
            f'<axis xyz="{axis}"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
        )
    return Robot(f'<robot name="slider">{"".join(parts)}</robot>', name="slider")


def test_rates_are_those_of_the_distances():
    """Central differences at random states, the base moving too; kinks left out where the sides differ."""
    robot, rng = load_robot("ets_vii"), np.random.default_rng(0)
    distances, h, compared = Distances(robot, Clearance()), 1e-5, 0
    pairs = len(distances.names)
    for _ in range(15):
        q = robot.configuration(rng.uniform(-2, 2, 6), pin.SE3.Random())
        rows, here, _ = (values[:pairs] for values in distances(q))
        for j in range(6):
            step = np.r_[rng.normal(size=6), np.zeros(6)]  # relative motion does not depend on the base's
            step[6 + j] = 1.0
            ahead = distances(pin.integrate(robot.model, q, h * step))[1][:pairs]
            behind = distances(pin.integrate(robot.model, q, -h * step))[1][:pairs]
            smooth = (np.abs(ahead - 2 * here + behind) < 5e-8) & (here > 1e-3)
            np.testing.assert_allclose(((ahead - behind) / (2 * h))[smooth], rows[smooth, j], atol=2e-3)
            compared += smooth.sum()
    assert compared > 0.7 * 15 * 6 * pairs


@pytest.mark.parametrize(
    ("geometry", "half"),
    [
        ('<sphere radius="0.2"/>', 0.2),
        ('<box size="1 0.4 0.6"/>', 0.3),
        ('<cylinder radius="0.1" length="0.8"/>', 0.4),
    ],
)
@pytest.mark.parametrize("lift", [0.4, 0.0, -0.2])
def test_faces_apart_touching_and_in_each_other(geometry, half, lift):
    """The gap is known, and lifting the body widens it as fast, however the faces lie."""
    robot = slider(geometry)
    rows, distances, _ = Distances(robot, Clearance())(robot.configuration([lift - 0.5 + half, 0.0]))
    assert distances.min() == pytest.approx(lift, abs=1e-6)
    np.testing.assert_allclose(rows[:, 0], 1.0, atol=1e-6)


@pytest.mark.parametrize("geometry", ['<cylinder radius="0.1" length="1"/>', '<box size="0.2 0.2 1"/>'])
def test_both_ends_of_what_lies_parallel_to_a_face_have_a_row(geometry):
    """Turning brings one end nearer and takes the other away: one row alone would hide it."""
    robot = slider(geometry)
    rows, distances, _ = Distances(robot, Clearance())(robot.configuration([0.0, np.pi / 2]))
    near = rows[distances < 0.4 + 1e-6, 1]
    assert near.min() == pytest.approx(-0.5, abs=1e-3)
    assert near.max() == pytest.approx(0.5, abs=1e-3)


def test_every_pair_that_can_meet_and_none_that_cannot():
    robot = load_robot("ets_vii")
    found = set(Distances(robot, Clearance()).names)
    arm = [f"link_{i}" for i in range(1, 7)]
    expected = {("bus", link) for link in arm[1:]} | {(a, b) for i, a in enumerate(arm) for b in arm[i + 2 :]}
    assert found == expected
    chosen = Distances(
        robot, Clearance(pairs=[("link_6", "bus"), ("link_3", "link_5")], ignored=[("link_3", "link_5")])
    )
    assert chosen.names == (("bus", "link_6"),) * 4  # bus, two wings and antenna


def test_a_horizon_leaves_out_what_is_far():
    robot = load_robot("ets_vii")
    q = robot.configuration(START)
    rows, distances, pairs = Distances(robot, Clearance(0.05))(q)
    near_rows, near, near_pairs = Distances(robot, Clearance(0.05, horizon=0.6))(q)
    np.testing.assert_array_equal(near, distances[distances < 0.6])
    np.testing.assert_array_equal(near_rows, rows[distances < 0.6])
    np.testing.assert_array_equal(near_pairs, pairs[distances < 0.6])
    assert 0 < len(near) < len(distances)


def test_overlaps_at_the_start_are_told():
    robot = slider('<sphere radius="0.2"/>')
    distances = Distances(robot, Clearance())
    distances.refuse_overlaps(robot.configuration([0.0, 0.0]))
    with pytest.raises(InputError, match=r"'base' and 'body' of 'slider' are 0.1 m in each other"):
        distances.refuse_overlaps(robot.configuration([-0.4, 0.0]))


def test_what_has_no_shapes_or_no_such_link_is_told():
    bare = Robot(f'<robot name="bare"><link name="base">{INERTIA.format(5)}</link></robot>', name="bare")
    with pytest.raises(InputError, match="no two collision shapes"):
        Distances(bare, Clearance())
    with pytest.raises(InputError, match="'link_9' of the pair"):
        Distances(load_robot("ets_vii"), Clearance(pairs=[("bus", "link_9")]))


def test_a_mesh_is_its_hull_and_one_that_is_missing_is_told(tmp_path):
    corners = np.array([[0, 0, -0.3], [0.2, 0, 0.3], [-0.2, 0.2, 0.3], [-0.2, -0.2, 0.3]])
    faces = [(0, 1, 2), (0, 2, 3), (0, 3, 1), (1, 3, 2)]
    text = ["v " + " ".join(map(str, corner)) for corner in corners]
    text += ["f " + " ".join(str(i + 1) for i in face) for face in faces]
    path = tmp_path / "tip.obj"
    path.write_text("\n".join(text) + "\n")
    robot = slider(f'<mesh filename="{path}"/>')
    rows, distances, _ = Distances(robot, Clearance())(robot.configuration([0.0, 0.0]))
    assert distances.min() == pytest.approx(0.2, abs=1e-6)
    np.testing.assert_allclose(rows[0], [1.0, 0.0], atol=1e-5)
    with pytest.raises(ModelError, match=r"a collision shape cannot be read; .*nowhere\.stl"):
        Distances(slider('<mesh filename="/nowhere.stl"/>'), Clearance())


@pytest.mark.parametrize("acceleration", [None, np.deg2rad(1.0)])
def test_bodies_keep_apart_along_a_motion_into_the_bus(acceleration):
    robot, protection, clearance = load_robot("ets_vii"), Protection("yaw"), Clearance(0.05)
    step, distances = (
        LimitedStep(robot, Limits(clearance=clearance), RATE, acceleration, DT),
        Distances(robot, clearance),
    )
    q, previous, least = robot.configuration(START), np.zeros(6), np.inf
    for _ in range(300):
        coupling, (rows, apart, _) = robot.coupling(q), distances(q)
        J_sub, J = np.ascontiguousarray(protection.J_sub(coupling)), np.ascontiguousarray(coupling.J_gt)
        v = 0.3 * (np.array([0.2, 0.1, 0.8]) - robot.frame_pose(q).translation)  # inside the bus
        plain = np.linalg.pinv(np.vstack([J, J_sub])) @ np.r_[v, 0.0]
        level = (J, v, 0.0)
        result = step(robot.joint_positions(q), previous, plain, J_sub, np.zeros(1), [level], rows, apart)
        assert result.excess == 0.0
        previous, least = result.joint_rates, min(least, apart.min())
        q = pin.integrate(robot.model, q, DT * np.r_[coupling.J_base @ previous, previous])
    assert 0.05 - 2e-3 < least < 0.06


def test_bodies_too_near_part_and_are_told():
    robot = slider('<sphere radius="0.2"/>')
    step = LimitedStep(robot, Limits(clearance=Clearance(0.1)), 1.0, None, DT)
    distances, q, apart = Distances(robot, Clearance(0.1)), robot.configuration([-0.27, 0.0]), []
    down = (np.eye(2), np.array([-0.5, 0.0]), 0.0)  # the task goes further in
    for _ in range(60):
        rows, distance, _ = distances(q)
        arguments = (robot.joint_positions(q), np.zeros(2), down[1], np.empty((0, 2)), np.empty(0), [down])
        result = step(*arguments, rows, distance)
        assert result.too_near == ((0,) if distance[0] < 0.1 - 1e-9 else ())
        apart.append(float(distance.min()))
        q = pin.integrate(robot.model, q, DT * np.r_[np.zeros(6), result.joint_rates])
    assert np.all(np.diff(apart)[:50] > 0)
    assert apart[-1] == pytest.approx(0.1, abs=1e-3)
