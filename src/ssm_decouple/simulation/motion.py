"""The record of a motion: an `xarray.Dataset` that says what each number is and that survives a round trip to disk."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pinocchio as pin
import xarray as xr
from numpy.typing import NDArray

from ssm_decouple.control import kernel
from ssm_decouple.control.law import SelectiveLaw
from ssm_decouple.errors import FileError
from ssm_decouple.files import written_whole
from ssm_decouple.model.robot import Robot

Floats = NDArray[np.float64]

STALL_PROGRESS = 0.05  # of the error, within one time constant 1 / k_p, in which an unhindered law sheds 63 %


@dataclass(frozen=True)
class Outcome:
    """How a motion ended.

    Attributes:
        name: "converged" (the error stays within the tolerance), "stalled" (it stopped shrinking outside it) or
            "running" (neither, when the time was over).
        time: When it came within the tolerance for good, or when it stopped making progress, or the end, s.
        error: Distance to the target at the end, m.
    """

    name: Literal["converged", "stalled", "running"]
    time: float
    error: float


def judge(time: Floats, error: Floats, tolerance: float, time_constant: float) -> Outcome:
    """Say how a motion ended.

    A motion is stalled when, to its end, the error never again shrinks by STALL_PROGRESS within one time constant.

    Args:
        time: Sample times (m,), s.
        error: Distances to the target (m,), m.
        tolerance: Distance, m, within which the end-effector has arrived.
        time_constant: 1 / k_p, s.

    Returns:
        The outcome.
    """
    if error[-1] <= tolerance:
        outside = np.flatnonzero(error > tolerance)
        return Outcome("converged", float(time[outside[-1] + 1] if outside.size else time[0]), float(error[-1]))
    earlier = np.searchsorted(time, time - time_constant * (1 + 1e-9))
    complete = time - time[0] >= time_constant * (1 - 1e-9)
    shrinking = ~complete | (error <= (1 - STALL_PROGRESS) * error[np.minimum(earlier, np.arange(time.size))])
    if shrinking[-1]:
        return Outcome("running", float(time[-1]), float(error[-1]))
    first = int(np.flatnonzero(shrinking)[-1]) + 1
    return Outcome("stalled", float(time[earlier[first]]), float(error[-1]))


# name: (dimensions, unit, frame, meaning)
_VARIABLES: dict[str, tuple[tuple[str, ...], str, str, str]] = {
    "configuration": (("time", "q"), "m, 1, rad", "inertial", "Pinocchio configuration"),
    "joint_positions": (("time", "joint"), "rad or m", "joint", "joint positions, without jumps at +-pi"),
    "joint_rates": (("time", "joint"), "rad/s or m/s", "joint", "commanded joint rates"),
    "base_position": (("time", "axis"), "m", "inertial", "origin of the base frame"),
    "base_quaternion": (("time", "quaternion"), "1", "base to inertial", "base attitude, x y z w"),
    "base_rpy": (("time", "axis"), "rad", "base to inertial", "roll, pitch, yaw: R = Rz(yaw) Ry(pitch) Rx(roll)"),
    "base_linear_velocity": (("time", "axis"), "m/s", "base", "velocity of the base origin"),
    "base_angular_velocity": (("time", "axis"), "rad/s", "base", "angular velocity of the base"),
    "base_twist_integral": (("time", "twist"), "m, rad", "base", "integral of the base twist from the start"),
    "protected_rate": (
        ("time", "protected"),
        "rad/s, or m/s and rad/s",
        "U_c",
        "U_c^T (base twist) as the law sees it, at the sample or as mean over the hold; in a dynamic motion the truth",
    ),
    "protected_angle": (
        ("time", "protected"),
        "rad, or m and rad",
        "U_c",
        "integral of the true rate along the protected directions",
    ),
    "end_effector_position": (("time", "axis"), "m", "inertial", "end-effector"),
    "target_position": (("time", "axis"), "m", "inertial", "where the end-effector should be"),
    "end_effector_error": (("time",), "m", "", "distance from the end-effector to the target"),
    "smallest_singular_value": (("time",), "m", "", "smallest singular value of J_gt N_sub"),
    "rate_scale": (("time",), "1", "", "factor that brought the joint rates inside their limits"),
    "rate_blend": (("time",), "1", "", "share of the wanted change of rates that acceleration limits allowed"),
    "plan_change": (("time",), "1", "", "relative change in the last pass of planning for the hold; settled at 1e-13"),
    "damping": (("time",), "m2", "", "regularising scalar rho, 0 away from singularities"),
    "linear_momentum": (("time", "axis"), "kg m/s", "inertial", "audit: linear momentum of (q, v)"),
    "angular_momentum": (("time", "axis"), "kg m2/s", "inertial", "audit: angular momentum about the centre of mass"),
    "centre_of_mass": (
        ("time", "axis"),
        "m",
        "inertial",
        "audit: centre of mass of the whole; if all is right at rest, or as the linear momentum moves it",
    ),
    "U_c": (
        ("twist", "protected"),
        "1",
        "",
        "protected directions of the base twist, columns, in the axes that the law's settings name",
    ),
    "robot_urdf": ((), "", "", "the robot, so that the motion can be drawn anywhere"),
}


_WHEEL_MOMENTUM = {"units": "N m s", "frame": "base", "long_name": "momentum of each wheel about its axis"}
_SHARE = {"units": "1", "frame": "", "long_name": "how far each direction is protected: 0 not, 1 fully"}
_OF_LIMITS = {
    "acceleration_excess": {
        "units": "1",
        "frame": "",
        "long_name": "how far acceleration limits are exceeded, of them",
    },
    "active_limits": {"units": "1", "frame": "", "long_name": "joints that stand at a bound of their rates"},
}
_TASK_ERROR = {"units": "m or rad", "frame": "as the task says", "long_name": "error of each task row"}


def rotations_to(robot: Robot | None, frame: str, configurations: Floats) -> Floats | None:
    """Return the rotations from base axes to those in which directions are fixed (m, 3, 3); None where they are base.

    Args:
        robot: The robot, needed where the frame is one of its own.
        frame: "base", "inertial" or a frame of the robot.
        configurations: (m, nq).
    """
    from scipy.spatial.transform import Rotation

    if frame == "base":
        return None
    if frame == "inertial":
        return Rotation.from_quat(np.ascontiguousarray(configurations[:, 3:7])).as_matrix()
    assert robot is not None
    held, data = robot.model.frames[robot.frame_id(frame)], robot.model.createData()
    turned = np.empty((len(configurations), 3, 3))
    for i, q in enumerate(configurations):
        pin.forwardKinematics(robot.model, data, q)
        axes = data.oMi[held.parentJoint].rotation @ held.placement.rotation
        turned[i] = axes.T @ data.oMi[1].rotation
    return turned


def protected_integral(
    U_twist: Floats, frame: str, twists: Floats, configurations: Floats, robot: Robot | None = None
) -> Floats:
    """Return how far the base has moved along directions of its twist since the start (m, k), m and rad.

    Along directions fixed in base axes this is the integral of the twist's components. Along directions fixed in
    inertial axes the linear part is the displacement of the base origin, and for the angular part the rotations from
    sample to sample are summed, which is its integral to second order in the time between samples. So is the integral
    along directions fixed in another frame.

    Args:
        U_twist: Directions of the base twist, columns (6, k).
        frame: "base", "inertial" or a frame of the robot.
        twists: Integral of the base twist, base axes (m, 6), m and rad.
        configurations: Configurations (m, nq), of which the base poses are read.
        robot: The robot, needed where the frame is one of its own.
    """
    from scipy.spatial.transform import Rotation

    if frame == "base" or len(twists) == 1:
        return twists @ U_twist
    if frame == "inertial":
        attitude = Rotation.from_quat(np.ascontiguousarray(configurations[:, 3:7]))
        turns = np.zeros((len(twists), 3))
        turns[1:] = np.cumsum((attitude[1:] * attitude[:-1].inv()).as_rotvec(), axis=0)
        return np.hstack([configurations[:, :3] - configurations[0, :3], turns]) @ U_twist
    turned = rotations_to(robot, frame, configurations)
    assert turned is not None
    between = 0.5 * (turned[1:] + turned[:-1])
    steps = np.diff(twists, axis=0).reshape(-1, 2, 3)
    moved = np.zeros_like(twists)
    moved[1:] = np.cumsum(np.einsum("mij,mbj->mbi", between, steps).reshape(-1, 6), axis=0)
    return moved @ U_twist


def twist_along(
    U_twist: Floats, frame: str, twists: Floats, configurations: Floats, robot: Robot | None = None
) -> Floats:
    """Return the components of base twists along directions (m, k), m/s and rad/s.

    Args:
        U_twist: Directions of the base twist, columns (6, k).
        frame: "base", "inertial" or a frame of the robot.
        twists: Base twists in base axes (m, 6).
        configurations: Configurations (m, nq).
        robot: The robot, needed where the frame is one of its own.
    """
    turned = rotations_to(robot, frame, configurations)
    if turned is not None:
        twists = np.einsum("mij,mbj->mbi", turned, twists.reshape(-1, 2, 3)).reshape(-1, 6)
    return twists @ U_twist


def record_bytes(law: SelectiveLaw, dynamic: bool = False) -> int:
    """Return about how much memory a sample of a motion takes, and what the plant of a dynamic one tells beside it."""
    nq, n, k = law.robot.model.nq, law.robot.n_joints, law.directions[0].shape[1]
    numbers = law.size + 3 * nq + 2 * n + 2 * k + 30
    if dynamic:  # twice, as they come one by one, in arrays of some hundred bytes each
        numbers += 2 * (nq + 3 * n + 3 * k + 30) + 80
    return 8 * numbers


def build_motion(
    law: SelectiveLaw,
    time: Floats,
    configurations: Floats,
    values: Floats,
    twists: Floats,
    targets: Floats,
    audited: tuple[Floats, Floats] | None = None,
) -> xr.Dataset:
    """Assemble the record of a motion from its samples.

    Args:
        law: The law that commanded it.
        time: Sample times (m,), s.
        configurations: Configurations (m, nq).
        values: The law's output arrays (m, law.size).
        twists: Integral of the base twist, base axes (m, 6), m and rad.
        targets: Flat targets (m, size): of one position, that position (m, 3), m, inertial axes.
        audited: Momenta (m, 6) and centres of mass (m, 3) for the audit; None is those of what the law commands.

    Returns:
        The motion; its variables are listed in the documentation of `simulate`.
    """
    from scipy.spatial.transform import Rotation

    robot, model = law.robot, law.robot.model
    n, m, (U_twist, axes) = robot.n_joints, time.size, law.directions
    k = U_twist.shape[1]
    results, layout = values[:, 6 + n :], law.layout
    shares = law.shares(time, configurations)
    errors = results[:, kernel.ERRORS : kernel.ERRORS + layout.size]
    nowhere = np.full((m, 3), np.nan)
    attitude = Rotation.from_quat(configurations[:, 3:7])
    momenta, centres = audited or _audit(model, configurations, values[:, : 6 + n])

    arrays = {
        "configuration": configurations,
        "joint_positions": _joint_positions(model, configurations),
        "joint_rates": values[:, 6 : 6 + n],
        "base_position": configurations[:, :3],
        "base_quaternion": configurations[:, 3:7],
        "base_rpy": attitude.as_euler("ZYX")[:, ::-1],
        "base_linear_velocity": values[:, :3],
        "base_angular_velocity": values[:, 3:6],
        "protected_rate": results[:, kernel.PROTECTED_RATE : kernel.PROTECTED_RATE + k]
        if shares is None
        else twist_along(U_twist, axes, values[:, :6], configurations, robot),
        "base_twist_integral": twists,
        "protected_angle": protected_integral(U_twist, axes, twists, configurations, robot),
        "end_effector_position": results[:, kernel.POSITION : kernel.POSITION + 3],
        "target_position": nowhere if layout.tool_target is None else targets[:, layout.tool_target],
        "end_effector_error": np.linalg.norm(
            nowhere if layout.tool_position is None else errors[:, layout.tool_position], axis=1
        ),
        "smallest_singular_value": results[:, kernel.ERRORS + layout.size],
        "rate_scale": results[:, kernel.RATE_SCALE],
        "rate_blend": results[:, kernel.RATE_BLEND],
        "plan_change": results[:, kernel.PLAN_CHANGE],
        "damping": results[:, kernel.ERRORS + layout.size + 1],
        "linear_momentum": momenta[:, :3],
        "angular_momentum": momenta[:, 3:],
        "centre_of_mass": centres,
        "U_c": U_twist,
        "robot_urdf": np.array(robot.urdf, dtype=object),
    }
    variables = {}
    for name, (dimensions, unit, frame, meaning) in _VARIABLES.items():
        attributes = {"units": unit, "frame": frame, "long_name": meaning}
        variables[name] = xr.Variable(dimensions, arrays[name], attributes, fastpath=True)
    coordinates = {
        "time": ("time", time, {"units": "s"}),
        "joint": list(robot.joint_names),
        "axis": ["x", "y", "z"],
        "twist": ["vx", "vy", "vz", "wx", "wy", "wz"],
        "protected": list(range(1, k + 1)),
        "quaternion": ["x", "y", "z", "w"],
    }
    if not layout.usual:
        variables["task_error"] = xr.Variable(("time", "task_row"), errors, _TASK_ERROR, fastpath=True)
        coordinates |= {"task_row": list(layout.row_names), "task_level": ("task_row", np.array(layout.row_levels))}
    if law.limits is not None:
        for name, row in (("acceleration_excess", kernel.EXCESS), ("active_limits", kernel.LIMITED)):
            variables[name] = xr.Variable(("time",), results[:, row], _OF_LIMITS[name], fastpath=True)
    if shares is not None:
        variables["protection_share"] = xr.Variable(("time", "protected"), shares, _SHARE, fastpath=True)
    attributes = _attributes(law)
    if robot.wheel_names:
        stored, spans = _wheels(law, time, values)
        variables["wheel_momentum"] = xr.Variable(("time", "wheel"), stored, _WHEEL_MOMENTUM, fastpath=True)
        coordinates["wheel"] = list(robot.wheel_names)
        attributes["saturated_wheels"] = json.dumps(spans)
    return xr.Dataset(variables, coordinates, attributes)


def _wheels(law: SelectiveLaw, time: Floats, values: Floats) -> tuple[Floats, dict[str, list[list[float]]]]:
    """Return the momentum about its axis of each wheel (m, wheels), and from when to when (s) each was at full speed.

    A command is held until the next sample, so a wheel leaves saturation at the first sample that slows it down.
    """
    robot, spans = law.robot, {}
    stored = np.empty((len(time), len(robot.wheel_names)))
    for i, name in enumerate(robot.wheel_names):
        joint = robot.model.joints[robot.model.getJointId(name)]
        axis, at = np.ravel(joint.createData().S)[3:], robot.joint_index(name)
        spin_inertia = axis @ robot.model.inertias[joint.id].inertia @ axis
        speed = values[:, 6 + at]
        stored[:, i] = spin_inertia * (speed + values[:, 3:6] @ axis)
        full = np.abs(speed) >= (1.0 - 1e-9) * law.rate_limits[at]
        if full.any():
            spans[name] = flagged_spans(time, full[:-1] if len(time) > 1 else full)
    return stored, spans


def flagged_spans(time: Floats, flags: NDArray[np.bool_]) -> list[list[float]]:
    """Return from when to when (s) the holds between samples (m - 1,) are flagged."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [[float(time[start]), float(time[end])] for start, end in edges.reshape(-1, 2)]


