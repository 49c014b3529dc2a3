"""The comparison as a table: in a terminal, and as Markdown for documents."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich import box
from rich.table import Table

from ssm_decouple.studies.bending import Bending
from ssm_decouple.studies.comparison import UNDAMPED, Summary
from ssm_decouple.studies.pointing import Pointing
from ssm_decouple.studies.robustness import Effect, Leak, slope
from ssm_decouple.studies.sampling import PLANS, Drift

HEADINGS = ("case", "law", "k", "outcome", "left (mm)", "|w_sub| (rad/s)", "roll, pitch, yaw (deg)", "sigma (m)")


def cells(row: Summary) -> tuple[str, ...]:
    """Return a summary as the table's texts, in the order of HEADINGS.

    "left" is the distance to the target at the end, |w_sub| the largest base rate about the directions that the case
    protects, the angles are peak to peak, sigma is the smallest singular value of J_gt N_sub over the motion.
    """
    left = 1e3 * row.final_error_m
    return (
        row.case,
        row.law,
        str(row.k),
        f"{row.outcome}, {row.outcome_time_s:.0f} s",
        f"{left:.2f}" if left < 100 else f"{left:.0f}",
        f"{row.w_sub_max_rad_s:.1e}",
        f"{row.roll_deg:.3f}  {row.pitch_deg:.3f}  {row.yaw_deg:.3f}",
        f"{row.sigma_min_m:.1e}",
    )


def terminal_table(rows: Sequence[Summary]) -> Table:
    """Return the comparison as a table for a terminal, a rule between cases."""
    table = _empty(HEADINGS, words=("case", "law", "outcome"))
    for i, row in enumerate(rows):
        last = i + 1 == len(rows) or rows[i + 1].case != row.case
        first = i == 0 or rows[i - 1].case != row.case
        texts = cells(row)
        style = {"converged": "green", "stalled": "red"}.get(row.outcome, "yellow")
        table.add_row(texts[0] if first else "", *texts[1:3], f"[{style}]{texts[3]}[/]", *texts[4:], end_section=last)
    return table


def markdown_table(rows: Sequence[Summary]) -> str:
    """Return the comparison as a Markdown table."""
    return markdown([[heading.replace("|w_sub|", "abs(w_sub)") for heading in HEADINGS], *map(cells, rows)])


def drift_table(rows: Sequence[Drift]) -> list[list[str]]:
    """Return the drift of sampled laws as rows of texts, headings first: one row a case and plan, one column a time."""
    times = sorted({row.sample_time_s for row in rows})
    lines = [["case", "law planned", *(f"{time:g} s" for time in times), "order"]]
    found = {(row.case, row.hold_nodes, row.sample_time_s): row for row in rows}
    for case, nodes in dict.fromkeys((row.case, row.hold_nodes) for row in rows):
        cells_ = [f"{found[case, nodes, time].drift_deg:.1e}" for time in times]
        orders = [found[case, nodes, time].order for time in times]
        known = [order for order in orders if order is not None]
        lines.append([case, PLANS[nodes], *cells_, f"{np.median(known):.1f}" if known else "rounding"])
    return lines


def bending_table(rows: Sequence[Bending]) -> list[list[str]]:
    """Return how appendages bend as rows of texts, headings first."""
    head = ["case", "protected", "rows", "tip, peak (mm)", "symmetric", "antisymmetric", "outcome", "left (mm)"]
    return [head] + [
        [
            row.case,
            row.protection,
            str(row.k),
            f"{row.peak_mm:.4f}",
            "" if row.symmetric_mm is None else f"{row.symmetric_mm:.4f}",
            "" if row.antisymmetric_mm is None else f"{row.antisymmetric_mm:.4f}",
            f"{row.outcome}, {row.outcome_time_s:.0f} s",
            f"{1e3 * row.final_error_m:.1f}",
        ]
        for row in rows
    ]


def pointing_table(rows: Sequence[Pointing]) -> list[list[str]]:
    """Return how a line of sight wanders as rows of texts, headings first."""
    head = ["case", "law", "k", "peak (arcsec)", "rms (arcsec)", "at the end", "outcome", "left (mm)"]
    return [head] + [
        [
            row.case,
            row.law,
            str(row.k),
            f"{row.peak_arcsec:.3g}",
            f"{row.rms_arcsec:.3g}",
            f"{row.end_arcsec:.3g}",
            f"{row.outcome}, {row.outcome_time_s:.0f} s",
            f"{1e3 * row.final_error_m:.1f}",
        ]
        for row in rows
    ]


def leak_table(rows: Sequence[Leak]) -> list[list[str]]:
    """Return what errors in the model leave of the protection as rows of texts, headings first."""
    head = ["case", "feedback", "error (%)", "runs", "median (deg)", "95 % band (deg)", "gain, median", "gain, worst"]
    head += ["arrived (%)", "slope"]
    lines = [head]
    for row in sorted(rows, key=lambda row: (row.case, row.feedback_gain, row.level)):
        grows = slope([other for other in rows if (other.case, other.feedback_gain) == (row.case, row.feedback_gain)])
        lines.append(
            [
                row.case,
                f"{row.feedback_gain:g} /s" if row.feedback_gain else "none",
                f"{100 * row.level:g}",
                str(row.runs),
                f"{row.median_deg:.1e}",
                f"{row.low_deg:.1e} to {row.high_deg:.1e}",
                f"{row.gain_median:.0f}",
                f"{row.gain_worst:.0f}",
                f"{100 * row.arrived:.0f}",
                "" if grows is None else f"{grows:.2f}",
            ]
        )
    return lines


def effect_table(rows: Sequence[Effect]) -> list[list[str]]:
    """Return what single imperfections do as rows of texts, headings first."""
    head = ["case", "imperfect", "without feedback (deg)", "with feedback (deg)", "left (mm)"]
    return [head] + [
        [row.case, row.cause, f"{row.without_deg:.1e}", f"{row.with_deg:.1e}", f"{1e3 * row.final_error_m:.1f}"]
        for row in rows
    ]


def markdown(lines: Sequence[Sequence[str]]) -> str:
    """Return rows of texts, headings first, as a Markdown table; the first two columns are words, the rest numbers."""
    head, *body = lines
    rule = ["---"] * 2 + ["---:"] * (len(head) - 2)
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, rule, *body))


def plain(lines: Sequence[Sequence[str]]) -> Table:
    """Return rows of texts, headings first, as a table for a terminal."""
    head, *body = lines
    table = _empty(head, words=head[:2])
    for line in body:
        table.add_row(*line)
    return table


def _empty(headings: Sequence[str], words: Sequence[str]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for heading in headings:
        table.add_column(heading, justify="left" if heading in words else "right", no_wrap=True)
    return table


def saturation(row: Summary) -> str | None:
    """Say when wheels were at full speed and drives at their torque limits; None if they never were."""
    wheels = f"{row.case}, {row.law}: at full speed: {row.full_wheels}." if row.full_wheels else None
    if not row.saturated:
        return wheels
    total = sum(end - start for start, end in row.saturated)
    listed = ", ".join(f"{start:.1f} to {end:.1f} s" for start, end in row.saturated[:3])
    more = f" and {len(row.saturated) - 3} times more" if row.saturated[3:] else ""
    drives = f"{row.case}, {row.law}: drives at their torque limits for {total:.1f} s: {listed}{more}."
    drives += f" {row.limited_drives}." if row.limited_drives else ""
    return drives if wheels is None else f"{drives} {wheels}"


def not_kept(row: Summary) -> str | None:
    """Say what was promised and not kept; None if all was."""
    return f"{row.case}, {row.law}: {row.told}." if row.told else None


def explain(row: Summary) -> str | None:
    """Say where and why a motion did not arrive; None if it did."""
    if row.outcome == "converged":
        return None
    x, y, z = row.final_position_m
    ended = {
        "stalled": f"stalled at {row.outcome_time_s:.1f} s",
        "running": f"still running when the time was over at {row.outcome_time_s:.1f} s",
    }[row.outcome]
    damped = "" if row.law.endswith(UNDAMPED) else f", damped for {100 * row.damped_share:.0f} % of the time"
    return (
        f"{row.case}, {row.law}: {ended}, {1e3 * row.final_error_m:.0f} mm of {1e3 * row.start_distance_m:.0f} mm "
        f"left, end-effector at ({x:.3f}, {y:.3f}, {z:.3f}) m. Smallest singular value of J_gt N_sub "
        f"{row.sigma_min_m:.1e} m at {row.sigma_min_time_s:.1f} s{damped}."
        + (f" At the end {row.lost}." if row.lost else "")
    )
