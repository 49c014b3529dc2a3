"""The figures of a motion: the paper's set, and one sheet that compares laws."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ssm_decouple.simulation.motion import error_of
from ssm_decouple.studies.bending import parts_of
from ssm_decouple.studies.case import Case
from ssm_decouple.studies.comparison import disturbance
from ssm_decouple.studies.pointing import ARCSEC, pointing_error
from ssm_decouple.studies.robustness import Leak
from ssm_decouple.studies.sampling import PLANS, Drift
from ssm_decouple.viewing.angles import JOINT_UNITS, joint_kinds, unwrapped
from ssm_decouple.viewing.spacecraft import draw_configurations
from ssm_decouple.viewing.style import (
    AXIS_COLORS,
    AXIS_LINES,
    COLUMN,
    LAW_LINES,
    PAGE,
    PROTECTED,
    ROOM,
    floored,
    joint_colors,
    panels,
    save,
    styled,
    tell_floor,
    tell_gaps,
)

Floats = NDArray[np.float64]

FLOOR = 1e-21  # rad/s: zero on a logarithmic axis
FLOOR_ERROR = 1e-12  # mm, or 1e-3 of what a task's error is: the rounding of metres
FLOOR_SIGMA = 1e-9  # m
FLOOR_DRIFT = 1e-19  # deg
FLOOR_TIP = 1e-6  # mm
FLOOR_POINTING = 1e-12  # arcsec
GAIN_COLORS = (PROTECTED, "#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9")
LISTED = 12  # joints that a legend has room for


@styled
def joints(motion: xr.Dataset) -> Figure:
    """Draw positions over rates, in panels of their own for joints that turn, joints that slide and reaction wheels."""
    kinds = joint_kinds(motion)
    shown = [kind for kind in JOINT_UNITS if kind in kinds]
    figure, panels_ = panels(2 * len(shown))
    positions, rates = motion.joint_positions.values, motion.joint_rates.values
    colors, count = joint_colors(motion.sizes["joint"]), motion.sizes["joint"]
    for row, kind in enumerate(shown):
        name, unit, factor = JOINT_UNITS[kind]
        top, bottom = panels_[2 * row : 2 * row + 2]
        for i in np.flatnonzero(np.array(kinds) == kind):
            # Neighbours differ in more than shade.
            style: dict[str, Any] = {"color": colors[i], "linestyle": ("-", (0, (4, 1.2)))[i % 2]}
            label = str(motion.joint.values[i]).replace("_", " ")
            top.plot(motion.time, factor * positions[:, i], label=label, **style)
            bottom.plot(motion.time, factor * rates[:, i], **style)
        top.set_ylabel(f"{name} ({unit})")
        bottom.set_ylabel(f"{name.split()[0]} rate ({unit}/s)")
    if count <= LISTED:
        listed = [each for axes in panels_[::2] for each in zip(*axes.get_legend_handles_labels(), strict=True)]
        handles, labels = zip(*listed, strict=True)
        figure.legend(handles, labels, ncols=3, loc="outside upper center")
    else:
        first, last = (str(name).replace("_", " ") for name in motion.joint.values[[0, -1]])
        figure.suptitle(f"{count} joints, from {first} (dark) to {last} (light)", fontsize=7)
    return _with_time(motion, figure, panels_[-1])


@styled
def base(motion: xr.Dataset) -> Figure:
    """Draw the base attitude, without jumps at +-180 deg, over the base angular velocity."""
    figure, (top, bottom) = panels(2)
    attitude = np.rad2deg(unwrapped(motion.base_rpy.values))
    for i, (name, line) in enumerate(AXIS_LINES.items()):
        top.plot(motion.time, attitude[:, i], label=name, **line)
        bottom.plot(motion.time, 1e3 * motion.base_angular_velocity.values[:, i], label=rf"$\omega_{i + 1}$", **line)
    top.set_ylabel("base attitude (deg)\nto inertial axes")
    bottom.set_ylabel("base angular velocity\n(mrad/s, base axes)")
    _legend_above(top)
    _legend_above(bottom)
    return _with_time(motion, figure, bottom)


@styled
def protected_rate(motion: xr.Dataset) -> Figure:
    """Draw the constrained disturbance angular velocity, or twist where the protection has linear parts.

    While a schedule does not fully protect a direction its line is pale.
    """
    figure, (axes,) = panels(1, height=1.9)
    rates = motion.protected_rate.values
    largest = float(np.abs(rates[np.isfinite(rates)]).max(initial=0.0))
    exponent = int(np.floor(np.log10(largest))) if largest > 0 else 0
    linear = bool(np.any(motion.U_c.values[:3]))
    shares = motion.protection_share.values if "protection_share" in motion else np.ones_like(rates)
    pale = False
    for i in range(rates.shape[1]):
        column = ", ".join(f"{value:.3g}" for value in motion.U_c.values[0 if linear else 3 :, i] + 0.0)
        color = (PROTECTED, "#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9")[i % 6]
        label = f"{'along' if linear else 'about'} ({column})"
        scaled, off = rates[:, i] / 10.0**exponent, shares[:, i] < 1.0
        axes.plot(motion.time, np.ma.masked_where(off, scaled), color=color, linewidth=0.6, label=label)
        if off.any():
            some = np.ma.masked_where(~(off | np.roll(off, 1) | np.roll(off, -1)), scaled)
            axes.plot(
                motion.time, some, color=color, linewidth=0.6, alpha=0.35, label=None if pale else "not protected"
            )
            pale = True
    if rates.shape[1]:
        axes.legend(loc="upper right")
    else:
        axes.text(0.5, 0.5, "nothing is protected", transform=axes.transAxes, ha="center")
    unit = "m/s, rad/s" if linear else "rad/s"
    told = (
        rf"$\omega_\mathrm{{sub}}$ ($10^{{{exponent}}}$ {unit})" if exponent else rf"$\omega_\mathrm{{sub}}$ ({unit})"
    )
    axes.set_ylabel(f"{told}\n{json.loads(motion.attrs['law'])['frame'].replace('_', ' ')} axes")
    return _with_time(motion, figure, axes)


@styled
def error(motion: xr.Dataset) -> Figure:
    """Draw the distance from the end-effector to the target, or of other tasks the norm of their errors of level 1."""
    figure, (axes,) = panels(1, height=1.9)
    factor, title, unit = _error_unit(motion)
    floored(axes, motion.time, factor * error_of(motion), FLOOR_ERROR, unit, color="black")
    tolerance = factor * float(motion.attrs["arrival_tolerance"])
    axes.axhline(tolerance, color="#8C8C8C", linewidth=0.7, linestyle="--")
    axes.text(
        0.01, tolerance, f"arrived: {tolerance:g} {unit}", transform=axes.get_yaxis_transform(), va="bottom", fontsize=7
    )
    axes.set_ylabel(f"{title} ({unit})")
    return _with_time(motion, figure, axes)


@styled
def configuration(motion: xr.Dataset) -> Figure:
    """Draw the spacecraft at the start and at the end, with U_c, the end-effector's path and the target."""
    return draw_configurations(motion)


