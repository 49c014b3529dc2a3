"""Damaged URDF: refused in our own words, or every number of the model is what the file says."""

from __future__ import annotations

import copy
import re
import time
import warnings
import xml.etree.ElementTree as ET
from collections import Counter

import numpy as np
import pytest
from random_robots import random_urdf
from urdf_oracle import assert_holds

import ssm_decouple as ssm

NUMBER = re.compile(r"(?<=[\" ])[+-]?\d[\d.e+-]*(?=[\" ])")
ODD_NUMBERS = (
    "", " ", "0", "-0", "1", "+1", "1.", ".5", "-.5e-3", "1E2", "1e400", "1e-400", "1e308", "-1e308", "1e-310", "nan",
    "inf", "-inf", "INF", "1_0", "0x10", "1.0f", "1d3", "1,5", "1;2", "--1", "1e", "e5", "\u22121", "\u0661", "1 2",
    "1\u00a0", "&#9;1", "1&#10;", "&#x31;", "&lt;1", "180", "1e9", "1e-20", "one", "${x}", "1/2", "pi", "1e+2", "00012",
)  # fmt: skip
USUAL_NUMBERS = ("0", "-0", "1.", "+.5", "2E-1", "1e-400", "0.1&#9;", "&#10;7", "1e-310", "-1e2", "00012")
ODD_WORDS = (
    "",
    "universe",
    "root_joint",
    "world",
    "end_effector",
    "bus",
    " ",
    "Revolute",
    "floating",
    "planar",
    "Link",
)


def damaged(text: str, rng: np.random.Generator) -> str:
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        text = str(rng.choice(np.array(WAYS, dtype=object))(text, rng))
    return text


def a_character(text: str, rng: np.random.Generator) -> str:
    place = int(rng.integers(len(text)))
    new = str(rng.choice(list("\"'<>/= \t\n01.-e&;abx\u00e9\ufeff")))
    return text[:place] + str(rng.choice(["", new])) + text[place + int(rng.integers(2)) :]


def a_number(text: str, rng: np.random.Generator) -> str:
    places = list(NUMBER.finditer(text))
    found = places[int(rng.integers(len(places)))] if places else None
    if found is None:
        return text
    number = str(rng.choice(USUAL_NUMBERS if rng.random() < 0.5 else ODD_NUMBERS))
    kept = rng.choice([number, number, number, found[0] + number, number + found[0], found[0].replace(".", ",")])
    return text[: found.start()] + str(kept) + text[found.end() :]


def a_span(text: str, rng: np.random.Generator) -> str:
    start = int(rng.integers(len(text)))
    end = start + int(rng.integers(1, 40))
    return str(rng.choice([text[:start] + text[end:], text[:end] + text[start:], text[:start]]))


def an_element(text: str, rng: np.random.Generator) -> str:
    """Take away, double, move or rename an element, or rename, take away or exchange attributes."""
    try:
        root = ET.fromstring(text)
    except (ET.ParseError, ValueError):
        return text
    parents = [(parent, child) for parent in root.iter() for child in parent]
    if not parents:
        return text
    parent, child = parents[int(rng.integers(len(parents)))]
    another = parents[int(rng.integers(len(parents)))][1]
    what = int(rng.integers(8))
    if what == 0:
        parent.remove(child)
    elif what == 1:
        parent.append(copy.deepcopy(child))
    elif what == 2 and another not in list(child.iter()):
        parent.remove(child)
        another.append(child)
    elif what == 3:
        child.tag = str(rng.choice([child.tag.capitalize(), child.tag[:-1] or "x", child.tag + "s", another.tag]))
    elif child.attrib:
        key = str(rng.choice(list(child.attrib)))
        value = child.attrib.pop(key)
        if what == 4:
            child.set(str(rng.choice([key.upper(), key + "s", key[:-1] or "x", "quat_xyzw", "rpy"])), value)
        elif what == 5:
            child.set(key, str(rng.choice(ODD_WORDS)))
        elif what == 6 and key in another.attrib:
            child.set(key, another.get(key, ""))
            another.set(key, value)
    return ET.tostring(root, encoding="unicode")


WAYS = (a_character, a_number, a_number, a_span, an_element, an_element)


def outcome(text: str, plain: ssm.Robot) -> str:
    """Load a damaged file; return what came of it."""
    start = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ssm.DecoupleWarning)
        try:
            robot = ssm.Robot(text, name="damaged", end_effector="end_effector")
        except ssm.DecoupleError as error:
            lines = str(error).splitlines()
            return "refused" if len(lines) == 1 else f"refused in {len(lines)} lines"
        assert_holds(robot, text)
        again = ssm.Robot(robot.urdf, name="again", end_effector="end_effector")
    assert again.model.inertias.tolist() == robot.model.inertias.tolist()
    assert str(robot.report())
    assert time.process_time() - start < 10
    same = robot.joint_names == plain.joint_names and robot.link_names == plain.link_names
    same = same and robot.model.inertias.tolist() == plain.model.inertias.tolist()
    same = same and robot.model.jointPlacements.tolist() == plain.model.jointPlacements.tolist()
    same = same and np.array_equal(robot.position_limits, plain.position_limits)
    return "equal" if same and np.array_equal(robot.rate_limits, plain.rate_limits) else "different, as the file says"


def counted(seeds: range, capfd: pytest.CaptureFixture[str]) -> Counter[str]:
    counts: Counter[str] = Counter()
    for seed in seeds:
        rng = np.random.default_rng(seed)
        text = random_urdf(seed % 7, 3)
        plain = ssm.Robot(text, name="plain")
        broken = damaged(text, rng)
        try:
            counts[outcome(broken, plain)] += 1
        except BaseException as error:
            raise AssertionError(f"seed {seed}: {type(error).__name__}: {error}\n{broken}") from error
    assert capfd.readouterr() == ("", "")
    assert set(counts) <= {"refused", "equal", "different, as the file says"}
    return counts


def test_a_damaged_file_is_refused_or_read_as_it_stands(capfd):
    counts = counted(range(100), capfd)
    assert counts["refused"] > 30
    assert counts["different, as the file says"] > 2


@pytest.mark.slow
def test_a_thousand_damaged_files(capfd):
    counts = counted(range(1000, 2000), capfd)
    with capfd.disabled():
        print("\n1,000 damaged URDF:", ", ".join(f"{count} {what}" for what, count in counts.most_common()))
    assert sum(counts.values()) == 1000
