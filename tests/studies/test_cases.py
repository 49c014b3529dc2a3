from __future__ import annotations

import csv
import dataclasses

import numpy as np
import pytest

import ssm_decouple as ssm
from ssm_decouple.studies.comparison import disturbance, laws_of, summarise, write_csv

# The paper's two tables, in its units.
PAPER = {
    "case1": ([150, -20, -10, 0, 0, 0], [-1.8, -0.3, 1.2], [[0, 0, 1]]),
    "case2": ([90, -30, 0, 0, 0, 0], [-1.5, -0.3, 1.2], [[0.5, 0, 0.866]]),
    "case3": ([180, 0, -20, 0, 0, 0], [-1.5, 0.1, 1.1], [[1, 0, 0], [0, 0, 1]]),
}
MINIMAL = """
robot = "ets_vii"
[target]
position = [-1.8, -0.3, 1.2]
[protection]
axes = "yaw"
[simulation]
duration = 1
dt = 0.1
"""


@pytest.fixture(scope="module")
def compared():
    with pytest.warns(ssm.DecoupleWarning, match="the commanded rates reverse"):  # of case2_flight, at its stall
        return {name: ssm.compare(ssm.load_case(name)) for name in ssm.cases()}


def rows_of(comparison):
    return {row.law: row for row in comparison.summaries()}


@pytest.mark.parametrize("name", PAPER)
@pytest.mark.parametrize("suffix", ["", "_flight"])
def test_the_files_hold_the_paper_s_tables(name, suffix):
    case = ssm.load_case(name + suffix)
    joints, target, axes = PAPER[name]
    np.testing.assert_allclose(case.robot.joint_positions(case.start()), np.deg2rad(joints), atol=1e-15)
    assert list(case.target) == target
    np.testing.assert_array_equal(case.protection.U_c, ssm.Protection(np.array(axes).T).U_c)
    assert (case.duration, case.dt) == (150.0, 0.1)
    law = case.make_law()
    assert law.gain == 0.05
    np.testing.assert_array_equal(law.rate_limits, np.full(6, np.deg2rad(5)))
    assert case.robot.name == "ets_vii" + suffix
    np.testing.assert_array_equal(case.start()[:7], [0, 0, 0, 0, 0, 0, 1])


# From a plain NumPy script of the paper's law: left at 150 s (mm), base angles peak to peak (deg).
@pytest.mark.parametrize(
    ("name", "law", "start", "left", "angles"),
    [
        ("case1", "selective", 1.454, 0.90, (0.169, 1.320, 0.002)),
        ("case2", "selective", 2.162, 5.25, (0.097, 1.284, 0.055)),
        ("case3", "selective", 1.109, 0.70, (0.000, 0.340, 0.000)),
        ("case1", "none", 1.454, 0.79, (0.360, 0.782, 0.234)),
        ("case2", "none", 2.162, 1.20, (1.208, 1.197, 0.433)),
        ("case3", "none", 1.109, 0.60, (0.044, 1.073, 0.011)),
    ],
)
def test_the_three_cases_settle(compared, name, law, start, left, angles):
    row = rows_of(compared[name])[law]
    assert row.outcome == "converged"
    assert row.start_distance_m == pytest.approx(start, abs=5e-4)
    assert 1e3 * row.final_error_m == pytest.approx(left, abs=5e-3)
    np.testing.assert_allclose([row.roll_deg, row.pitch_deg, row.yaw_deg], angles, atol=5e-4)
    assert row.damped_share == 0


@pytest.mark.parametrize(("name", "bound"), [("case1", 1.5e-19), ("case2", 7e-19), ("case3", 1.5e-19)])
def test_the_protected_rate_stays_under_the_paper_s_bounds(compared, name, bound):
    rows = rows_of(compared[name])
    assert rows["selective"].w_sub_max_rad_s <= bound
    assert rows["selective"].protected_angle_deg < 1e-14
    assert rows["none"].w_sub_max_rad_s > 1e-4


@pytest.mark.parametrize(("name", "left"), [("case1", 1.044), ("case2", 2.139), ("case3", 0.898)])
def test_reactionless_control_does_not_arrive(compared, name, left):
    rows = rows_of(compared[name])
    plain, damped = rows["reactionless, undamped"], rows["reactionless"]
    assert plain.outcome == "stalled"
    assert plain.final_error_m == pytest.approx(left, abs=5e-4)
    assert damped.outcome in ("stalled", "running")
    assert 0.15 < damped.final_error_m < plain.final_error_m
    for row in (plain, damped):
        assert max(row.roll_deg, row.pitch_deg, row.yaw_deg) < 1e-12
        assert row.sigma_min_m < 0.02


