from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from random_robots import random_robot

import ssm_decouple as ssm
from ssm_decouple.batch import Batch
from ssm_decouple.simulation.steps import Demand, held
from ssm_decouple.studies.postures import joint_ranges
from ssm_decouple.studies.shares import wilson
from ssm_decouple.studies.targets import (
    ARM,
    PROTECTIONS,
    SEVERAL,
    Trials,
    case_trials,
    end_of_path,
    laws_to_try,
    paired_interval,
    random_starts,
    random_targets,
    row_names,
    workspace_trials,
)
from ssm_decouple.viewing import targets as viewing

COUNT = 40


@pytest.fixture(scope="module")
def trials():
    """Case 1 on the flight kinematics in coarse steps: some motions arrive, some stall, some still run."""
    study = replace(case_trials(ssm.load_case("case1_flight"), COUNT, seed=3), dt=0.5)
    study.run()
    return study


def with_displaced_base(robot, joints):
    return robot.configuration(joints, pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.5, 1.1), np.array([1.0, -2.0, 0.5])))


@pytest.mark.parametrize("name", ["ets_vii_flight", "random"])
def test_a_target_is_where_the_free_base_and_the_joints_take_the_end_effector(name, rng):
    """The oracle solves the same motion one at a time, by another method of higher order on Pinocchio's matrices."""
    robot = random_robot(4, joints=7) if name == "random" else ssm.load_robot(name)
    law, rest = ssm.SelectiveLaw(robot, ssm.Protection("none"), rate_limit=1.0), Demand(None, None, None)
    starts = np.array([with_displaced_base(robot, rng.uniform(-1, 1, robot.n_joints)) for _ in range(3)])
    goals = rng.uniform(-2, 2, (3, robot.n_joints))
    ends = []
    for q, goal in zip(starts, goals, strict=True):
        values = np.r_[np.zeros(6), goal - robot.joint_positions(q)]
        for i in range(30):
            q, _ = held(law, rest, q, values, i / 30, (i + 1) / 30)
        np.testing.assert_allclose(np.exp(1j * robot.joint_positions(q)), np.exp(1j * goal), atol=1e-12)
        ends.append(robot.frame_pose(q).translation)
    errors = [np.abs(end_of_path(robot, starts, goals, m) - ends).max() for m in (8, 16, 32)]
    assert errors[2] < 2e-6
    assert errors[0] / errors[1] > 10  # fourth order
    assert errors[1] / errors[2] > 10


def test_the_ends_of_the_paths_lie_within_the_limits(ets_vii):
    narrow = ets_vii.urdf.replace('lower="-6.283185307179586"', 'lower="0.5"')
    assert narrow != ets_vii.urdf
    robot = ssm.Robot(narrow, name="narrow")
    np.testing.assert_array_equal(joint_ranges(robot), np.tile([0.5, 2 * np.pi], (6, 1)))
    found = random_targets(robot, robot.configuration(np.full(6, 0.6)), 50)
    assert 0.5 <= found.goals.min() < 0.7
    assert 2 * np.pi - 0.2 < found.goals.max() <= 2 * np.pi


def test_random_starts_are_regular_even_for_reactionless_control(ets_vii):
    joints = random_starts(ets_vii, 20, seed=1, margin=0.02)
    for row in joints:
        coupling = ets_vii.coupling(ets_vii.configuration(row))
        assert coupling.manipulability(ssm.Protection("all")).smallest >= 0.02 * (1 - 1e-9)
    np.testing.assert_array_equal(random_starts(ets_vii, 7, seed=1), joints[:7])
    assert not np.array_equal(random_starts(ets_vii, 7, seed=2), joints[:7])


def test_the_same_seed_gives_the_same_targets_and_rows(trials):
    again = replace(case_trials(ssm.load_case("case1_flight"), COUNT, seed=3), dt=0.5, threads=1)
    again.run()
    assert again.rows() == trials.rows()
    assert again.stops() == trials.stops()
    fewer = case_trials(ssm.load_case("case1_flight"), 5, seed=3).targets
    np.testing.assert_array_equal(fewer.positions, trials.targets.positions[:5])
    other = case_trials(ssm.load_case("case1_flight"), 5, seed=4).targets
    assert np.abs(other.positions - fewer.positions).max() > 0.1


