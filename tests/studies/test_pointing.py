from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ssm_decouple as ssm
from ssm_decouple.studies.pointing import ARCSEC, pointing, pointing_error
from ssm_decouple.viewing import figures
from ssm_decouple.viewing.table import pointing_table


@pytest.fixture(scope="module")
def found():
    case = replace(ssm.load_case("case3"), duration=30.0)
    return {row.law: (row, motion) for row, motion in pointing(case, physics=ssm.Dynamic(step=0.01))}


def test_the_line_of_sight_stays_where_it_is_protected(found):
    peak = {law: row.peak_arcsec for law, (row, _) in found.items()}
    assert peak["none"] > 100
    assert peak["selective"] < peak["none"] / 50
    assert peak["selective, planned"] < peak["selective"] / 20
    assert peak["selective, in the servo"] < peak["selective, planned"] / 100
    assert peak["reactionless"] < peak["none"] / 50


def test_any_line_of_sight():
    case = replace(ssm.load_case("case3"), duration=20.0)
    rows = {row.law: row for row, _ in pointing(case, [0.3, -0.8, 0.5], ssm.Dynamic(step=0.01))}
    assert rows["selective, planned"].peak_arcsec < rows["none"].peak_arcsec / 1000


def test_the_angle_is_that_between_the_lines(found, rng):
    """Against the rotation between the two attitudes: for a line across its axis they are the same angle."""
    _, motion = found["none"]
    attitudes = Rotation.from_quat(motion.base_quaternion.values)
    turned = (attitudes[0].inv() * attitudes[-1]).as_rotvec()
    across = np.cross(turned, rng.normal(size=3))
    assert pointing_error(motion, across)[-1] == pytest.approx(np.linalg.norm(turned), rel=1e-9)
    assert pointing_error(motion, turned)[-1] < 1e-9


def test_the_table_and_the_figure_tell_the_rows(found):
    assert len(pointing_table([row for row, _ in found.values()])) == 7
    top, _ = figures.pointing({law: motion for law, (_, motion) in found.items()}).axes
    wander = ARCSEC * pointing_error(found["none"][1], [0, 1, 0])
    np.testing.assert_allclose(top.lines[0].get_ydata(), np.maximum(wander[1:], 1e-12))


def test_a_boresight_of_zero_is_refused():
    with pytest.raises(ssm.InputError, match="a boresight needs 3 finite numbers"):
        next(pointing(ssm.load_case("case3"), [0, 0, 0]))
