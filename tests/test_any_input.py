"""Any argument at any public door: the answer of plain numbers, or a refusal of ours, and never another error."""

from __future__ import annotations

import resource
import time
import warnings
from collections import Counter
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import ssm_decouple as ssm
from ssm_decouple.studies.comparison import summarise
from ssm_decouple.studies.pointing import pointing_error
from ssm_decouple.studies.postures import joint_ranges
from ssm_decouple.studies.robustness import Robustness, tolerances_at
from ssm_decouple.studies.targets import end_of_path, random_starts, random_targets
from ssm_decouple.studies.workspace import Grid, Workspace, arm_joints, interval, joint_slice

pytestmark = pytest.mark.usefixtures("scratch_folder")  # what a door writes under a strange name lands here


A = np.deg2rad([150.0, -20, -10, 5, 10, 20])
X = np.array([-1.8, -0.3, 1.2])


class Door(NamedTuple):
    """A public function or class, arguments that it takes, and what of its result is numbers."""

    call: Callable[..., Any]
    good: dict[str, Any]
    told: Callable[[Any], Any] = lambda result: result


@cache
def doors() -> dict[str, Door]:
    robot, flexible, case = ssm.load_robot("ets_vii"), ssm.load_robot("ets_vii_flexible"), ssm.load_case("case1")
    pose = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.2, 0.5), np.array([0.1, 0.2, 0.3]))
    q, yaw = robot.configuration(A, pose), ssm.Protection("yaw")
    law, coupling, batch = ssm.SelectiveLaw(robot, yaw), robot.coupling(q), ssm.batch.Batch(robot, threads=1)
    schedule = ssm.Schedule([(0, "none"), (1, "yaw")], hand_over=0.5)
    limited = ssm.SelectiveLaw(robot, yaw, sample_time=0.5, acceleration_limit=0.1, limits=ssm.Limits())
    held = ssm.SelectiveLaw(robot, yaw, sample_time=0.5, hold_nodes=2)
    poses = ssm.SelectiveLaw(robot, yaw, tasks=[ssm.PositionTask(), ssm.PostureTask(level=2)])
    waypoints, plant = ssm.Waypoints([0, 1, 2], [[0, 0, 0], [1, 1, 1], [2, 2, 2]]), ssm.Plant.of(flexible)
    tumbling = ssm.TumblingTarget(np.diag([1, 2, 2.5]), np.eye(3), [0, 0.02, 0.1], [0, 0, 0], grasp_point=[1, 0, 0])
    motion = ssm.simulate(law, q, X, 1.0, 0.5)
    A_g = np.array(pin.computeCentroidalMap(robot.model, robot.model.createData(), q))
    values, record = (lambda command: command.values.copy()), (lambda motion: motion.configuration.values)
    fields = lambda made: [getattr(made, name) for name in vars(made)]  # noqa: E731
    where = lambda placement: placement.homogeneous  # noqa: E731
    still = {"target_velocity": np.zeros(3), "previous_rates": np.zeros(6)}
    wing = {"mount": [0.0, 0, 0], "span_direction": [0.0, 1, 0], "normal": [0.0, 0, 1], "span": 2.0, "chord": 1.0}
    task = {"gain": 0.1, "weight": 1.0, "level": 1}
    rates = {"J_sub": coupling.J_rc[2:], "J_task": coupling.J_gt, "task_velocity": X, "protected_rate": np.zeros(1)}

    def evaluated(**given: Any) -> Any:
        law.evaluate(**given)
        return given["out"]

    return {
        "law": Door(law, {"q": q, "target": X, **still, "protected_rate": np.zeros(1), "pace": 1.0}, values),
        "law plain": Door(law, {"q": q, "target": X}, values),
        "law.evaluate": Door(evaluated, {"q": q, "target": X, **still, "out": np.zeros(law.size)}, np.copy),
        "law limited": Door(limited, {"q": q, "target": X, **still}, values),
        "law held": Door(held, {"q": q, "target": X, **still}, values),
        "law of tasks": Door(poses, {"q": q, "target": [X, A], "previous_rates": np.zeros(6)}, values),
        "law of a schedule": Door(
            ssm.ScheduledLaw(robot, schedule), {"q": q, "target": X, **still, "time": 1.2}, values
        ),
        "law.base_twist": Door(law.base_twist, {"q": q, "joint_rates": 0.1 * A}),
        "law.lost_direction": Door(law.lost_direction, {"q": q}, lambda lost: lost.direction),
        "law.check_start": Door(limited.check_start, {"q": q}),
        "SelectiveLaw": Door(
            ssm.SelectiveLaw,
            {
                "robot": robot,
                "protection": yaw,
                "gain": 0.05,
                "rate_limit": 0.1 * np.ones(6),
                "damping": 1e-4,
                "damping_threshold": 0.02,
                "sample_time": 0.5,
                "hold_nodes": 1,
                "acceleration_limit": 0.1,
                "tasks": ssm.PositionTask(),
                "joint_weights": np.ones(6),
                "momentum": np.zeros(6),
                "limits": None,
            },
            lambda law: law(q, X, previous_rates=np.zeros(6)).values,
        ),
        "ScheduledLaw": Door(ssm.ScheduledLaw, {"robot": robot, "schedule": schedule, "gain": 0.05}),
        "Schedule": Door(ssm.Schedule, {"protections": [(0, "none"), (1.0, "yaw")], "hand_over": 0.5}),
        "Protection": Door(ssm.Protection, {"axes": np.array([0.6, 0, 0.8]), "frame": "base"}, lambda p: p.U_c),
        "Protection.boresight": Door(ssm.Protection.boresight, {"direction": X}, lambda p: p.U_c),
        "Protection.from_modes": Door(ssm.Protection.from_modes, {"participation": np.ones(6)}, lambda p: p.U_c),
        "Protection.parse": Door(ssm.Protection.parse, {"text": "1,0,0@inertial"}, lambda p: p.U_c),
        "protection.J_sub": Door(yaw.J_sub, {"coupling": coupling}),
        "load_robot": Door(ssm.load_robot, {"source": "ets_vii", "end_effector": None}),
        "load_case": Door(ssm.load_case, {"source": "case1"}),
        "load_motion": Door(ssm.load_motion, {"path": "no_such.nc"}),
        "Robot": Door(ssm.Robot, {"urdf": robot.urdf, "name": "x", "end_effector": None, "appendages": ()}),
        "compose": Door(
            ssm.compose,
            {"bus": "ets_vii_bus", "arm": "ets_vii", "mount": X, "mount_link": None, "prefix": "a_", "name": "x"},
            lambda made: made.coupling(made.configuration(A)).J_rc,
        ),
        "with_payload": Door(
            robot.with_payload,
            {"mass": 5.0, "centre_of_mass": 0.1 * X, "inertia": np.eye(3), "frame": None},
            lambda made: made.coupling(made.configuration(A)).J_rc,
        ),
        "with_wheels": Door(robot.with_wheels, {"wheels": ssm.Wheel("w", [0, 0, 1], 0.1, 600.0, 0.2)}),
        "with_locked": Door(robot.with_locked, {"joints": {"joint_1": 0.3}}),
        "with_appendages": Door(robot.with_appendages, {"appendages": ()}),
        "configuration": Door(robot.configuration, {"joints": A, "base_pose": pose.homogeneous}),
        "joint_index": Door(robot.joint_index, {"name": "joint_1"}),
        "frame_id": Door(robot.frame_id, {"name": "link_3"}),
        "joint_positions": Door(robot.joint_positions, {"q": q}),
        "base_pose": Door(robot.base_pose, {"q": q}, where),
        "frame_pose": Door(robot.frame_pose, {"q": q, "frame": "link_3"}, where),
        "shoulder_position": Door(robot.shoulder_position, {"q": q}),
        "coupling": Door(robot.coupling, {"q": q}, lambda found: found.J_g),
        "momentum": Door(robot.momentum, {"q": q, "v": np.arange(12.0)}),
        "modes": Door(flexible.modes, {"per_appendage": 1}, lambda modes: modes.participation),
        "report": Door(ssm.Report.of_robot, {"robot": robot}),
        "Coupling.at": Door(ssm.Coupling.at, {"robot": robot, "q": q}, lambda found: found.J_g),
        "coupling.base_twist": Door(coupling.base_twist, {"joint_rates": A}),
        "coupling.manipulability": Door(
            coupling.manipulability, {"protection": yaw, "characteristic_length": 1.0}, lambda found: found.semi_axes
        ),
        "coupling.coupling_factor": Door(coupling.coupling_factor, {"protection": yaw}),
        "coupling.dynamic_singularity_margin": Door(coupling.dynamic_singularity_margin, {"protection": yaw}),
        "coupling.protected_share": Door(coupling.protected_share, {"protection": yaw, "joint_rates": A}),
        "coupling.rotation_of": Door(coupling.rotation_of, {"frame": "link_3"}),
        "Ellipsoid.of": Door(ssm.Ellipsoid.of, {"matrix": coupling.J_gt}, lambda found: found.semi_axes),
        "PositionTask": Door(ssm.PositionTask, {"frame": None, **task}, fields),
        "RelativePoseTask": Door(ssm.RelativePoseTask, {"frame": "link_3", "reference": "bus", **task}, fields),
        "BoresightTask": Door(ssm.BoresightTask, {"direction": X, "frame": None, **task}, fields),
        "PostureTask": Door(ssm.PostureTask, {"joints": ("joint_1",), **task}, fields),
        "Limits": Door(ssm.Limits, {"position": np.outer(np.ones(6), [-3.0, 3]), "braking": 0.8}, fields),
        "Clearance": Door(ssm.Clearance, {"distance": 0.05, "horizon": 1.0, "pairs": None, "ignored": ()}, fields),
        "Wheel": Door(
            ssm.Wheel,
            {"name": "w", "axis": X, "spin_inertia": 0.1, "max_speed": 600.0, "max_torque": 0.2, "position": X},
            fields,
        ),
        "Appendage": Door(
            ssm.Appendage,
            {"name": "w", **wing, "mass": 5.0, "frequency": 0.2, "damping_ratio": 0.005, "segments": 2, "turn": 0.5},
            lambda wing: [wing.stiffness, wing.coupling, wing.turned_normal],
        ),
        "plant.configuration": Door(plant.configuration, {"q_rigid": flexible.configuration(A)}),
        "plant.tip_deflections": Door(plant.tip_deflections, {"hinge_angles": np.full(plant.hinges.size, 0.1)}),
        "Tolerances": Door(ssm.Tolerances, {"mass": 0.1, "inertia": 0.1, "centre_of_mass": 0.1}, fields),
        "perturbed": Door(
            ssm.perturbed, {"robot": robot, "tolerances": ssm.Tolerances(0.1), "seed": 1}, lambda made: made.mass
        ),
        "Servo": Door(
            ssm.Servo,
            {"frequency": 2.0, "damping_ratio": 1.0, "period": 0.01, "torque_limits": np.ones(6), "protects": False},
            fields,
        ),
        "Sensors": Door(ssm.Sensors, {"encoder_noise": 1e-4, "gyro_noise": 1e-5, "seed": 1}, fields),
        "Load": Door(ssm.Load, {"torque": X, "force": X, "start": 1.0, "duration": 2.0}, fields),
        "Dynamic": Door(ssm.Dynamic, {"step": 0.01, "servo": None, "sensors": None, "feedback_gain": 0.5}, fields),
        "Waypoints": Door(
            ssm.Waypoints, {"times": [0.0, 1, 3], "waypoints": np.outer([0.0, 1, 2], X)}, lambda w: w(0.7)
        ),
        "waypoints": Door(waypoints, {"time": 0.7}),
        "TumblingTarget": Door(
            ssm.TumblingTarget,
            {
                "inertia": np.diag([1, 2, 2.5]),
                "attitude": np.eye(3),
                "angular_velocity": 0.1 * X,
                "position": X,
                "velocity": X,
                "grasp_point": X,
            },
            lambda made: made.angular_momentum,
        ),
        "tumbling target": Door(tumbling, {"time": 0.7}),
        "simulate": Door(
            ssm.simulate,
            {
                "law": law,
                "q": q,
                "target": X,
                "duration": 1.0,
                "dt": 0.5,
                "method": "held",
                "arrival_tolerance": 0.01,
                "stop_early": False,
                "progress": None,
                "smooth_start": 0.5,
                "protected_rate": np.zeros(1),
            },
            record,
        ),
        "Case": Door(
            ssm.Case,
            {
                "name": "x",
                "title": "x",
                "robot_source": "ets_vii",
                "end_effector": None,
                "joints": A,
                "base_position": X,
                "base_rpy": 0.1 * X,
                "target": X,
                "protection": yaw,
                "law": {},
                "duration": 1.0,
                "dt": 0.5,
                "simulation": {},
                "turned": {},
            },
            lambda made: [made.joints, made.base_position, made.base_rpy, made.duration],
        ),
        "case.make_law": Door(case.make_law, {"protection": yaw, "dt": 0.5}),
        "compare": Door(ssm.compare, {"case": None, "dt": 0.5}),
        "summarise": Door(summarise, {"motion": motion, "law": "x"}),
        "Batch": Door(ssm.batch.Batch, {"robot": robot, "end_effector": None, "threads": 1}),
        "batch.matrices": Door(
            batch.matrices, {"joints": A[None], "protections": ["yaw"], "progress": None}, lambda found: found.values
        ),
        "batch.singular_values": Door(batch.singular_values, {"joints": A[None], "protections": ["yaw"]}),
        "batch.coupling_factors": Door(batch.coupling_factors, {"joints": A[None], "protections": ["yaw"]}),
        "batch.step": Door(batch.step, {"law": law, "configurations": q[None], "targets": X[None]}, values),
        "batch.motions": Door(
            batch.motions,
            {"law": law, "starts": q[None], "targets": X[None], "duration": 1.0, "dt": 0.5, "arrival_tolerance": 0.01},
            lambda motions: motions.configuration,
        ),
        "selective_rates": Door(
            ssm.selective_rates,
            {
                **rates,
                "rate_limits": np.ones(6),
                "joint_weights": np.ones(6),
                "damping": 1e-4,
                "damping_threshold": 0.02,
            },
        ),
        "base_twist_map": Door(ssm.base_twist_map, {"A_g": A_g}),
        "random_starts": Door(random_starts, {"robot": robot, "count": 2, "seed": 0}),
        "random_targets": Door(
            random_targets, {"robot": robot, "starts": q, "count": 2}, lambda found: found.positions
        ),
        "end_of_path": Door(end_of_path, {"robot": robot, "configurations": q[None], "goals": 2 * A[None]}),
        "joint_slice": Door(
            joint_slice,
            {"robot": robot, "posture": A, "joints": ("joint_1", "joint_2"), "points": 3},
            lambda s: s.sigma,
        ),
        "Workspace": Door(Workspace, {"robot": robot, "margin": 0.02, "samples": 16, "voxel": 0.5, "seed": 0}),
        "Grid.about": Door(Grid.about, {"robot": robot, "edge": 0.5}, lambda grid: grid.corner),
        "arm_joints": Door(arm_joints, {"robot": robot}),
        "joint_ranges": Door(joint_ranges, {"robot": robot}),
        "interval": Door(interval, {"shares": np.array([0.5, 0.625]), "samples": 16}),
        "Robustness": Door(Robustness, {"case": case, "levels": (0.01,), "runs": 1, "feedback_gain": 1.0, "seed": 0}),
        "tolerances_at": Door(tolerances_at, {"level": 0.25}, fields),
        "pointing_error": Door(pointing_error, {"motion": motion, "boresight": X}),
    }