def error_of(motion: xr.Dataset) -> Floats:
    """Return how far a motion is from its target (m,): m, or of other tasks the norm of all errors of level 1."""
    if "task_error" not in motion:
        return motion.end_effector_error.values
    first = motion.task_error.values[:, motion.task_level.values == 1]
    return np.linalg.norm(first, axis=1)


def robot_of(motion: xr.Dataset) -> Robot:
    """Return the robot of a motion, as its record holds it."""
    return Robot(str(motion.robot_urdf.item()), name=motion.attrs["robot"], end_effector=motion.attrs["end_effector"])


def _audit(model: pin.Model, configurations: Floats, velocities: Floats) -> tuple[Floats, Floats]:
    momenta, centres = np.empty((len(configurations), 6)), np.empty((len(configurations), 3))
    data = model.createData()
    total, centre = data.hg, data.com[0]
    for i, (q, v) in enumerate(zip(configurations, velocities, strict=True)):
        pin.computeCentroidalMomentum(model, data, q, v)
        momenta[i], centres[i] = total.vector, centre
    return momenta, centres


def _joint_positions(model: pin.Model, configurations: Floats) -> Floats:
    positions = np.empty((configurations.shape[0], model.nv - 6))
    for i, joint in enumerate(model.joints[2:]):
        first = configurations[:, joint.idx_q]
        if joint.nq == 1:
            positions[:, i] = first
        else:  # a continuous joint holds cosine and sine
            positions[:, i] = np.unwrap(np.arctan2(configurations[:, joint.idx_q + 1], first))
    return positions