@styled
def comparison(motions: Mapping[str, xr.Dataset]) -> Figure:
    """Draw motions of one case under several laws on one sheet."""
    figure, axes = panels(2, 3, width=PAGE, height=1.95)
    distance, disturbed, singular, *angles = axes
    thresholds, highest = set(), 1e-1
    first = next(iter(motions.values()))
    factor, error_title, error_unit = _error_unit(first)
    U_c = np.array(json.loads(first.attrs["case_U_c"]))
    about, unit = "about the protected axis" if U_c.shape[1] == 1 else "about the protected axes", "rad/s"
    if np.any(U_c[:3]):
        about, unit = "along the protected directions", "m/s, rad/s"
    for law, motion in motions.items():
        # The law in question lies on top, where the others would hide it.
        line: dict[str, Any] = {**LAW_LINES.get(law, {}), "label": law, "zorder": 3 if law == "selective" else 2}
        time = motion.time.values
        floored(distance, time, factor * error_of(motion), FLOOR_ERROR, error_unit, **line)
        rate = np.abs(disturbance(motion)[0]).max(axis=1, initial=0.0)
        highest = max(highest, float(rate[np.isfinite(rate)].max(initial=0.0)))
        floored(disturbed, time, rate, FLOOR, unit.split(", ")[-1], **{**line, "linewidth": 0.7})
        sigma = motion.smallest_singular_value.values
        floored(singular, time, sigma, FLOOR_SIGMA, "m", **{**line, "linewidth": 0.8})
        thresholds.add(float(json.loads(motion.attrs["law"])["damping_threshold"]))
        for i, axis in enumerate(angles):
            axis.plot(time, np.rad2deg(unwrapped(motion.base_rpy.values)[:, i]), **line)
    for threshold in thresholds:
        singular.axhline(threshold, color="black", linewidth=0.5, linestyle=":")
        singular.text(
            0.98,
            threshold,
            f"damped below {threshold:g} m",
            transform=singular.get_yaxis_transform(),
            ha="right",
            va="center",
            fontsize=6,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5},
        )
    distance.set(title=error_title, ylabel=error_unit)
    disturbed.set(
        title=f"rate {about}",
        ylabel=rf"$|\omega_\mathrm{{sub}}|$ ({unit})",
        ylim=(FLOOR / ROOM, highest if highest == 1e-1 else 3.0 * highest),
    )
    singular.set(title=r"smallest $\sigma$ of $J_{g,t} N_\mathrm{sub}$", ylabel="m")
    for axis, name in zip(angles, AXIS_COLORS, strict=True):
        axis.set(title=f"base {name}", ylabel="deg", xlabel="time (s)")
    low = min(axis.get_ylim()[0] for axis in angles)
    high = max(axis.get_ylim()[1] for axis in angles)
    for axis in angles:
        axis.set_ylim(low, high)
    figure.suptitle(first.attrs.get("title", first.attrs["robot"]), fontsize=9)
    figure.legend(*distance.get_legend_handles_labels(), ncols=len(motions), loc="outside lower center")
    distance.set_xlim(0, max(float(motion.time[-1]) for motion in motions.values()) or None)
    tell_gaps(figure)
    return figure


