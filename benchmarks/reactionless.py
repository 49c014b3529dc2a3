"""What share of random targets each law reaches: no protection, the cases' own, reactionless damped and undamped.

Cases 1 to 3 on both models. Writes the block and the figure of docs/reactionless.md. Ten thousand targets take a
quarter of an hour on two processors, a thousand a few minutes.

    python benchmarks/reactionless.py [--targets N]
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from matplotlib.figure import Figure

import ssm_decouple as ssm
from ssm_decouple.studies.targets import COUNT, Trials, case_trials
from ssm_decouple.viewing import targets as viewing
from ssm_decouple.viewing.style import save
from ssm_decouple.viewing.table import markdown

PAGE = Path(__file__).parents[1] / "docs" / "reactionless.md"
CASES = [f"case{i}{model}" for model in ("", "_flight") for i in (1, 2, 3)]
PATIENCE = 600.0  # s
PART = 20  # one target of so many gets this patience


def timed(trials: Trials) -> float:
    """Run the trials and return how long that took, s."""
    name, start = f"{trials.targets.start} of {trials.targets.robot.name}", time.perf_counter()
    trials.run(lambda law, share: print(f"\r{name}, {law}: {share:4.0%}   ", end="", file=sys.stderr))
    return time.perf_counter() - start


def patience(studies: Sequence[Trials]) -> list[list[str]]:
    """Return what share of the first targets the laws reach in the cases' time and in PATIENCE."""
    lines = [["start", "law", "targets", f"arrived in {studies[0].duration:g} s (%)", f"in {PATIENCE:g} s (%)"]]
    for trials in studies:
        count = max(1, len(trials.targets.positions) // PART)
        laws = {name: law for name, law in trials.laws.items() if law.protection.k}
        longer = replace(_first(trials, count), laws=laws, duration=PATIENCE, found={})
        timed(longer)
        for name in laws:
            shares = (100 * trials.arrived(name)[:count].mean(), 100 * longer.arrived(name).mean())
            lines.append([trials.targets.start, name, str(count), *(f"{share:.1f}" for share in shares)])
    return lines


def _first(trials: Trials, count: int) -> Trials:
    whole = trials.targets
    parts = {name: getattr(whole, name)[:count] for name in ("configurations", "goals", "positions")}
    return replace(trials, targets=replace(whole, **parts))


def block(studies: Sequence[Trials], seconds: float) -> str:
    """Return the tables, each with a line on what it is."""
    motions = sum(len(trials.laws) * len(trials.targets.positions) for trials in studies)
    count = len(studies[0].targets.positions)
    tables = {
        f"From the cases' starts, {count:,} targets each.": viewing.arrival_table(_all(studies, "rows")),
        "Two laws at the same targets; base angles are medians where both arrive.": viewing.pair_table(
            _all(studies, "pairs")
        ),
        "What holds the stalled motions: the protected row without which the arm could go on.": viewing.stop_table(
            _all(studies, "stops")
        ),
        "By the distance from the start, share that arrives, the three cases together.": viewing.distance_table(
            studies
        ),
        f"With {PATIENCE:g} s instead of {studies[0].duration:g} s.": patience(studies),
    }
    speed = (
        f"{motions:,} motions of {studies[0].duration:g} s took {seconds / 60:.0f} min on {os.cpu_count()} processors"
    )
    told = [f"{heading}\n\n{markdown(lines)}" for heading, lines in tables.items()]
    return "\n\n".join([*told, f"{speed}: {motions / seconds:.0f} motions a second."])


def _all(studies: Sequence[Trials], what: str) -> list:  # type: ignore[type-arg]
    return [row for trials in studies for row in getattr(trials, what)()]


def write(text: str, sheets: Mapping[str, Figure]) -> None:
    """Put the block into the page and the figures beside it."""
    page = PAGE.read_text(encoding="utf-8")
    pattern = r"(?<=<!-- begin reactionless -->\n\n).*?(?=\n\n<!-- end reactionless -->)"
    if not re.search(pattern, page, re.DOTALL):
        raise SystemExit(f"{PAGE}: there is no block 'reactionless', or no blank lines about it")
    PAGE.write_text(re.sub(pattern, lambda _: text, page, count=1, flags=re.DOTALL), encoding="utf-8")
    with tempfile.TemporaryDirectory() as scratch:
        for name, figure in sheets.items():
            save(figure, scratch, name)
            shutil.copy(Path(scratch) / f"{name}.png", PAGE.parent / "images" / f"{name}.png")


def main(count: int) -> None:
    """Run all trials, write page and figures."""
    studies = [case_trials(ssm.load_case(name), count) for name in CASES]
    seconds = sum(timed(trials) for trials in studies)
    write(block(studies, seconds), {"reactionless": viewing.distances(studies)})
    print(f"\nwritten: {PAGE}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--targets", type=int, default=COUNT, help=f"of each case, {COUNT} by default")
    main(parser.parse_args().targets)
