"""Your own robot: any URDF with a fixed-base arm, put on a spacecraft bus and decoupled.

Here a UR5 from example-robot-data (pip install 'ssm-decouple[robots]'); give another URDF and its tip as arguments:

    python examples/own_robot.py my_arm.urdf my_tool_link
"""

from __future__ import annotations

import sys

import numpy as np

import ssm_decouple as ssm

arm = sys.argv[1] if len(sys.argv) > 1 else ssm.example_robot("ur_description/urdf/ur5_robot.urdf")
tip = sys.argv[2] if len(sys.argv) > 2 else "tool0"
robot = ssm.compose("ets_vii_bus", arm, mount=[-0.79, -0.29, 1.0], end_effector=tip, prefix="arm_")
print(robot.report())

q = robot.configuration(np.linspace(0.3, -0.9, robot.n_joints))
target = robot.frame_pose(q).translation + [-0.15, 0.1, -0.1]

for name in ("none", "yaw", "roll+yaw", "all"):
    law = ssm.SelectiveLaw(robot, ssm.Protection(name), gain=0.1, rate_limit=np.deg2rad(5.0))
    motion = ssm.simulate(law, q, target, duration=100.0, dt=0.1)
    omega = np.abs(motion.base_angular_velocity.values).max(axis=0)
    left = 1e3 * float(motion.end_effector_error[-1])
    print(f"{name:<9} {motion.attrs['outcome']:<9} {left:8.3f} mm left, largest |omega| x, y, z {omega} rad/s")
