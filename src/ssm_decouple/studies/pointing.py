"""How far a line of sight wanders while the arm moves, in the dynamic simulation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from ssm_decouple.errors import InputError, as_kind, as_triple
from ssm_decouple.momentum.protection import Protection
from ssm_decouple.simulation.dynamic import Dynamic, Servo
from ssm_decouple.studies.case import Case, checked_case

Floats = NDArray[np.float64]

ARCSEC = 3600.0 * 180.0 / np.pi  # in a radian


@dataclass(frozen=True)
class Pointing:
    """What one law does to a line of sight; arcseconds, as it is for people to read.

    Attributes:
        case: Name of the case.
        law: "none", "selective" (the line of sight protected) or "reactionless"; "planned" with three hold nodes,
            "in the servo" with drives that protect too.
        k: Protected directions.
        peak_arcsec: Largest angle between the line of sight and where it looked at the start.
        rms_arcsec: The same, root mean square over the motion.
        end_arcsec: The same at the end.
        outcome: "converged", "stalled" or "running".
        outcome_time_s: When.
        final_error_m: Distance to the target at the end.
        saturated_s: Time in which a drive stood at its torque limit.
        energy_error: Of the simulation, relative.
        momentum_drift: The same.
    """

    case: str
    law: str
    k: int
    peak_arcsec: float
    rms_arcsec: float
    end_arcsec: float
    outcome: str
    outcome_time_s: float
    final_error_m: float
    saturated_s: float
    energy_error: float
    momentum_drift: float


def pointing_error(motion: xr.Dataset, boresight: ArrayLike) -> Floats:
    """Return the angle between a line of sight fixed in base axes and where it looked at the start (m,), rad."""
    from scipy.spatial.transform import Rotation

    as_kind("motion", motion, xr.Dataset, "give what simulate(..) returns")
    line = as_triple("boresight", boresight, "base axes")
    if not np.any(line):
        raise InputError("boresight is zero; it needs a direction")
    line = line / np.linalg.norm(line)
    lines = Rotation.from_quat(motion.base_quaternion.values).apply(line)
    across = np.linalg.norm(np.cross(lines, lines[0]), axis=1)
    return np.arctan2(across, lines @ lines[0])


def pointing(
    case: Case,
    boresight: ArrayLike = (0.0, 1.0, 0.0),
    physics: Dynamic | None = None,
    progress: Callable[[str, float], object] | None = None,
) -> Iterator[tuple[Pointing, xr.Dataset]]:
    """Run a case with joints driven by torques, under laws that protect nothing, the line of sight, and all axes.

    Args:
        case: The case; its own protection is replaced by that of the line of sight.
        boresight: Where the instrument looks (3,), base axes.
        physics: The dynamic simulation; None is its default.
        progress: Called now and then with the law and the share of its motion that is done.

    Yields:
        For each law the figures and the motion.

    Raises:
        InputError: the boresight is zero or not finite.
    """
    checked_case(case)
    sight = Protection.boresight(boresight)
    physics = Dynamic() if physics is None else as_kind("physics", physics, Dynamic, "give a Dynamic, or None")
    in_servo = replace(physics, servo=replace(physics.servo or Servo(), protects=True))
    laws = {
        "none": (Protection("none"), 0, physics),
        "selective": (sight, 0, physics),
        "selective, planned": (sight, 3, physics),
        "selective, in the servo": (sight, 0, in_servo),
        "reactionless": (Protection("all"), 0, physics),
        "reactionless, planned": (Protection("all"), 3, physics),
    }
    for name, (protection, nodes, method) in laws.items():
        variant = replace(
            case,
            protection=sight,
            law={**case.law, "hold_nodes": nodes},
            simulation={**case.simulation, "method": method},
        )
        motion = variant.run(protection, progress=None if progress is None else partial(progress, name))
        error = ARCSEC * pointing_error(motion, boresight)
        motion.attrs["boresight"] = as_triple("boresight", boresight).tolist()
        yield (
            Pointing(
                case=case.name,
                law=name,
                k=protection.k,
                peak_arcsec=float(error.max()),
                rms_arcsec=float(np.sqrt(np.mean(error**2))),
                end_arcsec=float(error[-1]),
                outcome=motion.attrs["outcome"],
                outcome_time_s=float(motion.attrs["outcome_time"]),
                final_error_m=float(motion.attrs["final_error"]),
                saturated_s=float(motion.saturated_time[-1]),
                energy_error=float(motion.attrs["energy_error"]),
                momentum_drift=float(motion.attrs["momentum_drift"]),
            ),
            motion,
        )
