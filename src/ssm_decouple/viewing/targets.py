"""Tables and figures of many motions to random targets."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise, product
from typing import Any

import numpy as np
import pinocchio as pin
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.ticker import NullLocator
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from ssm_decouple.model.robot import Robot
from ssm_decouple.model.urdf import Shape, visual_shapes
from ssm_decouple.studies.targets import ARM, ELSEWHERE, SEVERAL, Arrival, Pair, Stop, Trials, Triple
from ssm_decouple.viewing.style import AXIS_COLORS, LAW_LINES, PAGE, PROTECTED, styled

Floats = NDArray[np.float64]

FLOOR_DEG = 1e-4  # smaller base rotations stand at the edge
FLOOR_SIGMA = 1e-7  # m, likewise
FLOOR_MM = 0.1
DEGREES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0), ("less", "0.001", "0.01", "0.1", "1", "10")
FEWEST = 3  # targets in a cell of a map that is drawn
RARE = 0.01  # a cause that a table leaves out
SELDOM = 0.01  # a law that arrives at fewer leaves too few targets to compare others at
ARRIVED, RUNNING, HELD = "arrived", "still running", "stalled, held by "
CAUSE_COLORS = AXIS_COLORS | {SEVERAL: PROTECTED, ARM: "#444444", ELSEWHERE: "#56B4E9"}
PART_COLORS = {ARRIVED: "#DADADA", RUNNING: "white"} | {HELD + cause: color for cause, color in CAUSE_COLORS.items()}
OTHER_COLOR = "#F0E442"  # of a protected row that is no base axis


def arrival_table(rows: Sequence[Arrival]) -> list[list[str]]:
    """Return how each law did as rows of texts, headings first.

    Shares are of all targets, with their 95 % intervals; "arrives after" is the median and the 90th percentile of those
    that arrive, "left" the median of those that do not, "base" the median of each angle, peak to peak, of those that
    arrive, sigma the median and the 5th percentile of the smallest singular value on the way; "beyond limits" are
    motions that end with a joint beyond its position limits.
    """
    head = ["start", "law", "k", "arrived (%)", "95 % interval", "stalled (%)", "running (%)", "arrives after (s)"]
    head += ["left (mm)", "base roll, pitch, yaw (deg)", "sigma (m)", "beyond limits (%)"]
    return [head] + [
        [
            _start(row),
            row.law,
            str(row.k),
            _percent(row.share, row.targets),
            f"{_percent(row.share_low, row.targets)} to {_percent(row.share_high, row.targets)}",
            _percent(row.stalled / row.targets, row.targets),
            _percent(row.running / row.targets, row.targets),
            "" if row.time_median_s is None else f"{row.time_median_s:.0f}, {row.time_p90_s:.0f}",
            "" if row.left_median_mm is None else f"{row.left_median_mm:.0f}",
            _angles(row.base_median_deg),
            f"{row.sigma_median_m:.1e}, {row.sigma_p5_m:.1e}",
            f"{100 * row.beyond_limits / row.targets:.1f}",
        ]
        for row in rows
    ]


def pair_table(rows: Sequence[Pair]) -> list[list[str]]:
    """Return pairs of laws at the same targets as rows of texts, headings first; angles where both arrive."""
    head = ["start", "laws", "both", "only the first", "only the second", "neither", "difference (% points)"]
    head += ["base, the first (deg)", "base, the second (deg)"]
    return [head] + [
        [
            _start(row),
            f"{row.law} / {row.other}",
            *(str(count) for count in (row.both, row.only_law, row.only_other, row.neither)),
            f"{100 * row.difference:+.1f} ({100 * row.low:+.1f} to {100 * row.high:+.1f})",
            _angles(row.law_base_median_deg),
            _angles(row.other_base_median_deg),
        ]
        for row in rows
    ]


def stop_table(rows: Sequence[Stop]) -> list[list[str]]:
    """Return what holds the stalled motions of each law as rows of texts, headings first; rare causes left out."""
    lines = [["start, law", "held by", "stalled"]]
    for name, law in dict.fromkeys((_start(row), row.law) for row in rows):
        mine = [row for row in rows if (_start(row), row.law) == (name, law)]
        told = ", ".join(f"{row.cause} {100 * row.share:.0f} %" for row in mine if row.share >= RARE)
        lines.append([f"{name}, {law}", told, str(sum(row.stalled for row in mine))])
    return lines


def distance_table(studies: Sequence[Trials], edges: Sequence[float] = (0.5, 1.0, 1.5, 2.0, 3.0)) -> list[list[str]]:
    """Return the share of arrivals by how far the targets are, m, studies of a robot together; headings first."""
    bounds = [0.0, *edges, np.inf]
    told = [f"below {edges[0]:g} m", *(f"to {edge:g} m" for edge in edges[1:]), f"above {edges[-1]:g} m"]
    lines = [["robot", "law", *(f"{words} (%)" for words in told)]]
    for robot in dict.fromkeys(trials.targets.robot.name for trials in studies):
        mine = [trials for trials in studies if trials.targets.robot.name == robot]
        far = np.concatenate([trials.distances() for trials in mine])
        bands = [(low <= far) & (far < high) for low, high in pairwise(bounds)]
        for name in mine[0].found:
            arrived = np.concatenate([trials.arrived(name) for trials in mine])
            shares = [f"{100 * arrived[band].mean():.1f}" if band.any() else "" for band in bands]
            lines.append([robot, name, *shares])
        lines.append([robot, "targets", *(str(int(band.sum())) for band in bands)])
    return lines


def _start(row: Arrival | Pair | Stop) -> str:
    return row.start if row.start != "random" else f"{row.robot}, random"


def _percent(share: float, total: int) -> str:
    return f"{100 * share:.{2 if total >= 10_000 else 1}f}"


def _angles(values: Triple | None) -> str:
    return "" if values is None else "  ".join(f"{value:.3f}" for value in values)


@styled
def sheet(trials: Trials) -> Figure:
    """Draw where the laws arrive, and how far off, how disturbed and how near to singular their motions are."""
    names = list(trials.found)
    figure = Figure(figsize=(PAGE, 4.9))
    halves: Any = figure.subfigures(2, 1, height_ratios=(1.0, 1.05))
    maps = halves[0].subplots(1, len(names), sharex=True, sharey=True, squeeze=False)[0]
    for axes, name in zip(maps, names, strict=True):
        colors = _map(axes, trials, name)
    maps[0].set_ylabel("z (m)")
    halves[0].colorbar(colors, ax=list(maps), label="share that arrives", shrink=0.85, pad=0.01, aspect=14)
    left, base, sigma = halves[1].subplots(1, 3)
    draw_shares(left, {name: 1e3 * trials.found[name].final_error for name in names}, FLOOR_MM)
    left.axvline(1e3 * trials.arrival_tolerance, color="black", linewidth=0.5, linestyle=":")
    left.set(xlabel="distance left at the end (mm)", ylabel="share of the targets")
    draw_shares(sigma, {name: trials.found[name].smallest_singular_value for name in names}, FLOOR_SIGMA)
    sigma.axvline(trials.laws[names[0]].damping_threshold, color="black", linewidth=0.5, linestyle=":")
    sigma.set(xlabel=r"smallest $\sigma$ of $J_{g,t} N_\mathrm{sub}$ on the way (m)")
    _draw_where_all_arrive(base, trials)
    count, robot = len(trials.targets.positions), trials.targets.robot.name
    title = f"{trials.targets.start}, {robot}: {count:,} random reachable targets, {trials.duration:g} s"
    figure.suptitle(title, fontsize=9)
    halves[1].legend(*left.get_legend_handles_labels(), ncols=len(names), loc="outside lower center")
    return figure


def _map(axes: Axes, trials: Trials, name: str) -> Any:
    """Draw the share of arrivals over the plane of x and z, seen along y, and return what the colours mean."""
    x, _, z = trials.targets.positions.T
    arrived, cells = trials.arrived(name), int(np.clip(0.35 * np.sqrt(len(trials.targets.positions)), 8, 30))
    colors = axes.hexbin(
        x, z, arrived, gridsize=cells, mincnt=FEWEST, vmin=0.0, vmax=1.0, cmap="viridis", linewidths=0.1
    )
    for outline in silhouettes(trials.targets.robot, trials.targets.configurations[0]):
        axes.add_patch(Polygon(outline, closed=True, fill=False, edgecolor="#D55E00", linewidth=0.7))
    axes.set(title=f"{name}\n{100 * arrived.mean():.1f} % arrive", xlabel="x (m)", aspect="equal")
    axes.grid(visible=False)
    return colors


def silhouettes(robot: Robot, q: Floats) -> list[Floats]:
    """Return the outlines (points, 2) of the root link's boxes, cylinders and spheres in the plane of x and z."""
    root = next(frame.name for frame in robot.model.frames if frame.parentJoint == 1 and frame.name in robot.link_names)
    outlines = []
    for shape in visual_shapes(robot.urdf):
        if shape.link == root:
            pose = robot.frame_pose(q, root) * pin.SE3(pin.rpy.rpyToMatrix(*shape.rpy), shape.xyz)
            flat = (_points(shape) @ pose.rotation.T + pose.translation)[:, [0, 2]]
            outlines.append(flat[ConvexHull(flat, qhull_options="QJ").vertices])
    return outlines


