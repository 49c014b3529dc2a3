"""One case under no protection, its own protection and full reactionless control, side by side."""

from __future__ import annotations

import csv
import json
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ssm_decouple.control.schedule import Schedule
from ssm_decouple.errors import DecoupleWarning, InputError, as_kind
from ssm_decouple.files import written_whole
from ssm_decouple.momentum.protection import Protection
from ssm_decouple.simulation.dynamic import drives_at_limits
from ssm_decouple.simulation.motion import error_of, robot_of
from ssm_decouple.simulation.replay import integral_along, rates_along
from ssm_decouple.simulation.telling import sentences
from ssm_decouple.studies.case import Case, checked_case

LAWS = ("none", "selective", "reactionless")
UNDAMPED = ", undamped"  # behind a law's name: the same with rho = 0


@dataclass(frozen=True)
class Summary:
    """A motion in figures; angles are degrees here, as everything in it is for people to read.

    Attributes:
        case: Name of the case.
        robot: Name of the robot.
        law: "none", "selective" or "reactionless", followed by ", undamped" where rho is zero.
        k: Protected directions.
        outcome: "converged", "stalled" or "running".
        outcome_time_s: When it arrived for good, or stopped making progress.
        start_distance_m: End-effector to target at the start.
        final_error_m: The same at the end.
        final_position_m: Where the end-effector is at the end, inertial axes.
        w_sub_max_rad_s: Largest base angular velocity about any of the case's protected directions, at the samples or,
            of a law that plans for the hold, as mean over it. Where those are of the whole twist, the largest rate
            along any of them: m counts as rad, here and in what follows.
        protected_angle_deg: Largest true rotation from the start about any of them. Of a schedule, under whatever law,
            both count while it protects the direction, the rotation from then on.
        roll_deg: Base roll, peak to peak.
        pitch_deg: Base pitch, peak to peak.
        yaw_deg: Base yaw, peak to peak.
        sigma_min_m: Smallest singular value of J_gt N_sub over the motion.
        sigma_min_time_s: When.
        damped_share: Share of the samples in which rho was above zero.
        rate_limited_share: Share of the samples in which the rates were scaled down to the limits.
        joint_travel_deg: Joint rates' norm integrated over time.
        acceleration_max_deg_s2: Largest change of a joint rate from sample to sample, from rest on, over dt.
        centre_of_mass_drift_m: How far the centre of mass wandered from where the linear momentum takes it: the
            integrator's error, zero in physics.
        saturated: In a dynamic simulation, from when to when, s, a drive stood at its torque limit.
        full_wheels: Which reaction wheels were at full speed, and from when to when, in words.
        limited_drives: Which drives stood at their torque limits, how long, and what it cost the protection, in words.
        lost: Of a stalled motion the direction that its tasks could move least at the end, and what took it, in words.
        told: What was promised and not kept, in words: see `simulate`.
    """

    case: str
    robot: str
    law: str
    k: int
    outcome: str
    outcome_time_s: float
    start_distance_m: float
    final_error_m: float
    final_position_m: tuple[float, float, float]
    w_sub_max_rad_s: float
    protected_angle_deg: float
    roll_deg: float
    pitch_deg: float
    yaw_deg: float
    sigma_min_m: float
    sigma_min_time_s: float
    damped_share: float
    rate_limited_share: float
    joint_travel_deg: float
    acceleration_max_deg_s2: float
    centre_of_mass_drift_m: float
    saturated: tuple[tuple[float, float], ...] = ()
    full_wheels: str = ""
    limited_drives: str = ""
    lost: str = ""
    told: str = ""


def summarise(motion: xr.Dataset, law: str) -> Summary:
    """Return a motion in figures.

    Args:
        motion: A motion of a case, from `Case.run`.
        law: What the row is called.
    """
    as_kind("motion", motion, xr.Dataset, "give a motion of a case, as Case.run(..) returns it")
    if "case_U_c" not in motion.attrs:
        raise InputError("the motion is of no case; give one that Case.run(..) returns")
    time, error = motion.time.values, error_of(motion)
    rate, angle = disturbance(motion)
    swing = np.rad2deg(np.ptp(motion.base_rpy.values, axis=0))
    sigma = motion.smallest_singular_value.values
    speed = np.linalg.norm(motion.joint_rates.values, axis=1)
    rates = motion.joint_rates.values
    changes = np.diff(np.vstack([np.zeros_like(rates[:1]), rates[:-1]]), axis=0)
    drift = motion.centre_of_mass.values - motion.centre_of_mass.values[0]
    drift = drift - np.outer(time - time[0], _linear_velocity(motion))
    x, y, z = (float(value) for value in motion.end_effector_position.values[-1])
    return Summary(
        case=motion.attrs["case"],
        robot=motion.attrs["robot"],
        law=law,
        k=motion.sizes["protected"],
        outcome=motion.attrs["outcome"],
        outcome_time_s=float(motion.attrs["outcome_time"]),
        start_distance_m=float(error[0]),
        final_error_m=float(error[-1]),
        final_position_m=(x, y, z),
        w_sub_max_rad_s=float(np.abs(rate).max(initial=0.0)),
        protected_angle_deg=float(np.rad2deg(np.abs(angle).max(initial=0.0))),
        roll_deg=float(swing[0]),
        pitch_deg=float(swing[1]),
        yaw_deg=float(swing[2]),
        sigma_min_m=float(sigma.min()),
        sigma_min_time_s=float(time[sigma.argmin()]),
        damped_share=float(np.mean(motion.damping.values > 0)),
        rate_limited_share=float(np.mean(motion.rate_scale.values < 1)),
        joint_travel_deg=float(np.rad2deg(np.sum(speed[:-1] * np.diff(time)))),
        acceleration_max_deg_s2=float(np.rad2deg(np.abs(changes / np.diff(time)[:, None]).max())),
        centre_of_mass_drift_m=float(np.linalg.norm(drift, axis=1).max()),
        saturated=tuple((start, end) for start, end in json.loads(motion.attrs.get("saturated", "[]"))),
        full_wheels=full_wheels(motion),
        limited_drives=drives_at_limits(motion),
        lost=lost_direction(motion),
        told="; ".join(sentences(motion)),
    )


