"""The batch engine that is compiled by Numba and runs in threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from threading import Event
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ssm_decouple.batch import lanes, rows
from ssm_decouple.batch.base import NO_ROWS, Engine, Floats, Judge, Progress, Wanted
from ssm_decouple.control import kernel
from ssm_decouple.control.law import SelectiveLaw
from ssm_decouple.errors import as_whole
from ssm_decouple.model.robot import Robot
from ssm_decouple.momentum.protection import Protection

CONFIGURATIONS = 8192  # that a thread works on at a time
MOST_THREADS = 1024
MOTIONS = 256  # likewise: their matrices stay in the processor's cache
SAMPLES = 2**22  # of errors that a thread keeps: fewer motions at a time where they are long


class Batch(Engine):
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
        super().__init__(robot, end_effector)
        needs = "give a positive whole number, or None for one a processor"
        count = None if threads is None else as_whole("threads", threads, 1, needs, MOST_THREADS)
        self.threads: int = count or os.cpu_count() or 1

    def __repr__(self) -> str:
        return f"Batch({self.robot!r}, end_effector={self.end_effector!r}, threads={self.threads})"

    def _evaluate(
        self, joints: NDArray[Any], protections: list[Protection], wanted: Wanted, progress: Progress | None
    ) -> None:
        packed = _packed(protections)

        def work(start: int, end: int) -> None:
            part = np.require(joints[start:end], np.float64, ["C", "A", "W", "E"])
            lanes.evaluate(*self._constants, part, *packed, *wanted.part(start, end))

        _spread(len(joints), CONFIGURATIONS, self.threads, work, progress)

    def _command(self, law: SelectiveLaw, joints: Floats, poses: Floats, targets: Floats, out: Floats) -> None:
        constants = law.constants()

        def work(start: int, end: int) -> None:
            part = slice(start, end)
            seen, values = np.empty((end - start, 3)), self._row_values(end - start)
            rows.see_targets(poses[part], targets[part], seen)
            self._solve(constants, joints[part], seen, values, out[part])

        _spread(len(joints), CONFIGURATIONS, self.threads, work)

    def _row_values(self, count: int) -> Floats:
        return np.empty((count, 12 * self.robot.n_joints + lanes.SINGLES))

    def _solve(
        self, law: tuple[Floats, Floats, Floats, Floats], joints: Floats, seen: Floats, values: Floats, out: Floats
    ) -> None:
        """Write what the law commands at joint positions, targets being seen from the base, into `out`."""
        lanes.evaluate(*self._constants, joints, *_packed(()), values, NO_ROWS, NO_ROWS, NO_ROWS)
        kernel.solve_rows(values, *law, seen, out)

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
        constants, stop = law.constants(), Event()
        results, k = 6 + self.robot.n_joints, law.protection.k
        protected, errors = results + kernel.PROTECTED_RATE, results + kernel.ERRORS
        holds = np.diff(times, append=times[-1])

        def work(start: int, end: int) -> None:
            part, count = slice(start, end), end - start
            own, at, kept, wanted = joints[part], poses[part], record[part], targets[part]
            values, out, seen = self._row_values(count), np.empty((count, law.size)), np.empty((count, 3))
            history = np.empty((times.size, count))
            kept[:] = 0.0
            kept[:, rows.SMALLEST : rows.HIGHEST] = np.inf
            kept[:, rows.HIGHEST : rows.LATEST] = -np.inf
            trail = np.zeros((count, rows.TRAIL_SIZE, self.robot.n_joints))
            trail[:, rows.BEFORE] = np.nan
            for i, hold in enumerate(holds):
                if stop.is_set():
                    break
                rows.see_targets(at, wanted, seen)
                self._solve(constants, own, seen, values, out)
                rows.advance(out, protected, k, errors + 3, errors, hold, own, at, kept, trail, history[i])
            judge(part, history.T)

        share = -(-len(joints) // self.threads)
        size = max(1, min(MOTIONS, SAMPLES // times.size, share))
        _spread(len(joints), size, self.threads, work, progress, stop)


def _packed(protections: Sequence[Protection]) -> tuple[Floats, NDArray[np.int64], NDArray[np.int64]]:
    """Return directions, counts and first rows as `lanes.evaluate` wants them."""
    P = len(protections)
    directions, counts, firsts = np.zeros((P, 6, 6)), np.zeros(P, dtype=np.int64), np.zeros(P, dtype=np.int64)
    for i, protection in enumerate(protections):
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
