"""What both batch engines have in common: what they are asked, what they refuse and what they return."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssm_decouple.batch import lanes, rows
from ssm_decouple.batch.constants import constants_of
from ssm_decouple.batch.results import Commands, Matrices, Motions
from ssm_decouple.control.law import SelectiveLaw
from ssm_decouple.control.schedule import ScheduledLaw
from ssm_decouple.errors import InputError, as_floats, as_function, as_items, as_kind, as_positive, as_whole, shown
from ssm_decouple.model.origin import FAR
from ssm_decouple.model.robot import UNIT, Robot, checked_robot
from ssm_decouple.momentum.protection import Protection
from ssm_decouple.settled import Settled
from ssm_decouple.simulation.steps import sample_times

Floats = NDArray[np.float64]
Progress = Callable[[float], object]
# Takes the place of some motions, and their distances to the target (rows, samples).
Judge = Callable[[slice, Floats], None]

NO_ROWS: Floats = np.empty((0, 0))


class Wanted:
    """Arrays with a row a configuration, to be filled; of no rows where they are not wanted.

    Attributes:
        values: `Matrices.values` (N, 12 n + 15).
        smallest: Smallest singular values of J_gt N_sub (N, P).
        volumes: Products of its singular values (N, P).
        factors: Coupling factors (N, P).
    """

    def __init__(
        self, values: Floats = NO_ROWS, smallest: Floats = NO_ROWS, volumes: Floats = NO_ROWS, factors: Floats = NO_ROWS
    ) -> None:
        self.values, self.smallest, self.volumes, self.factors = values, smallest, volumes, factors

    def part(self, start: int, end: int) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the arrays' rows from start to end."""
        return (
            self.values[start:end],
            self.smallest[start:end],
            self.volumes[start:end],
            self.factors[start:end],
        )


