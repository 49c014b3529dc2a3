"""What a motion has to tell beside its numbers: promises that were not kept, as attributes of the record and in words.

An attribute is there only where there is something to tell.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ssm_decouple.control import kernel
from ssm_decouple.control.law import SelectiveLaw, lost_to
from ssm_decouple.simulation.motion import flagged_spans

Floats = NDArray[np.float64]

# A rate reverses from sample to sample where three changes running alternate in sign, each above this share of the
# joint's largest rate so far: no smooth motion has that.
REVERSAL_SHARE = 0.05
NOTHING = 1e-6  # of the largest rate of any joint so far: less is rounding
REVERSALS = 10  # of a joint, from which on they are told
SETTLED = (
    1e-9  # relative change in the last pass of planning above which the mean over the hold is not what was planned
)
TORQUE_SHARE = 1.01  # of a motor's torque: an acceleration limit of the wheel leaves out what the base's own takes

EXCEEDED = 1e-9  # of an acceleration limit: less beyond it is rounding


def reversals(joint_rates: Floats) -> NDArray[np.bool_]:
    """Say at which samples which joint's rate reverses once more: there, back and there again in three steps (m, n).

    Args:
        joint_rates: Commanded rates (m, n), rad/s or m/s.
    """
    found = np.zeros(joint_rates.shape, dtype=bool)
    changes, peaks = np.diff(joint_rates, axis=0), np.maximum.accumulate(np.abs(joint_rates))[1:]
    large = np.abs(changes) > np.maximum(REVERSAL_SHARE * peaks, NOTHING * peaks.max(axis=1, keepdims=True))
    turns = large[1:] & large[:-1] & (changes[1:] * changes[:-1] < 0.0)
    found[3:] = turns[1:] & turns[:-1]
    return found


def accelerations(time: Floats, joint_rates: Floats) -> Floats:
    """Return the acceleration (m, n), rad/s2 or m/s2, of each commanded change of rates, the first one from rest.

    Args:
        time: Sample times (m,), s.
        joint_rates: Commanded rates (m, n), rad/s or m/s.
    """
    return np.diff(joint_rates, axis=0, prepend=0.0) / _holds(time)[:, None]


def wheel_torques(law: SelectiveLaw, time: Floats, start: Floats, stored: Floats) -> Floats:
    """Return the torque (m, wheels), N m, that would bring each wheel's momentum to that of a sample within its hold.

    Args:
        law: The law that commanded the motion.
        time: Sample times (m,), s.
        start: Configuration at the start (nq,), where the joints are at rest.
        stored: Momentum of each wheel about its axis at the samples (m, wheels), N m s.
    """
    robot = law.robot
    turning = law.base_twist(start, np.zeros(robot.n_joints))[3:]
    axes = [np.ravel(robot.model.joints[robot.model.getJointId(name)].createData().S)[3:] for name in robot.wheel_names]
    before = robot.wheel_inertias * (np.array(axes) @ turning)
    return np.diff(np.vstack([before, stored]), axis=0) / _holds(time)[:, None]


def tell(motion: xr.Dataset, law: SelectiveLaw, values: Floats, start: Floats, dynamic: bool) -> dict[str, str]:
    """Return the attributes of a motion that say which promises were not kept; JSON each.

    Args:
        motion: The record.
        law: The law that commanded it.
        values: The law's output arrays (m, law.size).
        start: Configuration at the start (nq,).
        dynamic: Whether drives made it, whose own torques the record has.
    """
    time, results = motion.time.values, values[:, 6 + law.robot.n_joints :]
    told: dict[str, Any] = {}
    lost = results[:, kernel.LOST]
    if lost.any():
        codes = results[lost > 0.0, kernel.LOST_TO].astype(int)
        told["protection_lost"] = {
            "largest_rate": float(lost.max()),
            "at": float(time[lost.argmax()]),
            "spans": _spans(time, lost > 0.0),
            "why": list(lost_to(float(np.bitwise_or.reduce(codes)))),
            "momentum": law.momentum.tolist(),
        }
    change = results[:, kernel.PLAN_CHANGE]
    if change.max() > SETTLED and motion.sizes["protected"]:
        told["plan_unsettled"] = {"largest_change": float(change.max()), "spans": _spans(time, change > SETTLED)}
    turned = reversals(motion.joint_rates.values)
    counts = turned.sum(axis=0)
    if counts.max() >= REVERSALS:
        where = np.flatnonzero(turned[:, counts >= REVERSALS].any(axis=1))
        told["rate_reversals"] = {
            "joints": {name: int(count) for name, count in zip(law.robot.joint_names, counts, strict=True) if count},
            "spans": [[float(time[where[0]]), float(time[where[-1]])]],
        }
    if law.acceleration_limits is not None:
        exceeded = _exceeded(time, motion.joint_rates.values, law.acceleration_limits, law.robot.joint_names)
        if exceeded:
            told["acceleration_exceeded"] = exceeded
    if law.robot.wheel_names and not dynamic:
        needed = wheel_torques(law, time, start, motion.wheel_momentum.values)
        limits = law.robot.wheel_torques
        beyond = np.abs(needed) > TORQUE_SHARE * limits
        wheels = {
            name: {
                "needed": float(np.abs(needed[:, i]).max()),
                "limit": float(limits[i]),
                "spans": _spans(time, beyond[:, i]),
            }
            for i, name in enumerate(law.robot.wheel_names)
            if beyond[:, i].any()
        }
        if wheels:
            told["wheel_torque_exceeded"] = wheels
    return {name: json.dumps(value) for name, value in told.items()}


def sentences(motion: xr.Dataset) -> list[str]:
    """Return in words what `tell` has found, one sentence each; none of a motion that kept all."""
    found = {name: json.loads(motion.attrs[name]) for name in _WORDS if name in motion.attrs}
    return [_WORDS[name](told) for name, told in found.items()]


def _exceeded(time: Floats, joint_rates: Floats, limits: Floats, names: Sequence[str]) -> dict[str, Any]:
    """Return what is told of acceleration limits that the commanded rates exceed; nothing where they keep them."""
    found = np.abs(accelerations(time, joint_rates))
    rounding = 4 * kernel.EPS * np.abs(joint_rates).max(axis=1, keepdims=True) / _holds(time)[:, None]
    beyond = found > (1.0 + EXCEEDED) * limits + rounding
    if not beyond.any():
        return {}
    joints = {
        name: {"largest": float(found[:, i].max()), "limit": float(limits[i])}
        for i, name in enumerate(names)
        if beyond[:, i].any()
    }
    return {"joints": joints, "spans": _spans(time, beyond.any(axis=1))}


def _lost(told: dict[str, Any]) -> str:
    why = "; ".join(told["why"]) or "they could not be met"
    momentum = ", for the momentum on board" if any(told["momentum"]) else ""
    return (
        f"the protection is not kept {_listed(told['spans'])}: the protected rate is up to {told['largest_rate']:.2g} "
        f"rad/s off, at {told['at']:g} s; {why}{momentum}"
    )


def _unsettled(told: dict[str, Any]) -> str:
    return (
        f"the plan for the hold does not settle {_listed(told['spans'])}: the protected rate is zero over the hold to "
        f"{told['largest_change']:.2g} of what the joints do, not to rounding; take a shorter sample time"
    )


def _reversed(told: dict[str, Any]) -> str:
    name, count = max(told["joints"].items(), key=lambda item: item[1])
    others = f" and {len(told['joints']) - 1} other joints" if len(told["joints"]) > 1 else ""
    return (
        f"the commanded rates reverse from sample to sample {_listed(told['spans'])}: {name} {count} times{others}; a "
        "larger damping, a shorter sample time or an acceleration limit settles them"
    )


def _too_fast(told: dict[str, Any]) -> str:
    name, joint = max(told["joints"].items(), key=lambda item: item[1]["largest"] / item[1]["limit"])
    others = f", and {len(told['joints']) - 1} other joints theirs" if len(told["joints"]) > 1 else ""
    return (
        f"acceleration limits are exceeded {_listed(told['spans'])}, for what comes before them, such as the "
        f"protection: {name} takes {joint['largest']:.3g} of {joint['limit']:.3g} rad/s2 (or m/s2){others}; "
        "limits=Limits() brakes ahead, and lower rate limits need less"
    )


def _too_weak(told: dict[str, Any]) -> str:
    each = ", ".join(f"{name} {wheel['needed']:.3g} of {wheel['limit']:.3g} N m" for name, wheel in told.items())
    return (
        f"wheels need more torque than their motors have: {each}; give the law the sample_time and "
        "acceleration_limit=robot.acceleration_limits, or start smoothly"
    )


_WORDS = {
    "protection_lost": _lost,
    "plan_unsettled": _unsettled,
    "rate_reversals": _reversed,
    "acceleration_exceeded": _too_fast,
    "wheel_torque_exceeded": _too_weak,
}


def _holds(time: Floats) -> Floats:
    """Return for how long each sample's command is held (m,), s; the last as long as the one before it."""
    holds: Floats = np.diff(time, append=2 * time[-1] - time[-2]) if time.size > 1 else np.ones(1)
    return holds


def _listed(spans: list[list[float]]) -> str:
    told = ", ".join(f"from {start:g} to {end:g} s" for start, end in spans[:3])
    return told + (f" and {len(spans) - 3} times more" if len(spans) > 3 else "")


def _spans(time: Floats, flags: NDArray[np.bool_]) -> list[list[float]]:
    """Return from when to when (s) samples (m,) are flagged, each for the time that its command is held."""
    ends = np.append(time, time[-1])
    return flagged_spans(ends, flags)
