"""The figure of a campaign: how its motions end, how far off, and how far the base turns meanwhile."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ssm_decouple.errors import InputError
from ssm_decouple.studies.campaign import FAILED
from ssm_decouple.studies.shares import wilson
from ssm_decouple.studies.store import Store
from ssm_decouple.viewing.style import PAGE, styled
from ssm_decouple.viewing.targets import FLOOR_MM, draw_rotations, draw_shares

DRAWN = ("outcome", "final_error", "base_rotation")
WORDS = {"case": "the case's own", "all": "all rotation"}  # what the figures call a protection of a campaign
ENDS: dict[str, tuple[str, dict[str, Any]]] = {
    "converged": ("arrived", {"color": "#8CB8D8"}),
    "running": ("still running", {"color": "white", "edgecolor": "#888888", "hatch": "////"}),
    "stalled": ("stalled", {"color": "#E8B98A"}),
    FAILED: ("failed", {"color": "#444444"}),
}

Combinations = dict[str, dict[str, xr.Dataset]]


@styled
def campaign_sheet(store: Store) -> Figure:
    """Draw a campaign, a row a case: ends of its motions, distances left and base rotation under each protection.

    Args:
        store: The campaign's; samples that are not there yet are left out.

    Raises:
        InputError: no sample is there yet.
    """
    cases, status = combinations(store), store.status()
    most = max(map(len, cases.values()))
    figure = Figure(figsize=(PAGE, (1.3 + 0.2 * most) * len(cases) + 0.8))
    grid = figure.subplots(len(cases), 3, squeeze=False, sharex="col", width_ratios=(1.0, 1.0, 1.2))
    for (ends, left, base), (case, found) in zip(grid, cases.items(), strict=True):
        _draw_ends(ends, found)
        ends.set_title(case, loc="left")
        draw_shares(left, {name: 1e3 * rows.final_error.values for name, rows in found.items()}, FLOOR_MM)
        left.set_ylabel("share of the samples")
        arrived = {name: rows.base_rotation.values[rows.outcome.values == "converged"] for name, rows in found.items()}
        draw_rotations(base, arrived)
    grid[-1, 0].set_xlabel("share of the samples,\n95 % interval of arrivals")
    grid[-1, 1].set_xlabel("distance left at the end (mm)")
    grid[-1, 2].set_xlabel("base rotation, peak to peak,\nwhere it arrives (deg)")
    absent = [
        f"{case}, {word}" for case in status.cases for word in status.protections if not _is_in(cases, case, word)
    ]
    told = f"\nno sample yet of {'; '.join(absent)}" if absent else ""
    figure.suptitle(f"{status.title}\n{status.done:,} of {status.samples:,} samples{told}", fontsize=9)
    figure.legend(*_legend(grid[:, 0]), ncols=4, loc="outside lower left")
    figure.legend(*_legend(grid[:, 1]), ncols=4, loc="outside lower right")
    return figure


def combinations(store: Store) -> Combinations:
    """Return what is drawn of the samples that are there, by case and by protection in the figures' words.

    Raises:
        InputError: no sample is there yet.
    """
    status, there, whole = store.status(), store.rows_there(), store.dataset()[list(DRAWN)]
    samples = status.samples // (len(status.cases) * len(status.protections))
    found: Combinations = {}
    for number, (case, word) in enumerate((case, word) for case in status.cases for word in status.protections):
        part = slice(number * samples, (number + 1) * samples)
        if there[part].any():
            rows = whole.isel(sample=part).load().isel(sample=there[part])
            found.setdefault(case, {})[WORDS.get(word, word)] = rows
    if not found:
        raise InputError(f"no sample is in {store.path} yet; 'campaign run' with --resume goes on")
    return found


def _is_in(found: Combinations, case: str, word: str) -> bool:
    return WORDS.get(word, word) in found.get(case, {})


def _draw_ends(axes: Axes, found: Mapping[str, xr.Dataset]) -> None:
    """Draw a bar a protection: which share of its motions ends how."""
    for place, rows in enumerate(found.values()):
        outcome, edge = rows.outcome.values, 0.0
        for end, (label, look) in ENDS.items():
            share = float((outcome == end).mean())
            if share:
                axes.barh(-place, share, left=edge, height=0.7, label=label, linewidth=0.0, **look)
            edge += share
        arrived = int((outcome == "converged").sum())
        low, high = wilson(arrived, len(outcome))
        axes.plot([low, high], [-place, -place], color="black", linewidth=0.9)
        axes.text(1.02, -place, f"{100 * arrived / len(outcome):.1f} %", va="center", fontsize=6.5)
    axes.set(xlim=(0, 1), ylim=(-len(found) + 0.4, 0.6))
    axes.set_yticks([-place for place in range(len(found))], list(found))
    axes.grid(visible=False)


def _legend(column: Any) -> tuple[list[Any], list[str]]:
    """Return what the panels of a column draw, each label once."""
    handles: dict[str, Any] = {}
    for axes in column:
        handles = {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)} | handles
    return list(handles.values()), list(handles)
