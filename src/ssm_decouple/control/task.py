"""Tasks: what the arm shall do with the freedoms that the protection leaves.

Each task names what it moves, how fast its error shall go (its gain) and its place among the others: tasks of one level
share, by their weights, and a level acts only in what the levels before it leave.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from ssm_decouple.control import kernel
from ssm_decouple.errors import InputError, as_floats, as_items, as_positive, as_text, as_whole, shown
from ssm_decouple.model.robot import Robot
from ssm_decouple.settled import Settled, fixed_array

Floats = NDArray[np.float64]


class Piece(NamedTuple):
    """A task, or a part of one, as the kernel knows it."""

    kind: int
    row_names: tuple[str, ...]
    moves: Floats  # (n,), the row MOVES of the kernel's `columns`
    joint: int = 0
    point: Floats = np.zeros(3)
    axes: Floats = np.eye(3)
    target: int = 0  # where its part of the task's target begins
    stride: int = 1
    velocity: int = 0
    reference: int = -1  # joint that holds the frame in which the target stands; -1 for inertial axes
    reference_pose: pin.SE3 = pin.SE3.Identity()  # of that frame in its joint


class Task(ABC):
    """What all tasks share. A task is a description: it holds no robot and no target.

    Attributes:
        gain: k_p, 1/s: the error falls as exp(-gain t) where nothing hinders it; None for the law's.
        weight: Of the task's squared error rate, beside the other tasks of its level.
        level: Its priority: 1 is the first after the protection.
        takes_target: Whether it needs a target.
    """

    gain: float | None
    weight: float
    level: int
    takes_target: ClassVar[bool] = True

    def __post_init__(self) -> None:
        place = f"{self.word} task: "
        gain = None if self.gain is None else as_positive(place + "gain", self.gain)
        level = as_whole(place + "level", self.level, 1, "levels are 1 (first), 2, ..")
        kept: dict[str, Any] = {"gain": gain, "weight": as_positive(place + "weight", self.weight), "level": level}
        for name in ("frame", "reference"):
            if hasattr(self, name) and (name == "reference" or getattr(self, name) is not None):
                kept[name] = as_text(place + name, getattr(self, name), "it is the name of a frame of the robot")
        for name, value in kept.items():
            object.__setattr__(self, name, value)

    @property
    def word(self) -> str:
        """What the task is called in messages and records, such as "position"."""
        return type(self).__name__.removesuffix("Task").lower()

    @abstractmethod
    def pieces(self, robot: Robot) -> list[Piece]:
        """Return what the kernel needs to know of the task.

        Raises:
            InputError: the robot has no such frame or joint, or no joint moves it.
        """

    @abstractmethod
    def flat_target(self, robot: Robot, target: Any) -> Floats:
        """Return a target as a flat array.

        Raises:
            InputError: it has the wrong shape.
        """

    @abstractmethod
    def sizes(self, robot: Robot) -> tuple[int, int]:
        """Return how many numbers a flat target has, and its velocity."""

    def owner(self, robot: Robot) -> str:
        """Return what it moves, for messages and the names of its rows."""
        frame = getattr(self, "frame", None)
        return robot.end_effector if frame is None else frame

    def describe(self) -> dict[str, Any]:
        """Return the task in plain types, for a record."""
        return {"task": self.word, **asdict(self)}  # type: ignore[call-overload]


@dataclass(frozen=True)
class FrameTask(Task):
    """What the tasks share that move a frame and need nothing else.

    Attributes:
        frame: Any frame of the robot; None for the end-effector.
    """

    frame: str | None = None
    gain: float | None = None
    weight: float = 1.0
    level: int = 1


@dataclass(frozen=True)
class PositionTask(FrameTask):
    """Bring the origin of a frame to a position: target (3,), m, inertial axes; its velocity (3,), m/s.

    The error is target minus position.

    Attributes:
        frame: Any frame of the robot; None for the end-effector.
    """

    def pieces(self, robot: Robot) -> list[Piece]:
        """Return its three rows."""
        joint, pose, moves = _on_arm(robot, self.frame)
        return [Piece(kernel.POINTS, ("x", "y", "z"), moves, joint, pose.translation)]

    def flat_target(self, robot: Robot, target: Any) -> Floats:
        """Return a position (3,)."""
        return _numbers("a position target", target, 3, "m, inertial axes")

    def sizes(self, robot: Robot) -> tuple[int, int]:
        """Return the lengths of a position and of a velocity."""
        return 3, 3


@dataclass(frozen=True)
class OrientationTask(FrameTask):
    """Turn a frame to an attitude: target a rotation matrix (3, 3), frame to inertial axes, or a pin.SE3's.

    The error is the rotation vector of R_target R^T (3,), rad, inertial axes: the shortest turn to the target. The
    target's velocity is its angular velocity (3,), rad/s, inertial axes.

    Attributes:
        frame: Any frame of the robot; None for the end-effector.
    """

    def pieces(self, robot: Robot) -> list[Piece]:
        """Return its three rows."""
        joint, pose, moves = _on_arm(robot, self.frame)
        return [Piece(kernel.TURNS, ("rx", "ry", "rz"), moves, joint, axes=pose.rotation, stride=3)]

    def flat_target(self, robot: Robot, target: Any) -> Floats:
        """Return a rotation matrix (9,) by rows."""
        matrix = as_floats("an orientation target", target.rotation if isinstance(target, pin.SE3) else target)
        if matrix.shape != (3, 3):
            raise InputError(
                f"an orientation target has shape {matrix.shape}; it needs a rotation matrix (3, 3), frame to inertial "
                "axes, or a pin.SE3"
            )
        return matrix.ravel()

    def sizes(self, robot: Robot) -> tuple[int, int]:
        """Return the lengths of a rotation matrix and of an angular velocity."""
        return 9, 3


@dataclass(frozen=True)
class PoseTask(FrameTask):
    """Bring a frame to a pose: target a pin.SE3 or a homogeneous matrix (4, 4), frame to inertial.

    It is a position and an orientation task in one: the error (6,) is [position; rotation vector], m and rad, inertial
    axes, and not the logarithm on SE(3). Both halves are the axes in which the generalized Jacobian stands, each falls
    as exp(-gain t) by itself, and the origin goes straight to its target instead of along a screw. Where the arm lacks
    freedoms 1 m weighs as much as 1 rad: two tasks of one level, each with its weight, say otherwise. The target's
    velocity is (6,), [linear; angular], m/s and rad/s, inertial axes.

    Attributes:
        frame: Any frame of the robot; None for the end-effector.
    """

    def pieces(self, robot: Robot) -> list[Piece]:
        """Return three rows of position and three of rotation."""
        joint, pose, moves = _on_arm(robot, self.frame)
        return [
            Piece(kernel.POINTS, ("x", "y", "z"), moves, joint, pose.translation, target=3, stride=4),
            Piece(kernel.TURNS, ("rx", "ry", "rz"), moves, joint, axes=pose.rotation, stride=4, velocity=3),
        ]

    def flat_target(self, robot: Robot, target: Any) -> Floats:
        """Return a homogeneous matrix (16,) by rows."""
        return _flat_pose(target)

    def sizes(self, robot: Robot) -> tuple[int, int]:
        """Return the lengths of a homogeneous matrix and of a twist."""
        return 16, 6


@dataclass(frozen=True)
class RelativePoseTask(Task):
    """Bring a frame to a pose in another frame of the robot: two hands on one body, or a hand beside the bus.

    The target is a pin.SE3 or a homogeneous matrix (4, 4), frame to reference; the error (6,) is [position; rotation
    vector], m and rad, in the axes of the reference, and the target's velocity (6,) stands there too. Where the base
    goes plays no part, so that momentum does not enter its Jacobian.

    Attributes:
        frame: What is moved: any frame of the robot.
        reference: Against what: any other frame, on another arm, on the same one or on the base.
    """

    frame: str
    reference: str
    gain: float | None = None
    weight: float = 1.0
    level: int = 1

    @property
    def word(self) -> str:
        """Its name in messages and records."""
        return "relative pose"

    def pieces(self, robot: Robot) -> list[Piece]:
        """Return three rows of position and three of rotation."""
        joint, pose, moves = _on_arm(robot, self.frame)
        holder, reference, carried = _on_arm(robot, self.reference)
        moves = moves - carried
        if 0 in (joint, holder):
            raise InputError(
                f"a relative pose task has frames of the robot, not '{self.frame if joint == 0 else self.reference}', "
                "which is inertial; use a PoseTask for a pose in inertial axes"
            )
        return [
            Piece(kernel.POINTS, ("x", "y", "z"), moves, joint, *_split(pose), 3, 4, 0, holder, reference),
            Piece(kernel.TURNS, ("rx", "ry", "rz"), moves, joint, *_split(pose), 0, 4, 3, holder, reference),
        ]

    def flat_target(self, robot: Robot, target: Any) -> Floats:
        """Return a homogeneous matrix (16,) by rows."""
        return _flat_pose(target)

    def sizes(self, robot: Robot) -> tuple[int, int]:
        """Return the lengths of a homogeneous matrix and of a twist."""
        return 16, 6

    def owner(self, robot: Robot) -> str:
        """Return both frames."""
        return f"{self.frame} in {self.reference}"


@dataclass(frozen=True)
class BoresightTask(Task):
    """Point a direction fixed in a frame, such as a camera's axis, along a target direction (3,), inertial axes.

    The target may have any length. The turn about the direction stays free, so that there are two rows: the error is
    the shortest turn from the one direction to the other, rad, about two axes across it that are fixed in the frame.
    Exactly opposite the target, where there are many such turns, it is one of them. The target's velocity is the
    angular velocity (3,), rad/s, inertial axes, at which the target direction turns.

    Attributes:
        direction: What is pointed (3,), of any length, in the frame's axes.
        frame: Any frame of the robot; None for the end-effector.
    """

    direction: tuple[float, float, float]
    frame: str | None = None
    gain: float | None = None
    weight: float = 1.0
    level: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        direction = _direction("the direction of a boresight task", self.direction)
        object.__setattr__(self, "direction", tuple((direction / np.linalg.norm(direction)).tolist()))

    def pieces(self, robot: Robot) -> list[Piece]:
        """Return its two rows."""
        joint, pose, moves = _on_arm(robot, self.frame)
        line = np.array(self.direction)
        first, second = np.linalg.svd(line[None])[2][1:]
        if np.linalg.det([first, second, line]) < 0:
            first = -first
        axes = pose.rotation @ np.column_stack([first, second, line])
        return [Piece(kernel.LOOKS, ("across_1", "across_2"), moves, joint, axes=axes)]

    def flat_target(self, robot: Robot, target: Any) -> Floats:
        """Return a direction (3,)."""
        return _numbers("a boresight target", target, 3, "a direction in inertial axes")

    def sizes(self, robot: Robot) -> tuple[int, int]:
        """Return the lengths of a direction and of an angular velocity."""
        return 3, 3


@dataclass(frozen=True)
class PostureTask(Task):
    """Bring joints to positions: target (joints,), rad or m; its velocity (joints,), rad/s or m/s.

    The error is target minus position; a continuous joint takes the shorter way round.

    Attributes:
        joints: Names of the joints, in the order of the target; None for all, in the order of the joint rates.
    """

    joints: tuple[str, ...] | None = None
    gain: float | None = None
    weight: float = 1.0
    level: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.joints is None:
            return
        named = [self.joints] if isinstance(self.joints, str) else self.joints
        joints = tuple(as_text("a joint of a posture task", name) for name in as_items("joints", named, _NAMES))
        if not joints or len(set(joints)) < len(joints):
            raise InputError(f"a posture task needs one or more different joints, not {shown(list(joints))}")
        object.__setattr__(self, "joints", joints)

    def pieces(self, robot: Robot) -> list[Piece]:
        """Return a row a joint."""
        names = robot.joint_names if self.joints is None else self.joints
        moves = np.zeros(robot.n_joints)
        for row, name in enumerate(names, 1):
            moves[robot.joint_index(name)] = row
        return [Piece(kernel.JOINTS, tuple(names), moves)]

    def flat_target(self, robot: Robot, target: Any) -> Floats:
        """Return joint positions."""
        return _numbers("a posture target", target, self.sizes(robot)[0], "joint positions, rad or m")

    def sizes(self, robot: Robot) -> tuple[int, int]:
        """Return the number of joints, twice."""
        size = robot.n_joints if self.joints is None else len(self.joints)
        return size, size

    def owner(self, robot: Robot) -> str:
        """Return the word for rows that name their joint themselves."""
        return "joint"


class RateTask(Task):
    """What the tasks share that ask for joint rates themselves: a row a joint, no target, and the rates as velocity."""

    takes_target: ClassVar[bool] = False

    def pieces(self, robot: Robot) -> list[Piece]:
        """Return a row a joint."""
        return [Piece(kernel.CLIMBS, robot.joint_names, np.arange(1.0, robot.n_joints + 1))]

    def flat_target(self, robot: Robot, target: Any) -> Floats:
        """Return nothing."""
        return np.zeros(0)

    def sizes(self, robot: Robot) -> tuple[int, int]:
        """Return nothing for the target and a rate a joint."""
        return 0, robot.n_joints

    def owner(self, robot: Robot) -> str:
        """Return the word for rows that name their joint themselves."""
        return "joint"


@dataclass(frozen=True)
class ManipulabilityTask(RateTask):
    """Move the joints to where the tasks of level 1 have more freedom, with what the levels before leave.

    The joint rates asked for are the gain times the gradient of log w, w the product of the singular values of J_1
    N_sub: its manipulability under the protection (Yoshikawa 1985). They are held to a quarter of the rate limits, as a
    whole, so that they hardly slow the tasks down. It takes no target. The gradient is found by finite differences and
    costs the matrices of n more configurations.
    """

    gain: float | None = None
    weight: float = 1.0
    level: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.level == 1:
            raise InputError("a manipulability task serves those of level 1, so its level is 2 or more")


class Layout(Settled):
    """The tasks of a law: how their rows and targets stand in the kernel's arrays, which follow the levels.

    Attributes:
        tasks: As given.
        rows: For each task the slice of its rows.
        level_rows: For each level the slice of its rows.
        row_names: For each row what it is, such as "end_effector x".
        size: Number of rows.
        row_levels: For each row its level, counted from 1.
        slowest_gain: Of the tasks of level 1, 1/s.
        tool_position: The three rows of the end-effector's position; None if no task has them.
        tool_target: Where their targets stand in the flat targets.
        climbs: Where the rates of a manipulability task stand in the flat velocities, and its gain; None without one.
        table: The kernel's `tasks` (pieces, TASK_SIZE).
        moves: The last rows of the kernel's `columns` (pieces, n).
        target_sizes: Length of the flat targets and of the flat velocities.
        plain: Whether there is nothing but one position, whose target is flat as it is.
        usual: Whether that is the end-effector's.

    Raises:
        InputError: the robot has not got what a task names.
    """

    def __init__(self, robot: Robot, tasks: Sequence[Task], gain: float) -> None:
        self.robot, self.tasks = robot, tuple(tasks)
        numbers = sorted({task.level for task in self.tasks})
        self._order = sorted(range(len(self.tasks)), key=lambda i: self.tasks[i].level)
        rows: dict[int, slice] = {}
        lines, moves, names, counts, place = [], [], list[str](), [0] * len(numbers), [0, 0]
        self.tool_position: slice | None = None
        self.tool_target: slice | None = None
        self.climbs: tuple[slice, float] | None = None
        for i in self._order:
            task, first = self.tasks[i], len(names)
            level = numbers.index(task.level)
            for piece in task.pieces(robot):
                lines.append(_line(piece, level, gain if task.gain is None else task.gain, task.weight, place))
                moves.append(piece.moves)
                tool = piece.kind == kernel.POINTS and task.owner(robot) == robot.end_effector
                if isinstance(task, ManipulabilityTask):
                    self.climbs = slice(place[1], place[1] + robot.n_joints), float(lines[-1][kernel.GAIN])
                if tool and self.tool_position is None:
                    start, stride = place[0] + piece.target, piece.stride
                    self.tool_position = slice(len(names), len(names) + 3)
                    self.tool_target = slice(start, start + 2 * stride + 1, stride)
                names += [f"{task.owner(robot)} {name}" for name in piece.row_names]
            rows[i] = slice(first, len(names))
            counts[level] += len(names) - first
            place = [start + size for start, size in zip(place, task.sizes(robot), strict=True)]
        ends = np.cumsum(counts).tolist()
        self.rows = tuple(rows[i] for i in range(len(self.tasks)))
        self.level_rows = tuple(slice(end - count, end) for end, count in zip(ends, counts, strict=True))
        self.row_names, self.size = tuple(names), len(names)
        self.row_levels = tuple(level for level, count in enumerate(counts, 1) for _ in range(count))
        self.table: Floats = fixed_array(np.array(lines, dtype=float))
        self.slowest_gain = float(self.table[self.table[:, kernel.LEVEL] == 0, kernel.GAIN].min())
        self.moves: Floats = fixed_array(np.array(moves))
        self.target_sizes: tuple[int, int] = (place[0], place[1])
        self.plain = len(self.tasks) == 1 and isinstance(self.tasks[0], PositionTask)
        self.usual = self.plain and self.tool_position is not None

    def flat_targets(self, targets: Any) -> Floats:
        """Return the target of the only task, or a sequence of one a task, as one flat array.

        Raises:
            InputError: there are not as many as tasks, or one has the wrong shape.
        """
        if len(self.tasks) == 1:
            return self.tasks[0].flat_target(self.robot, targets)
        each = self._one_a_task("targets", targets)
        return np.concatenate([self.tasks[i].flat_target(self.robot, each[i]) for i in self._order])

    def flat_velocities(self, velocities: Any) -> Floats:
        """Return the velocities of the targets as one flat array, zeros for None.

        Raises:
            InputError: there are not as many as tasks, or one has the wrong shape.
        """
        if velocities is None:
            return np.zeros(self.target_sizes[1])
        each = [velocities] if len(self.tasks) == 1 else self._one_a_task("target velocities", velocities)
        return np.concatenate([self._flat_velocity(self.tasks[i], each[i]) for i in self._order])

    def _flat_velocity(self, task: Task, velocity: Any) -> Floats:
        size = task.sizes(self.robot)[1]
        if velocity is None:
            return np.zeros(size)
        return _numbers(f"the target velocity of a {task.word} task", velocity, size, "m/s or rad/s")

    def _one_a_task(self, name: str, values: Any) -> list[Any]:
        """Return a value for each task, None for those that take no target."""
        words = [task.word for task in self.tasks if task.takes_target]
        if len(words) == 1:
            values = [values]
        several = isinstance(values, Sequence) or (isinstance(values, np.ndarray) and values.ndim > 0)
        if not several or len(values) != len(words):
            found = len(values) if several else "no sequence"
            raise InputError(f"{name}: {found}; give {len(words)}, one a task, in their order: {', '.join(words)}")
        left = iter(values)
        return [next(left) if task.takes_target else None for task in self.tasks]

    def any_target(self) -> Floats:
        """Return flat targets that could be some: positions zero, no turn, any direction."""
        flat = np.zeros(self.target_sizes[0])
        for line in self.table:
            start, stride = int(line[kernel.TARGET]), int(line[kernel.STRIDE])
            if line[kernel.KIND] == kernel.TURNS:
                flat[start : start + 2 * stride + 3 : stride + 1] = 1.0
            if line[kernel.KIND] == kernel.LOOKS:
                flat[start] = 1.0
        return flat

    def targets_from(self, origin: Floats, targets: Floats) -> Floats:
        """Return flat targets whose positions in inertial axes are counted from another origin (3,), m."""
        moved = targets.copy()
        for line in self.table:
            if line[kernel.KIND] == kernel.POINTS and line[kernel.REFERENCE] < 0.0:
                start, stride = int(line[kernel.TARGET]), int(line[kernel.STRIDE])
                moved[start : start + 2 * stride + 1 : stride] -= origin
        return moved

    def strange_target(self, targets: Floats) -> str:
        """Say which of flat targets is none: it is no rotation, or no direction."""
        for line in self.table:
            start, stride = int(line[kernel.TARGET]), int(line[kernel.STRIDE])
            part = (
                np.array([targets[start + r * stride :][:3] for r in range(3)]) if stride > 1 else targets[start:][:3]
            )
            if line[kernel.KIND] == kernel.LOOKS and not np.any(part):
                return "a boresight's target is zero: it has no direction"
            if line[kernel.KIND] == kernel.TURNS:
                gap = np.abs(part @ part.T - np.eye(3)).max()
                if gap > 1e-7 or np.linalg.det(part) < 0:
                    return f"a target is no rotation: its matrix {part.tolist()} needs right-handed orthonormal columns"
        return (
            "a target is no rotation seen from this configuration: the length of the quaternion q[3:7] is off by more "
            "than a rotation task bears, 1e-7; use pinocchio.normalize(model, q)"
        )


_NAMES = "give a list of joint names, or None for all joints"


def _line(piece: Piece, level: int, gain: float, weight: float, place: Sequence[int]) -> list[float]:
    """Return a piece's row of the kernel's `tasks`; the task's target and velocity begin at `place`."""
    where = [place[0] + piece.target, piece.stride, place[1] + piece.velocity]
    numbers = [piece.kind, level, len(piece.row_names), piece.joint, gain, np.sqrt(weight), *where]
    reference = [piece.reference, *piece.reference_pose.translation, *piece.reference_pose.rotation.ravel()]
    return [*numbers, *piece.point, *piece.axes.ravel(), *reference]