def test_on_the_flight_kinematics_the_law_stalls_in_cases_2_and_3(compared):
    assert rows_of(compared["case1_flight"])["selective"].outcome == "converged"
    for name, left in (("case2_flight", (0.50, 0.59)), ("case3_flight", (0.23, 0.585))):
        for law in ("selective", "selective, undamped"):
            row = rows_of(compared[name])[law]
            assert row.outcome == "stalled"
            assert left[0] < row.final_error_m < left[1]
            assert row.sigma_min_m < 2e-3


def test_undamped_runs_are_added_only_where_damping_acted(compared):
    assert list(compared["case1"].motions) == ["none", "selective", "reactionless", "reactionless, undamped"]
    for comparison in compared.values():
        for law, motion in comparison.motions.items():
            if law.endswith(", undamped") or law + ", undamped" not in comparison.motions:
                assert not np.any(motion.damping)


def test_disturbance_under_another_law_is_about_the_case_s_axes(compared):
    motion = compared["case2"].motions["none"]
    rate, angle = disturbance(motion)
    U_c = compared["case2"].case.protection.U_c
    np.testing.assert_allclose(rate, motion.base_angular_velocity.values @ U_c, atol=1e-18)
    # The summed angle is the rate's integral, as the base holds its rate for each step.
    np.testing.assert_allclose(angle[1:], np.cumsum(rate[:-1] * 0.1, axis=0), atol=1e-12)


def test_disturbance_along_twists(compared):
    """A case that protects rows of the whole twist: what each law does along them."""
    rng = np.random.default_rng(5)
    U_c = np.linalg.qr(rng.normal(size=(6, 2)))[0]
    for frame in ("base", "inertial"):
        case = dataclasses.replace(
            compared["case2"].case, protection=ssm.Protection(U_c, frame), duration=10.0, title="modes"
        )
        comparison = ssm.compare(case)
        own, free = comparison.motions["selective"], comparison.motions["none"]
        np.testing.assert_array_equal(disturbance(own)[0], own.protected_rate)
        assert np.abs(disturbance(own)[0]).max() < 1e-17
        rate, angle = disturbance(free)
        R = [case.robot.base_pose(q).rotation if frame == "inertial" else np.eye(3) for q in free.configuration.values]
        linear, angular = free.base_linear_velocity.values, free.base_angular_velocity.values
        expected = [U_c.T @ np.r_[r @ v, r @ w] for r, v, w in zip(R, linear, angular, strict=True)]
        np.testing.assert_allclose(rate, expected, atol=1e-16)
        np.testing.assert_allclose(angle[1:], np.cumsum(rate[:-1] * 0.1, axis=0), atol=1e-4 * np.abs(angle).max())


def test_the_case_s_own_protection_is_not_compared_twice():
    case = ssm.load_case("case1")
    three = ssm.Protection(np.eye(6)[:, [0, 2, 4]])
    assert list(laws_of(dataclasses.replace(case, protection=three))) == ["none", "selective", "reactionless"]
    turns = ssm.Protection(np.eye(6)[:, 3:])
    assert list(laws_of(dataclasses.replace(case, protection=turns))) == ["none", "selective"]
    assert list(laws_of(dataclasses.replace(case, protection=ssm.Protection("none")))) == ["none", "reactionless"]
    assert list(laws_of(dataclasses.replace(case, protection=ssm.Protection("all")))) == ["none", "selective"]


def test_the_csv_holds_every_row(compared, tmp_path):
    rows = compared["case1"].summaries()
    path = write_csv(rows, tmp_path / "table.csv")
    with path.open(newline="") as file:
        read = list(csv.DictReader(file))
    assert [row["law"] for row in read] == [row.law for row in rows]
    assert float(read[1]["final_error_m"]) == rows[1].final_error_m
    assert len(read[0]["final_position_m"].split()) == 3


# A user's own case.


def test_a_minimal_case_of_one_s_own(write):
    case = ssm.load_case(write(MINIMAL, "mine.toml"))
    assert (case.name, case.title) == ("mine", "mine")
    motion = case.run()
    assert motion.attrs["case"] == "mine"
    assert motion.sizes["time"] == 11
    assert summarise(motion, "selective").k == 1


def test_a_case_with_twists_and_a_smooth_start(write):
    text = MINIMAL.replace('axes = "yaw"', "axes = [[0, 0, 1, 0, 0, 0], [0, 0, 0, 0, 1, 0]]")
    case = ssm.load_case(write(text + "smooth_start = 0.5", "mine.toml"))
    np.testing.assert_array_equal(case.protection.U_c, np.eye(6)[:, [2, 4]])
    motion = case.run()
    assert motion.attrs["smooth_start"] == 0.5
    speed = np.abs(motion.joint_rates.values).max(axis=1)
    assert speed[0] < 0.02 * speed[5]
    assert summarise(motion, "selective").k == 2
    with pytest.raises(ssm.InputError, match="case 'mine': smooth_start is -1"):
        ssm.load_case(write(MINIMAL + "smooth_start = -1", "mine.toml")).run()


