from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import ssm_decouple as ssm
from ssm_decouple.studies.robustness import CAUSES, STEP, Robustness, effects, slope, tolerances_at, true_rotation
from ssm_decouple.viewing import figures
from ssm_decouple.viewing.table import effect_table, leak_table


@pytest.fixture(scope="module")
def campaign():
    case = replace(ssm.load_case("case1"), duration=120.0)  # the arm arrives after some 102 s
    study = Robustness(case, levels=(0.02, 0.05), runs=4)
    study.run()
    return study


def test_the_leak_grows_with_the_error_and_feedback_takes_it_back(campaign):
    rows = {(row.level, row.feedback_gain): row for row in campaign.leaks()}
    plain = [rows[level, 0.0] for level in (0.02, 0.05)]
    assert slope(plain) == pytest.approx(1.0, abs=0.15)
    for level in (0.02, 0.05):
        assert rows[level, 1.0].median_deg < rows[level, 0.0].median_deg / 5
    # Lengths off by 2 mm each leave the hand within 10 mm of its target, by 5 mm most often not, feedback or not.
    assert rows[0.02, 0.0].arrived == rows[0.02, 1.0].arrived == 1.0
    assert rows[0.05, 0.0].arrived == rows[0.05, 1.0].arrived == 0.25
    assert rows[0.05, 1.0].gain_worst > 20
    assert all(row.low_deg <= row.median_deg <= row.high_deg <= row.largest_deg for row in rows.values())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["case1", "case2", "case3"])
def test_five_per_cent_off_with_feedback_stays_twenty_times_below_no_protection(name):
    study = Robustness(ssm.load_case(name), levels=(0.05,), runs=200)
    study.run()
    plain, fed_back = study.leaks()
    assert fed_back.gain_worst > 20
    assert fed_back.median_deg < plain.median_deg / 5


def test_one_run_can_be_done_again_alone(campaign):
    level, i = 0.05, 2
    case = campaign.case
    plant = ssm.perturbed(case.robot, tolerances_at(level), campaign._seed(i))
    turned, *_ = true_rotation(case, ssm.Dynamic(step=STEP, plant=plant))
    assert turned == campaign.found[level, 0.0][i][0]


def test_what_is_found_is_not_run_again(campaign):
    shares = []
    study = Robustness(
        campaign.case, campaign.levels, runs=4, found={key: dict(v) for key, v in campaign.found.items()}
    )
    del study.found[0.05, 1.0][3]
    study.run(shares.append)
    assert shares == [1.0]
    assert study.found == campaign.found


def test_a_finer_physics_step_tells_the_same():
    case = ssm.load_case("case1")
    plant = ssm.perturbed(case.robot, tolerances_at(0.05), 3)
    coarse, *_ = true_rotation(case, ssm.Dynamic(step=STEP, plant=plant))
    fine, *_ = true_rotation(case, ssm.Dynamic(step=STEP / 4, plant=plant))
    assert coarse == pytest.approx(fine, rel=0.02)


def test_single_imperfections():
    case = replace(ssm.load_case("case1"), duration=40.0)
    rows = {row.cause: row for row in effects(case)}
    assert rows.keys() == CAUSES.keys()
    nothing = rows["nothing"].without_deg
    assert nothing < 1e-4
    assert rows["servo of 0.5 Hz"].without_deg > 3 * nothing
    # Gyros matter to the feedback alone, and a torque from outside is what it is for.
    assert rows["gyros, noise 1e-5 rad/s"].without_deg == nothing
    assert rows["gyros, noise 1e-5 rad/s"].with_deg > 10 * nothing
    pushed = rows["10 mN m on each axis, 20 to 30 s"]
    assert pushed.with_deg < pushed.without_deg / 5
    assert len(effect_table(list(rows.values()))) == 1 + len(CAUSES)


def test_the_table_and_the_figure_tell_the_rows(campaign):
    rows = campaign.leaks()
    lines = leak_table(rows)
    assert [line[1:4] for line in lines[1:]] == [
        ["none", "2", "4"],
        ["none", "5", "4"],
        ["1 /s", "2", "4"],
        ["1 /s", "5", "4"],
    ]
    (axes,) = figures.robustness(rows).axes
    medians = [row.median_deg for row in rows if row.feedback_gain == 0.0]
    np.testing.assert_allclose(axes.lines[0].get_ydata(), medians)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"levels": (0.0,)}, "level 0.0 is no tolerance"),
        ({"levels": (5.0,)}, "0.05 for 5 %"),
        ({"runs": 0}, "0 runs are no study"),
        ({"feedback_gain": 0.0}, "feedback_gain is 0.0"),
        ({"workers": 0}, "0 workers do nothing"),
        ({"seed": -1}, "seed is -1"),
    ],
)
def test_what_makes_no_study_is_refused(change, words):
    with pytest.raises(ssm.InputError, match=words):
        Robustness(ssm.load_case("case1"), **change)


def test_a_case_that_protects_nothing_is_refused():
    case = replace(ssm.load_case("case1"), protection=ssm.Protection("none"))
    with pytest.raises(ssm.InputError, match="needs a protection of rotation: one to three directions"):
        Robustness(case)