class ArrayLike:
    """What some other library's array is to NumPy."""

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        return self.values


def unaligned(x: np.ndarray) -> np.ndarray:
    room = np.zeros(x.nbytes + 1, dtype=np.uint8)[1:].view(np.float64).reshape(x.shape)
    room[...] = x
    return room


def strided(x: np.ndarray) -> np.ndarray:
    room = np.full((*x.shape[:-1], 3 * x.shape[-1]), np.nan) if x.ndim else np.full(3, np.nan)
    view = room[..., ::3] if x.ndim else room[1:2].reshape(())
    view[...] = x
    return view


def read_only(x: np.ndarray) -> np.ndarray:
    x = np.array(x)
    x.flags.writeable = False
    return x


# Another shape of numbers, and the plain numbers that it stands for; None where it has to be refused.
SHAPES: dict[str, tuple[Callable[[np.ndarray], Any], Callable[[np.ndarray], Any] | None]] = {
    "other byte order": (lambda x: x.astype(">f8"), lambda x: x),
    "float32": (lambda x: x.astype(np.float32), lambda x: x.astype(np.float32).astype(float)),
    "float16, other byte order": (lambda x: x.astype(">f2"), lambda x: x.astype(np.float16).astype(float)),
    "long double": (lambda x: x.astype(np.longdouble), lambda x: x),
    "integers": (lambda x: np.rint(x).astype(np.int64), np.rint),
    "small integers, other byte order": (lambda x: np.rint(x).astype(">i2"), np.rint),
    "objects": (lambda x: x.astype(object), lambda x: x),
    "list": (lambda x: x.tolist(), lambda x: x),
    "tuple": (lambda x: tuple(x.tolist()) if x.ndim else float(x), lambda x: x),
    "strided": (strided, lambda x: x),
    "backwards": (lambda x: x[::-1].copy()[::-1] if x.ndim else x, lambda x: x),
    "by columns": (np.asfortranarray, lambda x: x),
    "unaligned": (unaligned, lambda x: x),
    "read-only": (read_only, lambda x: x),
    "array of another library": (ArrayLike, lambda x: x),
    "xarray": (xr.DataArray, lambda x: x),
    "masked, nothing hidden": (np.ma.array, lambda x: x),
    "a subclass": (lambda x: x.view(type("Sub", (np.ndarray,), {})), lambda x: x),
    "masked": (lambda x: np.ma.array(x, mask=np.arange(x.size).reshape(x.shape) == 0), None),
    "list of masked": (lambda x: [np.ma.array(x, mask=True)], None),
    "complex": (lambda x: x + 0j, None),
    "text": (lambda x: x.astype(str), None),
    "one text": (str, None),
    "truth values": (lambda x: x.astype(bool), None),
    "list of truth values": (lambda x: x.astype(bool).tolist(), None),
    "times": (lambda x: np.rint(x).astype("timedelta64[s]"), None),
    "not finite": (lambda x: np.where(np.arange(x.size).reshape(x.shape) == 0, np.nan, x), None),
    "one axis more": (lambda x: x.reshape(1, *x.shape, 1, 1), None),
    "records": (lambda x: np.zeros(x.shape, dtype=[("a", float)]), None),
}
WRITTEN = "out"


