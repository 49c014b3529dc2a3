"""Case files with tasks, schedules, momentum on board, weights and limits."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

import ssm_decouple as ssm
from ssm_decouple.studies.comparison import summarise
from ssm_decouple.viewing.table import saturation

MISSION = """
robot = "ets_vii"
[start]
joints_deg = [150, -20, -10, 0, 0, 0]
linear_momentum = [0.1, 0, 0]
angular_momentum = [0.05, -0.02, 0.04]
[[task]]
kind = "pose"
position = [-1.8, -0.3, 1.2]
rpy_deg = [10, 20, 30]
gain = 0.1
weight = 2
[[task]]
kind = "boresight"
frame = "link_3"
direction = [0, 0, 2]
toward = [1, 0, 0]
level = 2
[[task]]
kind = "posture"
joints = ["joint_4", "joint_2"]
positions_deg = [30, 60]
level = 3
[[task]]
kind = "manipulability"
level = 4
[protection]
phases = [{ from = 0, axes = "none" }, { from = 0.5, axes = [[0, 0, 1]] }]
hand_over = 0.2
[law]
joint_weights = [1, 1, 1, 2, 2, 2]
acceleration_limit = 0.2
[limits]
braking = 0.7
[simulation]
duration = 1
dt = 0.1
method = "held"
"""


@pytest.mark.filterwarnings("ignore::ssm_decouple.DecoupleWarning")  # the pose alone takes all freedoms
def test_a_mission(write):
    case = ssm.load_case(write(MISSION, "mission.toml"))
    pose, boresight, posture, climb = case.law["tasks"]
    assert pose == ssm.PoseTask(gain=0.1, weight=2)
    assert boresight == ssm.BoresightTask((0, 0, 1), frame="link_3", level=2)
    assert posture == ssm.PostureTask(("joint_4", "joint_2"), level=3)
    assert climb == ssm.ManipulabilityTask(level=4)
    assert case.target[0] == pin.SE3(pin.rpy.rpyToMatrix(*np.deg2rad([10, 20, 30])), np.array([-1.8, -0.3, 1.2]))
    assert case.target[1] == [1, 0, 0]
    np.testing.assert_allclose(case.target[2], np.deg2rad([30, 60]))

    law = case.make_law()
    assert isinstance(law, ssm.ScheduledLaw)
    np.testing.assert_array_equal(law.momentum, [0.1, 0, 0, 0.05, -0.02, 0.04])
    assert law.limits == ssm.Limits(braking=0.7)
    motion = case.run()
    np.testing.assert_allclose(motion.angular_momentum, np.tile([0.05, -0.02, 0.04], (11, 1)), atol=1e-12)
    assert np.abs(motion.protected_rate.values[motion.protection_share.values == 1]).max() < 1e-16
    assert isinstance(case.make_law(ssm.Protection("yaw")), ssm.SelectiveLaw)


def test_other_tasks_and_a_comparison(write):
    text = MISSION.split("[[task]]")[0] + (
        '[[task]]\nkind = "orientation"\nrpy_deg = [0, 90, 0]\n[[task]]\nkind = "position"\nposition = [-1.8, 0, 1.2]\n'
        'level = 2\n[[task]]\nkind = "relative_pose"\nframe = "link_5"\nreference = "bus"\nposition = [0, 0, 2]\n'
        'rpy_deg = [0, 0, 0]\nlevel = 2\n[[task]]\nkind = "posture"\npositions = [0, 0, 0, 0, 0, 0]\nlevel = 3\n'
        '[protection]\naxes = "yaw"\n[simulation]\nduration = 2\ndt = 0.1\n'
    )
    case = ssm.load_case(write(text, "other.toml"))
    kinds = [type(task) for task in case.law["tasks"]]
    assert kinds == [ssm.OrientationTask, ssm.PositionTask, ssm.RelativePoseTask, ssm.PostureTask]
    with pytest.warns(ssm.DecoupleWarning):
        rows = ssm.compare(case).summaries()
    assert np.isfinite([row.start_distance_m for row in rows]).all()
    assert all(row.centre_of_mass_drift_m < 1e-3 for row in rows)  # explicit steps, with linear momentum


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (('kind = "pose"', 'kind = "posse"'), r"\[\[task\]\] 1 unknown kind 'posse'; did you mean 'pose'"),
        (("rpy_deg = [10, 20, 30]\n", ""), r"\[\[task\]\] 1 rpy_deg is missing"),
        (("toward = [1, 0, 0]", "towards = [1, 0, 0]"), r"\[\[task\]\] 2 unknown key 'towards'; did you mean 'toward'"),
        (("positions_deg = [30, 60]", ""), r"\[\[task\]\] 3 needs positions or positions_deg"),
        (("[[task]]", "[target]\nposition = [0, 0, 0]\n[[task]]"), "and not both"),
        (("level = 2", "level = 0"), "level is 0; levels are 1"),
        (("hand_over = 0.2", ""), "needs axes, or phases and hand_over"),
        (("hand_over = 0.2", 'hand_over = 0.2\naxes = "yaw"'), "needs axes, or phases and hand_over"),
        (("from = 0.5", "at = 0.5"), r"\[protection\] phase 2 unknown key 'at'"),
        (("from = 0.5", "from = 0.0"), "leave no room for hand-overs"),
        (("joint_weights = [1, 1", "joint_weights = [true, 1"), "joint_weights is .* it must be a list of numbers"),
        (("braking = 0.7", "braking = 1.5"), "braking is 1.5"),
        (('joints = ["joint_4", "joint_2"]', "joints = [4, 2]"), "it must be a list of names"),
        (("phases = [{ from", "phases = [3, { from"), "it must be a list of tables"),
    ],
)
def test_what_is_no_mission_is_refused(write, change, says):
    with pytest.raises(ssm.InputError, match=says) as caught:
        ssm.load_case(write(MISSION.replace(change[0], change[1], 1), "mission.toml"))
    assert "\n" not in str(caught.value)


def test_a_task_table_of_another_kind_is_refused(write):
    text = 'robot = "ets_vii"\ntask = 3\n[protection]\naxes = "yaw"\n[simulation]\nduration = 1\ndt = 0.1\n'
    with pytest.raises(ssm.InputError, match="'task' must be an array of tables"):
        ssm.load_case(write(text, "odd.toml"))
    with pytest.raises(ssm.InputError, match=r"give \[target\] position, or \[\[task\]\] tables"):
        ssm.load_case(write(text.replace("task = 3\n", ""), "odd.toml"))


@pytest.mark.filterwarnings("ignore:wheels need more torque")
def test_full_wheels_are_told(ets_vii):
    """Two wheels of little momentum: one is filled from the start, and slows down when the arm gives momentum back."""
    axes = {"wheel_y": [0, 1, 0], "wheel_z": [0, 0, 1]}
    wheels = [ssm.Wheel(name, axis, spin_inertia=0.01, max_speed=100.0, max_torque=1.0) for name, axis in axes.items()]
    robot = ets_vii.with_wheels(wheels)
    start = robot.configuration({f"joint_{i + 1}": np.deg2rad(a) for i, a in enumerate([150, -20, -10, 0, 0, 0])})
    law = ssm.SelectiveLaw(robot, ssm.Protection("all"), gain=0.05)
    motion = ssm.simulate(law, start, [-1.8, -0.3, 1.2], 150.0, 0.1)
    motion.attrs |= {"case": "wheels", "case_U_c": "[[0], [0], [0], [0], [0], [1]]", "case_frame": "base"}
    row = summarise(motion, "selective")
    full = np.abs(motion.joint_rates.sel(joint="wheel_y")).values >= 100.0 * (1 - 1e-9)
    assert full.any()
    assert row.full_wheels.startswith(f"wheel_y from {motion.time.values[full.argmax()]:.1f} to ")
    assert saturation(row).startswith("wheels, selective: at full speed: wheel_y from ")