def test_everything_a_case_can_say(write, tmp_path):
    (tmp_path / "robot.urdf").write_text(ssm.models()["ets_vii"].read_text())
    text = """
    title = "Mine"
    robot = "robot.urdf"
    end_effector = "link_6"
    [start]
    joints_deg = { joint_1 = 90, joint_3 = -45 }
    joints = { joint_2 = 0.25 }
    base_position = [1, 2, 3]
    base_rpy_deg = [0, 0, 90]
    [target]
    position = [2, 1, 4]
    [protection]
    axes = [[0, 0, 1], [1, 0, 0]]
    frame = "inertial"
    [law]
    gain = 0.1
    rate_limit = 0.05
    damping = 0.001
    damping_threshold = 0.03
    [simulation]
    duration = 2
    dt = 0.5
    method = "rk4"
    arrival_tolerance = 0.02
    [spacecraft]
    turned_deg = { wing_left = 10 }
    """
    case = ssm.load_case(write(text, "mine.toml"))
    q = case.start()
    np.testing.assert_allclose(case.robot.joint_positions(q), [np.pi / 2, 0.25, -np.pi / 4, 0, 0, 0], atol=1e-15)
    np.testing.assert_allclose(q[:7], [1, 2, 3, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-15)
    assert case.robot.end_effector == "link_6"
    law = case.make_law()
    assert (law.gain, law.damping, law.damping_threshold, law.protection.frame) == (0.1, 0.001, 0.03, "inertial")
    np.testing.assert_array_equal(law.rate_limits, np.full(6, 0.05))
    motion = case.run()
    assert (motion.attrs["method"], motion.attrs["arrival_tolerance"]) == ("rk4", 0.02)
    assert motion.sizes["time"] == 5
    assert case.run(ssm.Protection("none"), dt=1.0).sizes == {**motion.sizes, "time": 3, "protected": 0}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("robot =", "robbot ="), "unknown key 'robbot'; did you mean 'robot'?"),
        (("[target]", "[targets]"), "unknown key 'targets'; did you mean 'target'?"),
        (("dt = 0.1", "dtt = 0.1"), r"\[simulation\] unknown key 'dtt'; did you mean 'dt'?"),
        (("dt = 0.1", 'dt = "0.1"'), r"\[simulation\] dt is '0.1'; it must be a number"),
        (("dt = 0.1", "dt = true"), "dt is True; it must be a number"),
        (("dt = 0.1", ""), r"\[simulation\] dt is missing"),
        (("dt = 0.1", 'dt = 0.1\nmethod = "rk5"'), "unknown method 'rk5'; did you mean 'rk4'?"),
        (("position = [-1.8, -0.3, 1.2]", "position = [-1.8, -0.3]"), "it must be 3 numbers"),
        (('axes = "yaw"', 'axes = "yow"'), "unknown protection 'yow'"),
        (('axes = "yaw"', "axes = [[0, 0, 1], [0, 0, 1]]"), "directions 1 and 2 of U_c are the same"),
        (('axes = "yaw"', "axes = [[0, 0]]"), "each direction needs 3 numbers"),
        (('axes = "yaw"', "axes = [[1, 0, 0], [0, 1]]"), "each direction needs 3 numbers"),
        (('axes = "yaw"', "axes = [[1, 0, 0], 1]"), "each direction needs 3 numbers"),
        (('axes = "yaw"', "axes = [[1, 0, 0], [0, 1, 0, 0, 0, 0]]"), "each direction needs 3 numbers, or each 6"),
        (('axes = "yaw"', 'axes = "yaw"\nframe = ""'), "frame is 'base', 'inertial' or the name"),
        (("[target]", "law = 3\n[target]"), r"'law' must be a table: write \[law\]"),
        (("[target]", "[start]\njoints = [0]\njoints_deg = [0]\n[target]"), "tables by joint name that share none"),
        (("[target]", "[law]\nrate_limit = 1\nrate_limit_deg = 1\n[target]"), "not both"),
        (("[target]", "[target"), "is not TOML"),
    ],
)
def test_a_bad_case_is_refused(write, change, says):
    with pytest.raises(ssm.InputError, match=says) as caught:
        ssm.load_case(write(MINIMAL.replace(*change), "mine.toml"))
    assert "\n" not in str(caught.value)


def test_what_is_no_case_is_refused(tmp_path):
    with pytest.raises(ssm.InputError, match="neither a file nor one of the cases case1, case2, case3"):
        ssm.load_case("case9")
    with pytest.raises(ssm.InputError, match="neither a file"):
        ssm.load_case(tmp_path)


def test_a_case_of_a_missing_robot_says_so(write):
    case = ssm.load_case(write(MINIMAL.replace("ets_vii", "gone.urdf"), "mine.toml"))
    with pytest.raises(ssm.ModelError, match=r"gone.urdf' is neither a file nor a robot"):
        case.run()
