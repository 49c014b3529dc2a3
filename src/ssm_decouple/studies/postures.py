"""Between which positions random postures are drawn, and which protections are tried on them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ssm_decouple.errors import InputError
from ssm_decouple.model.robot import UNLIMITED, Robot, checked_robot

Floats = NDArray[np.float64]

PROTECTIONS = ("none", "roll", "pitch", "yaw", "roll+pitch", "roll+yaw", "pitch+yaw", "all")
MARGIN = (
    0.02  # m: of the smallest singular value, where the damping of a `SelectiveLaw` sets in if nothing else is said
)


def joint_ranges(robot: Robot) -> Floats:
    """Return between which positions each joint is drawn (n, 2), rad or m: its limits.

    A joint that turns and has no limits, or room for a whole turn, is drawn from -pi to pi: a turn more is the same
    posture.

    Raises:
        InputError: a joint that slides has no limits, or a joint's limits leave it no room; it is named.
    """
    ranges = checked_robot(robot).position_limits.copy()
    for i, name in enumerate(robot.joint_names):
        low, high = ranges[i]
        bounded = max(abs(low), abs(high)) < UNLIMITED
        if not robot.model.joints[i + 2].shortname().startswith("JointModelP"):
            if not bounded or high - low >= 2 * np.pi:
                ranges[i] = -np.pi, np.pi
        elif not bounded:
            raise InputError(
                f"joint '{name}' of '{robot.name}' slides without limits, so that there is no range to draw from; give "
                "it limits in the URDF, or fix it with robot.with_locked(..)"
            )
        if not ranges[i, 0] < ranges[i, 1]:
            raise InputError(
                f"joint '{name}' of '{robot.name}' has limits {low:g} to {high:g}, which leave it no room; widen them "
                "in the URDF, or fix it with robot.with_locked(..)"
            )
    return ranges
