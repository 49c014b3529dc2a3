"""Write the tables and the figure of the documents, or check that the tables are what the package computes.

python docs/tables.py           # rewrite the blocks between <!-- begin NAME --> and <!-- end NAME -->
python docs/tables.py --check   # exit status 1 if one is out of date
python docs/tables.py speed robustness ..   # rewrite blocks that no check holds: timings differ from machine to
                                            # machine, and what is drawn at random takes a quarter of an hour
"""

from __future__ import annotations

import inspect
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import workspace_tables
import xarray as xr
from matplotlib.figure import Figure

import ssm_decouple as ssm
from ssm_decouple.control import paper
from ssm_decouple.studies.bending import Bending, bending, flexible
from ssm_decouple.studies.comparison import Summary, summarise
from ssm_decouple.studies.pointing import Pointing, pointing
from ssm_decouple.studies.robustness import Leak, Robustness, effects, tolerances_at
from ssm_decouple.studies.sampling import Drift, sampling
from ssm_decouple.viewing import figures
from ssm_decouple.viewing.style import save
from ssm_decouple.viewing.table import (
    bending_table,
    drift_table,
    effect_table,
    explain,
    leak_table,
    markdown,
    markdown_table,
    pointing_table,
)

ROOT = Path(__file__).parents[1]
DOCUMENTS = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))


@cache
def compared(name: str) -> ssm.Comparison:
    """Return the comparison of a case, computed once for all tables and figures."""
    return ssm.compare(ssm.load_case(name))


@cache
def drifts() -> list[Drift]:
    """Return the drift of cases 1 to 3 under sampled laws, computed once for the table and the figure."""
    return [row for i in (1, 2, 3) for row in sampling(ssm.load_case(f"case{i}"))]


def summaries(suffix: str = "") -> list[Summary]:
    """Return every row of the comparison of cases 1 to 3 on one of the two models."""
    return [row for i in (1, 2, 3) for row in compared(f"case{i}{suffix}").summaries()]


def cases_table(suffix: str) -> str:
    """Return the comparison of cases 1 to 3 on one of the two models."""
    return markdown_table(summaries(suffix))


def stalls() -> str:
    """Return where and why reactionless control does not arrive in cases 1 to 3."""
    return "\n".join(f"- {reason}" for row in summaries() if (reason := explain(row)))


def directions() -> str:
    """Return how many of many protected directions let the arm arrive in each case."""
    i = np.arange(100)
    height, around = (i + 0.5) / i.size, np.pi * (1 + 5**0.5) * i
    flat = np.sqrt(1 - height**2)
    spread = np.column_stack([flat * np.cos(around), flat * np.sin(around), height])
    lines = ["| case | directions that let the arm arrive, of 100 |", "|---|---:|"]
    for name in ssm.cases():
        case = ssm.load_case(name)
        arrived = sum(case.run(ssm.Protection(axis)).attrs["outcome"] == "converged" for axis in spread)
        lines.append(f"| {name} | {arrived} |")
    return "\n".join(lines)


def patience() -> str:
    """Return how damped reactionless control ends when it has half an hour."""
    lines = [["case", "outcome", "left (mm)", "turns of the wrist roll"]]
    for i in (1, 2, 3):
        case = replace(ssm.load_case(f"case{i}"), duration=1800.0)
        motion = case.run(ssm.Protection("all"))
        ended, when, left = (motion.attrs[key] for key in ("outcome", "outcome_time", "final_error"))
        turns = float(np.ptp(motion.joint_positions.values[:, -1])) / (2 * np.pi)
        lines.append([case.name, f"{ended} at {when:.0f} s", f"{1e3 * left:.0f}", f"{turns:.0f}"])
    return markdown(lines)


def drift() -> str:
    """Return how far the protected axis turns when commands are held, for each plan and sample time."""
    return markdown(drift_table(drifts()))


def gentle() -> str:
    """Return the largest joint acceleration with and without limits, in cases 1 to 3 with held commands."""
    lines = [["case", "limit (deg/s2)", "largest acceleration (deg/s2)", "outcome", "left (mm)", "drift (deg)"]]
    for i in (1, 2, 3):
        for limit in (None, 1.0, 0.1):
            case = ssm.load_case(f"case{i}")
            more = {"hold_nodes": 2} | ({} if limit is None else {"acceleration_limit": np.deg2rad(limit)})
            row = summarise(replace(case, law={**case.law, **more}, simulation={"method": "held"}).run(), "selective")
            numbers = (
                f"{row.acceleration_max_deg_s2:.3f}",
                f"{row.outcome}, {row.outcome_time_s:.0f} s",
                f"{1e3 * row.final_error_m:.2f}",
            )
            lines.append(
                [case.name, "none" if limit is None else f"{limit:g}", *numbers, f"{row.protected_angle_deg:.1e}"]
            )
    return markdown(lines)


@cache
def bent() -> dict[str, dict[str, tuple[Bending, xr.Dataset]]]:
    """Return what bends in cases 1 to 3, by case and protection, computed once for the table and the figure."""
    cases = [flexible(ssm.load_case(f"case{i}")) for i in (1, 2, 3)]
    return {case.name: {row.protection: (row, motion) for row, motion in bending(case)} for case in cases}