@styled
def sampling(rows: Sequence[Drift]) -> Figure:
    """Draw the drift of the protected axis against the sample time, a panel a case, a line for each plan."""
    names = list(dict.fromkeys(row.case for row in rows))
    figure, axes = panels(1, len(names), width=PAGE, height=2.3)
    for axis, name in zip(axes, names, strict=True):
        least, largest = 1.0, 1e-1
        for nodes, color in zip(PLANS, ("#8C8C8C", "#56B4E9", "#0072B2", PROTECTED), strict=True):
            mine = sorted(
                (row.sample_time_s, row.drift_deg) for row in rows if (row.case, row.hold_nodes) == (name, nodes)
            )
            times, drifts = zip(*mine, strict=True)
            axis.loglog(
                times, np.maximum(drifts, FLOOR_DRIFT), color=color, marker="o", markersize=2.5, label=PLANS[nodes]
            )
            least, largest = min(least, *drifts), max(largest, *drifts)
        if least <= FLOOR_DRIFT:
            tell_floor(axis, FLOOR_DRIFT, "deg")
        bottom = FLOOR_DRIFT if least > FLOOR_DRIFT else FLOOR_DRIFT / ROOM
        top = largest if largest == 1e-1 else 3.0 * largest
        axis.set(title=name, xlabel="sample time (s)", ylim=(bottom, top))
        axis.set_xticks(times, [f"{time:g}" for time in times])
        axis.set_xticks([], minor=True)
    axes[0].set_ylabel("rotation about the\nprotected axes (deg)")
    figure.legend(*axes[0].get_legend_handles_labels(), ncols=len(PLANS), loc="outside lower center")
    return figure


@styled
def bending(subject: tuple[Case, Mapping[str, xr.Dataset]]) -> Figure:
    """Draw how the appendages of a case bend under several protections: `subject` is the case and its motions."""
    case, motions = subject
    first = next(iter(motions.values()))
    names = [str(name).replace("_", " ") for name in first.appendage.values]
    two = parts_of(case, np.zeros((1, len(names))))[0] is not None
    titles = ["symmetric: driven by translation", "antisymmetric: driven by rotation"] if two else names
    figure, axes = panels(2, len(titles), width=PAGE, height=1.95)
    period = 1.0 / min(appendage.frequency for appendage in case.robot.appendages)
    for law, motion in motions.items():
        tips = 1e3 * motion.tip_deflection.values
        parts = parts_of(case, tips) if two else tuple(tips.T)
        for i, part in enumerate(parts):
            values = np.asarray(part)
            line: dict[str, Any] = {**LAW_LINES.get(law, {}), "label": law, "linewidth": 0.7}
            axes[i].plot(motion.time, values, **line)
            envelope = _envelope(motion.time.values, values, period)
            floored(axes[len(titles) + i], motion.time, envelope, FLOOR_TIP, "mm", **line)
    for i, title in enumerate(titles):
        axes[i].set_title(title)
        axes[len(titles) + i].set_xlabel("time (s)")
    axes[0].set_ylabel("tip deflection (mm)")
    axes[len(titles)].set_ylabel("its envelope (mm)")
    figure.suptitle(first.attrs["title"], fontsize=9)
    figure.legend(*axes[0].get_legend_handles_labels(), ncols=len(motions), loc="outside lower center")
    axes[0].set_xlim(0, float(first.time[-1]) or None)
    tell_gaps(figure)
    return figure


