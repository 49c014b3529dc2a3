"""Studies count the directions of a schedule while it protects them, under whatever law the case runs."""

from dataclasses import replace

import numpy as np
import pytest

import ssm_decouple as ssm
from ssm_decouple.studies.comparison import disturbance, largest_rotation_deg


@pytest.mark.parametrize("frame", ["base", "inertial"])
def test_the_same_windows_under_every_law(frame):
    yaw, both = ssm.Protection("yaw", frame), ssm.Protection("roll+yaw", frame)
    schedule = ssm.Schedule([(0.0, "none"), (4.0, yaw), (10.0, both)], hand_over=2.0)
    case = replace(ssm.load_case("case1"), duration=16.0, protection=schedule)
    for protection in (None, ssm.Protection("none"), ssm.Protection("all")):
        motion = case.run(protection)
        rate, angle = disturbance(motion)
        time = motion.time.values
        on = np.array([[t >= 6.0, t >= 12.0] for t in time])  # yaw, then roll
        if schedule.U_twist[5, 0] == 0.0:
            on = on[:, ::-1]
        assert not rate[~on].any()
        assert not angle[~on].any()
        largest = np.rad2deg(np.abs(angle).max())
        assert largest_rotation_deg(motion, schedule) == pytest.approx(largest, rel=1e-12, abs=1e-16)
        if protection is not None and protection.k == 0:
            assert largest > 1e-3
        if protection is None:
            assert np.abs(rate).max() < 1e-17