def _points(shape: Shape) -> Floats:
    """Return points (m, 3) on the shape, in its own axes, whose hull it is."""
    if shape.kind == "box":
        return 0.5 * np.array(shape.size) * np.array(list(product((-1, 1), repeat=3)))
    around = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    ring = shape.size[0] * np.column_stack([np.cos(around), np.sin(around), np.zeros(24)])
    if shape.kind == "cylinder":
        return np.vstack([ring + [0, 0, end * shape.size[1]] for end in (-0.5, 0.5)])
    return np.vstack([np.roll(ring, i, axis=1) for i in range(3)])


def draw_shares(axes: Axes, values: dict[str, Floats], floor: float) -> None:
    """Draw which share of the motions of each law lies below each value."""
    for name, each in values.items():
        line: dict[str, Any] = LAW_LINES.get(name, {})
        rising = np.maximum(np.sort(each), floor)
        axes.step(rising, np.arange(1, len(each) + 1) / len(each), where="post", label=name, **line)
    axes.set(xscale="log", ylim=(-0.02, 1.02))
    axes.xaxis.set_minor_locator(NullLocator())
    below = any(np.any(each <= floor) for each in values.values())
    if below:
        told = f"{floor:g} or less"
        axes.text(floor, 1.0, told, rotation=90, ha="right", va="top", fontsize=5.5, color="#666666")


