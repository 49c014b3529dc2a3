"""A case: which robot, from where, to where, protecting what, under which law. Read from TOML."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
import xarray as xr
from numpy.typing import NDArray

from ssm_decouple.control.law import SelectiveLaw
from ssm_decouple.control.schedule import Schedule, ScheduledLaw
from ssm_decouple.control.task import (
    BoresightTask,
    ManipulabilityTask,
    OrientationTask,
    PoseTask,
    PositionTask,
    PostureTask,
    RelativePoseTask,
    Task,
)
from ssm_decouple.errors import (
    DecoupleError,
    InputError,
    as_floats,
    as_kind,
    as_path,
    as_positive,
    as_text,
    as_triple,
    is_function,
    shown,
    unknown,
)
from ssm_decouple.files import is_file
from ssm_decouple.model.catalogue import load_robot, models
from ssm_decouple.model.robot import Robot
from ssm_decouple.momentum.protection import Protection, checked_protection
from ssm_decouple.settled import FixedArrays, fixed, fixed_array
from ssm_decouple.simulation.dynamic import Dynamic, Servo
from ssm_decouple.simulation.simulate import Progress, simulate
from ssm_decouple.simulation.steps import STEPS
from ssm_decouple.studies.schema import (
    AXES,
    JOINTS,
    LIST,
    NAMES,
    NUMBER,
    NUMBERS,
    PHASES,
    SWITCH,
    TEXT,
    TURNS,
    check_keys,
    read_toml,
)

if TYPE_CHECKING:
    from ssm_decouple.control.limits import Limits

Floats = NDArray[np.float64]

_FOLDER = Path(__file__).parent / "cases"

# What a case file may hold: table, key, what the value must be, and whether it has to be there.
_SCHEMA: dict[str, dict[str, tuple[str, bool]]] = {
    "": {"title": (TEXT, False), "robot": (TEXT, True), "end_effector": (TEXT, False)},
    "start": {
        "joints_deg": (JOINTS, False),
        "joints": (JOINTS, False),
        "base_position": (NUMBERS, False),
        "base_rpy_deg": (NUMBERS, False),
        "linear_momentum": (NUMBERS, False),
        "angular_momentum": (NUMBERS, False),
    },
    "target": {"position": (NUMBERS, False)},
    "protection": {
        "axes": (AXES, False),
        "frame": (TEXT, False),
        "phases": (PHASES, False),
        "hand_over": (NUMBER, False),
    },
    "law": {
        "gain": (NUMBER, False),
        "rate_limit_deg": (NUMBER, False),
        "rate_limit": (NUMBER, False),
        "damping": (NUMBER, False),
        "damping_threshold": (NUMBER, False),
        "hold_nodes": (NUMBER, False),
        "acceleration_limit_deg": (NUMBER, False),
        "acceleration_limit": (NUMBER, False),
        "joint_weights": (LIST, False),
    },
    "limits": {"braking": (NUMBER, False), "clearance": (NUMBER, False)},
    "simulation": {
        "duration": (NUMBER, True),
        "dt": (NUMBER, True),
        "method": (TEXT, False),
        "arrival_tolerance": (NUMBER, False),
        "smooth_start": (NUMBER, False),
    },
    "dynamic": {
        "step": (NUMBER, False),
        "drives": (TEXT, False),
        "servo_frequency": (NUMBER, False),
        "servo_damping_ratio": (NUMBER, False),
        "servo_period": (NUMBER, False),
        "servo_protects": (SWITCH, False),
        "feedback_gain": (NUMBER, False),
    },
    "spacecraft": {"turned_deg": (TURNS, False)},
}
DRIVES = ("torque", "prescribed")

# What a [[task]] of each kind takes beside kind, gain, weight and level; True where it has to be there.
_POSE = {"position": (NUMBERS, True), "rpy_deg": (NUMBERS, True)}
_FRAME = {"frame": (TEXT, False)}
_TASKS: dict[str, tuple[type[Task], dict[str, tuple[str, bool]]]] = {
    "position": (PositionTask, {**_FRAME, "position": (NUMBERS, True)}),
    "orientation": (OrientationTask, {**_FRAME, "rpy_deg": (NUMBERS, True)}),
    "pose": (PoseTask, {**_FRAME, **_POSE}),
    "relative_pose": (RelativePoseTask, {"frame": (TEXT, True), "reference": (TEXT, True), **_POSE}),
    "boresight": (BoresightTask, {**_FRAME, "direction": (NUMBERS, True), "toward": (NUMBERS, True)}),
    "posture": (PostureTask, {"joints": (NAMES, False), "positions": (LIST, False), "positions_deg": (LIST, False)}),
    "manipulability": (ManipulabilityTask, {}),
}
_ANY_TASK = {"kind": (TEXT, True), "gain": (NUMBER, False), "weight": (NUMBER, False), "level": (NUMBER, False)}


@dataclass(frozen=True)
class Case(FixedArrays):
    """One motion to simulate. Units are SI and radians. What it holds is read-only: `dataclasses.replace` changes it.

    Attributes:
        name: Short name, used for file names.
        title: One line for tables and figures.
        robot_source: Catalogue name or URDF path.
        end_effector: Frame that the task moves; None as in `load_robot`.
        joints: Start joint positions by joint name or in order, rad or m.
        base_position: Start position of the base origin (3,), m.
        base_rpy: Start roll, pitch, yaw of the base (3,), rad.
        target: Desired end-effector position (3,), m, inertial axes, or what the law's tasks take.
        protection: The case's own protection, or a schedule of several.
        law: Further arguments of `SelectiveLaw`: gain, rate_limit, damping, damping_threshold, hold_nodes,
            acceleration_limit, tasks, joint_weights, momentum, limits. The law's sample time is `dt`.
        duration: s.
        dt: Time between samples, s.
        simulation: Further arguments of `simulate`: method, arrival_tolerance, smooth_start.
        turned: What of the root link stands turned about its y axis, rad by name: visuals, which the figures show so,
            and appendages, which bend so.
    """

    name: str
    title: str
    robot_source: str
    end_effector: str | None
    joints: Floats | Mapping[str, float] | None
    base_position: tuple[float, ...]
    base_rpy: tuple[float, ...]
    target: Any
    protection: Protection | Schedule
    law: Mapping[str, Any] = field(default_factory=dict)
    duration: float = 150.0
    dt: float = 0.1
    simulation: Mapping[str, Any] = field(default_factory=dict)
    turned: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse what is no case, and keep copies that stay as they are.

        Raises:
            InputError: a setting of another kind; the message names it.
        """
        as_text("name of a case", self.name)
        as_path("robot of a case", self.robot_source)
        if not isinstance(self.protection, Schedule):
            checked_protection(self.protection)
        joints = self.joints
        if joints is not None:
            joints = fixed(joints) if isinstance(joints, Mapping) else fixed_array(as_floats("joints", joints))
            if isinstance(joints, np.ndarray) and (joints.ndim != 1 or not np.all(np.isfinite(joints))):
                raise InputError(f"joints is {shown(joints.tolist())}; it needs finite numbers, one a joint")
        kept: dict[str, Any] = {"joints": joints, "target": fixed(self.target)}
        if not (is_function(self.target) or (isinstance(self.law, Mapping) and self.law.get("tasks"))):
            kept["target"] = tuple(as_triple("target", self.target, "inertial axes").tolist())
        for name in ("base_position", "base_rpy"):
            kept[name] = tuple(as_triple(name, getattr(self, name)).tolist())
        for name in ("duration", "dt"):
            kept[name] = as_positive(name, getattr(self, name), "it must be a positive time, s")
        for name in ("law", "simulation", "turned"):
            mend = "give a table of settings by name"
            kept[name] = fixed(as_kind(name, getattr(self, name), Mapping, mend))  # type: ignore[type-abstract]
        for name, value in kept.items():
            object.__setattr__(self, name, value)

    @cached_property
    def robot(self) -> Robot:
        """The robot, loaded when first asked for, its appendages turned as the case has them."""
        robot = load_robot(self.robot_source, self.end_effector)
        if not self.turned:
            return robot
        known = {visual.get("name", "") for visual in ET.fromstring(robot.urdf).iter("visual")}
        known |= {appendage.name for appendage in robot.appendages}
        for name in self.turned:
            if name not in known:
                raise InputError(f"[spacecraft] turned_deg: {unknown('part', name, sorted(known - {''}))}")
        turned = []
        for appendage in robot.appendages:
            R = pin.rpy.rpyToMatrix(0.0, self.turned.get(appendage.name, 0.0), 0.0)
            directions = {name: R @ getattr(appendage, name) for name in ("span_direction", "normal")}
            turned.append(replace(appendage, **directions))
        return robot.with_appendages(turned) if turned else robot

    def start(self) -> Floats:
        """Return the start configuration (nq,)."""
        pose = pin.SE3(pin.rpy.rpyToMatrix(*self.base_rpy), np.array(self.base_position))
        return self.robot.configuration(self.joints, pose)

    def make_law(self, protection: Protection | Schedule | None = None, dt: float | None = None) -> SelectiveLaw:
        """Return the case's law, with another protection or time between samples than its own if one is given."""
        step = self.dt if dt is None else as_positive("dt", dt, "it must be a positive time, s")
        planned = bool(self.law.keys() & {"hold_nodes", "acceleration_limit", "limits"})
        chosen = self.protection if protection is None else protection
        sample_time = step if planned else None
        if isinstance(chosen, Schedule):
            return ScheduledLaw(self.robot, chosen, sample_time=sample_time, **self.law)
        return SelectiveLaw(self.robot, chosen, sample_time=sample_time, **self.law)

    def run(
        self,
        protection: Protection | Schedule | None = None,
        dt: float | None = None,
        progress: Progress | None = None,
    ) -> xr.Dataset:
        """Simulate the case.

        Args:
            protection: Instead of the case's own.
            dt: Time between samples, s, instead of the case's own.
            progress: Called now and then with the share done, 0 to 1.

        Returns:
            The motion, as `simulate` returns it, with the case's name and title and U_c of the case in its attributes.

        Raises:
            DecoupleError: the case cannot be run; the message says why.
        """
        step = self.dt if dt is None else dt
        try:
            law, start = self.make_law(protection, dt), self.start()
            motion = simulate(law, start, self.target, self.duration, step, progress=progress, **self.simulation)
        except InputError as error:
            told = InputError(f"case '{self.name}': {error}")
            if hasattr(error, "motion"):
                told.motion = error.motion  # type: ignore[attr-defined]
            raise told from error
        motion.attrs |= {
            "case": self.name,
            "title": self.title,
            "case_U_c": json.dumps(self.protection.U_twist.tolist()),
            "case_frame": self.protection.frame,
            "case_schedule": json.dumps(self.protection.settings() if isinstance(self.protection, Schedule) else None),
            "turned": json.dumps(dict(self.turned)),
        }
        return motion