def full_wheels(motion: xr.Dataset) -> str:
    """Return in words which reaction wheels were at full speed, and when; nothing where none was."""
    found = json.loads(motion.attrs.get("saturated_wheels", "{}"))
    spans = {name: ", ".join(f"{start:.1f} to {end:.1f} s" for start, end in found[name][:3]) for name in found}
    return "; ".join(f"{name} from {told}{' and again' if found[name][3:] else ''}" for name, told in spans.items())


def _linear_velocity(motion: xr.Dataset) -> np.ndarray[Any, Any]:
    """Return the velocity of the centre of mass (3,), m/s, that the momentum on board means."""
    momentum = np.array(json.loads(motion.attrs["law"])["momentum"][:3])
    return momentum / robot_of(motion).mass if momentum.any() else momentum


def lost_direction(motion: xr.Dataset) -> str:
    """Return in words which direction a stalled motion had lost at its end, and to what; nothing of another."""
    if "lost_direction" not in motion.attrs:
        return ""
    lost = json.loads(motion.attrs["lost_direction"])
    rows = [f"{x:+.2f} {row}" for x, row in zip(lost["direction"], lost["rows"], strict=True) if abs(x) > 0.005]
    told, here = f"it could move least along {', '.join(rows)}: {lost['singular_value']:.1e} m", lost["singular_value"]
    best = int(np.argmax(lost["without"])) if lost["without"] else -1
    if best < 0 or lost["without"][best] <= 2.0 * here:
        return told + ", which no single protected row takes"
    column = ", ".join(f"{x:.3g}" for x in motion.U_c.values[0 if np.any(motion.U_c.values[:3]) else 3 :, best] + 0.0)
    return told + f"; without protected row {best + 1}, ({column}), {lost['without'][best]:.1e} m"


def disturbance(motion: xr.Dataset) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return rate (m, k), rad/s, and angle (m, k), rad, along the directions that the motion's case protects.

    Directions of the whole base twist mix m with rad.

    Under the case's own protection these are the motion's protected_rate and protected_angle; under another they say
    what the same directions suffer.
    """
    U_c, frame = np.array(json.loads(motion.attrs["case_U_c"])).reshape(6, -1), motion.attrs["case_frame"]
    if np.array_equal(U_c, motion.U_c.values) and frame == json.loads(motion.attrs["law"])["frame"]:
        rate, angle = motion.protected_rate.values, motion.protected_angle.values
    else:
        rate, angle = rates_along(motion, U_c, frame), integral_along(motion, U_c, frame)
    shares = _shares_of_case(motion, frame)
    return (rate, angle) if shares is None else _while_on(rate, angle, shares)


def _shares_of_case(motion: xr.Dataset, frame: str) -> np.ndarray[Any, Any] | None:
    """Return how far the case protects each of its directions (m, k), 0 to 1, by time; None where it always does."""
    told = json.loads(motion.attrs.get("case_schedule", "null"))
    if told is None:
        return None
    steps = [(step["start"], Protection(np.reshape(step["U_c"], (6, -1)), frame)) for step in told]
    return _shares(Schedule(steps, hand_over=told[0]["hand_over"]), motion)


def _shares(schedule: Schedule, motion: xr.Dataset) -> np.ndarray[Any, Any]:
    places = zip(motion.time.values.tolist(), motion.configuration.values, strict=True)
    return np.array([schedule.shares(*schedule.at(time, q)) for time, q in places]).reshape(-1, schedule.k)


def _while_on(
    rate: np.ndarray[Any, Any], angle: np.ndarray[Any, Any], shares: np.ndarray[Any, Any]
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return rate and angle of directions, zero while one is not fully protected.

    The angle of a direction is counted from when it came to be.
    """
    on = shares == 1.0
    rate, angle = np.where(on, rate, 0.0), angle.copy()
    for i in range(on.shape[1]):
        begun = np.flatnonzero(on[:, i] & ~np.r_[False, on[:-1, i]])
        which = np.searchsorted(begun, np.arange(len(on)), side="right") - 1
        start = angle[begun[np.maximum(which, 0)], i] if begun.size else 0.0
        angle[:, i] = np.where(on[:, i], angle[:, i] - start, 0.0)
    return rate, angle