def _attributes(law: SelectiveLaw) -> dict[str, Any]:
    return {
        "robot": law.robot.name,
        "end_effector": law.robot.end_effector,
        "law": json.dumps(law.describe()),
        "versions": json.dumps({name: metadata.version(name) for name in ("ssm-decouple", "pin", "numpy", "numba")}),
    }


def save_motion(motion: xr.Dataset, path: str | Path) -> Path:
    """Write a motion to a netCDF file, whole or not at all.

    Raises:
        FileError: the place cannot be written.
    """
    final = Path(path)
    with written_whole(final) as temporary:
        motion.to_netcdf(temporary, engine="h5netcdf")
    return final


def load_motion(path: str | Path) -> xr.Dataset:
    """Read a motion from a netCDF file.

    Raises:
        FileError: no such file, not netCDF, or not a motion of this package; what is missing is named.
    """
    if not Path(path).is_file():
        raise FileError(f"no motion at '{path}': not a file")
    try:
        with xr.open_dataset(path, engine="h5netcdf") as opened:
            motion = opened.load()
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FileError(f"'{path}' is not a netCDF file: {error}") from error
    missing = [name for name in _VARIABLES if name not in motion.variables]
    if missing:
        raise FileError(
            f"'{path}' is netCDF but not a motion: it lacks {', '.join(missing[:4])}{', ..' if missing[4:] else ''}"
        )
    for name, (dimensions, *_) in _VARIABLES.items():
        if motion[name].dims != dimensions:
            raise FileError(f"'{path}' is no motion: {name} has dimensions {motion[name].dims}, expected {dimensions}")
    return motion