def _draw_where_all_arrive(axes: Axes, trials: Trials) -> None:
    """Draw the base's angles at the targets that all laws reach which reach one of a hundred."""
    arriving = [name for name in trials.found if trials.arrived(name).mean() >= SELDOM]
    both = np.all([np.ones(len(trials.targets.positions), dtype=bool), *map(trials.arrived, arriving)], axis=0)
    draw_rotations(axes, {name: trials.found[name].base_rotation[both] for name in arriving})
    told = f"{int(both.sum()):,} targets that these laws reach" if arriving else "no law arrives"
    axes.set_xlabel(f"base rotation, peak to peak (deg)\n{told}")


def draw_rotations(axes: Axes, turned: dict[str, Floats]) -> None:
    """Draw roll, pitch and yaw (m, 3), rad, of each law's motions: 5th to 95th percentile, quartiles, median."""
    largest = 0.0
    for i, (j, (name, angles)) in product(range(3), enumerate(turned.items())):
        values = np.maximum(np.rad2deg(angles[:, i]), FLOOR_DEG)
        if not len(values):
            place = -i - 0.17 * (j - 0.5 * (len(turned) - 1))
            axes.text(FLOOR_DEG, place, f"{name}: none arrives", va="center", fontsize=5, color="#666666")
        else:
            largest = max(largest, float(np.percentile(values, 95)))
            low, first, middle, third, high = np.percentile(values, [5, 25, 50, 75, 95])
            place = -i - 0.17 * (j - 0.5 * (len(turned) - 1))
            color = LAW_LINES.get(name, {}).get("color")
            axes.plot([low, high], [place, place], color=color, linewidth=0.8)
            axes.plot([first, third], [place, place], color=color, linewidth=3.0, solid_capstyle="butt")
            edge = color if middle <= FLOOR_DEG else "black"
            axes.plot([middle], [place], color=edge, marker="|", markersize=5, markeredgewidth=0.9, clip_on=False)
    _set_degrees(axes, 30.0, largest)
    axes.set_yticks([0, -1, -2], list(AXIS_COLORS))
    axes.set_ylim(-2.6, 0.6)