class Engine(Settled):
    """What the engines share. A subclass fills arrays that are laid out here, from arguments that are checked here."""

    def __init__(self, robot: Robot, end_effector: str | None) -> None:
        if checked_robot(robot).n_joints == 0:
            raise InputError(f"'{robot.name}' has no joints; put an arm on it with compose(..)")
        robot.refuse_changed_model()
        self.robot = robot
        self.end_effector = robot.end_effector if end_effector is None else end_effector
        self._constants = constants_of(robot, robot.frame_id(self.end_effector))
        self._continuous = [joint.nq == 2 for joint in list(robot.model.joints)[2:]]
        self._places = [joint.idx_q for joint in list(robot.model.joints)[2:]]

    @abstractmethod
    def _evaluate(
        self, joints: NDArray[Any], protections: list[Protection], wanted: Wanted, progress: Progress | None
    ) -> None:
        """Fill what is wanted at joint positions (N, n)."""

    @abstractmethod
    def _command(self, law: SelectiveLaw, joints: Floats, poses: Floats, targets: Floats, out: Floats) -> None:
        """Fill `out` (N, law.size) with commands; positions and errors in base axes, from the base origin."""

    @abstractmethod
    def _move(
        self,
        law: SelectiveLaw,
        joints: Floats,
        poses: Floats,
        targets: Floats,
        times: Floats,
        record: Floats,
        judge: Judge,
        progress: Progress | None,
    ) -> None:
        """Move joints (N, n) and poses (N, 7) to the end, fill the record (N, RECORD_SIZE) and have them judged."""

    def matrices(
        self, joints: ArrayLike, protections: Sequence[Protection | str] = (), progress: Progress | None = None
    ) -> Matrices:
        """Return the momentum matrices, in base axes, and what protections leave of J_gt.

        Args:
            joints: Joint positions (N, n).
            protections: For each of them the smallest singular value and the manipulability are computed; "none" is
                one. Their directions must be fixed in base axes.
            progress: Called now and then with the share done, 0 to 1.

        Raises:
            InputError: a wrong shape, no numbers, or directions that are not fixed in base axes.
        """
        as_function("progress", progress)
        given, checked = self._rows("joints", joints), _checked(protections)
        N, P, n = len(given), len(checked), self.robot.n_joints
        found = Matrices(np.empty((N, 12 * n + lanes.SINGLES)), n, np.empty((N, P)), np.empty((N, P)))
        wanted = Wanted(found.values, found.smallest_singular_values, found.manipulability)
        self._evaluate(given, checked, wanted, progress)
        return found

    def singular_values(
        self, joints: ArrayLike, protections: Sequence[Protection | str], progress: Progress | None = None
    ) -> Floats:
        """Return the smallest singular value of J_gt N_sub (N, P), m; the arguments are those of `matrices`.

        It is `Coupling.manipulability(..).smallest`, and `Command.smallest_singular_value` of a law without joint
        weights. 0 where the protection leaves fewer than three freedoms.
        """
        as_function("progress", progress)
        given, checked = self._rows("joints", joints), _checked(protections)
        wanted = Wanted(smallest=np.empty((len(given), len(checked))))
        self._evaluate(given, checked, wanted, progress)
        return wanted.smallest

    def coupling_factors(
        self, joints: ArrayLike, protections: Sequence[Protection | str], progress: Progress | None = None
    ) -> Floats:
        """Return the largest base angular speed per speed of the end-effector (N, P), rad/m.

        It is `Coupling.coupling_factor(..)`: |J_rc (J_gt N_sub)^+|; the arguments are those of `matrices`. It grows
        without bound towards a singularity, and its error with it; a singular value of J_gt N_sub that is rounding,
        as one of a planar arm is, does not count.
        """
        as_function("progress", progress)
        given, checked = self._rows("joints", joints), _checked(protections)
        wanted = Wanted(factors=np.empty((len(given), len(checked))))
        self._evaluate(given, checked, wanted, progress)
        return wanted.factors

    def blocks(
        self, joints: ArrayLike, protections: Sequence[Protection | str] = (), size: int = 65536
    ) -> Iterator[tuple[slice, Matrices]]:
        """Yield the matrices of `size` rows after `size` rows, each with where it belongs: for more than memory holds.

        The other arguments are those of `matrices`. `joints` may be a memory-mapped array.
        """
        size = as_whole("size", size, 1, "a block needs at least one row")
        given = self._rows("joints", joints)
        for start in range(0, len(given), size):
            place = slice(start, min(start + size, len(given)))
            yield place, self.matrices(given[place], protections)

    def step(self, law: SelectiveLaw, configurations: ArrayLike, targets: ArrayLike) -> Commands:
        """Return what a law commands at many configurations: its `law(q, target)`, row by row.

        Args:
            law: Of this robot, with one task, the position of the engine's end-effector, and directions fixed in base
                axes; without hold nodes, `limits`, acceleration limits and momentum on board.
            configurations: Pinocchio's (N, nq), or joint positions (N, n) with the base at the origin, or one of these.
            targets: (N, 3), m, inertial axes, or one for all.

        Raises:
            InputError: another law, shapes that do not fit, or a base quaternion that is not of unit length.
        """
        joints, poses, wanted = self._starts(law, configurations, targets)
        origins = _take_out_origins(poses, wanted)
        out = np.empty((len(joints), law.size))
        self._command(law, joints, poses, wanted, out)
        commands = Commands(out, self.robot.n_joints, law.protection.k)
        tools = commands.end_effector_position.copy()
        rows.place_points(poses, tools)
        commands.end_effector_position[:], commands.end_effector_error[:] = tools + origins, wanted - tools
        return commands

    def motions(
        self,
        law: SelectiveLaw,
        starts: ArrayLike,
        targets: ArrayLike,
        duration: float,
        dt: float,
        arrival_tolerance: float = 0.01,
        progress: Progress | None = None,
    ) -> Motions:
        """Return how many motions go: `simulate(law, start, target, duration, dt)`, row by row.

        Args:
            law: As for `step`.
            starts: Configurations (N, nq) or joint positions (N, n), or one for all targets.
            targets: (N, 3), m, inertial axes, or one for all starts.
            duration: Length of each motion, s.
            dt: Time between samples, s. A last shorter step is taken where `duration` is no multiple of it.
            arrival_tolerance: Distance, m, within which the end-effector has arrived.
            progress: Called now and then with the share done, 0 to 1.

        Raises:
            InputError: another law, shapes that do not fit, or times that make no sense.
        """
        as_function("progress", progress)
        times = sample_times(duration, dt)
        tolerance = as_positive("arrival_tolerance", arrival_tolerance)
        joints, poses, wanted = self._starts(law, starts, targets)
        origins = _take_out_origins(poses, wanted)
        N = len(joints)
        record, errors = np.empty((N, rows.RECORD_SIZE)), np.empty(N)
        outcomes: NDArray[np.str_] = np.full(N, "undefined", dtype="<U9")
        outcome_times: Floats = np.full(N, np.nan)

        def judge(part: slice, history: Floats) -> None:
            errors[part] = history[:, -1]
            _judge(times, history, tolerance, 1.0 / law.layout.slowest_gain, outcomes[part], outcome_times[part])

        self._move(law, joints, poses, wanted, times, record, judge, progress)
        record[np.isnan(errors)] = np.nan
        poses[:, :3] += origins
        return Motions(
            outcome=outcomes,
            outcome_time=outcome_times,
            final_error=errors,
            joint_travel=record[:, rows.TRAVEL],
            peak_rate=record[:, rows.PEAK],
            protected_rate=record[:, rows.LEAK],
            base_rotation=record[:, rows.HIGHEST : rows.HIGHEST + 3] - record[:, rows.LOWEST : rows.LOWEST + 3],
            smallest_singular_value=record[:, rows.SMALLEST],
            rate_reversals=record[:, rows.REVERSALS],
            configuration=self._configurations(joints, poses),
        )

    def _rows(self, name: str, joints: ArrayLike) -> NDArray[Any]:
        plain = isinstance(joints, np.ndarray) and joints.dtype.kind in "fiu" and not np.ma.is_masked(joints)
        given: NDArray[Any] = np.asarray(joints) if plain else as_floats(name, joints)  # may be mapped into memory
        n = self.robot.n_joints
        if given.ndim != 2 or given.shape[1] != n:
            raise InputError(
                f"{name} have shape {given.shape}; '{self.robot.name}' needs (N, {n}), a row a configuration, in the "
                f"order {', '.join(self.robot.joint_names)}"
            )
        return given

    def _starts(
        self, law: SelectiveLaw, configurations: ArrayLike, targets: ArrayLike
    ) -> tuple[Floats, Floats, Floats]:
        """Return joint positions (N, n), base poses (N, 7) and targets (N, 3), copies, a row each."""
        self._refuse_other_laws(law)
        given, wanted = np.atleast_2d(as_floats("configurations", configurations)), as_floats("targets", targets)
        n, nq = self.robot.n_joints, self.robot.model.nq
        if given.ndim != 2 or given.shape[1] not in (n, nq):
            raise InputError(
                f"configurations have shape {given.shape}; '{self.robot.name}' needs joint positions (N, {n}) or "
                f"configurations (N, {nq})"
            )
        wanted = np.atleast_2d(wanted)
        if (
            wanted.ndim != 2
            or wanted.shape[1] != 3
            or (len(wanted) != len(given) and 1 not in (len(wanted), len(given)))
        ):
            raise InputError(
                f"targets have shape {wanted.shape}; {len(given)} configurations need ({len(given)}, 3), or one target "
                "for all"
            )
        N = len(given) if len(wanted) == 1 else len(wanted)
        joints, poses = (
            (given, np.tile([0.0, 0, 0, 0, 0, 0, 1], (len(given), 1))) if given.shape[1] == n else self.split(given)
        )
        spread = [np.broadcast_to(part, (N, part.shape[1])).copy() for part in (joints, poses, wanted)]
        return spread[0], spread[1], spread[2]

    def split(self, configurations: Floats) -> tuple[Floats, Floats]:
        """Return joint positions (N, n), rad or m, and base poses (N, 7) of configurations (N, nq); copies.

        Raises:
            InputError: another shape, or a base quaternion that is not of unit length.
        """
        configurations = as_floats("configurations", configurations)
        if configurations.ndim != 2 or configurations.shape[1] != self.robot.model.nq:
            raise InputError(f"configurations have shape {configurations.shape}; they need (N, {self.robot.model.nq})")
        poses, joints = configurations[:, :7].copy(), configurations[:, self._places]
        off = np.abs(np.linalg.norm(poses[:, 3:], axis=1) - 1.0) > UNIT
        if off.any():
            row = int(np.argmax(off))
            raise InputError(
                f"row {row} of configurations has a quaternion {poses[row, 3:].tolist()} that is not of unit length; "
                "use pinocchio.normalize(model, q)"
            )
        for j in np.flatnonzero(self._continuous):
            place = self._places[j]
            cosines, sines = configurations[:, place], configurations[:, place + 1]
            off = np.abs(np.hypot(cosines, sines) - 1.0) > UNIT
            if off.any():
                row = int(np.argmax(off))
                raise InputError(
                    f"row {row} of configurations: continuous joint '{self.robot.joint_names[j]}' takes cosine and "
                    f"sine, q[{place}:{place + 2}] is {[float(cosines[row]), float(sines[row])]}; build q with "
                    "robot.configuration(..)"
                )
            joints[:, j] = np.arctan2(sines, cosines)
        return joints, poses

    def _configurations(self, joints: Floats, poses: Floats) -> Floats:
        found = np.empty((len(joints), self.robot.model.nq))
        found[:, :7] = poses
        found[:, self._places] = joints
        for j in np.flatnonzero(self._continuous):
            place = self._places[j]
            found[:, place], found[:, place + 1] = np.cos(joints[:, j]), np.sin(joints[:, j])
        return found

    def _refuse_other_laws(self, law: SelectiveLaw) -> None:
        as_kind("law", law, SelectiveLaw, "give a SelectiveLaw")
        if law.robot.urdf != self.robot.urdf or law.robot.end_effector != self.end_effector:
            raise InputError(
                f"the law moves '{law.robot.end_effector}' of '{law.robot.name}', the engine '{self.end_effector}' of "
                f"'{self.robot.name}'; make both of one robot"
            )
        beyond = {
            "a schedule": isinstance(law, ScheduledLaw),
            "other tasks than the end-effector's position": not law.layout.usual,
            f"directions fixed in '{law.protection.frame}'": law.protection.frame != "base",
            "hold_nodes": law.hold_nodes > 0,
            "limits": law.limits is not None,
            "an acceleration_limit": law.acceleration_limits is not None,
            "momentum on board": bool(law.momentum.any()),
        }
        for what, present in beyond.items():
            if present:
                raise InputError(
                    f"the law has {what}, which the batch engine does not do; use the law itself or simulate(..)"
                )


