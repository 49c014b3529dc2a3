"""How far the protected axis really turns when commands are held between samples."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ssm_decouple.errors import as_function, as_items, as_positive
from ssm_decouple.studies.case import Case, checked_case
from ssm_decouple.studies.comparison import disturbance

SAMPLE_TIMES = (0.02, 0.05, 0.1, 0.2, 0.5)
PLANS = {0: "at the sample", 1: "middle of the hold", 2: "two Gauss points", 3: "three Gauss points"}


@dataclass(frozen=True)
class Drift:
    """What one sampled law did to the protected axes; degrees, as it is for people to read.

    Attributes:
        case: Name of the case.
        hold_nodes: How the law plans for the hold; 0 is the paper's projection at the sample.
        sample_time_s: Time between samples.
        drift_deg: Largest true rotation about a protected axis over the motion, in magnitude; m counts as rad where
            the protection is of the whole twist.
        order: Order at which the drift shrinks with the sample time, against the next longer one; None for the longest
            and where the drift is rounding.
        final_error_m: Distance to the target at the end.
    """

    case: str
    hold_nodes: int
    sample_time_s: float
    drift_deg: float
    order: float | None
    final_error_m: float


def sampling(
    case: Case,
    sample_times: Sequence[float] = SAMPLE_TIMES,
    progress: Callable[[int, float, float], object] | None = None,
) -> Iterator[Drift]:
    """Run a case with held commands, for each sample time and each way of planning for the hold.

    The joints follow the commands perfectly and the base moves exactly in between (`method="held"`), so that what is
    left is the law's own error.

    Args:
        case: The case.
        sample_times: Times between samples, s.
        progress: Called now and then with hold nodes, sample time and the share of that motion that is done.

    Yields:
        One result for each way and time, from the longest time to the shortest.
    """
    checked_case(case)
    as_function("progress", progress)
    given = as_items("sample_times", sample_times, "give a list of times, s")
    sample_times = [as_positive("sample time", time, "it must be a positive time, s") for time in given]
    for nodes in PLANS:
        before: Drift | None = None
        for dt in sorted(sample_times, reverse=True):
            variant = replace(
                case, law={**case.law, "hold_nodes": nodes}, simulation={**case.simulation, "method": "held"}
            )
            tick = None if progress is None else lambda share, dt=dt, nodes=nodes: progress(nodes, dt, share)
            motion = variant.run(dt=dt, progress=tick)
            drift = float(np.rad2deg(np.abs(disturbance(motion)[1]).max(initial=0.0)))
            order: float | None = None
            if before is not None and drift > 1e-14:
                order = float(np.log(before.drift_deg / drift) / np.log(before.sample_time_s / dt))
            before = Drift(case.name, nodes, dt, drift, order, float(motion.attrs["final_error"]))
            yield before
