"""The batch engine: a robot's matrices, commands and motions for arrays of configurations."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from threading import Event
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssm_decouple.batch import lanes, rows
from ssm_decouple.batch.constants import constants_of
from ssm_decouple.batch.results import Commands, Matrices, Motions
from ssm_decouple.control import kernel
from ssm_decouple.control.law import SelectiveLaw
from ssm_decouple.control.schedule import ScheduledLaw
from ssm_decouple.errors import InputError, as_floats, as_positive
from ssm_decouple.model.robot import Robot
from ssm_decouple.momentum.protection import Protection
from ssm_decouple.simulation.steps import sample_times

Floats = NDArray[np.float64]
Progress = Callable[[float], object]
LawConstants = tuple[Floats, Floats, Floats, Floats]  # of `SelectiveLaw.constants`

CONFIGURATIONS = 8192  # that a thread works on at a time
MOTIONS = 256  # likewise: their matrices stay in the processor's cache
SAMPLES = 2**22  # of errors that a thread keeps: fewer motions at a time where they are long
NO_ROWS: Floats = np.empty((0, 0))


class Batch:
    """A robot whose matrices, commands and motions are computed for many configurations at once.

    The numbers are those of `Robot.coupling`, `SelectiveLaw` and `simulate(.., method="explicit")`, to rounding. The
    constants are read from `robot.model` when the engine is made; what walks the tree then is compiled, at the first
    use, and runs in threads. Memory grows with the results alone.

    Joint positions come as arrays (N, n) in the order of `robot.joint_names`, rad or m, continuous joints as angles. A
    row that is not finite gives a row of NaN and disturbs no other; no rows give empty results.

    Args:
        robot: The robot.
        end_effector: The frame whose translation J_gt is of; None is the robot's end-effector.
        threads: How many at a time; None is one a processor.

    Raises:
        InputError: the robot has no joints, no such frame, a joint of a kind that is not supported (it is named), or
            threads is no positive whole number.
    """

    def __init__(self, robot: Robot, end_effector: str | None = None, threads: int | None = None) -> None:
        if robot.n_joints == 0:
            raise InputError(f"'{robot.name}' has no joints; put an arm on it with compose(..)")
        if threads is not None and not (isinstance(threads, int) and threads > 0):
            raise InputError(f"threads is {threads!r}; give a positive whole number, or None for one a processor")
        self.robot = robot
        self.end_effector = robot.end_effector if end_effector is None else end_effector
        self.threads: int = threads or os.cpu_count() or 1
        self._constants = constants_of(robot, robot.frame_id(self.end_effector))
        self._continuous = [joint.nq == 2 for joint in list(robot.model.joints)[2:]]
        self._places = [joint.idx_q for joint in list(robot.model.joints)[2:]]

    def __repr__(self) -> str:
        return f"Batch({self.robot!r}, end_effector={self.end_effector!r}, threads={self.threads})"

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
        given = self._rows("joints", joints)
        N, P = len(given), len(protections)
        found = Matrices(
            np.empty((N, 12 * self.robot.n_joints + lanes.SINGLES)),
            self.robot.n_joints,
            np.empty((N, P)),
            np.empty((N, P)),
        )
        self._evaluate(given, protections, found.values, found.smallest_singular_values, found.manipulability, progress)
        return found

    def singular_values(
        self, joints: ArrayLike, protections: Sequence[Protection | str], progress: Progress | None = None
    ) -> Floats:
        """Return the smallest singular value of J_gt N_sub (N, P), m; the arguments are those of `matrices`.

        It is `Coupling.manipulability(..).smallest`, and `Command.smallest_singular_value` of a law without joint
        weights. 0 where the protection leaves fewer than three freedoms.
        """
        given = self._rows("joints", joints)
        smallest = np.empty((len(given), len(protections)))
        self._evaluate(given, protections, NO_ROWS, smallest, NO_ROWS, progress)
        return smallest

    def blocks(
        self, joints: ArrayLike, protections: Sequence[Protection | str] = (), size: int = 65536
    ) -> Iterator[tuple[slice, Matrices]]:
        """Yield the matrices of `size` rows after `size` rows, each with where it belongs: for more than memory holds.

        The other arguments are those of `matrices`. `joints` may be a memory-mapped array.
        """
        if size < 1:
            raise InputError(f"size is {size}; a block needs at least one row")
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
        out, constants = np.empty((len(joints), law.size)), law.constants()

        def work(start: int, end: int) -> None:
            part = slice(start, end)
            seen, values = np.empty((end - start, 3)), self._row_values(end - start)
            rows.see_targets(poses[part], wanted[part], seen)
            self._command(constants, joints[part], seen, values, out[part])

        _spread(len(joints), CONFIGURATIONS, self.threads, work)
        commands = Commands(out, self.robot.n_joints, law.protection.k)
        turned = _rotations(poses)
        commands.end_effector_position[:] = _turned(turned, commands.end_effector_position) + poses[:, :3]
        commands.end_effector_error[:] = _turned(turned, commands.end_effector_error)
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
        times = sample_times(as_positive("duration", duration), as_positive("dt", dt))
        tolerance = as_positive("arrival_tolerance", arrival_tolerance)
        joints, poses, wanted = self._starts(law, starts, targets)
        N, constants = len(joints), law.constants()
        record, errors = np.empty((N, rows.RECORD_SIZE)), np.empty(N)
        outcomes: NDArray[np.str_] = np.full(N, "undefined", dtype="<U9")
        outcome_times: Floats = np.full(N, np.nan)
        stop = Event()

        def work(start: int, end: int) -> None:
            part = slice(start, end)
            history = self._move(
                constants,
                (law.size, law.protection.k),
                joints[part],
                poses[part],
                wanted[part],
                times,
                record[part],
                stop,
            )
            errors[part] = history[:, -1]
            _judge(times, history, tolerance, 1.0 / law.gain, outcomes[part], outcome_times[part])

        share = -(-N // self.threads)
        _spread(N, max(1, min(MOTIONS, SAMPLES // times.size, share)), self.threads, work, progress, stop)
        record[np.isnan(errors)] = np.nan
        return Motions(
            outcome=outcomes,
            outcome_time=outcome_times,
            final_error=errors,
            joint_travel=record[:, rows.TRAVEL],
            peak_rate=record[:, rows.PEAK],
            protected_rate=record[:, rows.LEAK],
            base_rotation=record[:, rows.HIGHEST : rows.HIGHEST + 3] - record[:, rows.LOWEST : rows.LOWEST + 3],
            smallest_singular_value=record[:, rows.SMALLEST],
            configuration=self._configurations(joints, poses),
        )

    def _evaluate(
        self,
        joints: NDArray[Any],
        protections: Sequence[Protection | str],
        values: Floats,
        smallest: Floats,
        volumes: Floats,
        progress: Progress | None,
    ) -> None:
        packed = _packed(protections)

        def work(start: int, end: int) -> None:
            part = np.require(joints[start:end], np.float64, ["C", "A", "W", "E"])
            lanes.evaluate(*self._constants, part, *packed, values[start:end], smallest[start:end], volumes[start:end])

        _spread(len(joints), CONFIGURATIONS, self.threads, work, progress)

    def _row_values(self, count: int) -> Floats:
        return np.empty((count, 12 * self.robot.n_joints + lanes.SINGLES))

    def _command(self, law: LawConstants, joints: Floats, seen: Floats, values: Floats, out: Floats) -> None:
        """Write what the law commands at joint positions, targets being seen from the base, into `out`."""
        lanes.evaluate(*self._constants, joints, *_packed(()), values, np.empty((len(joints), 0)), NO_ROWS)
        kernel.solve_rows(values, *law, seen, out)

    def _move(
        self,
        law: LawConstants,
        sizes: tuple[int, int],
        joints: Floats,
        poses: Floats,
        targets: Floats,
        times: Floats,
        record: Floats,
        stop: Event,
    ) -> Floats:
        """Move joints and poses to the end of the motion; return the distances to the targets (rows, samples).

        `sizes` are the law's size and its number of protected directions.
        """
        count, (size, k) = len(joints), sizes
        values, out, seen = self._row_values(count), np.empty((count, size)), np.empty((count, 3))
        history = np.empty((times.size, count))
        record[:] = 0.0
        record[:, rows.SMALLEST : rows.HIGHEST] = np.inf
        record[:, rows.HIGHEST :] = -np.inf
        errors = 6 + joints.shape[1] + kernel.ERRORS
        for i, hold in enumerate(np.diff(times, append=times[-1])):
            if stop.is_set():
                break
            rows.see_targets(poses, targets, seen)
            self._command(law, joints, seen, values, out)
            rows.advance(out, k, errors + 3, errors, hold, joints, poses, record, history[i])
        return history.T

    def _rows(self, name: str, joints: ArrayLike) -> NDArray[Any]:
        given = np.asarray(joints)
        if given.dtype.kind not in "fiu":
            given = as_floats(name, joints)
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
            (given, np.tile([0.0, 0, 0, 0, 0, 0, 1], (len(given), 1))) if given.shape[1] == n else (self._split(given))
        )
        spread = [np.broadcast_to(part, (N, part.shape[1])).copy() for part in (joints, poses, wanted)]
        return spread[0], spread[1], spread[2]

    def _split(self, configurations: Floats) -> tuple[Floats, Floats]:
        """Return joint positions and base poses of configurations."""
        poses, joints = configurations[:, :7], configurations[:, self._places]
        off = np.abs(np.linalg.norm(poses[:, 3:], axis=1) - 1.0) > 1e-6
        if off.any():
            row = int(np.argmax(off))
            raise InputError(
                f"row {row} of configurations has a quaternion {poses[row, 3:].tolist()} that is not of unit length; "
                "use pinocchio.normalize(model, q)"
            )
        for j in np.flatnonzero(self._continuous):
            place = self._places[j]
            joints[:, j] = np.arctan2(configurations[:, place + 1], configurations[:, place])
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
        if not isinstance(law, SelectiveLaw):
            raise InputError(f"law is {law!r}; give a SelectiveLaw")
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


def _packed(protections: Sequence[Protection | str]) -> tuple[Floats, NDArray[np.int64], NDArray[np.int64]]:
    """Return directions, counts and first rows as `lanes.evaluate` wants them."""
    if isinstance(protections, (str, Protection)):
        raise InputError(f"protections is {protections!r}; give a list, such as ['none', 'yaw']")
    checked = [Protection(given) if isinstance(given, str) else given for given in protections]
    P = len(checked)
    directions, counts, firsts = np.zeros((P, 6, 6)), np.zeros(P, dtype=np.int64), np.zeros(P, dtype=np.int64)
    for i, protection in enumerate(checked):
        if not isinstance(protection, Protection):
            raise InputError(f"protection {i + 1} is {protection!r}; give a Protection, or a name such as 'yaw'")
        if protection.frame != "base":
            raise InputError(
                f"protection {i + 1} is fixed in '{protection.frame}' axes; without base poses only 'base' makes sense"
            )
        directions[i, :, : protection.k], counts[i] = protection.U_twist, protection.k
        firsts[i] = 0 if protection.U_twist[:3].any() else 3
    return directions, counts, firsts


def _spread(
    count: int,
    size: int,
    threads: int,
    work: Callable[[int, int], None],
    progress: Progress | None = None,
    stop: Event | None = None,
) -> None:
    """Call work(start, end) for `size` rows after `size` rows, in threads: compiled code runs in them side by side."""
    spans = [(start, min(start + size, count)) for start in range(0, count, size)]
    if threads == 1 or len(spans) < 2:
        for done, span in enumerate(spans, 1):
            work(*span)
            if progress is not None:
                progress(done / len(spans))
        return
    with ThreadPoolExecutor(threads) as pool:
        try:
            futures = [pool.submit(work, *span) for span in spans]
            for done, future in enumerate(as_completed(futures), 1):
                future.result()
                if progress is not None:
                    progress(done / len(spans))
        except BaseException:  # Ctrl-C too: what has not begun does not begin
            if stop is not None:
                stop.set()
            pool.shutdown(cancel_futures=True)
            raise


def _judge(
    times: Floats, history: Floats, tolerance: float, time_constant: float, outcomes: NDArray[np.str_], ends: Floats
) -> None:
    """Fill outcome and its time of motions, from their distances to the target (rows, samples)."""
    from ssm_decouple.simulation.motion import judge  # brings xarray, which nothing else here needs

    for i, error in enumerate(history):
        if np.isfinite(error[-1]):
            outcome = judge(times, error, tolerance, time_constant)
            outcomes[i], ends[i] = outcome.name, outcome.time


def _rotations(poses: Floats) -> Floats:
    """Return the rotations (N, 3, 3) of poses (N, 7) with unit quaternions."""
    x, y, z, w = poses[:, 3:].T
    turned = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(turned), 2, 0)


def _turned(rotations: Floats, vectors: Floats) -> Floats:
    return np.einsum("nij,nj->ni", rotations, vectors)
