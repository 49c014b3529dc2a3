from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_robots import random_robot

import ssm_decouple as ssm
from ssm_decouple.model.perturb import Tolerances, perturbed
from ssm_decouple.model.urdf import root_link

ALL = Tolerances(mass=0.1, inertia=0.2, centre_of_mass=0.02, mount=0.05, length=0.01)


def bodies(robot: ssm.Robot) -> list[pin.Inertia]:
    """Return the inertia of each link, by a model whose joints all move, so that none is merged."""
    urdf = robot.urdf.replace('type="fixed"', 'type="revolute"')
    urdf = urdf.replace("</joint>", '<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>')
    model = pin.buildModelFromXML(urdf, pin.JointModelFreeFlyer())
    return [inertia for inertia in model.inertias[1:] if inertia.mass > 0]


def placements(robot: ssm.Robot) -> dict[str, pin.SE3]:
    """Return the placement of each frame in its parent joint."""
    return {frame.name: frame.placement for frame in robot.model.frames if frame.type == pin.FrameType.BODY}


@pytest.mark.parametrize("name", ["ets_vii", "composed", "random_2", "random_5"])
def test_the_same_seed_gives_the_same_robot(robots, name):
    robot = robots[name]
    one, again = perturbed(robot, ALL, 7), perturbed(robot, ALL, np.random.default_rng(7))
    assert one.urdf == again.urdf
    assert perturbed(robot, ALL, 8).urdf != one.urdf
    assert one.name == f"{robot.name} (perturbed)"
    assert (one.end_effector, one.joint_names) == (robot.end_effector, robot.joint_names)
    np.testing.assert_array_equal(one.rate_limits, robot.rate_limits)


def test_without_tolerances_nothing_changes(robot):
    same = perturbed(robot, Tolerances(), 1)
    for one, other in zip(same.model.inertias, robot.model.inertias, strict=True):
        np.testing.assert_allclose(
            one.matrix(), other.matrix(), rtol=0, atol=1e-14 * (1 + np.abs(other.matrix()).max())
        )
    for one, other in zip(same.model.jointPlacements, robot.model.jointPlacements, strict=True):
        assert one == other


@given(seed=st.integers(0, 10**6), mass=st.floats(0, 0.9), inertia=st.floats(0, 0.9))
def test_values_stay_within_their_tolerances_and_bodies_stay_solid(seed, mass, inertia):
    robot = random_robot(seed % 8)
    off = perturbed(robot, Tolerances(mass, inertia, centre_of_mass=0.02), seed)
    for before, after in zip(bodies(robot), bodies(off), strict=True):
        heavier = after.mass / before.mass
        assert abs(heavier - 1) <= mass + 1e-12
        shift = after.lever - before.lever
        # Along the axes of the inertial frame; its length is what other axes see.
        assert np.linalg.norm(shift) <= 0.02 * np.sqrt(3) + 1e-12
        x, y, z = np.linalg.eigvalsh(after.inertia)
        assert x > 0
        assert x + y >= z * (1 - 1e-9)
        # Each direction's moment is within the tolerance, the mass apart.
        stretch = np.linalg.eigvals(np.linalg.solve(before.inertia, after.inertia)).real / heavier
        assert np.all(np.abs(stretch - 1) <= inertia + 1e-9)


def test_each_tolerance_moves_what_it_names(ets_vii):
    def changed(**tolerance: float) -> tuple[bool, ...]:
        off = perturbed(ets_vii, Tolerances(**tolerance), 5)
        pairs = list(zip(bodies(ets_vii), bodies(off), strict=True))
        shifted = any(
            not np.allclose(placements(off)[name].translation, placement.translation, atol=1e-9)
            for name, placement in placements(ets_vii).items()
        ) or any(
            not np.allclose(one.translation, other.translation, atol=1e-9)
            for one, other in zip(ets_vii.model.jointPlacements, off.model.jointPlacements, strict=True)
        )
        return (
            any(abs(a.mass / b.mass - 1) > 1e-9 for a, b in pairs),
            any(not np.allclose(a.inertia / a.mass, b.inertia / b.mass, rtol=1e-9) for a, b in pairs),
            any(not np.allclose(a.lever, b.lever, atol=1e-9) for a, b in pairs),
            shifted,
        )

    assert changed(mass=0.1) == (True, False, False, False)
    assert changed(inertia=0.1) == (False, True, False, False)
    assert changed(centre_of_mass=0.01) == (False, False, True, False)
    assert changed(mount=0.01) == (False, False, False, True)
    assert changed(length=0.01) == (False, False, False, True)