@pytest.mark.filterwarnings("ignore:the commanded rates reverse:ssm_decouple.errors.DecoupleWarning")
@pytest.mark.parametrize("name", ["none", "selective"])
def test_rows_are_what_simulate_says_one_at_a_time(trials, name):
    """All end alike; motions that stay clear of singularities, which amplify rounding, end at the same place."""
    few, start, found = 10, trials.targets.configurations[0], trials.found[name]
    motions = [ssm.simulate(trials.laws[name], start, target, 150.0, 0.5) for target in trials.targets.positions[:few]]
    assert [motion.attrs["outcome"] for motion in motions] == found.outcome[:few].tolist()
    clear = np.flatnonzero(found.smallest_singular_value[:few] > 0.02)
    assert len(clear) > 2
    left = [motions[i].attrs["final_error"] for i in clear]
    np.testing.assert_allclose(found.final_error[clear], left, rtol=0, atol=1e-9)
    ends = [motions[i].end_effector_position.values[-1] for i in clear]
    np.testing.assert_allclose(trials.final_positions(name)[clear], ends, rtol=0, atol=1e-9)


def test_a_row_counts_and_measures_its_motions(trials):
    for row in trials.rows():
        found = trials.found[row.law]
        arrived = found.outcome == "converged"
        assert (row.targets, row.arrived + row.stalled + row.running) == (COUNT, COUNT)
        assert row.arrived == arrived.sum() == (found.final_error <= 0.01).sum()
        assert row.share_low <= row.share == row.arrived / COUNT <= row.share_high
        assert row.protected_rate_max_rad_s < 1e-17
        assert row.common == np.all([m.outcome == "converged" for m in trials.found.values()], axis=0).sum()
        last = np.array([trials.targets.robot.joint_positions(q) for q in found.configuration])
        assert row.beyond_limits == (np.abs(last).max(axis=1) > 2 * np.pi).sum() >= row.arrived_beyond_limits
    none, selective, reactionless, _ = trials.rows()
    assert reactionless.beyond_limits > COUNT / 2 > none.beyond_limits  # it spins the wrist
    assert none.share > selective.share > 0
    turned = np.rad2deg(trials.found["selective"].base_rotation[trials.arrived("selective")])
    np.testing.assert_allclose(selective.base_median_deg, np.median(turned, axis=0))
    assert selective.base_median_deg[2] < 0.1 * none.base_median_deg[2]


def test_what_holds_a_stalled_motion_is_what_its_own_record_says():
    """The record of `simulate` tells the lost direction and what it is without each row, by another computation."""
    robot = ssm.load_robot("ets_vii")
    study = workspace_trials(robot, 30, seed=5)
    study = replace(study, laws={"roll+yaw": study.laws["roll+yaw"]}, dt=0.5)
    study.run()
    causes = study.causes("roll+yaw")
    assert np.array_equal(causes != "", study.found["roll+yaw"].outcome == "stalled")
    agree = []
    for i in np.flatnonzero((causes == "roll") | (causes == "yaw")):
        lost = study.laws["roll+yaw"].lost_direction(study.found["roll+yaw"].configuration[i])
        agree.append(causes[i] == ("roll", "yaw")[int(np.argmax(lost.without))])
    assert len(agree) > 10
    assert np.mean(agree) > 0.8  # a direction's own gain and the smallest of all need not name the same row
    assert {"roll", "yaw"} <= set(causes)
    rows = study.stops()
    assert sum(row.stalled for row in rows) == (causes != "").sum()
    assert sum(row.share for row in rows) == pytest.approx(1.0)


def test_without_protection_only_the_arm_can_hold_a_motion(ets_vii):
    """An arm stretched out towards a target beyond its reach."""
    start = ets_vii.configuration(np.deg2rad([0.0, 0.0, -90.0, 0.0, 0.0, 0.0]))
    targets = random_targets(ets_vii, start, 4)
    far = replace(targets, positions=targets.positions + [0.0, 0.0, 4.0])
    study = Trials(far, {"none": ssm.SelectiveLaw(ets_vii, ssm.Protection("none"))}, duration=400.0, dt=0.5)
    study.run()
    assert set(study.causes("none")) == {ARM}