def _split(pose: pin.SE3) -> tuple[Floats, Floats]:
    return pose.translation, pose.rotation


def _flat_pose(target: Any) -> Floats:
    """Return a homogeneous matrix (16,) by rows."""
    if isinstance(target, pin.SE3):
        return target.homogeneous.ravel()
    right = type(target) is np.ndarray and target.dtype == np.float64
    matrix = target if right else as_floats("a pose target", target)
    if matrix.shape != (4, 4) or matrix[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise InputError(
            f"a pose target has shape {matrix.shape}; it needs a pin.SE3 or a homogeneous matrix (4, 4) whose last "
            "row is 0 0 0 1"
        )
    return matrix.flatten()


def _on_arm(robot: Robot, name: str | None) -> tuple[int, pin.SE3, Floats]:
    """Return the joint that holds a frame, the frame in it, and which joints carry it (n,), 1 or 0."""
    model = robot.model
    frame = model.frames[robot.end_effector_id if name is None else robot.frame_id(name)]
    moves = np.zeros(robot.n_joints)
    moves[[model.joints[j].idx_v - 6 for j in model.supports[frame.parentJoint] if j > 1]] = 1.0
    return frame.parentJoint, frame.placement, moves


def checked_tasks(robot: Robot, tasks: Task | Sequence[Task]) -> tuple[Task, ...]:
    """Return tasks as a tuple.

    Raises:
        InputError: there is none, something is no task, or no joint carries the frame that one is to move.
    """
    mend = "give one or more, such as PositionTask(), or None for the position alone"
    given = (tasks,) if isinstance(tasks, Task) else tuple(as_items("tasks", tasks, mend))
    if not given:
        raise InputError(f"tasks is {shown(tasks)}; {mend}")
    for task in given:
        if isinstance(task, type) and issubclass(task, Task):
            raise InputError(f"a task is the class {task.__name__}; make one: {task.__name__}(..)")
        if not isinstance(task, Task):
            raise InputError(
                f"{shown(task)} is no task; use PositionTask, OrientationTask, PoseTask, RelativePoseTask, "
                "BoresightTask, PostureTask or ManipulabilityTask"
            )
        moving = all(piece.moves.any() for piece in task.pieces(robot))
        if not moving and isinstance(task, RelativePoseTask):
            raise InputError(
                f"a relative pose task cannot move frame '{task.frame}' of '{robot.name}' against '{task.reference}': "
                "no joint is between the two; name frames of different bodies"
            )
        if not moving:
            raise InputError(
                f"a {task.word} task cannot move frame '{task.owner(robot)}' of '{robot.name}': no joint carries it, "
                "it is fixed to the base; name a frame on an arm (what the base does is for a Protection)"
            )
    if sum(isinstance(task, ManipulabilityTask) for task in given) > 1:
        raise InputError("there are two manipulability tasks, which ask for the same; drop one")
    served = [task.level for task in given if not isinstance(task, ManipulabilityTask)]
    for task in given:
        if isinstance(task, ManipulabilityTask) and not (served and min(served) < task.level):
            raise InputError(
                f"a manipulability task of level {task.level} needs a task of a level before its own to serve; add "
                "one, such as PositionTask()"
            )
    return given


def _numbers(name: str, value: Any, size: int, unit: str) -> Floats:
    numbers = as_floats(name, value)
    if numbers.shape != (size,):
        raise InputError(f"{name} has shape {numbers.shape}; it needs {size} numbers, {unit}")
    return numbers


def _direction(name: str, value: ArrayLike) -> Floats:
    direction = as_floats(name, value)
    if direction.shape != (3,) or not (np.all(np.isfinite(direction)) and np.any(direction)):
        raise InputError(f"{name} is {shown(value)}; it needs 3 finite numbers that are not all zero")
    return direction