@styled
def distances(studies: Sequence[Trials]) -> Figure:
    """Draw which share of the targets each law comes within each distance of, a panel a study, three in a row."""
    columns = min(3, len(studies))
    rows = -(-len(studies) // columns)
    figure = Figure(figsize=(PAGE, 1.9 * rows + 0.5))
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes, trials in zip(grid.flat, studies, strict=False):
        draw_shares(axes, {name: 1e3 * trials.found[name].final_error for name in trials.found}, FLOOR_MM)
        axes.axvline(1e3 * trials.arrival_tolerance, color="black", linewidth=0.5, linestyle=":")
        shares = " / ".join(f"{100 * trials.arrived(name).mean():.1f}" for name in trials.found)
        farthest = max(6e3, *(1.1e3 * np.nanmax(found.final_error, initial=0.0) for found in trials.found.values()))
        axes.set(title=f"{trials.targets.start}\n{shares} % arrive", xlim=(FLOOR_MM, farthest))
    for axes in grid[:, 0]:
        axes.set_ylabel("share of the targets")
    for axes in grid[-1]:
        axes.set_xlabel("distance left at the end (mm)")
    figure.legend(*grid[0, 0].get_legend_handles_labels(), ncols=4, loc="outside lower center")
    return figure


@styled
def protections(studies: Sequence[Trials]) -> Figure:
    """Draw how the motions end under each protection, what holds the stalled ones, and how the base turns."""
    most = max(len(trials.found) for trials in studies)
    figure = Figure(figsize=(PAGE, (0.2 * most + 0.55) * len(studies) + 0.6))
    grid = figure.subplots(len(studies), 2, sharey="row", squeeze=False, width_ratios=(1.9, 1.0))
    for (ends, base), trials in zip(grid, studies, strict=True):
        _draw_ends(ends, trials)
        _draw_medians(base, trials)
        ends.set_title(f"{trials.targets.robot.name}: how {len(trials.targets.positions):,} motions end", loc="left")
    grid[0, 1].set_title("base rotation where it arrives", loc="left")
    grid[-1, 0].set_xlabel("share of the motions")
    grid[-1, 1].set_xlabel("median, peak to peak (deg)")
    bars: dict[str, Any] = {}
    for axes in grid[:, 0]:
        bars |= {label: bar for bar, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    order = [label for label in _parts(bars) if label in bars]
    figure.legend([bars[label] for label in order], order, ncols=3, loc="outside lower left")
    figure.legend(*grid[0, 1].get_legend_handles_labels(), ncols=3, loc="outside lower right")
    return figure


def _parts(found: Iterable[str]) -> list[str]:
    """Return the labels of a bar's parts in their order; rows that are no base axis come after those that are."""
    first = [ARRIVED, *(HELD + axis for axis in AXIS_COLORS)]
    last = [HELD + SEVERAL, HELD + ARM, HELD + ELSEWHERE, RUNNING]
    return [*first, *sorted(set(found) - {*first, *last}), *last]


def _draw_ends(axes: Axes, trials: Trials) -> None:
    """Draw a bar a law: arrived, stalled by what holds them, and still running."""
    for place, name in enumerate(trials.found):
        outcome, causes = trials.found[name].outcome, trials.causes(name)
        shares = {ARRIVED: float((outcome == "converged").mean()), RUNNING: float((outcome == "running").mean())}
        shares |= {HELD + str(cause): float((causes == cause).mean()) for cause in np.unique(causes[causes != ""])}
        edge = 0.0
        for label in _parts(shares):
            share, color = shares.get(label, 0.0), PART_COLORS.get(label, OTHER_COLOR)
            line: dict[str, Any] = (
                {"edgecolor": "#888888", "hatch": "////"} if label == RUNNING else {"edgecolor": color}
            )
            if share:
                axes.barh(-place, share, left=edge, color=color, height=0.76, label=label, linewidth=0.0, **line)
            edge += share
        box = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 0.8}
        axes.text(0.01, -place, f"{100 * shares[ARRIVED]:.1f} %", va="center", fontsize=6.5, bbox=box)
    axes.set(xlim=(0, 1), ylim=(-len(trials.found) + 0.4, 0.6))
    axes.set_yticks([-place for place in range(len(trials.found))], list(trials.found))
    axes.grid(visible=False)


def _draw_medians(axes: Axes, trials: Trials) -> None:
    """Draw the medians of the base's angles under each law, where it arrives."""
    largest = 0.0
    for i, (axis, color) in enumerate(AXIS_COLORS.items()):
        turned = [np.rad2deg(found.base_rotation[trials.arrived(name), i]) for name, found in trials.found.items()]
        medians = [np.median(values) if len(values) else np.nan for values in turned]
        places = -np.arange(len(medians), dtype=float)
        mark: dict[str, Any] = {
            "color": color,
            "marker": "os^"[i],
            "markersize": (3.5, 3.0, 3.5)[i],
            "linestyle": "none",
        }
        axes.plot(np.maximum(medians, FLOOR_DEG), places, label=axis, **mark)
        largest = max(largest, *np.nan_to_num(medians))
        for place, middle in zip(places, medians, strict=True):
            if np.isnan(middle) and i == 0:
                axes.text(FLOOR_DEG, place, "none arrives", va="center", fontsize=5.5, color="#666666")
    _set_degrees(axes, 10.0, largest)


def _set_degrees(axes: Axes, usual: float, largest: float) -> None:
    """Set the axis of base rotations, deg, so that none is beyond its end."""
    ticks, labels = list(DEGREES[0]), list(DEGREES[1])
    if largest > usual:
        ticks, labels = [*ticks, 100.0, 360.0], [*labels, "100", "360"]
    axes.set_xscale("log")
    axes.set_xticks(ticks, labels)
    axes.set_xlim(0.7 * FLOOR_DEG, usual if largest <= usual else 500.0)
    axes.xaxis.set_minor_locator(NullLocator())