def checked_case(case: Case) -> Case:
    """Return a case.

    Raises:
        InputError: it is none; the message says how one is loaded.
    """
    mend = f"load it with load_case({shown(case)})" if isinstance(case, str) else "load one with load_case(..)"
    return as_kind("case", case, Case, mend)


def cases() -> dict[str, Path]:
    """Return the cases that come with the package: name to TOML path."""
    return {path.stem: path for path in sorted(_FOLDER.glob("*.toml"), key=lambda path: (len(path.stem), path.stem))}


def load_case(source: str | Path) -> Case:
    """Read a case: the name of one that comes with the package, or a path to a TOML file.

    Args:
        source: Name such as "case1", or path. A robot path in the file is taken relative to the file.

    Returns:
        The case.

    Raises:
        InputError: no such case, not TOML, an unknown key (the nearest known one is named), a missing key or a value
            of the wrong kind.
    """
    catalogue = cases()
    path = as_path("case", source, f"give a path, or one of the cases {', '.join(catalogue)}")
    path = catalogue.get(str(source), path)
    if not is_file(path):
        raise InputError(f"'{source}' is neither a file nor one of the cases {', '.join(catalogue)}")
    content, _ = read_toml(path)
    try:
        return case_of(content, path)
    except DecoupleError as error:
        raise InputError(f"case '{path}': {error}") from error


