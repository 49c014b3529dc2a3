"""Follow a point on a satellite that tumbles at 2 deg/s, with yaw protected.

The position law with the target's velocity fed forward. What is left once the end-effector has caught up is the floor
of sampling: a velocity that is held for a sample time dt misses a dt / 2 of it on average, a the target's acceleration,
and the gain makes a dt / (2 gain) of distance of that. Rates that are right at the sample only miss some more. Planning
over the hold takes away the second; the target's mean velocity over the hold, instead of that at the sample, the first.
"""

from __future__ import annotations

import numpy as np

import ssm_decouple as ssm

GAIN, SAMPLE, CAUGHT_UP = 0.2, 0.1, 60.0  # 1/s, s, s

robot = ssm.load_robot("ets_vii")
q = robot.configuration(np.deg2rad([150, -20, -10, 0, 0, 0]))
axis = np.array([0.5, 0.5, 0.7])
target = ssm.TumblingTarget(
    inertia=np.diag([40.0, 60.0, 90.0]),
    attitude=np.eye(3),
    angular_velocity=np.deg2rad(2.0) * axis / np.linalg.norm(axis),
    position=[-2.1, 0.0, 1.8],
    grasp_point=[0.3, 0.1, 0.2],
)


def unaware(time: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the grasp point as if it stood still."""
    return target(time)[0], np.zeros(3)


def averaged(time: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the grasp point, and its mean velocity until the next sample."""
    position = target(time)[0]
    return position, (target(time + SAMPLE)[0] - position) / SAMPLE


times = np.arange(CAUGHT_UP, 240.0, SAMPLE)
speeds = np.array([target(time)[1] for time in times])
acceleration = np.linalg.norm(np.gradient(speeds, SAMPLE, axis=0), axis=1).max()
print(
    f"the grasp point moves at up to {1e3 * np.linalg.norm(speeds, axis=1).max():.1f} mm/s and "
    f"{1e3 * acceleration:.2f} mm/s2; a dt / (2 gain) = {1e3 * acceleration * SAMPLE / (2 * GAIN):.2f} mm"
)
for name, reference, nodes in (
    ("no feed-forward", unaware, 0),
    ("feed-forward", target, 0),
    ("feed-forward, planned over the hold", target, 2),
    ("mean feed-forward, planned over the hold", averaged, 2),
):
    law = ssm.SelectiveLaw(robot, ssm.Protection("yaw"), gain=GAIN, sample_time=SAMPLE, hold_nodes=nodes)
    motion = ssm.simulate(law, q, reference, duration=240.0, dt=SAMPLE, method="held")
    left = motion.end_effector_error.sel(time=slice(CAUGHT_UP, None))
    turned = np.rad2deg(float(abs(motion.protected_angle).max()))
    print(f"{name:<41} at most {1e3 * float(left.max()):7.3f} mm after {CAUGHT_UP:g} s, yaw axis {turned:.1e} deg")