class Unspeakable:
    def __repr__(self) -> str:
        raise RuntimeError("no words")


class Unreadable:
    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        raise RuntimeError("not now")


STRANGERS: list[Any] = [
    None,
    True,
    False,
    0,
    -1,
    1,
    3,
    2.5,
    -0.5,
    1e308,
    5e-324,
    float("nan"),
    float("inf"),
    10**400,
    1j,
    b"x",
    "",
    "yaw",
    "case1",
    "ets_vii",
    "a\0b",
    "x" * 500,
    "yaw@",
    "1,0,0@@base",
    "/",
    "..",
    [],
    (),
    {},
    set(),
    [1],
    [1, 2, 3],
    [[1, 2], [3]],
    {"a": 1},
    {"joint_1": 150.0},
    {"joint_1": "x"},
    object(),
    int,
    ssm.PositionTask,
    ssm.PositionTask(),
    ssm.Protection,
    ssm.Robot,
    ssm.Protection("yaw"),
    np.zeros(0),
    np.zeros((2, 3, 4)),
    np.full(13, np.nan),
    np.array("x"),
    np.ma.masked,
    np.datetime64("2020-01-01"),
    np.bool_(True),
    np.float32(0.5),
    np.int64(2),
    np.void(b"abc"),
    np.eye(4) * 2,
    pin.SE3.Identity(),
    Unspeakable(),
    Unreadable(),
    ssm,
    range(3),
    slice(3),
    Exception("x"),
    [None],
    ["yaw", 5],
    [[0, "yaw"], [1, None]],
    [ssm.PositionTask],
    frozenset("a"),
    np.array(["a"]),
    [1, "2", 3],
    xr.Dataset(),
]