@cache
def pointed() -> dict[str, tuple[Pointing, xr.Dataset]]:
    """Return how the line of sight wanders in case 3, computed once for the table and the figure."""
    return {row.law: (row, motion) for row, motion in pointing(ssm.load_case("case3"))}


def bending_block() -> str:
    """Return how the appendages bend in cases 1 to 3."""
    return markdown(bending_table([row for runs in bent().values() for row, _ in runs.values()]))


def pointing_block() -> str:
    """Return how the line of sight wanders in case 3."""
    return markdown(pointing_table([row for row, _ in pointed().values()]))


def dynamic() -> str:
    """Return cases 1 to 3 under torques: how they end, and the drift, also when the model is off."""
    ways = {
        "at the sample": (0, False),
        "three Gauss points": (3, False),
        "at the sample, servo protects": (0, True),
    }
    lines = [["case", "law planned", "outcome", "left (mm)", "drift (deg)", "model 5 % off (deg)", "torque (N m)"]]
    for i in (1, 2, 3):
        for way, (nodes, protects) in ways.items():
            case = ssm.load_case(f"case{i}")
            physics = ssm.Dynamic(servo=ssm.Servo(protects=protects))
            motions = []
            for plant in (None, ssm.perturbed(case.robot, tolerances_at(0.05), 4)):
                method = replace(physics, plant=plant)
                variant = replace(case, law={**case.law, "hold_nodes": nodes}, simulation={"method": method})
                motions.append(variant.run())
            drifts = [f"{np.rad2deg(np.abs(motion.protected_angle.values).max()):.1e}" for motion in motions]
            attributes = motions[0].attrs
            largest = max(json.loads(attributes["largest_torques"]))
            ended = f"{attributes['outcome']}, {attributes['outcome_time']:.0f} s"
            lines.append([case.name, way, ended, f"{1e3 * attributes['final_error']:.2f}", *drifts, f"{largest:.0f}"])
    return markdown(lines)


@cache
def leaks() -> list[Leak]:
    """Return the Monte Carlo study of cases 1 to 3, computed once for the table and the figure."""
    rows = []
    for i in (1, 2, 3):
        campaign = Robustness(ssm.load_case(f"case{i}"), runs=40)
        campaign.run(lambda share, i=i: print(f"\rcase{i} {share:4.0%}", end="", file=sys.stderr))
        rows += campaign.leaks()
    return rows


def robustness() -> str:
    """Return what errors in the model leave of the protection, and draw the figure."""
    draw({"robustness": figures.robustness(leaks())})
    return markdown(leak_table(leaks()))


def effects_block() -> str:
    """Return what single imperfections leave of the protection in cases 1 to 3."""
    return markdown(effect_table([row for i in (1, 2, 3) for row in effects(ssm.load_case(f"case{i}"))]))


def variables(motion: xr.Dataset, without: Collection[Hashable] = ()) -> str:
    """Return what stands in the record of a motion, but for the variables that are known already."""
    lines = ["| variable | dimensions | units | frame | what |", "|---|---|---|---|---|"]
    for name, variable in motion.data_vars.items():
        if name not in without:
            frame, meaning = (variable.attrs.get(key, "") for key in ("frame", "long_name"))
            dimensions = ", ".join(map(str, variable.dims))
            lines.append(f"| `{name}` | {dimensions} | {variable.attrs['units']} | {frame} | {meaning} |")
    return "\n".join(lines)


def dynamic_record() -> str:
    """Return what a dynamic motion of a spacecraft with flexible wings holds beside the kinematic record."""
    case = replace(flexible(ssm.load_case("case1")), duration=1.0, simulation={"method": ssm.Dynamic(step=0.01)})
    return variables(case.run(), compared("case1").motions["selective"].data_vars)


def workspace_block() -> str:
    """Return what protections leave of the workspace, and draw the figures."""
    draw(workspace_tables.figures())
    return workspace_tables.table()


def workspace_targets() -> str:
    """Return how many of random targets each protection lets the arm reach, and draw the figure."""
    draw({"workspace_targets": workspace_tables.targets_figure()})
    return workspace_tables.arrivals()


def reactionless() -> str:
    """Return the block that its benchmark writes, with the figure."""
    printed_by("benchmarks/reactionless.py")
    page = (ROOT / "docs" / "reactionless.md").read_text(encoding="utf-8")
    return page.split("<!-- begin reactionless -->\n\n")[1].split("\n\n<!-- end reactionless -->")[0]


def paper_law() -> str:
    """Return the law's function from its file, as code that runs on the page."""
    source = inspect.getsource(paper.selective_law)
    return f"```python\nfrom numpy import ndarray as Floats\n\n\n{source.strip()}\n```"


