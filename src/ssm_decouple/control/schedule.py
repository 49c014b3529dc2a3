"""Protections that follow one another, with smooth hand-overs between them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssm_decouple.control import kernel
from ssm_decouple.control.law import FULL, LostDirection, SelectiveLaw
from ssm_decouple.control.task import RateTask
from ssm_decouple.errors import InputError, as_floats, as_items, as_kind, as_number, as_positive, is_function, shown
from ssm_decouple.model.robot import Robot
from ssm_decouple.momentum.protection import Protection
from ssm_decouple.settled import Settled, fixed, fixed_array

Floats = NDArray[np.float64]
Progress = Callable[[float, Floats], float]

_OF_THE_BRIDGE: tuple[int | slice, ...] = (  # what a hand-over's results are, of those that stand in `out`
    slice(kernel.PROTECTED_RATE, kernel.PROTECTED_RATE + 6),
    kernel.RANK,
    kernel.RATE_BLEND,
    kernel.PLAN_CHANGE,
    kernel.EXCESS,
    kernel.LIMITED,
    kernel.LOST,
    kernel.LOST_TO,
)
SHARED = 1e-12  # how far from 1 the cosine between two subspaces may be for a direction to count as in both


class Schedule(Settled):
    """Protections one after the other, each handed over to the next smoothly.

    By time, each but the first begins to enter at its own time and has done so a hand-over later:

        ssm.Schedule([(0.0, "none"), (20.0, "yaw"), (60.0, "roll+yaw")], hand_over=5.0)

    By state, `progress` says where in the list one is: 0 is the first protection, 1 the second, and in between is the
    way from the one to the other. Let it be continuous along the motion:

        ssm.Schedule(["none", "yaw"], progress=lambda time, q: np.clip(2.0 - distance(q), 0.0, 1.0))

    Args:
        protections: Protections or what makes one, such as a name; by time with the time, s, at which each begins to
            enter, the first at 0.
        hand_over: By time: how long each hand-over takes, s.
        progress: By state: a function of the time, s, and of the configuration (nq,).

    Attributes:
        protections: A tuple.
        frame: The axes in which all of them are fixed.
        U_twist: Their directions (6, K), each once.
        k: K.
        rows: For each protection where its directions stand among the K.

    Raises:
        InputError: fewer than two protections, different frames, times that do not start at 0 or leave no room for a
            hand-over, or both or neither of `hand_over` and `progress`.
    """

    def __init__(
        self,
        protections: Sequence[Any],
        hand_over: float | None = None,
        progress: Progress | None = None,
    ) -> None:
        if (hand_over is None) == (progress is None):
            raise InputError("a schedule needs either hand_over, s, for protections with times, or progress(time, q)")
        self._starts: Floats = np.zeros(0)
        self._hand_over, self._progress = 1.0, progress
        if progress is not None and not is_function(progress):
            raise InputError(f"progress is {shown(progress)}; it must be a function of time, s, and configuration")
        given = as_items("protections", protections, "a schedule needs a list of two or more")
        if hand_over is not None:
            self._hand_over = as_positive("hand_over", hand_over)
            given = self._read_times(given)
        self.protections = tuple(p if isinstance(p, Protection) else Protection(p) for p in given)
        if len(self.protections) < 2:
            raise InputError(f"a schedule needs two or more protections, not {len(self.protections)}")
        frames = list(dict.fromkeys(protection.frame for protection in self.protections if protection.k))
        if len(frames) > 1:
            raise InputError(f"the protections of a schedule need the same frame, not {', '.join(frames)}")
        self.frame = frames[0] if frames else "base"
        found: list[Floats] = []
        self.rows = tuple(fixed([_place(found, column) for column in p.U_twist.T]) for p in self.protections)
        self.U_twist: Floats = fixed_array(np.array(found).reshape(-1, 6).T)
        self.k: int = len(found)

    def _read_times(self, given: list[Any]) -> list[Any]:
        if not all(isinstance(pair, list | tuple) and len(pair) == 2 for pair in given):
            raise InputError("a schedule by time is a list of pairs (time in s, protection)")
        self._starts = as_floats("schedule times", [pair[0] for pair in given])
        gaps = np.diff(self._starts)
        if not (np.all(np.isfinite(self._starts)) and self._starts.size and self._starts[0] == 0.0):
            raise InputError(
                f"schedule times are {shown(self._starts.tolist())}; the first protection has to start at 0 s"
            )
        if not (np.all(gaps[:1] > 0) and np.all(gaps[1:] >= self._hand_over)):
            raise InputError(
                f"schedule times {shown(self._starts.tolist())} leave no room for hand-overs of {self._hand_over:g} s; "
                "let them rise, each later than the hand-over before it ends"
            )
        return [pair[1] for pair in given]

    def at(self, time: float, q: Floats) -> tuple[int, float]:
        """Return the number of the protection that is left or stays, and the share in [0, 1) of the next.

        The share rises as 10 x^3 - 15 x^4 + 6 x^5 with the way x, so that neither the rates nor the accelerations of
        the joints jump.

        Raises:
            InputError: `progress` is not in [0, protections - 1].
        """
        last = len(self.protections) - 1
        time = as_number("time", time, "a schedule needs a finite one, s")
        if self._progress is None:
            entering = int(np.searchsorted(self._starts[1:], time, side="right"))  # how many have begun to enter
            way = (time - self._starts[entering]) / self._hand_over if entering else 1.0
            place = entering if way >= 1.0 else entering - 1 + way
        else:
            told = as_floats("progress(time, q) of a schedule", self._progress(time, q))
            place = float(told) if told.shape == () else np.nan
            if not 0.0 <= place <= last:
                raise InputError(f"progress(time, q) of a schedule is {told} at {time:g} s; it is from 0 to {last}")
        number = min(int(place), last)
        x = place - number
        return number, x**3 * (10.0 - 15.0 * x + 6.0 * x**2)

    def seen_from(self, origin: Floats) -> Schedule:
        """Return the schedule for configurations whose base position is counted from another origin (3,), m."""
        if self._progress is None:
            return self
        seen, progress = copy.copy(self), self._progress

        def true_progress(time: float, q: Floats) -> float:
            there = np.array(q, dtype=float)
            there[:3] += origin
            return progress(time, there)

        seen._progress = true_progress
        return seen

    def shared(self, number: int) -> Protection:
        """Return what the protection of that number and the next have in common: it stays protected in between."""
        first, second = (self.protections[i].U_twist for i in (number, number + 1))
        left, cosines, _ = np.linalg.svd(first.T @ second)
        common = first @ left[:, : int(np.sum(cosines > 1.0 - SHARED))]
        return Protection(common, self.frame) if common.size else Protection("none", self.frame)

    def shares(self, number: int, share: float) -> Floats:
        """Return how far each direction is protected (K,), 0 to 1, at a share of the way from a protection on."""
        told = np.zeros(self.k)
        for weight, protection in zip((1.0 - share, share), self.protections[number : number + 2], strict=False):
            inside = np.linalg.norm(protection.U_twist.T @ self.U_twist, axis=0) > 1.0 - SHARED
            told += weight * inside
        return told

    def describe(self) -> str:
        """Say when each protection begins to enter, and what it is."""
        starts = [f"from {start:g} s " for start in self._starts.tolist()] or [""] * len(self.protections)
        return "; then ".join(start + p.describe() for start, p in zip(starts, self.protections, strict=True))

    def settings(self) -> list[dict[str, Any]]:
        """Return the schedule in plain types, for a record."""
        starts = self._starts.tolist() or [None] * len(self.protections)
        return [
            {"start": start, "hand_over": self._hand_over if self._starts.size else None, "U_c": p.U_twist.tolist()}
            for start, p in zip(starts, self.protections, strict=True)
        ]


def _place(found: list[Floats], column: Floats) -> int:
    """Return where a direction stands in a list, to which it is added if it is new."""
    for i, known in enumerate(found):
        if np.abs(known - column).max() < SHARED:
            return i
    found.append(column)
    return len(found) - 1


@dataclass(frozen=True)
class _GivenRates(RateTask):
    """Joint rates as near to given ones as the protection lets them be."""

    gain: float | None = None
    weight: float = 1.0
    level: int = 1


class ScheduledLaw(SelectiveLaw):
    """The selective law under a schedule of protections.

    While one protection hands over to the next the rates are (1 - s) q_dot_1 + s q_dot_2, with s the schedule's share
    and q_dot_1 and q_dot_2 what the law commands under the one and under the other. Rate and acceleration limits that
    both keep are kept, what both protect stays protected, to machine precision, and a row that enters leaves with
    (1 - s) of the rate that the base has without it: J_sub q_dot = b with b going to zero.

    Args:
        robot: The robot.
        schedule: The protections.
        settings: All other arguments of `SelectiveLaw`.

    Attributes:
        schedule: As given.
        phases: The law of each protection.

    Raises:
        InputError: as for `SelectiveLaw`.
    """

    def __init__(self, robot: Robot, schedule: Schedule, **settings: Any) -> None:
        as_kind("schedule", schedule, Schedule, "give a Schedule, or use SelectiveLaw for one Protection")
        self.phases: tuple[SelectiveLaw, ...] = ()
        super().__init__(robot, schedule.protections[0], **settings)
        self.schedule = schedule
        self.phases = tuple(SelectiveLaw(robot, protection, **settings) for protection in schedule.protections)
        # In a hand-over the limits on changes are kept once, by the bridge: two laws that both start from the rates
        # commanded before would each keep part of what the other has changed.
        free = {name: value for name, value in settings.items() if name not in ("acceleration_limit", "limits")}
        self._free = self.phases
        if len(free) < len(settings):
            self._free = tuple(SelectiveLaw(robot, protection, **free) for protection in schedule.protections)
        follow = {**settings, "tasks": _GivenRates(), "damping": 0.0}
        count = len(self.phases) - 1
        self._bridges = tuple(SelectiveLaw(robot, schedule.shared(i), **follow) for i in range(count))
        self._first, self._second = np.empty(self.size), np.empty(self.size)
        self._bridged = np.empty(self._bridges[0].size)

    @property
    def directions(self) -> tuple[Floats, str]:
        """The directions of all protections, columns (6, K), and the axes in which they are fixed."""
        return self.schedule.U_twist, self.schedule.frame

    def shares(self, time: Floats, configurations: Floats) -> Floats | None:
        """Return how far each of the K directions is protected (m, K), 0 to 1."""
        schedule = self.schedule
        told = [schedule.shares(*schedule.at(t, q)) for t, q in zip(time.tolist(), configurations, strict=True)]
        return np.array(told).reshape(len(time), schedule.k)

    def seen_from(self, origin: Floats) -> ScheduledLaw:
        """Return the law for configurations whose base position is counted from another origin (3,), m.

        Its schedule goes on to look at the true ones; the scratch memory of both laws is one.
        """
        seen = copy.copy(self)
        object.__setattr__(seen, "schedule", self.schedule.seen_from(origin))  # a copy that is being made
        return seen

    def lost_direction(self, q: ArrayLike) -> LostDirection:
        """Refuse: it is a matter of one protection.

        Raises:
            InputError: always.
        """
        raise InputError("each protection of a schedule loses its own direction: ask law.phases[i].lost_direction(q)")

    def _set_momentum(self, momentum: ArrayLike | None) -> None:
        super()._set_momentum(momentum)
        if self.phases:  # not while the first of them is made
            for law in (*self.phases, *self._free, *self._bridges):
                law.momentum = self.momentum

    def evaluate(
        self,
        q: ArrayLike,
        target: ArrayLike,
        target_velocity: ArrayLike,
        out: Floats,
        previous_rates: ArrayLike | None = None,
        protected_rate: ArrayLike | None = None,
        pace: float = FULL,
        time: float = 0.0,
    ) -> None:
        """Compute a command into an array, as `SelectiveLaw.evaluate` does; the call does the same.

        `protected_rate` has a number for each of the K rows. The command's own has the rows that are protected then,
        and during a hand-over those of what both protections have; as of one protection it is the mean over the hold
        where the law has hold nodes. The record of a motion has all K.

        Raises:
            InputError: as for `SelectiveLaw`.
        """
        wanted = self._rows_of_each(protected_rate)
        number, share = self.schedule.at(time, self.robot.checked(q))
        if share == 0.0:
            self.phases[number].evaluate(q, target, target_velocity, out, previous_rates, wanted[number], pace)
            self._limited, self._k = self.phases[number].limited, self.phases[number].protection.k
            return
        self._checked_out(out)
        for phase, values in ((number, self._first), (number + 1, self._second)):
            self._free[phase].evaluate(q, target, target_velocity, values, previous_rates, wanted[phase], pace)
        n, first, second, bridged = self._n, self._first, self._second, self._bridged
        rates, bridge = first[6 : 6 + n] + share * (second[6 : 6 + n] - first[6 : 6 + n]), self._bridges[number]
        asked = None if protected_rate is None else self._bridge(number, wanted)
        bridge.evaluate(q, np.zeros(0), rates, bridged, previous_rates, asked)
        out[:] = first if share < 0.5 else second
        out[: 6 + n] = bridged[: 6 + n]
        for kept in _OF_THE_BRIDGE:
            out[6 + n :][kept] = bridged[6 + n :][kept]
        out[6 + n + kernel.RATE_SCALE] = min(part[6 + n + kernel.RATE_SCALE] for part in (first, second, bridged))
        self._limited, self._k = bridge.limited, bridge.protection.k

    def _rows_of_each(self, protected_rate: ArrayLike | None) -> list[Floats | None]:
        if protected_rate is None:
            return [None] * len(self.phases)
        rate = as_floats("protected_rate", protected_rate)
        if rate.shape != (self.schedule.k,) or not np.all(np.isfinite(rate)):
            raise InputError(
                f"protected_rate is {shown(rate.tolist())}; it needs {self.schedule.k} finite numbers, one a direction "
                "of the schedule"
            )
        return [rate[rows] for rows in self.schedule.rows]

    def _bridge(self, number: int, wanted: list[Floats | None]) -> Floats:
        """Return what is asked for along the rows that a protection and the next share."""
        given = wanted[number]
        assert given is not None
        return self._bridges[number].protection.U_twist.T @ self.schedule.protections[number].U_twist @ given

    def describe(self) -> dict[str, Any]:
        """Return the law's settings in plain types, for a record."""
        told = {"U_c": self.schedule.U_twist.tolist(), "frame": self.schedule.frame, "k": self.schedule.k}
        return {**super().describe(), **told, "schedule": self.schedule.settings()}
