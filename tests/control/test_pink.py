"""The constraints for Pink against the law, which shares nothing with Pink's QP."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from random_robots import random_state

import ssm_decouple as ssm

pink = pytest.importorskip("pink")
from pink.tasks import Task  # noqa: E402

from ssm_decouple.control.pink import ConservedMomentum, ProtectedRate  # noqa: E402


class Velocity(Task):
    """Ask the end-effector for a velocity, m/s in inertial axes."""

    def __init__(self, robot, velocity, dt):
        super().__init__(cost=np.ones(3))
        self.robot, self.step = robot, velocity * dt

    def compute_error(self, configuration):
        return -self.step

    def compute_jacobian(self, configuration):
        pin.computeJointJacobians(self.robot.model, configuration.data, configuration.q)
        pin.updateFramePlacements(self.robot.model, configuration.data)
        return pin.getFrameJacobian(
            self.robot.model, configuration.data, self.robot.end_effector_id, pin.LOCAL_WORLD_ALIGNED
        )[:3]

    def __repr__(self):
        return "Velocity()"


@pytest.mark.parametrize(
    "protection",
    [
        ssm.Protection("yaw"),
        ssm.Protection("roll+yaw", frame="inertial"),
        ssm.Protection("all"),
        ssm.Protection.from_modes([1.0, 0, 0, 0, 0, 3.0]),
    ],
    ids=["yaw", "inertial", "all", "twist"],
)
def test_pink_with_the_constraints_solves_the_same_problem(ets_vii, rng, protection):
    law = ssm.SelectiveLaw(ets_vii, protection, gain=1.0, rate_limit=np.inf, damping=0.0)
    dt, solved = 0.01, 0
    while solved < 3:
        q = random_state(ets_vii, rng)
        command = law(q, [0, 0, 0])
        if command.smallest_singular_value < (0.02 if protection.k == 3 else 0.05):
            continue
        here, velocity = command.end_effector_position, np.array([0.02, -0.01, 0.015])
        command = law(q, here, velocity)
        configuration = pink.Configuration(ets_vii.model, ets_vii.model.createData(), q)
        v = pink.solve_ik(
            configuration,
            [Velocity(ets_vii, velocity, dt)],
            dt,
            solver="daqp",
            damping=1e-10,
            limits=[],
            constraints=[ConservedMomentum(), ProtectedRate(protection)],
            safety_break=False,
        )
        coupling = ets_vii.coupling(q)
        np.testing.assert_allclose(v[:6], coupling.base_twist(v[6:]), atol=1e-9)
        np.testing.assert_allclose(protection.J_sub(coupling) @ v[6:], 0, atol=1e-9)
        np.testing.assert_allclose(coupling.J_gt @ v[6:], velocity, atol=1e-6)
        # Of all joint rates that do this the law's are the shortest; Pink's are so together with the base's twist.
        assert np.linalg.norm(command.joint_rates) <= np.linalg.norm(v[6:]) * (1 + 1e-6)
        assert np.linalg.norm(v) <= np.linalg.norm(command.velocity) * (1 + 1e-6)
        if protection.k == 3:  # nothing is left to choose
            np.testing.assert_allclose(v, command.velocity, atol=1e-5)
        solved += 1


def test_nothing_protected_is_no_constraint():
    with pytest.raises(ssm.InputError, match="leave it out"):
        ProtectedRate(ssm.Protection("none"))