def test_eight_protections_and_one_more_row_never_help(ets_vii):
    study = replace(workspace_trials(ets_vii, 64, seed=2), dt=0.5)
    study.run()
    shares = {row.law: row.share for row in study.rows()}
    assert list(shares) == [*PROTECTIONS, "all, undamped"]
    assert shares["none"] > 0.8
    assert shares["none"] > max(shares[name] for name in ("roll", "pitch", "yaw"))
    assert min(shares[name] for name in ("roll", "pitch", "yaw")) > shares["all"]
    pairs = study.pairs([("none", "all"), ("all", "none")])
    assert pairs[0].both + pairs[0].only_law + pairs[0].only_other + pairs[0].neither == 64
    assert pairs[0].difference == -pairs[1].difference == pytest.approx(shares["none"] - shares["all"])
    assert pairs[0].low == -pairs[1].high


def test_intervals_against_their_closed_forms():
    z = 1.959963984540054
    for arrived, total in ((0, 50), (7, 50), (50, 50), (4699, 10_000)):
        p = arrived / total
        middle = (p + z**2 / (2 * total)) / (1 + z**2 / total)
        half = z * np.sqrt(p * (1 - p) / total + z**2 / (4 * total**2)) / (1 + z**2 / total)
        np.testing.assert_allclose(wilson(arrived, total), (middle - half, middle + half), atol=1e-12)
    # The variance of a mean of +1, 0 and -1, counted one by one.
    steps = np.repeat([1.0, -1.0, 0.0], [30, 10, 60])
    low, high = paired_interval(30, 10, 100)
    assert 0.5 * (low + high) == pytest.approx(steps.sum() / 102)
    assert high - low == pytest.approx(2 * z * steps.std() / 10, rel=0.02)
    assert paired_interval(0, 0, 100)[0] < 0 < paired_interval(0, 0, 100)[1]


def test_an_interruption_keeps_the_laws_that_are_done(trials, monkeypatch):
    plain, calls = Batch.motions, []

    def motions(self, law, *rest):
        calls.append(law.protection.k)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return plain(self, law, *rest)

    monkeypatch.setattr(Batch, "motions", motions)
    study = replace(trials, found={})
    with pytest.raises(KeyboardInterrupt):
        study.run()
    assert [row.law for row in study.rows()] == ["none"]
    assert study.pairs() == []
    study.run()
    assert calls == [0, 1, 1, 3, 3]  # what was done is not done again
    assert study.rows() == trials.rows()


def test_progress_names_the_law(trials):
    told = []
    study = replace(trials, laws={"none": trials.laws["none"]}, found={})
    study.run(lambda law, share: told.append((law, share)))
    assert told[-1] == ("none", 1.0)


def test_the_undamped_law_is_tried_where_there_is_a_damped_one():
    case = ssm.load_case("case3")
    assert list(laws_to_try(case)) == ["none", "selective", "reactionless", "reactionless, undamped"]
    assert list(laws_to_try(replace(case, law={**case.law, "damping": 0.0}))) == ["none", "selective", "reactionless"]
    assert list(laws_to_try(replace(case, protection=ssm.Protection("none"))))[-1] == "reactionless, undamped"