def numeric(value: Any) -> bool:
    """Say whether a good argument is numbers that may come in another shape."""
    if isinstance(value, bool):
        return False
    return isinstance(value, float) or (isinstance(value, np.ndarray) and value.dtype == np.float64)


def outcome(door: Door, arguments: dict[str, Any]) -> Any:
    """Return the numbers of a result, or the refusal."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return door.told(door.call(**arguments))
    except ssm.DecoupleError as error:
        return error


def same(one: Any, two: Any, near: float = 0.0) -> bool:
    if isinstance(one, np.ndarray | float | int | tuple | list) and not isinstance(one, str):
        try:
            first, second = np.asarray(one, dtype=float), np.asarray(two, dtype=float)
            return first.shape == second.shape and np.allclose(first, second, near, near, equal_nan=True)
        except (TypeError, ValueError):
            return len(one) == len(two) and all(same(a, b) for a, b in zip(one, two, strict=True))
    return type(one) is type(two)


def finite(found: Any) -> bool:
    try:
        return bool(np.all(np.isfinite(np.asarray(found, dtype=float))))
    except (TypeError, ValueError):
        return True


def check_shape(name: str, argument: str, shape: str, noise: float) -> str:
    door = doors()[name]
    plain = np.asarray(door.good[argument], dtype=float)
    vary = argument not in ("q", "configurations", "starts", "q_rigid", "attitude", "base_pose", "axes", "out")
    plain = plain * (1.0 + 0.2 * noise) if vary else plain
    given, stands_for = SHAPES[shape]
    found = outcome(door, {**door.good, argument: given(plain)})
    if isinstance(found, ssm.DecoupleError):
        return "refused"
    if argument == WRITTEN:
        assert shape in ("backwards", "by columns", "not finite"), f"{shape} was written into"
        return "equal"
    if shape == "not finite" and (argument == "previous_rates" or not finite(found)):
        return "not a number"  # a batch says so of its rows; a law without acceleration limits does not look
    assert stands_for is not None, f"{name}({argument}={shape}) was taken"
    near = 1e-12 if name == "law limited" else 0.0  # it tries the bounds of its last solution first
    expected = outcome(door, {**door.good, argument: np.array(stands_for(plain), dtype=float)})
    assert not isinstance(expected, ssm.DecoupleError), (shape, str(expected))
    assert same(expected, found, near), f"{name}({argument}={shape})"
    return "equal"


def check_stranger(name: str, argument: str, stranger: int) -> str:
    door = doors()[name]
    found = outcome(door, {**door.good, argument: STRANGERS[stranger]})
    return "refused" if isinstance(found, ssm.DecoupleError) else "taken"


PLACES = [(name, argument) for name, door in doors().items() for argument in door.good]
NUMBERS = [place for place in PLACES if numeric(doors()[place[0]].good[place[1]])]

shapes = st.tuples(st.sampled_from(NUMBERS), st.sampled_from(sorted(SHAPES)), st.floats(-1.0, 1.0))
strangers = st.tuples(st.sampled_from(PLACES), st.integers(0, len(STRANGERS) - 1))
QUIET = [HealthCheck.too_slow, HealthCheck.filter_too_much]


@settings(max_examples=400, suppress_health_check=QUIET)
@given(shapes)
def test_numbers_in_another_shape_give_the_plain_answer_or_are_refused(example):
    (name, argument), shape, noise = example
    check_shape(name, argument, shape, noise)


@settings(max_examples=400, suppress_health_check=QUIET)
@given(strangers)
def test_a_stranger_at_any_door_is_refused_by_us_or_taken(example):
    (name, argument), stranger = example
    check_stranger(name, argument, stranger)


@pytest.mark.slow
def test_ten_thousand_inputs():
    """Print what became of them; none takes 10 s or a gigabyte."""
    counts: Counter[str] = Counter()
    longest = 0.0
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    def timed(check: Callable[..., str], *example: Any) -> None:
        nonlocal longest
        start = time.perf_counter()
        counts[check(*example)] += 1
        longest = max(longest, time.perf_counter() - start)

    @settings(max_examples=6000, suppress_health_check=QUIET)
    @given(shapes)
    def in_another_shape(example: Any) -> None:
        (name, argument), shape, noise = example
        timed(check_shape, name, argument, shape, noise)

    @settings(max_examples=4000, suppress_health_check=QUIET)
    @given(strangers)
    def of_another_kind(example: Any) -> None:
        (name, argument), stranger = example
        timed(check_stranger, name, argument, stranger)

    in_another_shape()
    of_another_kind()
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 2**20
    print(f"{counts.total()} inputs: {dict(counts)}; the longest took {longest:.1f} s, memory grew by {grown:.2f} GB")
    assert counts.total() >= 10_000
    assert longest < 10.0
    assert grown < 1.0