def largest_rotation_deg(motion: xr.Dataset, protection: Protection | Schedule) -> float:
    """Return the largest true rotation of the base about directions, deg, whatever the motion's law protects.

    Args:
        motion: Any motion.
        protection: The directions. Of rows of the whole twist the angular part counts; under a schedule a direction
            counts while it is fully protected, from when it came to be.
    """
    turning = protection.U_twist.copy()
    turning[:3] = 0.0
    own = np.array_equal(turning, motion.U_c.values) and protection.frame == json.loads(motion.attrs["law"])["frame"]
    if own and not isinstance(protection, Schedule):
        return float(np.rad2deg(np.abs(motion.protected_angle.values).max(initial=0.0)))  # as good as its method has it
    turned = integral_along(motion, turning, protection.frame)
    if isinstance(protection, Schedule):
        _, turned = _while_on(turned, turned, _shares(protection, motion))
    return float(np.rad2deg(np.abs(turned).max(initial=0.0)))


@dataclass(frozen=True)
class Comparison:
    """One case under several laws.

    Attributes:
        case: The case.
        motions: The motions by law: "none", "selective", "reactionless"; where the damping acted in one of them, also
            the same law undamped, for example "reactionless, undamped".
    """

    case: Case
    motions: Mapping[str, xr.Dataset]

    def __post_init__(self) -> None:
        """Refuse what is no case, or no table of motions.

        Raises:
            InputError: the message names it.
        """
        checked_case(self.case)
        as_kind("motions", self.motions, Mapping, "give motions by the name of their law")  # type: ignore[type-abstract]

    def summaries(self) -> list[Summary]:
        """Return one row of figures a law."""
        return [summarise(motion, law) for law, motion in self.motions.items()]


def laws_of(case: Case) -> dict[str, Protection | Schedule]:
    """Return the protections to compare: none, the case's own, all. One that the case has already is left out."""
    chosen: dict[str, Protection | Schedule] = {
        "none": Protection("none"),
        "selective": case.protection,
        "reactionless": Protection("all"),
    }
    if case.protection.k == 0:
        del chosen["selective"]
    if case.protection.k == 3 and not np.any(case.protection.U_twist[:3]):
        del chosen["reactionless"]
    return chosen


def compare_step_by_step(
    case: Case, dt: float | None = None, progress: Callable[[str, float], object] | None = None
) -> Iterator[tuple[str, xr.Dataset]]:
    """Run a case under each law in turn and give each motion as soon as it is there.

    Args:
        case: The case.
        dt: Time between samples, s, instead of the case's own.
        progress: Called now and then with the law and the share of its motion that is done.

    Yields:
        The law's name and the motion. Where the damping acted, the same law undamped follows: how a singular system is
        regularised decides where the arm ends, so both are shown.
    """
    undamped = replace(checked_case(case), law={**case.law, "damping": 0.0})

    def run(law: str, variant: Case, protection: Protection | Schedule) -> xr.Dataset:
        with warnings.catch_warnings():
            if law != "selective":  # beside the case's own law the rows of the comparison tell
                warnings.simplefilter("ignore", DecoupleWarning)
            return variant.run(protection, dt, None if progress is None else lambda share: progress(law, share))

    for law, protection in laws_of(case).items():
        motion = run(law, case, protection)
        yield law, motion
        if np.any(motion.damping > 0):
            yield law + UNDAMPED, run(law + UNDAMPED, undamped, protection)


def compare(case: Case, dt: float | None = None) -> Comparison:
    """Run a case under no protection, its own protection and full reactionless control.

    Args:
        case: The case.
        dt: Time between samples, s, instead of the case's own.

    Returns:
        The comparison.

    Raises:
        DecoupleError: the case cannot be run; the message says why.
    """
    return Comparison(checked_case(case), dict(compare_step_by_step(case, dt)))


def write_csv(rows: Sequence[Any], path: str | Path) -> Path:
    """Write results, dataclasses of one kind, as a CSV table, whole or not at all.

    Raises:
        FileError: the place cannot be written.
    """
    final = Path(path)
    columns = [column.name for column in fields(rows[0])]
    with written_whole(final) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for row in rows:
            values = (getattr(row, column) for column in columns)
            writer.writerow([" ".join(map(repr, value)) if isinstance(value, tuple) else value for value in values])
    return final
