"""Turning the base about a protected axis while the arm works."""

from __future__ import annotations

import numpy as np
import pytest

import ssm_decouple as ssm

START, TARGET, TURN = np.deg2rad([150, -20, -10, 0, 0, 0]), [-1.8, -0.3, 1.2], np.deg2rad(0.01)


def slew(time):
    x = min(time / 30.0, 1.0)
    return [TURN, -0.5 * TURN] @ np.diag([x * x * (1.0 - x) ** 2] * 2)


@pytest.mark.parametrize(
    ("method", "nodes", "tolerance"), [("rk4", 0, 1e-10), ("held", 2, 1e-8), ("explicit", 0, 1e-6)]
)
def test_the_base_turns_as_it_is_asked_to(ets_vii, method, nodes, tolerance):
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection("roll+yaw"), sample_time=0.1, hold_nodes=nodes)
    q = ets_vii.configuration(START)
    motion = ssm.simulate(law, q, TARGET, 40.0, 0.1, method=method, protected_rate=slew)
    fine = np.linspace(0.0, 30.0, 3001)
    rates = np.array([slew(time) for time in fine])
    turned = np.sum(0.5 * (rates[1:] + rates[:-1]) * np.diff(fine)[:, None], axis=0)
    np.testing.assert_allclose(motion.protected_angle.values[-1], turned, atol=tolerance)
    assert abs(turned[0]) > 1e-4


def test_a_constant_rate_and_a_dynamic_motion(ets_vii):
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw"), sample_time=0.1, hold_nodes=2)
    q = ets_vii.configuration(START)
    motion = ssm.simulate(law, q, TARGET, 5.0, 0.1, ssm.Dynamic(step=0.005, servo=None), protected_rate=[1e-5])
    np.testing.assert_allclose(motion.protected_angle.values[-1], 5e-5, rtol=1e-2)


def test_what_cannot_be_asked_for_is_refused(ets_vii):
    law, q = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw")), ets_vii.configuration(START)
    for wrong in ([1.0, 2.0], lambda time: [np.nan], "fast"):
        with pytest.raises(ssm.InputError, match="protected_rate"):
            ssm.simulate(law, q, TARGET, 1.0, 0.1, protected_rate=wrong)
    for physics in (ssm.Dynamic(feedback_gain=0.1), ssm.Dynamic(servo=ssm.Servo(protects=True))):
        with pytest.raises(ssm.InputError, match="leave them out where a protected_rate"):
            ssm.simulate(law, q, TARGET, 1.0, 0.1, physics, protected_rate=[1e-5])
