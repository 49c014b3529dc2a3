"""How far flexible appendages bend while the arm moves, under several protections."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import xarray as xr

from ssm_decouple.control.schedule import Schedule
from ssm_decouple.errors import InputError
from ssm_decouple.momentum.protection import Protection
from ssm_decouple.simulation.dynamic import Dynamic, Servo
from ssm_decouple.studies.case import Case, checked_case
from ssm_decouple.studies.comparison import largest_rotation_deg

FLEXIBLE = "ets_vii_flexible"
PARALLEL = 0.99  # cosine between two panels' normals from which on they bend together or against each other


@dataclass(frozen=True)
class Bending:
    """What one protection does to the appendages; millimetres, as it is for people to read.

    Attributes:
        case: Name of the case.
        protection: What is protected: "none", "the case's own", "bending modes" or "all rotation".
        k: Protected rows.
        peak_mm: Largest deflection of any appendage's tip.
        symmetric_mm: Of two appendages, the largest mean of their tip deflections along the first one's normal: what
            base translation excites. None where there are not two.
        antisymmetric_mm: The same of half their difference: what base rotation excites.
        outcome: "converged", "stalled" or "running".
        outcome_time_s: When.
        final_error_m: Distance to the target at the end.
        protected_angle_deg: Largest true rotation about the directions that the case itself protects; of rows of the
            whole twist, their angular part.
        energy_error: Of the simulation, relative.
        momentum_drift: The same.
    """

    case: str
    protection: str
    k: int
    peak_mm: float
    symmetric_mm: float | None
    antisymmetric_mm: float | None
    outcome: str
    outcome_time_s: float
    final_error_m: float
    protected_angle_deg: float
    energy_error: float
    momentum_drift: float


def flexible(case: Case) -> Case:
    """Return the case on a robot whose appendages bend: its own, or the flexible ETS-VII in place of the rigid one.

    Raises:
        InputError: the case's robot has no appendages and is not the ETS-VII.
    """
    if checked_case(case).robot.appendages:
        return case
    if case.robot_source != "ets_vii":
        raise InputError(
            f"case '{case.name}': robot '{case.robot_source}' has no appendages to bend; describe them in a TOML file "
            "beside its URDF, as in ets_vii_flexible.toml"
        )
    return replace(case, robot_source=FLEXIBLE)


def protections_of(case: Case) -> dict[str, Protection | Schedule]:
    """Return what to compare: nothing, the case's own, the appendages' first bending modes, all rotation."""
    return {
        "none": Protection("none"),
        "the case's own": case.protection,
        "bending modes": Protection.from_modes(case.robot.modes().participation),
        "all rotation": Protection("all"),
    }


def bending(
    case: Case,
    servo: Servo | None = None,
    smooth_start: float = 8.0,
    step: float = 0.01,
    progress: Callable[[str, float], object] | None = None,
) -> Iterator[tuple[Bending, xr.Dataset]]:
    """Run a case with bending appendages, under each protection in turn.

    The law plans for the hold at three Gauss points, so that what bends the appendages is not its sampling.

    Args:
        case: The case; `flexible` is applied to it.
        servo: The drives; None prescribes the joint rates.
        smooth_start: Time over which the motion gathers pace, s: an array that is jerked rings for minutes.
        step: Physics step, s.
        progress: Called now and then with the protection and the share of its motion that is done.

    Yields:
        For each protection the figures and the motion.
    """
    case = flexible(case)
    variant = replace(
        case,
        law={**case.law, "hold_nodes": 3},
        simulation={**case.simulation, "method": Dynamic(step=step, servo=servo), "smooth_start": smooth_start},
    )
    for name, protection in protections_of(case).items():
        motion = variant.run(protection, progress=None if progress is None else partial(progress, name))
        motion.attrs["protection"] = name
        yield summarise_bending(case, name, motion), motion


def summarise_bending(case: Case, name: str, motion: xr.Dataset) -> Bending:
    """Return a motion with bending appendages in figures."""
    tips = 1e3 * motion.tip_deflection.values
    symmetric, antisymmetric = parts_of(case, tips)
    return Bending(
        case=case.name,
        protection=name,
        k=motion.sizes["protected"],
        peak_mm=float(np.abs(tips).max()),
        symmetric_mm=None if symmetric is None else float(np.abs(symmetric).max()),
        antisymmetric_mm=None if antisymmetric is None else float(np.abs(antisymmetric).max()),
        outcome=motion.attrs["outcome"],
        outcome_time_s=float(motion.attrs["outcome_time"]),
        final_error_m=float(motion.attrs["final_error"]),
        protected_angle_deg=largest_rotation_deg(motion, case.protection),
        energy_error=float(motion.attrs["energy_error"]),
        momentum_drift=float(motion.attrs["momentum_drift"]),
    )


def parts_of(
    case: Case, tips: np.ndarray[tuple[int, ...], np.dtype[np.float64]]
) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.float64]] | None, ...]:
    """Return the symmetric and antisymmetric parts (m,) of two tips' deflections (m, 2), along the first normal.

    None where there are not two, or their panels do not face the same way.
    """
    wings = case.robot.appendages
    if len(wings) != 2:
        return None, None
    aligned = float(wings[0].turned_normal @ wings[1].turned_normal)
    if abs(aligned) < PARALLEL:
        return None, None
    second = tips[:, 1] * np.sign(aligned)
    return 0.5 * (tips[:, 0] + second), 0.5 * (tips[:, 0] - second)
