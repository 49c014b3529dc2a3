from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

import ssm_decouple as ssm
from ssm_decouple.studies.bending import bending, flexible, parts_of
from ssm_decouple.viewing import figures
from ssm_decouple.viewing.table import bending_table


@pytest.fixture(scope="module")
def found():
    """Case 1 until its wings have rung a few times."""
    case = flexible(replace(ssm.load_case("case1"), duration=40.0))
    return case, {row.protection: (row, motion) for row, motion in bending(case)}


def test_what_each_protection_leaves(found):
    _, runs = found
    rows = {name: row for name, (row, _) in runs.items()}
    none, own, modes, everything = (rows[name] for name in ("none", "the case's own", "bending modes", "all rotation"))
    assert none.peak_mm > 1.0
    # The bending axis protected: the wings no longer bend against each other, but still together.
    assert own.antisymmetric_mm < none.antisymmetric_mm / 500
    assert own.symmetric_mm > none.symmetric_mm / 3
    assert everything.symmetric_mm > none.symmetric_mm / 3
    assert modes.peak_mm < none.peak_mm / 500
    assert modes.k == 2
    for row in rows.values():
        assert row.energy_error < 1e-10
        assert row.momentum_drift < 1e-10


def test_the_rows_that_from_modes_protects_stay_still(found):
    case, runs = found
    participation = case.robot.modes().participation
    _, motion = runs["bending modes"]
    _, free = runs["none"]

    def driven(motion):
        return np.abs(motion.base_twist_integral.values @ participation).max()

    assert driven(motion) < 1e-3 * driven(free)


def test_a_wing_follows_the_modal_equation(found):
    """Independent of the plant: one oscillator a mode, driven by the recorded base, gives the recorded tips."""
    case, runs = found
    modes = case.robot.modes()
    _, motion = runs["none"]
    time = motion.time.values
    for j in range(2):
        w, zeta = 2 * np.pi * modes.frequencies[j], modes.damping_ratios[j]
        # With y = eta + X, X the integral of P . twist: y'' + 2 zeta w y' + w^2 y = 2 zeta w X' + w^2 X.
        X = motion.base_twist_integral.values @ modes.participation[:, j]
        system = ([[0.0, 1.0], [-(w**2), -2 * zeta * w]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]])
        _, y, _ = scipy.signal.lsim(system, 2 * zeta * w * np.gradient(X, time) + w**2 * X, time)
        eta = y - X
        tip = eta * modes.shapes[j, j] * case.robot.appendages[j].span
        recorded = motion.tip_deflection.values[:, j]
        assert np.abs(tip - recorded).max() < 0.01 * np.abs(recorded).max()


def test_the_parts_add_up_to_the_tips(found):
    case, runs = found
    tips = runs["none"][1].tip_deflection.values
    together, against = parts_of(case, tips)
    np.testing.assert_allclose(together + against, tips[:, 0], atol=1e-18)
    np.testing.assert_allclose(together - against, tips[:, 1], atol=1e-18)


def test_turned_wings_bend_about_the_axis_that_case_2_protects():
    case = flexible(ssm.load_case("case2"))
    rows = case.robot.modes().participation
    against = rows[:, 0] - rows[:, 1]
    np.testing.assert_allclose(against[:3], 0, atol=1e-12)
    axis = against[3:] / np.linalg.norm(against[3:])
    assert abs(axis @ case.protection.U_c[:, 0]) > np.cos(1e-4)


def test_with_torques_the_wings_stay_as_still():
    from ssm_decouple.simulation.dynamic import Servo

    case = replace(ssm.load_case("case1"), duration=30.0)
    rows = {row.protection: row for row, _ in bending(case, servo=Servo())}
    assert rows["bending modes"].peak_mm < rows["none"].peak_mm / 100


def test_a_robot_without_wings_is_refused(write):
    text = ssm.load_robot("ets_vii_flight").urdf
    case = replace(ssm.load_case("case1_flight"), robot_source=str(write(text)))
    with pytest.raises(ssm.InputError, match="has no appendages to bend; describe them in a TOML file"):
        flexible(case)


def test_the_table_and_the_figure_tell_the_rows(found):
    case, runs = found
    lines = bending_table([row for row, _ in runs.values()])
    assert [line[1] for line in lines[1:]] == ["none", "the case's own", "bending modes", "all rotation"]
    sheet = figures.bending((case, {name: motion for name, (_, motion) in runs.items()}))
    top, envelope = sheet.axes[0], sheet.axes[2]
    symmetric = 1e3 * parts_of(case, runs["none"][1].tip_deflection.values)[0]
    np.testing.assert_allclose(top.lines[0].get_ydata(), symmetric)
    assert np.all(envelope.lines[0].get_ydata() >= np.abs(symmetric) - 1e-12)
    assert "mm" in top.get_ylabel()


def test_wings_described_with_opposite_normals_have_the_same_parts(found):
    case, runs = found
    left, right = case.robot.appendages
    same = replace(right, turn=np.pi)  # the same plate, its normal the other way
    other = replace(case)
    other.__dict__["robot"] = case.robot.with_appendages([left, same])
    tips = runs["none"][1].tip_deflection.values
    for before, after in zip(parts_of(case, tips), parts_of(other, tips * [1, -1]), strict=True):
        np.testing.assert_allclose(before, after, atol=1e-15)
    other.__dict__["robot"] = case.robot.with_appendages([left, replace(right, turn=np.pi / 2)])
    assert parts_of(other, tips) == (None, None)


@pytest.mark.parametrize("frame", ["base", "inertial"])
def test_the_rotation_that_is_told_is_that_of_the_motion(frame):
    """In any frame, and with metres left out of it."""
    case = replace(ssm.load_case("case1"), duration=10.0, base_rpy=(np.pi / 2, 0.0, 0.0))
    turned = replace(case, protection=ssm.Protection("yaw", frame))
    row, motion = {row.protection: (row, motion) for row, motion in bending(turned)}["the case's own"]
    assert row.protected_angle_deg == pytest.approx(float(np.rad2deg(np.abs(motion.protected_angle).max())), rel=1e-12)
    twisted = replace(case, protection=ssm.Protection(np.eye(6)[:, [0, 5]]))
    row, motion = {row.protection: (row, motion) for row, motion in bending(twisted)}["none"]
    yaw = np.abs(motion.base_twist_integral.sel(twist="wz")).max()
    assert row.protected_angle_deg == pytest.approx(float(np.rad2deg(yaw)), rel=1e-12)
