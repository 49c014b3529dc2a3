"""Case 1: protect the solar arrays' bending axis, the base's z.

The wings' panel normal is x, so out-of-plane bending is excited by yaw. Roll and pitch take up the momentum.
"""

from __future__ import annotations

import numpy as np

import ssm_decouple as ssm

robot = ssm.load_robot("ets_vii")
q = robot.configuration(np.deg2rad([150, -20, -10, 0, 0, 0]))
target = [-1.8, -0.3, 1.2]

for name in ("none", "yaw", "all"):
    protection = ssm.Protection(name)
    law = ssm.SelectiveLaw(robot, protection, gain=0.05, rate_limit=np.deg2rad(5.0))
    motion = ssm.simulate(law, q, target, duration=150.0, dt=0.1)

    left = 1e3 * float(motion.end_effector_error[-1])
    swing = np.rad2deg(np.ptp(motion.base_rpy.values, axis=0))
    rate = float(np.abs(motion.base_angular_velocity[:, 2]).max())
    print(f"{protection.describe()}")
    print(f"  {motion.attrs['outcome']} at {motion.attrs['outcome_time']:.1f} s, {left:.2f} mm left")
    print(f"  base roll, pitch, yaw, peak to peak: {swing.round(3)} deg; largest |yaw rate| {rate:.1e} rad/s")
