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

from ssm_decouple.studies.comparison import disturbance
from ssm_decouple.studies.sampling import PLANS, Drift
from ssm_decouple.viewing.spacecraft import draw_configurations
from ssm_decouple.viewing.style import AXIS_COLORS, LAW_LINES, PAGE, PROTECTED, joint_colors, panels, save, styled

FLOOR = 1e-21  # rad/s: zero on a logarithmic axis


@styled
def joints(motion: xr.Dataset) -> Figure:
    """Draw joint positions over joint rates."""
    figure, (top, bottom) = panels(2)
    positions, rates = motion.joint_positions.values, motion.joint_rates.values
    sliding = _sliding_joints(motion)
    for i, (name, color) in enumerate(zip(motion.joint.values, joint_colors(motion.sizes["joint"]), strict=True)):
        unit = 1.0 if name in sliding else np.rad2deg(1.0)
        style: dict[str, Any] = {
            "color": color,
            "linestyle": ("-", (0, (4, 1.2)))[i % 2],
        }  # neighbours differ in more than shade
        top.plot(motion.time, unit * positions[:, i], label=str(name).replace("_", " "), **style)
        bottom.plot(motion.time, unit * rates[:, i], **style)
    top.set_ylabel("joint angle (deg)" if not sliding else "joint position (deg or m)")
    bottom.set_ylabel("joint rate (deg/s)" if not sliding else "joint rate (deg/s or m/s)")
    if motion.sizes["joint"] <= 12:
        figure.legend(*top.get_legend_handles_labels(), ncols=3, loc="outside upper center")
    return _with_time(motion, figure, bottom)


@styled
def base(motion: xr.Dataset) -> Figure:
    """Draw the base attitude over the base angular velocity."""
    figure, (top, bottom) = panels(2)
    for i, (name, color) in enumerate(AXIS_COLORS.items()):
        top.plot(motion.time, np.rad2deg(motion.base_rpy.values[:, i]), color=color, label=name)
        bottom.plot(
            motion.time, 1e3 * motion.base_angular_velocity.values[:, i], color=color, label=rf"$\omega_{i + 1}$"
        )
    top.set_ylabel("base attitude (deg)")
    bottom.set_ylabel("base angular velocity\n(mrad/s, base axes)")
    _legend_above(top)
    _legend_above(bottom)
    return _with_time(motion, figure, bottom)


@styled
def protected_rate(motion: xr.Dataset) -> Figure:
    """Draw the constrained disturbance angular velocity."""
    figure, (axes,) = panels(1, height=1.9)
    rates = motion.protected_rate.values
    exponent = int(np.floor(np.log10(np.abs(rates).max(initial=0.0)))) if np.any(rates) else 0
    for i in range(rates.shape[1]):
        column = ", ".join(f"{value:.3g}" for value in motion.U_c.values[:, i] + 0.0)
        axes.plot(
            motion.time,
            rates[:, i] / 10.0**exponent,
            color=(PROTECTED, "#0072B2", "#E69F00")[i],
            linewidth=0.6,
            label=f"about ({column})",
        )
    if rates.shape[1]:
        axes.legend(loc="upper right")
    else:
        axes.text(0.5, 0.5, "nothing is protected", transform=axes.transAxes, ha="center")
    axes.set_ylabel(
        rf"$\omega_\mathrm{{sub}}$ ($10^{{{exponent}}}$ rad/s)" if exponent else r"$\omega_\mathrm{sub}$ (rad/s)"
    )
    return _with_time(motion, figure, axes)


@styled
def error(motion: xr.Dataset) -> Figure:
    """Draw the distance from the end-effector to the target."""
    figure, (axes,) = panels(1, height=1.9)
    axes.semilogy(motion.time, 1e3 * motion.end_effector_error, color="black")
    tolerance = 1e3 * float(motion.attrs["arrival_tolerance"])
    axes.axhline(tolerance, color="#8C8C8C", linewidth=0.7, linestyle="--")
    axes.text(
        0.01, tolerance, f"arrived: {tolerance:g} mm", transform=axes.get_yaxis_transform(), va="bottom", fontsize=7
    )
    axes.set_ylabel("distance to target (mm)")
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
    thresholds = set()
    first = next(iter(motions.values()))
    one = len(json.loads(first.attrs["case_U_c"])[0]) == 1
    for law, motion in motions.items():
        # The law in question lies on top, where the others would hide it.
        line: dict[str, Any] = {**LAW_LINES.get(law, {}), "label": law, "zorder": 3 if law == "selective" else 2}
        time = motion.time.values
        distance.semilogy(time, 1e3 * motion.end_effector_error, **line)
        rate = np.abs(disturbance(motion)[0]).max(axis=1, initial=0.0)
        disturbed.semilogy(time, np.maximum(rate, FLOOR), **{**line, "linewidth": 0.7})
        singular.semilogy(time, np.maximum(motion.smallest_singular_value, 1e-9), **{**line, "linewidth": 0.8})
        thresholds.add(float(json.loads(motion.attrs["law"])["damping_threshold"]))
        for i, axis in enumerate(angles):
            axis.plot(time, np.rad2deg(motion.base_rpy.values[:, i]), **line)
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
    distance.set(title="distance to target", ylabel="mm")
    disturbed.set(
        title="rate about the protected axis" if one else "rate about the protected axes",
        ylabel=r"$|\omega_\mathrm{sub}|$ (rad/s)",
        ylim=(FLOOR / 3, 1e-1),
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
    distance.set_xlim(0, float(first.time[-1]))
    return figure


@styled
def sampling(rows: Sequence[Drift]) -> Figure:
    """Draw the drift of the protected axis against the sample time, a panel a case, a line for each plan."""
    names = list(dict.fromkeys(row.case for row in rows))
    figure, axes = panels(1, len(names), width=PAGE, height=2.3)
    for axis, name in zip(axes, names, strict=True):
        for nodes, color in zip(PLANS, ("#8C8C8C", "#56B4E9", "#0072B2", PROTECTED), strict=True):
            mine = sorted(
                (row.sample_time_s, row.drift_deg) for row in rows if (row.case, row.hold_nodes) == (name, nodes)
            )
            times, drifts = zip(*mine, strict=True)
            axis.loglog(times, np.maximum(drifts, 1e-19), color=color, marker="o", markersize=2.5, label=PLANS[nodes])
        axis.set(title=name, xlabel="sample time (s)", ylim=(1e-19, 1e-1))
        axis.set_xticks(times, [f"{time:g}" for time in times])
        axis.set_xticks([], minor=True)
    axes[0].set_ylabel("rotation about the\nprotected axes (deg)")
    figure.legend(*axes[0].get_legend_handles_labels(), ncols=len(PLANS), loc="outside lower center")
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
    lowest.set(xlabel="time (s)", xlim=(0, float(motion.time[-1])))
    return figure


def _sliding_joints(motion: xr.Dataset) -> set[str]:
    import xml.etree.ElementTree as ET

    root = ET.fromstring(str(motion.robot_urdf.values))
    return {joint.get("name", "") for joint in root.findall("joint") if joint.get("type") == "prismatic"}