def case_of(content: dict[str, Any], path: Path) -> Case:
    """Return the case that the content of a TOML file describes; a robot's path is relative to the file's `path`.

    Raises:
        InputError: as for `load_case`.
    """
    _validate(content)
    start, law, simulation = (content.get(table, {}) for table in ("start", "law", "simulation"))
    robot = content["robot"]
    law_arguments = {key: value for key, value in law.items() if not key.endswith("_deg")}
    for key in ("rate_limit", "acceleration_limit"):
        if f"{key}_deg" in law:
            if key in law:
                raise InputError(f"give {key}_deg or {key}, not both")
            law_arguments[key] = float(np.deg2rad(law[f"{key}_deg"]))
    if start.keys() & {"linear_momentum", "angular_momentum"}:
        law_arguments["momentum"] = [
            float(x) for part in ("linear", "angular") for x in start.get(f"{part}_momentum", (0, 0, 0))
        ]
    if "limits" in content:
        law_arguments["limits"] = _limits(content["limits"])
    tasks, target = _tasks(content)
    if tasks:
        law_arguments["tasks"] = tasks
    return Case(
        name=path.stem,
        title=content.get("title", path.stem),
        robot_source=robot if robot in models() else str(path.parent / Path(robot).expanduser()),
        end_effector=content.get("end_effector"),
        joints=_joints(start),
        base_position=tuple(map(float, start.get("base_position", (0, 0, 0)))),
        base_rpy=tuple(map(float, np.deg2rad(start.get("base_rpy_deg", (0, 0, 0))))),
        target=target,
        protection=_protection(content["protection"]),
        law=law_arguments,
        duration=float(simulation["duration"]),
        dt=float(simulation["dt"]),
        simulation={key: value for key, value in simulation.items() if key not in ("duration", "dt")}
        | _physics(content),
        turned={
            name: float(np.deg2rad(angle))
            for name, angle in content.get("spacecraft", {}).get("turned_deg", {}).items()
        },
    )