BLOCKS: dict[str, Callable[[], str]] = {
    "paper": paper_law,
    "cases": lambda: cases_table(""),
    "flight": lambda: cases_table("_flight"),
    "stalls": stalls,
    "directions": directions,
    "patience": patience,
    "drift": drift,
    "gentle": gentle,
    "bending": bending_block,
    "pointing": pointing_block,
    "dynamic": dynamic,
    "effects": effects_block,
    "first_case": lambda: markdown_table(compared("case1").summaries()),
    "record": lambda: variables(compared("case1").motions["selective"]),
    "dynamic_record": dynamic_record,
}
KEPT: dict[str, Callable[[], str]] = {
    "speed": lambda: printed_by("benchmarks/control_step.py"),
    "dynamic_speed": lambda: printed_by("benchmarks/dynamic.py"),
    "exactness": lambda: printed_by("benchmarks/exactness.py").replace("\n\n", "\n"),  # progress bars left them
    "robustness": robustness,
    "two_arms": lambda: printed_by("examples/two_arms.py", "1000"),
    "workspace": workspace_block,
    "workspace_margins": workspace_tables.margins,
    "workspace_changes": workspace_tables.changes,
    "workspace_targets": workspace_targets,
    "workspace_steps": workspace_tables.steps,
    "workspace_stops": workspace_tables.stops,
    "reactionless": reactionless,
    "batch_speed": lambda: printed_by("benchmarks/batch.py", "1e7"),
    "arms": lambda: printed_by("benchmarks/arms.py"),
    "start_up": lambda: printed_by("benchmarks/start_up.py"),
    "viewer_speed": lambda: printed_by("benchmarks/viewer.py"),
    "campaign": lambda: printed_by("benchmarks/campaign.py"),
}


NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e-\d+)?")


def agree(old: str, new: str) -> bool:
    """Say whether two blocks tell the same: equal words, and numbers within 3 %.

    Another processor rounds otherwise, and a motion that chatters at a singularity carries that into the third digit;
    numbers with an exponent are rounding themselves, or singular values of such a motion.
    """
    if NUMBER.sub("#", old) != NUMBER.sub("#", new):
        return False
    pairs = zip(NUMBER.findall(old), NUMBER.findall(new), strict=True)
    return all("e" in b or abs(float(a) - float(b)) <= 0.03 * abs(float(b)) + 2e-3 for a, b in pairs)


def draw(sheets: Mapping[str, Figure]) -> None:
    """Write figures that the documents show."""
    folder = ROOT / "docs" / "images"
    folder.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        for name, figure in sheets.items():
            save(figure, scratch, name)
        for path in Path(scratch).glob("*.png"):
            shutil.copy(path, folder / path.name)


def sheets() -> dict[str, Figure]:
    """Return the figures of what the checked blocks tell."""
    wings = {law: motion for law, (_, motion) in bent()["case1"].items()}
    return {
        "case1_comparison": figures.comparison(compared("case1").motions),
        "case2_configuration": figures.configuration(compared("case2").motions["selective"]),
        "sampling": figures.sampling(drifts()),
        "case1_bending": figures.bending((flexible(ssm.load_case("case1")), wings)),
        "case3_pointing": figures.pointing({law: motion for law, (_, motion) in pointed().items()}),
    }


def printed_by(script: str, *arguments: str) -> str:
    """Return what a script prints here."""
    words = [sys.executable, str(ROOT / script), *arguments]
    printed = subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()
    return f"```text\n{printed}\n```"


def build(name: str) -> str:
    """Return a block's new text."""
    return {**BLOCKS, **KEPT}[name]()


def main(check: bool, named: Sequence[str]) -> int:
    """Rewrite or check every block but the kept ones, or rewrite the named ones; return the exit status."""
    wanted = [
        name
        for document in DOCUMENTS
        for name in re.findall(r"<!-- begin (\w+) -->", document.read_text(encoding="utf-8"))
        if (name in named if named else name not in KEPT)
    ]
    if named:  # timings want the machine for themselves
        made = {name: build(name) for name in wanted}
    else:
        with ProcessPoolExecutor() as pool:
            made = dict(zip(wanted, pool.map(build, wanted), strict=True))
    stale = []
    for document in DOCUMENTS:
        text = document.read_text(encoding="utf-8")
        for name in re.findall(r"<!-- begin (\w+) -->", text):
            if name not in made:
                continue
            pattern = rf"(<!-- begin {name} -->\n\n)(.*?)(\n\n<!-- end {name} -->)"
            old = re.search(pattern, text, re.DOTALL)
            if old is None:
                raise SystemExit(f"{document}: block '{name}' has no end, or no blank lines about it")
            if not (agree(old[2], made[name]) if check else old[2] == made[name]):
                stale.append(f"{document.relative_to(ROOT)}: {name}")
                text = text[: old.start(2)] + made[name] + text[old.end(2) :]
        if not check:
            document.write_text(text, encoding="utf-8")
    if not check and not named:
        draw(sheets())
    for block in stale:
        print(f"{'out of date' if check else 'rewritten'}: {block}")
    return int(check and bool(stale))


if __name__ == "__main__":
    given = sys.argv[1:]
    sys.exit(main("--check" in given, [word for word in given if word != "--check"]))
