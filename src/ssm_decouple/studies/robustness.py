"""What is left of the protection when the model is wrong, the sensors are noisy and the drives lag."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from ssm_decouple.errors import (
    InputError,
    as_items,
    as_not_negative,
    as_number,
    as_positive,
    as_seed,
    as_whole,
    shown,
)
from ssm_decouple.model.perturb import Tolerances, perturbed
from ssm_decouple.momentum.protection import Protection
from ssm_decouple.settled import Settled
from ssm_decouple.simulation.dynamic import Dynamic, Load, Sensors, Servo
from ssm_decouple.studies.case import Case, checked_case
from ssm_decouple.studies.comparison import largest_rotation_deg

LEVELS = (0.01, 0.02, 0.05, 0.1)
RUNS = 200
MOST_RUNS = 10**5
MOST_WORKERS = 1024
FEEDBACK_GAIN = 1.0  # 1/s
STEP = 0.02  # s: of the physics, a quarter of the servo's radian
METRES_PER_LEVEL = 0.1  # what a tolerance of 1 stands for where lengths are concerned: 5 % is 5 mm


@dataclass(frozen=True)
class Leak:
    """How far the protected axes really turn at one level of error in the model; degrees, for people to read.

    Attributes:
        case: Name of the case.
        level: Tolerance of masses and inertias, relative; of centres of mass, mounts and lengths, that many tenths of a
            metre.
        feedback_gain: K, 1/s; 0 for none.
        runs: Number of random plants.
        median_deg: Median over the plants of the largest true rotation about a protected axis.
        low_deg: 2.5th percentile.
        high_deg: 97.5th percentile.
        largest_deg: The worst plant.
        unprotected_deg: The same rotation with no protection and no error.
        gain_median: unprotected_deg over median_deg.
        gain_worst: unprotected_deg over largest_deg.
        arrived: Share of the plants on which the end-effector arrived.
    """

    case: str
    level: float
    feedback_gain: float
    runs: int
    median_deg: float
    low_deg: float
    high_deg: float
    largest_deg: float
    unprotected_deg: float
    gain_median: float
    gain_worst: float
    arrived: float


@dataclass(frozen=True)
class Effect:
    """What one imperfection alone does, the model being right; degrees.

    Attributes:
        case: Name of the case.
        cause: What is imperfect.
        without_deg: Largest true rotation about a protected axis without feedback.
        with_deg: With it.
        final_error_m: Distance to the target at the end, with feedback.
    """

    case: str
    cause: str
    without_deg: float
    with_deg: float
    final_error_m: float


CAUSES: dict[str, Dynamic] = {
    "nothing": Dynamic(step=STEP),
    "servo of 1 Hz instead of 2": Dynamic(step=STEP, servo=Servo(frequency=1.0)),
    "servo of 0.5 Hz": Dynamic(step=STEP, servo=Servo(frequency=0.5)),
    "encoders, noise 0.1 mrad": Dynamic(step=STEP, sensors=Sensors(encoder_noise=1e-4)),
    "encoders, steps of 1 mrad": Dynamic(step=STEP, sensors=Sensors(encoder_resolution=1e-3)),
    "gyros, noise 1e-6 rad/s": Dynamic(step=STEP, sensors=Sensors(gyro_noise=1e-6)),
    "gyros, noise 1e-5 rad/s": Dynamic(step=STEP, sensors=Sensors(gyro_noise=1e-5)),
    "10 mN m on each axis, 20 to 30 s": Dynamic(step=STEP, load=Load((0.01, 0.01, 0.01), start=20.0, duration=10.0)),
}


def true_rotation(case: Case, physics: Dynamic, protection: Protection | None = None) -> tuple[float, float, bool]:
    """Run a case and return the largest true rotation about its protected axes, deg, what is left, m, and arrival."""
    variant = replace(
        case,
        law={**checked_case(case).law, "hold_nodes": 1},
        simulation={**case.simulation, "method": physics},
    )
    motion = variant.run(protection)
    arrived = motion.attrs["outcome"] == "converged"
    return largest_rotation_deg(motion, case.protection), float(motion.attrs["final_error"]), arrived


def tolerances_at(level: float) -> Tolerances:
    """Return the tolerances of a level of error."""
    level = as_not_negative("level", level)
    length = METRES_PER_LEVEL * level
    return Tolerances(level, level, length, length, length)


def _one_run(case: Case, level: float, gain: float, seed: int) -> tuple[float, bool]:
    plant = perturbed(case.robot, tolerances_at(level), seed)
    turned, _, arrived = true_rotation(case, Dynamic(step=STEP, plant=plant, feedback_gain=gain))
    return turned, arrived


@dataclass
class Robustness(Settled):
    """A Monte Carlo study of one case, in worker processes; what is done stays when it is interrupted.

    Attributes:
        case: The case; its protection has to be of rotation.
        levels: Levels of error, see `Leak`.
        runs: Random plants at each level; plant i of a level is the same with and without feedback.
        feedback_gain: K, 1/s, of the runs with feedback.
        seed: Of the plants.
        workers: Number of processes.
        found: Results so far: (level, gain) to plant number to rotation, deg, and whether the end-effector arrived.
        unprotected: The rotation with nothing protected and no error, deg; computed before the first plant.
    """

    _assignable: ClassVar[tuple[str, ...]] = ("unprotected",)

    case: Case
    levels: Sequence[float] = LEVELS
    runs: int = RUNS
    feedback_gain: float = FEEDBACK_GAIN
    seed: int = 0
    workers: int = 2
    found: dict[tuple[float, float], dict[int, tuple[float, bool]]] = field(default_factory=dict)
    unprotected: float | None = None

    def __post_init__(self) -> None:
        """Refuse what makes no study.

        Raises:
            InputError: a level outside (0, 1), no runs, no worker, a gain that is not positive, or a case that does not
                protect rotation alone.
        """
        checked_case(self.case)
        self.levels = tuple(as_number("level", level) for level in as_items("levels", self.levels, "give a list"))
        for level in self.levels:
            if not 0 < level < 1:
                raise InputError(f"level {level} is no tolerance: give shares above 0 and below 1, 0.05 for 5 %")
        for name, most, wrong in (
            ("runs", MOST_RUNS, "runs are no study"),
            ("workers", MOST_WORKERS, "workers do nothing"),
        ):
            try:
                setattr(self, name, as_whole(name, getattr(self, name)))
            except InputError:
                raise InputError(f"{shown(getattr(self, name))} {wrong}; give at least 1") from None
            as_whole(name, getattr(self, name), most=most)
        self.feedback_gain = as_positive("feedback_gain", self.feedback_gain, "it must be positive, 1/s")
        self.seed = as_seed("seed", self.seed)
        if self.case.protection.k == 0 or np.any(self.case.protection.U_twist[:3]):
            raise InputError(f"case '{self.case.name}' needs a protection of rotation: one to three directions")

    def run(self, progress: Callable[[float], object] | None = None) -> None:
        """Run all that is not yet found.

        Args:
            progress: Called after each run with the share that is done.

        Raises:
            KeyboardInterrupt: Ctrl-C; `found` keeps what was done.
        """
        if self.unprotected is None:
            self.unprotected, *_ = true_rotation(self.case, Dynamic(step=STEP), Protection("none"))
        plain = replace(self.case)  # without a loaded robot, which would travel to the workers
        todo = [
            (level, gain, i)
            for i in range(self.runs)
            for level in self.levels
            for gain in (0.0, self.feedback_gain)
            if i not in self.found.get((level, gain), {})
        ]
        pool = ProcessPoolExecutor(self.workers, initializer=signal.signal, initargs=(signal.SIGINT, signal.SIG_IGN))
        try:
            tasks = {
                pool.submit(_one_run, plain, level, gain, self._seed(i)): (level, gain, i) for level, gain, i in todo
            }
            for done, task in enumerate(as_completed(tasks), 1):
                level, gain, i = tasks[task]
                self.found.setdefault((level, gain), {})[i] = task.result()
                if progress is not None:
                    progress(done / len(todo))
        finally:
            pool.shutdown(wait=False, cancel_futures=True)

    def _seed(self, i: int) -> int:
        """Return the seed of plant i, the same at every level: there its errors are only larger or smaller."""
        return int(np.random.SeedSequence([self.seed, i]).generate_state(1)[0])

    def leaks(self) -> list[Leak]:
        """Return the figures of what has been found, by level, without feedback first."""
        unprotected, rows = self.unprotected or np.nan, []
        for (level, gain), runs in sorted(self.found.items()):
            turned = np.array([turned for turned, _ in runs.values()])
            low, median, high = np.percentile(turned, [2.5, 50.0, 97.5])
            rows.append(
                Leak(
                    case=self.case.name,
                    level=level,
                    feedback_gain=gain,
                    runs=len(turned),
                    median_deg=float(median),
                    low_deg=float(low),
                    high_deg=float(high),
                    largest_deg=float(turned.max()),
                    unprotected_deg=unprotected,
                    gain_median=unprotected / float(median),
                    gain_worst=unprotected / float(turned.max()),
                    arrived=float(np.mean([arrived for _, arrived in runs.values()])),
                )
            )
        return rows


def slope(rows: Sequence[Leak]) -> float | None:
    """Return the power of the error with which the median leak grows; None for less than two levels."""
    if len(rows) < 2:
        return None
    return float(np.polyfit(np.log([row.level for row in rows]), np.log([row.median_deg for row in rows]), 1)[0])


def effects(case: Case, feedback_gain: float = FEEDBACK_GAIN) -> Iterator[Effect]:
    """Run a case with one imperfection at a time, without feedback and with it.

    Args:
        case: The case.
        feedback_gain: K, 1/s.

    Yields:
        One result for each of CAUSES.
    """
    for cause, physics in CAUSES.items():
        without, *_ = true_rotation(case, physics)
        fed_back, left, _ = true_rotation(case, replace(physics, feedback_gain=feedback_gain))
        yield Effect(case.name, cause, without, fed_back, left)