def _limits(given: Mapping[str, Any]) -> Limits:
    from ssm_decouple.control.collision import Clearance
    from ssm_decouple.control.limits import Limits

    clearance = Clearance(given["clearance"]) if "clearance" in given else None
    return Limits(braking=given.get("braking", 0.8), clearance=clearance)


def _protection(given: Mapping[str, Any]) -> Protection | Schedule:
    frame = given.get("frame", "base")

    def one(axes: Any) -> Protection:
        return Protection(axes if isinstance(axes, str) else _directions(axes), frame)

    if ("axes" in given) == ("phases" in given) or ("phases" in given) != ("hand_over" in given):
        raise InputError("[protection] needs axes, or phases and hand_over for a schedule of several protections")
    if "axes" in given:
        return one(given["axes"])
    pairs = [(phase["from"], one(phase["axes"])) for phase in given["phases"]]
    return Schedule(pairs, hand_over=given["hand_over"])


def _tasks(content: Mapping[str, Any]) -> tuple[list[Task], Any]:
    """Return the tasks of a case, none for the end-effector's position alone, and their targets."""
    tables, place = content.get("task"), content.get("target", {}).get("position")
    if (tables is None) == (place is None):
        raise InputError("give [target] position, or [[task]] tables with a target in each, and not both")
    if tables is None:
        return [], tuple(map(float, place))
    if not isinstance(tables, list) or not tables:
        raise InputError("'task' must be an array of tables: write [[task]] on a line of its own above each")
    tasks, targets = [], []
    for number, table in enumerate(tables, 1):
        task, target = _task(table, f"[[task]] {number} ")
        tasks.append(task)
        if task.takes_target:
            targets.append(target)
    return tasks, targets[0] if len(targets) == 1 else targets


