"""Case 2: protect a tilted axis, as of solar arrays turned 30 deg to face the Sun, and look inside the law.

The direction is no principal axis of anything: all three attitude angles move, but the base does not turn about it.
"""

from __future__ import annotations

import numpy as np

import ssm_decouple as ssm

robot = ssm.load_robot("ets_vii")
q = robot.configuration(np.deg2rad([90, -30, 0, 0, 0, 0]))
target = [-1.5, -0.3, 1.2]
protection = ssm.Protection([0.5, 0.0, 0.866])
print(protection.describe())

# One step by hand: every matrix of the paper is there.
coupling = robot.coupling(q)
J_sub, N_sub = protection.J_sub(coupling), protection.N_sub(coupling)
print("J_sub, rad/s of base per rad/s of joint:", J_sub.round(4))
print("singular values of J_g:      ", np.linalg.svd(coupling.J_gt, compute_uv=False).round(3))
print("singular values of J_gt N_sub:", np.linalg.svd(coupling.J_gt @ N_sub, compute_uv=False).round(3))
law = ssm.SelectiveLaw(robot, protection, gain=0.05, rate_limit=np.deg2rad(5.0))
print(law(q, target))

# And the whole motion.
motion = ssm.simulate(law, q, target, duration=150.0, dt=0.1)
swing = np.rad2deg(np.ptp(motion.base_rpy.values, axis=0))
print(
    f"{motion.attrs['outcome']} at {motion.attrs['outcome_time']:.1f} s, "
    f"{1e3 * motion.attrs['final_error']:.2f} mm left"
)
print(f"roll, pitch, yaw, peak to peak: {swing.round(3)} deg")
print(f"largest |w_sub|: {float(np.abs(motion.protected_rate).max()):.1e} rad/s")