def test_rows_have_the_names_of_the_axes():
    assert row_names(ssm.Protection("roll+yaw")) == ["roll", "yaw"]
    assert row_names(ssm.Protection([0.5, 0, 0.866])) == ["(0.5, 0, 0.866)"]


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (lambda r, q: random_targets(r, q, 0), "0 targets are no study"),
        (lambda r, q: random_targets(r, q, 2.5), "2.5 targets are no study"),
        (lambda r, q: random_targets(r, q, 3, seed=-1), "seed is -1"),
        (lambda r, q: random_targets(r, q[:5], 3), r"starts have shape \(1, 5\)"),
        (lambda r, q: random_targets(r, np.tile(q, (2, 1)), 3), r"3 targets of 'ets_vii' need \(3, 13\)"),
        (lambda r, q: random_starts(r, 5, margin=5.0), "too few are regular"),
        (lambda r, q: Trials(random_targets(r, q, 3), {}), "there are no laws"),
        (
            lambda r, q: Trials(
                random_targets(r, q, 3), {"mine": ssm.SelectiveLaw(r, ssm.Protection("yaw", "inertial"))}
            ),
            "law 'mine': the law has directions fixed in 'inertial', which the batch engine does not do",
        ),
        (lambda r, q: case_trials(ssm.load_case("case1"), -4), "case 'case1': -4 targets are no study"),
        (
            lambda r, q: case_trials(replace(ssm.load_case("case1"), simulation={"method": "held"}), 4),
            "asks for method = 'held'",
        ),
        (
            lambda r, q: case_trials(replace(ssm.load_case("case1"), simulation={"smooth_start": 5.0}), 4),
            "asks for smooth_start = 5.0",
        ),
    ],
)
def test_nonsense_is_refused(ets_vii, wrong, says):
    with pytest.raises(ssm.InputError, match=says):
        wrong(ets_vii, ets_vii.configuration())


def test_a_slide_without_limits_is_refused():
    robot = random_robot(0, joints=4)
    index = next(i for i, joint in enumerate(robot.model.joints[2:]) if joint.shortname().startswith("JointModelP"))
    endless = ssm.Robot(robot.urdf, name="endless")
    limits = endless.position_limits.copy()
    limits[index] = -np.inf, np.inf
    endless.__dict__["position_limits"] = limits  # no URDF of such a joint is loaded
    with pytest.raises(ssm.InputError, match=f"joint '{robot.joint_names[index]}' of 'endless' slides without limits"):
        joint_ranges(endless)


def test_tables_and_figures_tell_the_rows(trials, tmp_path):
    arrivals, pairs = viewing.arrival_table(trials.rows()), viewing.pair_table(trials.pairs())
    stops = viewing.stop_table(trials.stops())
    assert [line[1] for line in arrivals[1:]] == list(trials.found)
    assert len(pairs) == 4
    for lines in (arrivals, pairs, stops):
        assert {len(line) for line in lines} == {len(lines[0])}
    figure = viewing.sheet(trials)
    titles = [axes.get_title() for axes in figure.axes]
    for row in trials.rows():
        assert f"{row.law}\n{100 * row.share:.1f} % arrive" in titles
    (grid,) = [viewing.distances([trials, trials])]
    line = grid.axes[0].lines[1]
    np.testing.assert_allclose(line.get_xdata(), np.maximum(np.sort(1e3 * trials.found["selective"].final_error), 0.1))


def test_the_shares_by_distance_add_up_to_all(trials):
    head, *lines = viewing.distance_table([trials, trials], (1.0, 2.0))
    assert head[2:] == ["below 1 m (%)", "to 2 m (%)", "above 2 m (%)"]
    counts = np.array(lines[-1][2:], dtype=float)
    assert counts.sum() == 2 * COUNT
    for line, row in zip(lines, trials.rows(), strict=False):
        assert np.array(line[2:], dtype=float) @ counts / 100 == pytest.approx(2 * row.arrived, abs=0.1)
    here = trials.targets.robot.frame_pose(trials.targets.configurations[0]).translation
    np.testing.assert_allclose(trials.distances(), np.linalg.norm(trials.targets.positions - here, axis=1))


def test_the_bars_of_a_protection_are_all_its_motions(trials):
    figure = viewing.protections([trials])
    widths = np.zeros(len(trials.found))
    for bar in figure.axes[0].patches:
        widths[round(-bar.get_y() - 0.38)] += bar.get_width()
    np.testing.assert_allclose(widths, 1.0)
    labels = viewing._parts(["stalled, held by (0.5, 0, 0.866)"])
    assert labels.index("stalled, held by (0.5, 0, 0.866)") == labels.index(f"stalled, held by {SEVERAL}") - 1
