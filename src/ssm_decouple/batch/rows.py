"""The compiled motion of many robots at once, row by row: poses, steps and what is kept of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ssm_decouple.compiled import compiled, unlocked

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

# What is kept of a motion, a row each.
TRAVEL = 0  # integral of the joint rates' norm
PEAK = 1  # largest joint rate
LEAK = 2  # largest rate along a protected direction
SMALLEST = 3  # smallest singular value
LOWEST = 4  # 3: roll, pitch and yaw at their lowest
HIGHEST = 7  # 3: at their highest
LATEST = 10  # 3: as they are now, counted on beyond half a turn
REVERSALS = 13  # of the joint rate that reverses most often from sample to sample
RECORD_SIZE = 14

# What has to be known of the samples before to see that, one entry a joint.
BEFORE = 0  # the rate at the sample before; not a number at the first
CHANGE = 1  # its change, if that was large, else zero
TURN = 2  # 1.0 if that was against a large change before it
OWN_PEAK = 3  # largest rate of the joint so far
COUNT = 4  # reversals so far
TRAIL_SIZE = 5

REVERSAL_SHARE = 0.05  # as in simulation/telling.py
NOTHING = 1e-6  # likewise


@compiled
def turned(x: float, y: float, z: float, w: float, a: float, b: float, c: float) -> tuple[float, float, float]:
    """Return a vector (a, b, c) turned by a unit quaternion."""
    u, v, t = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return a + w * u + y * t - z * v, b + w * v + z * u - x * t, c + w * t + x * v - y * u


@compiled
def move_pose(pose: Floats, twist: Floats, time: float) -> None:
    """Move a pose (7,) by a twist (6,) in its own axes that is held for a time: the exponential map of SE(3)."""
    vx, vy, vz = time * twist[0], time * twist[1], time * twist[2]
    wx, wy, wz = time * twist[3], time * twist[4], time * twist[5]
    square = wx * wx + wy * wy + wz * wz
    angle = np.sqrt(square)
    half = 0.5 * angle
    if angle > 0.1:
        sinc = np.sin(half) / half
        second = (1.0 - np.sin(angle) / angle) / square
    else:
        quarter = half * half
        sinc = 1.0 - quarter / 6.0 * (1.0 - quarter / 20.0 * (1.0 - quarter / 42.0 * (1.0 - quarter / 72.0)))
        second = (1.0 - square / 20.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0))) / 6.0
    first = 0.5 * sinc * sinc
    ax, ay, az = wy * vz - wz * vy, wz * vx - wx * vz, wx * vy - wy * vx
    along = wx * vx + wy * vy + wz * vz
    # w x (w x v) = w (w v) - v |w|^2
    mx = vx + first * ax + second * (wx * along - vx * square)
    my = vy + first * ay + second * (wy * along - vy * square)
    mz = vz + first * az + second * (wz * along - vz * square)
    x, y, z, w = pose[3], pose[4], pose[5], pose[6]
    mx, my, mz = turned(x, y, z, w, mx, my, mz)
    pose[0], pose[1], pose[2] = pose[0] + mx, pose[1] + my, pose[2] + mz
    s, c = 0.5 * sinc, np.cos(half)
    a, b, d = s * wx, s * wy, s * wz
    x, y, z, w = (
        w * a + x * c + y * d - z * b,
        w * b + y * c + z * a - x * d,
        w * d + z * c + x * b - y * a,
        w * c - x * a - y * b - z * d,
    )
    # Of the two signs the one nearer to the quaternion before, as Pinocchio has it.
    size = (1.0 if c >= 0.0 else -1.0) / np.sqrt(x * x + y * y + z * z + w * w)
    pose[3], pose[4], pose[5], pose[6] = size * x, size * y, size * z, size * w


@compiled
def keep_attitude(pose: Floats, record: Floats) -> None:
    """Widen the ranges of roll, pitch and yaw, R = Rz(yaw) Ry(pitch) Rx(roll), to hold those of a pose.

    Each goes on from where it was before, so that half a turn is no jump.
    """
    x, y, z, w = pose[3], pose[4], pose[5], pose[6]
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(min(max(2.0 * (w * y - z * x), -1.0), 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    for i, within in enumerate((roll, pitch, yaw)):
        angle = within + 2.0 * np.pi * np.rint((record[LATEST + i] - within) / (2.0 * np.pi))
        record[LATEST + i] = angle
        record[LOWEST + i] = min(record[LOWEST + i], angle)
        record[HIGHEST + i] = max(record[HIGHEST + i], angle)


@compiled
def keep_reversals(rates: Floats, trail: Floats, record: Floats) -> None:
    """Count the joint rates (n,) that reverse: whose last three changes are large and alternate in sign."""
    for j in range(rates.shape[0]):
        change = rates[j] - trail[BEFORE, j]
        trail[OWN_PEAK, j] = max(trail[OWN_PEAK, j], abs(rates[j]))
        large = abs(change) > max(REVERSAL_SHARE * trail[OWN_PEAK, j], NOTHING * record[PEAK])
        turn = 1.0 if large and change * trail[CHANGE, j] < 0.0 else 0.0
        trail[COUNT, j] += turn * trail[TURN, j]
        trail[TURN, j] = turn
        trail[CHANGE, j] = change if large else 0.0
        trail[BEFORE, j] = rates[j]
        record[REVERSALS] = max(record[REVERSALS], trail[COUNT, j])


@unlocked
def see_targets(poses: Floats, targets: Floats, seen: Floats) -> None:
    """Fill the targets (rows, 3), inertial axes, as seen from the base poses (rows, 7)."""
    for row in range(poses.shape[0]):
        pose, target = poses[row], targets[row]
        a, b, c = target[0] - pose[0], target[1] - pose[1], target[2] - pose[2]
        seen[row, 0], seen[row, 1], seen[row, 2] = turned(-pose[3], -pose[4], -pose[5], pose[6], a, b, c)


@unlocked
def place_points(poses: Floats, points: Floats) -> None:
    """Bring points (rows, 3) from the axes of poses (rows, 7), position and x y z w, to inertial axes, in place."""
    for row in range(poses.shape[0]):
        pose, point = poses[row], points[row]
        a, b, c = turned(pose[3], pose[4], pose[5], pose[6], point[0], point[1], point[2])
        point[0], point[1], point[2] = pose[0] + a, pose[1] + b, pose[2] + c


@unlocked
def move_poses(poses: Floats, twists: Floats) -> None:
    """Move poses (rows, 7) by twists (rows, 6) in their own axes that are held for a second."""
    for row in range(poses.shape[0]):
        move_pose(poses[row], twists[row], 1.0)


@unlocked
def advance(
    commands: Floats,
    protected: int,
    k: int,
    smallest: int,
    errors: int,
    time: float,
    joints: Floats,
    poses: Floats,
    record: Floats,
    trail: Floats,
    history: Floats,
) -> None:
    """Keep what a sample tells of each motion, then hold its rates and its base twist for a time.

    Args:
        commands: What the law commands (rows, law.size).
        protected: Where the rates along the protected directions (k) stand in it.
        k: Number of these.
        smallest: Where the smallest singular value stands.
        errors: Where the error of the position (3) stands.
        time: For how long it is held, s; 0 at the last sample.
        joints: Joint positions (rows, n), moved.
        poses: Base poses (rows, 7), moved.
        record: (rows, RECORD_SIZE), brought up to date.
        trail: (rows, TRAIL_SIZE, n), likewise.
        history: The distance to the target at this sample (rows,), overwritten.
    """
    n = joints.shape[1]
    for row in range(joints.shape[0]):
        command, kept = commands[row], record[row]
        distance, square = 0.0, 0.0
        for r in range(3):
            distance += command[errors + r] ** 2
        history[row] = np.sqrt(distance)
        for j in range(n):
            rate = command[6 + j]
            square += rate * rate
            kept[PEAK] = max(kept[PEAK], abs(rate))
            joints[row, j] += time * rate
        for i in range(k):
            kept[LEAK] = max(kept[LEAK], abs(command[protected + i]))
        kept[TRAVEL] += time * np.sqrt(square)
        kept[SMALLEST] = min(kept[SMALLEST], command[smallest])
        keep_reversals(command[6 : 6 + n], trail[row], kept)
        keep_attitude(poses[row], kept)
        if time > 0.0:
            move_pose(poses[row], command, time)