def _take_out_origins(poses: Floats, targets: Floats) -> Floats:
    """Count the positions of poses (N, 7) that are far from the inertial origin, and their targets (N, 3), from there.

    In place; what is to be added to come back is returned (N, 3). A position near the origin stays as it is.
    """
    far = np.abs(poses[:, :3]).max(axis=1) > FAR
    origins = np.where(far[:, None] & np.isfinite(poses[:, :3]), poses[:, :3], 0.0)
    poses[:, :3] -= origins
    targets -= origins
    return origins


def _checked(protections: Sequence[Protection | str]) -> list[Protection]:
    given = as_items("protections", protections, "give a list, such as ['none', 'yaw']")
    checked = [Protection(one) if isinstance(one, str) else one for one in given]
    for i, protection in enumerate(checked, 1):
        if not isinstance(protection, Protection):
            raise InputError(f"protection {i} is {shown(protection)}; give a Protection, or a name such as 'yaw'")
        if protection.frame != "base":
            raise InputError(
                f"protection {i} is fixed in '{protection.frame}' axes; without base poses only 'base' makes sense"
            )
    return checked


def _judge(
    times: Floats, history: Floats, tolerance: float, time_constant: float, outcomes: NDArray[np.str_], ends: Floats
) -> None:
    """Fill outcome and its time of motions, from their distances to the target (rows, samples)."""
    from ssm_decouple.simulation.motion import judge  # brings xarray, which nothing else here needs

    for i, error in enumerate(history):
        if np.isfinite(error[-1]):
            outcome = judge(times, error, tolerance, time_constant)
            outcomes[i], ends[i] = outcome.name, outcome.time
