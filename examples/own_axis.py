"""Protect any direction.

Forty directions over half the sky; for each, how fast the base turns about it unprotected and protected, and whether
the arm still reaches its target. It does not always: one protected direction is cheap, not free.
"""

from __future__ import annotations

import numpy as np

import ssm_decouple as ssm

robot = ssm.load_robot("ets_vii")
q = robot.configuration(np.deg2rad([150, -20, -10, 0, 0, 0]))
target = [-1.8, -0.3, 1.2]

free = ssm.simulate(ssm.SelectiveLaw(robot, ssm.Protection("none")), q, target, duration=150.0, dt=0.1)

i = np.arange(40)
height, around = (i + 0.5) / 40, np.pi * (1 + 5**0.5) * i  # a spiral that spreads them evenly
directions = np.column_stack([np.sqrt(1 - height**2) * np.cos(around), np.sqrt(1 - height**2) * np.sin(around), height])

arrived = 0
print("direction (base axes)    unprotected    protected          left   outcome")
for direction in directions:
    law = ssm.SelectiveLaw(robot, ssm.Protection(direction))
    motion = ssm.simulate(law, q, target, duration=150.0, dt=0.1)
    before = float(np.abs(free.base_angular_velocity.values @ direction).max())
    after = float(np.abs(motion.protected_rate).max())
    left = 1e3 * float(motion.end_effector_error[-1])
    arrived += motion.attrs["outcome"] == "converged"
    print(
        f"{np.round(direction, 3)!s:<24} {before:.1e} rad/s {after:.1e} rad/s {left:7.2f} mm  {motion.attrs['outcome']}"
    )
print(f"{arrived} of {len(directions)} directions can be protected on this motion and let the arm arrive")