def _task(table: Any, place: str) -> tuple[Task, Any]:
    if not isinstance(table, dict):
        raise InputError(f"{place}is {table!r}; it must be a table")
    kind = table.get("kind")
    if not isinstance(kind, str) or kind not in _TASKS:
        raise InputError(f"{place}{unknown('kind', str(kind), list(_TASKS))}")
    made, keys = _TASKS[kind]
    check_keys(table, {**_ANY_TASK, **keys}, place)
    arguments = {key: table[key] for key in ("gain", "weight", "level", "frame", "reference") if key in table}
    if kind == "boresight":
        arguments["direction"] = tuple(table["direction"])
    if "joints" in table:
        arguments["joints"] = tuple(table["joints"])
    if kind == "posture":
        if ("positions" in table) == ("positions_deg" in table):
            raise InputError(f"{place}needs positions or positions_deg, and not both")
        return made(**arguments), table.get("positions", np.deg2rad(table.get("positions_deg", [])))
    rotation = pin.rpy.rpyToMatrix(*np.deg2rad(np.array(table.get("rpy_deg", (0, 0, 0)), dtype=float)))
    position = np.array(table.get("position", (0, 0, 0)), dtype=float)
    targets = {"position": position, "orientation": rotation, "boresight": table.get("toward")}
    return made(**arguments), targets.get(kind, pin.SE3(rotation, position))


def _physics(content: Mapping[str, Any]) -> dict[str, Dynamic]:
    """Return the method of a dynamic case; nothing of another."""
    given = dict(content.get("dynamic", {}))
    if content["simulation"].get("method") != "dynamic":
        if given:
            raise InputError('[dynamic] is only read where [simulation] has method = "dynamic"')
        return {}
    drives = given.pop("drives", "torque")
    if drives not in DRIVES:
        raise InputError(f"[dynamic] {unknown('drives', drives, list(DRIVES))}")
    servo = {key.removeprefix("servo_"): given.pop(key) for key in list(given) if key.startswith("servo_")}
    if drives == "prescribed" and servo:
        raise InputError('[dynamic] drives = "prescribed" has no servo: its joints follow the commands at once')
    return {"method": Dynamic(servo=Servo(**servo) if drives == "torque" else None, **given)}


def _joints(start: Mapping[str, Any]) -> Floats | dict[str, float] | None:
    degrees, plain = start.get("joints_deg"), start.get("joints")
    if degrees is None or plain is None:
        given = degrees if degrees is not None else plain
        factor = np.pi / 180 if degrees is not None else 1.0
        if given is None:
            return None
        if isinstance(given, dict):
            return {name: factor * value for name, value in given.items()}
        return factor * np.array(given, dtype=float)
    if not (isinstance(degrees, dict) and isinstance(plain, dict)) or degrees.keys() & plain.keys():
        raise InputError("[start]: joints_deg and joints together must be tables by joint name that share none")
    return {**plain, **{name: float(np.deg2rad(value)) for name, value in degrees.items()}}


def _directions(axes: list[Any]) -> Floats:
    """Turn a case file's directions, one in a row, into the columns of U_c."""
    rows = axes if axes and all(isinstance(row, list) for row in axes) else [axes]
    flat = not any(isinstance(x, list) for row in rows for x in row)
    if not flat or {len(row) for row in rows} not in ({3}, {6}):
        raise InputError(f"[protection] axes {axes}: each direction needs 3 numbers, or each 6 for the whole twist")
    return as_floats("[protection] axes", rows).T


def _validate(content: dict[str, Any]) -> None:
    tables = [*filter(None, _SCHEMA), "task"]
    for key, value in content.items():
        if key not in _SCHEMA[""] and key not in tables:
            raise InputError(unknown("key", key, [*_SCHEMA[""], *tables]))
        if key in tables and key != "task" and not isinstance(value, dict):
            raise InputError(f"'{key}' must be a table: write [{key}] on a line of its own")
    for table, keys in _SCHEMA.items():
        values = content.get(table, {}) if table else {k: v for k, v in content.items() if k not in tables}
        check_keys(values, keys, f"[{table}] " if table else "")
    if "protection" not in content:
        raise InputError("[protection] is missing; it needs axes")
    for number, phase in enumerate(content["protection"].get("phases", []), 1):
        check_keys(phase, {"from": (NUMBER, True), "axes": (AXES, True)}, f"[protection] phase {number} ")
    method = content["simulation"].get("method", "explicit")
    if method not in (*STEPS, "dynamic"):
        raise InputError(f"[simulation] {unknown('method', method, [*STEPS, 'dynamic'])}")
