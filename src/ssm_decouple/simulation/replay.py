"""What a recorded motion has done along directions that its own law need not know."""

from __future__ import annotations

import json

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ssm_decouple.control.law import SelectiveLaw
from ssm_decouple.momentum.protection import Protection
from ssm_decouple.simulation.motion import robot_of, sum_along, twist_along
from ssm_decouple.simulation.steps import HOLDS, after_jump, between

Floats = NDArray[np.float64]


def rates_along(motion: xr.Dataset, U_twist: Floats, frame: str) -> Floats:
    """Return the base twist of a motion along directions (m, k), m/s and rad/s.

    It is what `protected_rate` is in the record of a law that protects them: at the samples, or, of a law with hold
    nodes, the mean over the hold on the nodes of that law; in a dynamic motion at the samples, always.

    Args:
        motion: Any motion.
        U_twist: Directions of the base twist, columns (6, k).
        frame: "base", "inertial" or a frame of the robot: the axes in which they are fixed.
    """
    configurations = motion.configuration.values
    if json.loads(motion.attrs["law"])["hold_nodes"] and motion.attrs["method"] != "dynamic":
        law, rates = _bystander(motion, frame), motion.joint_rates.values
        means = [law.mean_twist(q, each) for q, each in zip(configurations, rates, strict=True)]
        return np.array(means).reshape(-1, 6) @ U_twist
    robot = None if frame in ("base", "inertial") else robot_of(motion)
    return twist_along(U_twist, frame, _velocities(motion)[:, :6], configurations, robot)


def integral_along(motion: xr.Dataset, U_twist: Floats, frame: str) -> Floats:
    """Return how far the base of a motion has moved along directions since the start (m, k), m and rad.

    It is the integral of the true rate, along the motion that the method of simulation makes: exact to the order of
    that method. Of "rk4" and of a dynamic motion the record has the ends of each step, and the integral is of fourth
    order in the time between samples.

    Args:
        motion: Any motion.
        U_twist: Directions of the base twist, columns (6, k).
        frame: "base", "inertial" or a frame of the robot: the axes in which they are fixed.
    """
    configurations, base = motion.configuration.values, motion.base_twist_integral.values
    if frame == "base":
        return base @ U_twist
    law, velocities, hold = _bystander(motion, frame), _velocities(motion), HOLDS.get(motion.attrs["method"])
    rates, prescribed = motion.joint_rates.values, _rates_are_prescribed(motion)
    along = np.zeros_like(base)
    for i, h in enumerate(np.diff(motion.time.values).tolist()):
        moved, ends = base[i + 1] - base[i], velocities[i : i + 2]
        if hold is not None:
            moved = hold(law, configurations[i], velocities[i], h)[1][1]
        else:
            ends = after_jump(ends, rates[i], moved, h) if prescribed else ends
            moved = between(law, configurations[i : i + 2], ends, moved, h)
        along[i + 1] = along[i] + moved
    return sum_along(U_twist, frame, along, configurations)


def _velocities(motion: xr.Dataset) -> Floats:
    """Return Pinocchio's velocities (m, 6 + n) of the law's robot: in a dynamic motion the true ones."""
    rates = motion.joint_velocities if "joint_velocities" in motion else motion.joint_rates
    return np.hstack([motion.base_linear_velocity, motion.base_angular_velocity, rates])


def _rates_are_prescribed(motion: xr.Dataset) -> bool:
    return motion.attrs["method"] == "dynamic" and json.loads(motion.attrs["physics"])["servo"] is None


def _bystander(motion: xr.Dataset, frame: str) -> SelectiveLaw:
    """Return a law with the plan and the momentum of a motion's, and directions that are fixed in a frame."""
    told = json.loads(motion.attrs["law"])
    kept = {name: told[name] for name in ("momentum", "sample_time", "hold_nodes")}
    return SelectiveLaw(robot_of(motion), Protection("yaw", frame), rate_limit=np.inf, **kept)