def _envelope(time: Floats, values: Floats, window: float) -> Floats:
    """Return the largest magnitude within half a window, s, of each sample."""
    if len(time) < 2:
        return np.abs(values)
    half = max(1, round(0.5 * window / float(time[1] - time[0])))
    padded = np.pad(np.abs(values), half, mode="edge")
    return np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1).max(axis=1)


@styled
def pointing(motions: Mapping[str, xr.Dataset]) -> Figure:
    """Draw how a line of sight wanders under several laws, over the distance to the target."""
    figure, (top, bottom) = panels(2, width=COLUMN, height=1.9)
    first = next(iter(motions.values()))
    factor, title, unit = _error_unit(first)
    for law, motion in motions.items():
        line: dict[str, Any] = {**LAW_LINES.get(law, {}), "label": law, "linewidth": 0.9}
        wander = ARCSEC * pointing_error(motion, motion.attrs["boresight"])
        # At the start it is zero by definition.
        floored(top, motion.time[1:], wander[1:], FLOOR_POINTING, "arcsec", **line)
        floored(bottom, motion.time, factor * error_of(motion), FLOOR_ERROR, unit, **line)
    top.set_ylabel("pointing error (arcsec)")
    bottom.set_ylabel(f"{title} ({unit})")
    figure.legend(*top.get_legend_handles_labels(), ncols=2, loc="outside upper center")
    return _with_time(first, figure, bottom)


@styled
def robustness(rows: Sequence[Leak]) -> Figure:
    """Draw the leak into the protected axes against the error of the model, a panel a case."""
    names = list(dict.fromkeys(row.case for row in rows))
    figure, axes = panels(1, len(names), width=PAGE if len(names) > 1 else COLUMN, height=2.3)
    for axis, name in zip(axes, names, strict=True):
        mine = [row for row in rows if row.case == name]
        for i, gain in enumerate(sorted({row.feedback_gain for row in mine})):
            color = GAIN_COLORS[i % len(GAIN_COLORS)]
            line = sorted((row for row in mine if row.feedback_gain == gain), key=lambda row: row.level)
            levels = [100 * row.level for row in line]
            label = f"feedback, K = {gain:g}/s" if gain else "no feedback"
            axis.loglog(levels, [row.median_deg for row in line], color=color, marker="o", markersize=3, label=label)
            axis.fill_between(
                levels, [row.low_deg for row in line], [row.high_deg for row in line], color=color, alpha=0.2, lw=0
            )
            axis.set_xticks(levels, [f"{level:g}" for level in levels])
            axis.set_xticks([], minor=True)
        axis.axhline(mine[0].unprotected_deg, color="#8C8C8C", linestyle="--", label="nothing protected")
        axis.set(title=name, xlabel="error of the model (%)")
    axes[0].set_ylabel("rotation about the\nprotected axes (deg)")
    figure.legend(*axes[0].get_legend_handles_labels(), ncols=3, loc="outside lower center")
    return figure


FIGURES = {
    "joints": joints,
    "base": base,
    "protected_rate": protected_rate,
    "error": error,
    "configuration": configuration,
}


def save_figures(motion: xr.Dataset, folder: str | Path, name: str) -> list[Path]:
    """Write the paper's set of figures of a motion, each as PDF and PNG.

    Args:
        motion: The motion.
        folder: Where to; made if needed.
        name: What the file names start with.

    Returns:
        The paths written.

    Raises:
        FileError: the folder cannot be made or written.
    """
    return [path for kind, draw in FIGURES.items() for path in save(draw(motion), folder, f"{name}_{kind}")]


def _legend_above(axes: Axes) -> None:
    axes.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 0.97))


def _with_time(motion: xr.Dataset, figure: Figure, lowest: Axes) -> Figure:
    lowest.set_xlabel("time (s)")
    if motion.sizes["time"] > 1:
        lowest.set_xlim(0, float(motion.time[-1]))
    tell_gaps(figure)
    return figure


def _error_unit(motion: xr.Dataset) -> tuple[float, str, str]:
    """Return the factor, the name and the unit in which the error of a motion is drawn: of tasks it mixes m and rad."""
    return (1e3, "distance to target", "mm") if "task_error" not in motion else (1.0, "error of level 1", "m, rad")
