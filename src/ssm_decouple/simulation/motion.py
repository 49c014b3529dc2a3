"""The record of a motion: an `xarray.Dataset` that says what each number is and that survives a round trip to disk."""

from __future__ import annotations

import hashlib
import io
import json
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
import pinocchio as pin
import xarray as xr
from numpy.typing import NDArray

from ssm_decouple.control import kernel
from ssm_decouple.control.law import SelectiveLaw
from ssm_decouple.errors import DecoupleWarning, FileError, InputError, as_kind, as_path
from ssm_decouple.files import is_file, written_whole
from ssm_decouple.model.origin import from_base
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


def judge(
    time: Floats, error: Floats, tolerance: float, time_constant: float, target_way: Floats | None = None
) -> Outcome:
    """Say how a motion ended.

    A motion is stalled when, to its end, the error never again shrinks by STALL_PROGRESS within one time constant. What
    a moving target adds to it in that time, at most, has to be shed too: who follows at a distance is not stalled.

    Args:
        time: Sample times (m,), s.
        error: Distances to the target (m,), m.
        tolerance: Distance, m, within which the end-effector has arrived.
        time_constant: 1 / k_p, s.
        target_way: How far the target has moved since the start (m,), in the error's unit; None if it rests.

    Returns:
        The outcome.
    """
    if error[-1] <= tolerance:
        outside = np.flatnonzero(error > tolerance)
        return Outcome("converged", float(time[outside[-1] + 1] if outside.size else time[0]), float(error[-1]))
    earlier = np.searchsorted(time, time - time_constant * (1 + 1e-9))
    complete = time - time[0] >= time_constant * (1 - 1e-9)
    earlier = np.minimum(earlier, np.arange(time.size))
    before = error[earlier] if target_way is None else error[earlier] + (target_way - target_way[earlier])
    shrinking = ~complete | (error <= (1 - STALL_PROGRESS) * before)
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
    "base_rpy": (
        ("time", "axis"),
        "rad",
        "base to inertial",
        "roll, pitch, yaw: R = Rz(yaw) Ry(pitch) Rx(roll), without jumps at +-pi",
    ),
    "base_linear_velocity": (("time", "axis"), "m/s", "base", "velocity of the base origin"),
    "base_angular_velocity": (("time", "axis"), "rad/s", "base", "angular velocity of the base"),
    "base_twist_integral": (("time", "twist"), "m, rad", "base", "integral of the base twist from the start"),
    "protected_rate": (
        ("time", "protected"),
        "rad/s, or m/s and rad/s",
        "U_c",
        "U_c^T (base twist)",
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
    "smallest_singular_value": (
        ("time",),
        "m",
        "",
        "smallest singular value of J_gt N_sub, or of the rows of level 1, in joint weights, as the law sees it",
    ),
    "rate_scale": (("time",), "1", "", "factor that brought the joint rates inside their limits"),
    "rate_blend": (("time",), "1", "", "share of the wanted change of rates that acceleration limits allowed"),
    "plan_change": (("time",), "1", "", "relative change in the last pass of planning for the hold; settled at 1e-13"),
    "damping": (("time",), "m2", "", "regularising scalar rho of level 1, 0 away from singularities"),
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
    held, data = robot.model.frames[robot.frame_id(frame)], pin.Data(robot.model)
    turned = np.empty((len(configurations), 3, 3))
    for i, q in enumerate(configurations):
        pin.forwardKinematics(robot.model, data, q)
        axes = data.oMi[held.parentJoint].rotation @ held.placement.rotation
        turned[i] = axes.T @ data.oMi[1].rotation
    return turned


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


def sum_along(U_twist: Floats, frame: str, twists: Floats, configurations: Floats) -> Floats:
    """Return how far the base has moved along directions of its twist since the start (m, k), m and rad.

    Args:
        U_twist: Directions of the base twist, columns (6, k).
        frame: "base", "inertial" or a frame of the robot: the axes in which they are fixed.
        twists: Integral of the base twist in these axes (m, 6), m and rad.
        configurations: Configurations (m, nq). In inertial axes the base positions in them are that integral.
    """
    if frame == "inertial":
        twists = np.hstack([configurations[:, :3] - configurations[0, :3], twists[:, 3:]])
    return twists @ U_twist


def _protected_rates(law: SelectiveLaw, configurations: Floats, values: Floats, scheduled: bool) -> Floats:
    """Return the base twist along the law's directions (m, k), as the law plans: at the sample or over the hold."""
    n, (U_twist, axes) = law.robot.n_joints, law.directions
    if not scheduled:
        return values[:, 6 + n + kernel.PROTECTED_RATE :][:, : U_twist.shape[1]]
    if law.hold_nodes:  # a command tells them of the rows alone that are protected then
        means = [law.mean_twist(q, v[6:]) for q, v in zip(configurations, values[:, : 6 + n], strict=True)]
        return np.array(means).reshape(-1, 6) @ U_twist
    return twist_along(U_twist, axes, values[:, :6], configurations, law.robot)


def _told_of(law: SelectiveLaw) -> dict[str, dict[str, str]]:
    """Return what the attributes of a variable say of a motion under this law, by name."""
    held = "mean over the coming hold, as the law plans it" if law.hold_nodes else "at the sample, as commanded"
    told = {"protected_rate": {"long_name": f"U_c^T (base twist): {held}"}}
    if not law.layout.usual:
        told |= {name: {"units": "as the rows of level 1"} for name in ("smallest_singular_value", "damping")}
    return told


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
        twists: Integral of the base twist in base axes and in those of the law's directions (2, m, 6), m and rad.
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
        "joint_positions": joint_positions(model, configurations, np.diff(time)[:, None] * values[:-1, 6 : 6 + n]),
        "joint_rates": values[:, 6 : 6 + n],
        "base_position": configurations[:, :3],
        "base_quaternion": configurations[:, 3:7],
        "base_rpy": np.unwrap(attitude.as_euler("ZYX")[:, ::-1], axis=0),
        "base_linear_velocity": values[:, :3],
        "base_angular_velocity": values[:, 3:6],
        "protected_rate": _protected_rates(law, configurations, values, shares is not None),
        "base_twist_integral": twists[0],
        "protected_angle": sum_along(U_twist, axes, twists[1], configurations),
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
    told = _told_of(law)
    variables = {}
    for name, (dimensions, unit, frame, meaning) in _VARIABLES.items():
        attributes = {"units": unit, "frame": frame, "long_name": meaning} | told.get(name, {})
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
        stored = wheel_momenta(model, robot.wheel_names, values[:, : 6 + n])
        variables["wheel_momentum"] = xr.Variable(("time", "wheel"), stored, _WHEEL_MOMENTUM, fastpath=True)
        coordinates["wheel"] = list(robot.wheel_names)
        attributes["saturated_wheels"] = json.dumps(_full_wheels(law, time, values))
    return xr.Dataset(variables, coordinates, attributes)


def _full_wheels(law: SelectiveLaw, time: Floats, values: Floats) -> dict[str, list[list[float]]]:
    """Return from when to when (s) each wheel was commanded its full speed.

    A command is held until the next sample, so a wheel leaves saturation at the first sample that slows it down.
    """
    spans = {}
    for name in law.robot.wheel_names:
        at = law.robot.joint_index(name)
        full = np.abs(values[:, 6 + at]) >= (1.0 - 1e-9) * law.rate_limits[at]
        if full.any():
            spans[name] = flagged_spans(time, full[:-1] if len(time) > 1 else full)
    return spans


def wheel_momenta(model: pin.Model, names: Sequence[str], velocities: Floats) -> Floats:
    """Return the momentum about its axis of each wheel (m, wheels), N m s.

    Args:
        model: Pinocchio's, in which the wheels are joints of the base.
        names: Of the wheels.
        velocities: Pinocchio's velocities (m, nv).
    """
    stored = np.empty((len(velocities), len(names)))
    for i, name in enumerate(names):
        joint = model.joints[model.getJointId(name)]
        axis = np.ravel(joint.createData().S)[3:]
        spin_inertia = axis @ model.inertias[joint.id].inertia @ axis
        in_base = model.jointPlacements[joint.id].rotation @ axis
        stored[:, i] = spin_inertia * (velocities[:, joint.idx_v] + velocities[:, 3:6] @ in_base)
    return stored


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
    data = pin.Data(model)
    total, centre = data.hg, data.com[0]
    for i, (q, v) in enumerate(zip(configurations, velocities, strict=True)):
        near = from_base(q)
        pin.computeCentroidalMomentum(model, data, near, v)
        momenta[i], centres[i] = total.vector, centre
        if near is not q:
            centres[i] += q[:3]
    return momenta, centres


def joint_positions(model: pin.Model, configurations: Floats, moved: Floats) -> Floats:
    """Return joint positions (m, n); those of continuous joints, which hold cosine and sine, count on.

    Args:
        model: Pinocchio's.
        configurations: (m, nq).
        moved: About how far each joint goes from sample to sample (m - 1, n): a wheel may turn many times.
    """
    positions = np.empty((configurations.shape[0], model.nv - 6))
    for i, joint in enumerate(model.joints[2:]):
        first = configurations[:, joint.idx_q]
        if joint.nq == 1:
            positions[:, i] = first
        else:
            angles = np.arctan2(configurations[:, joint.idx_q + 1], first)
            turns = np.cumsum(np.rint((moved[:, i] - np.diff(angles)) / (2.0 * np.pi)))
            positions[:, i] = angles + 2.0 * np.pi * np.r_[0.0, turns]
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

    Its numbers carry HDF5's own checksums (fletcher32), which any reader heeds, and behind the end of the HDF5 file,
    where readers do not look, stands the SHA-256 of all its bytes, by which `load_motion` sees that it is as written.

    Raises:
        InputError: it is no dataset, or holds what netCDF cannot.
        FileError: the place cannot be written.
        InputError: it is no motion, or no path.
    """
    as_kind("motion", motion, xr.Dataset, "give what simulate(..) or load_motion(..) returns")
    final = as_path("path", path)
    content = _netcdf(motion)  # not written to the disk by HDF5, which does not survive that the disk is full
    with written_whole(final) as temporary:
        temporary.write_bytes(content + _SEAL + hashlib.sha256(content).hexdigest().encode() + b"\n")
    return final


def load_motion(path: str | Path) -> xr.Dataset:
    """Read a motion from a netCDF file.

    What `save_motion` has written is verified first. A file without its checksum, which another program or an earlier
    version has written, is read as HDF5 lets it, and a warning says so.

    Raises:
        FileError: no such file, not netCDF, damaged, or not a motion of this package; what is missing is named.
    """
    path = as_path("path", path)
    if not is_file(path):
        raise FileError(f"no motion at '{path}': not a file")
    try:
        verified = _verify(Path(path))
        with xr.open_dataset(path, engine="h5netcdf") as opened:
            motion = opened.load()
    except FileError:
        raise
    except Exception as error:  # HDF5 and its readers raise all kinds
        told = (isinstance(error, OSError) and error.strerror) or str(error)
        raise FileError(f"'{path}' is not a netCDF file: {told}") from error
    _refuse_other(motion, path)
    if not verified:
        warnings.warn(
            f"'{path}' has no checksum, so that damage to it may go unseen: save_motion writes one",
            DecoupleWarning,
            stacklevel=2,
        )
    return motion


_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_AGAIN = "compute the motion again, or take an undamaged copy of the file"
_SEAL = b"\nssm-decouple sha256 "  # between HDF5's end and the digest
_DIGEST = 64 + 1  # characters, with the line's end
_CHUNK = 2**17  # numbers that carry one checksum
_DEFLATED = 1032  # times smaller than itself is the most that HDF5's usual compression can make anything


def _netcdf(motion: xr.Dataset) -> bytes:
    """Return a motion as the bytes of a netCDF file."""
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    if not isinstance(motion, xr.Dataset):
        raise InputError(f"{type(motion).__name__} is no motion; give what simulate(..) or load_motion(..) returns")
    written, content = motion.copy(deep=False), io.BytesIO()
    for variable in written.variables.values():
        variable.encoding = _encoding(variable)
    try:
        with h5netcdf.File(content, "w") as file:
            written.dump_to_store(H5NetCDFStore(file))
    except (TypeError, ValueError, KeyError, AttributeError, RuntimeError, OSError) as error:
        raise InputError(f"the motion holds what netCDF cannot: {error}") from error
    return content.getvalue()


def _encoding(variable: xr.Variable) -> dict[str, Any]:
    """Say how a variable is written: numbers with checksums, which HDF5 has for chunks alone."""
    if variable.dtype.kind not in "fiub" or not variable.ndim or not variable.size:
        return {}
    rows, *others = variable.shape
    parts = -(-variable.size // _CHUNK)
    return {"fletcher32": True, "chunksizes": (-(-rows // parts), *others)}


def _verify(path: Path) -> bool:
    """Say whether a file has a checksum; refuse one whose bytes are not those that were written.

    HDF5's end stands at its beginning: what is behind it is a checksum, whole or damaged.
    """
    with path.open("rb") as file:
        size, head = os.fstat(file.fileno()).st_size, file.read(64)
        if not head.startswith(_SIGNATURE):
            raise FileError(f"'{path}' is not a netCDF file: it is {'empty' if not size else 'no HDF5 file'}")
        whole = max(0, size - len(_SEAL) - _DIGEST)
        file.seek(whole)
        seal = file.read()
        if seal.startswith(_SEAL):
            if _sha256(file, whole) != seal[len(_SEAL) : -1]:
                raise FileError(f"'{path}' is damaged: its bytes are not those that were written; {_AGAIN}")
            return True
        if _hdf5_end(head) not in (None, size):
            raise FileError(f"'{path}' is damaged: its end is not where it was written; {_AGAIN}")
    _refuse_absurd(path, size)
    return False


def _sha256(file: BinaryIO, size: int) -> bytes:
    """Return the digest, in hexadecimal, of so many bytes from the beginning of a file."""
    file.seek(0)
    found = hashlib.sha256()
    while size > 0 and (part := file.read(min(size, 2**20))):
        found.update(part)
        size -= len(part)
    return found.hexdigest().encode()


def _hdf5_end(head: bytes) -> int | None:
    """Return where HDF5's superblock says that the file ends; None where it is of a kind that is not known here."""
    version = head[8] if len(head) == 64 else None
    if version in (0, 1) and head[13] == 8:
        start = 40 + 4 * version
    elif version in (2, 3) and head[9] == 8:
        start = 28
    else:
        return None
    return int.from_bytes(head[start : start + 8], "little")


def _refuse_absurd(path: Path, size: int) -> None:
    """Refuse a file without a checksum that says that it holds more than its bytes can."""
    import h5py

    with h5py.File(path) as file:
        claimed: list[int] = []
        file.visititems(lambda _, item: claimed.append(item.nbytes if isinstance(item, h5py.Dataset) else 0))
    if sum(claimed) > _DEFLATED * size:
        held = f"{sum(claimed) / 1e9:.3g} GB in {size / 1e6:.3g} MB"
        raise FileError(f"'{path}' is damaged: it claims to hold {held}; {_AGAIN}")


def _refuse_other(motion: xr.Dataset, path: str | Path) -> None:
    """Refuse a netCDF file that is no motion."""
    missing = [name for name in _VARIABLES if name not in motion.variables]
    missing += [f"the attribute {name}" for name in ("robot", "end_effector", "law") if name not in motion.attrs]
    if missing:
        raise FileError(
            f"'{path}' is netCDF but not a motion: it lacks {', '.join(missing[:4])}{', ..' if missing[4:] else ''}"
        )
    for name, (dimensions, *_) in _VARIABLES.items():
        if motion[name].dims != dimensions:
            raise FileError(f"'{path}' is no motion: {name} has dimensions {motion[name].dims}, expected {dimensions}")
        if name != "robot_urdf" and motion[name].dtype.kind != "f":
            raise FileError(f"'{path}' is no motion: {name} is of {motion[name].dtype}, not of numbers")