def test_the_draw_is_uniform_and_fills_its_range(ets_vii):
    masses = np.array([[b.mass for b in bodies(perturbed(ets_vii, Tolerances(mass=0.1), seed))] for seed in range(150)])
    off = masses / [b.mass for b in bodies(ets_vii)] - 1
    assert off.std() == pytest.approx(0.1 / np.sqrt(3), rel=0.05)
    assert off.max() > 0.098
    assert off.min() < -0.098
    assert np.abs(np.corrcoef(off.T) - np.eye(off.shape[1])).max() < 0.35


def test_only_the_mount_moves(ets_vii):
    off = perturbed(ets_vii, Tolerances(mount=0.05), 3)
    first, *rest = (
        off.model.jointPlacements[i].translation - ets_vii.model.jointPlacements[i].translation for i in range(2, 8)
    )
    assert 0 < np.abs(first).max() <= 0.05
    np.testing.assert_array_equal(rest, np.zeros((5, 3)))


@pytest.mark.parametrize("name", ["ets_vii", "composed", "random_3"])
def test_only_what_stands_on_other_links_than_the_root_is_off_in_length(robots, name):
    robot = robots[name]
    off, root = perturbed(robot, Tolerances(length=0.005), 3), ET.fromstring(robot.urdf)
    on_base = {j.get("name") for j in root.findall("joint") if j.find("parent").get("link") == root_link(root)}
    names = {j.get("name") for j in root.findall("joint")}
    moved = {}
    for joint in ET.fromstring(off.urdf).findall("joint"):
        before = next(j for j in root.findall("joint") if j.get("name") == joint.get("name")).find("origin")
        xyz = [
            [float(x) for x in (o.get("xyz", "0 0 0").split() if o is not None else "000")]
            for o in (before, joint.find("origin"))
        ]
        moved[joint.get("name")] = np.abs(np.subtract(*xyz))
    assert moved.keys() == names
    for joint, by in moved.items():
        assert (by == 0).all() if joint in on_base else ((by > 0) & (by <= 0.005)).all()
    # The end-effector stands off by no more than the sum, and its place is what the law does not know.
    q = robot.configuration(np.full(robot.n_joints, 0.4))
    apart = np.linalg.norm(off.frame_pose(q).translation - robot.frame_pose(q).translation)
    assert 0 < apart <= 0.005 * np.sqrt(3) * len(names)


def test_lengths_leave_the_other_draws_as_they_are(ets_vii):
    one, other = (perturbed(ets_vii, Tolerances(0.1, 0.2, 0.02, 0.05, length), 7) for length in (0.0, 0.01))
    assert [b.mass for b in bodies(one)] == [b.mass for b in bodies(other)]
    np.testing.assert_array_equal(one.model.jointPlacements[2].translation, other.model.jointPlacements[2].translation)


def test_the_appendages_stay():
    robot = ssm.load_robot("ets_vii_flexible")
    off = perturbed(robot, ALL, 3)
    assert off.appendages == robot.appendages
    assert ssm.Plant.of(off).hinges.size == 2
    assert off.mass != robot.mass


@pytest.mark.parametrize(
    ("tolerance", "says"),
    [
        ({"mass": -0.1}, "tolerance of mass is -0.1; it must be at least 0 and below 1"),
        ({"mass": 1.0}, "tolerance of mass is 1.0"),
        ({"inertia": np.nan}, "tolerance of inertia is nan"),
        ({"inertia": 1.5}, "tolerance of inertia is 1.5"),
        ({"centre_of_mass": -1e-9}, "tolerance of centre_of_mass is -1e-09; it must be at least 0"),
        ({"mount": np.inf}, "tolerance of mount is inf"),
        ({"length": -1.0}, "tolerance of length is -1.0"),
    ],
)
def test_bad_tolerances_are_refused(tolerance, says):
    with pytest.raises(ssm.InputError, match=says):
        Tolerances(**tolerance)
