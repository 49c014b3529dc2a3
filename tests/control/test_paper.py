"""The plain form of the law is an oracle only as long as it is the paper's: here it meets the law, state by state."""

from __future__ import annotations

import numpy as np
import pytest

import ssm_decouple as ssm
from ssm_decouple.control.paper import scaled_to_limits, selective_law, task_velocity


def plain_rates(robot: ssm.Robot, q, target, U_c, gain: float, **damping: float):
    coupling, still = robot.coupling(q), np.zeros(3)
    v_cmd = task_velocity(still, gain, np.asarray(target), robot.frame_pose(q).translation)
    return selective_law(coupling.J_rc, coupling.J_gt, U_c, v_cmd, **damping)


@pytest.mark.parametrize("protected", ["none", "yaw", "roll+yaw", "all"])
@pytest.mark.parametrize("damping", [0.0, 1e-4])
def test_the_law_is_the_paper_s(robot, protected, damping, rng):
    protection = ssm.Protection(protected)
    law = ssm.SelectiveLaw(robot, protection, gain=0.05, rate_limit=np.inf, damping=damping)
    scaled = ssm.SelectiveLaw(robot, protection, gain=0.05, rate_limit=0.05, damping=damping)
    met = 0
    for _ in range(8):
        q = robot.configuration(rng.uniform(-2, 2, robot.n_joints))
        target = robot.frame_pose(q).translation + rng.uniform(-1, 1, 3)
        rates = plain_rates(robot, q, target, protection.U_c, 0.05, rho_max=damping)
        command = law(q, target)
        s = command.smallest_singular_value
        if s < 1e-6:
            continue  # an inverse by singular values has lost its digits there
        met += 1
        tolerance = 1e-11 * max(1.0, 1e-3 / s) * (1 + np.abs(rates).max())
        np.testing.assert_allclose(command.joint_rates, rates, rtol=0, atol=tolerance)
        limited = scaled_to_limits(rates, np.full(robot.n_joints, 0.05))
        np.testing.assert_allclose(scaled(q, target).joint_rates, limited, rtol=0, atol=tolerance)
    assert met or robot.n_joints - protection.k < 3


@pytest.mark.parametrize("name", ["case1", "case2", "case3"])
def test_it_does_the_paper_s_cases(name):
    case = ssm.load_case(name)
    law, motion = case.make_law(), case.run()
    for i in range(0, motion.sizes["time"], 50):
        rates = plain_rates(case.robot, motion.configuration.values[i], case.target, law.protection.U_c, law.gain)
        limited = scaled_to_limits(rates, law.rate_limits)
        np.testing.assert_allclose(motion.joint_rates.values[i], limited, rtol=0, atol=1e-12)
