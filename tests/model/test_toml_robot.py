"""Robots that a TOML file describes: a URDF with wings."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import ssm_decouple as ssm
from ssm_decouple.cli import app
from ssm_decouple.model.catalogue import find_robot, find_urdf

WINGED = """urdf = "ets_vii"
[[appendage]]
name = "wing"
mount = [0.0, 1.45, 0.0]
span_direction = [0, 1, 0]
normal = [1, 0, 0]
span = 6.5
chord = 2.4
mass = 50
frequency = 0.15
damping_ratio = 0.005
segments = 2
turn_deg = 30
"""


def test_the_shipped_wings(ets_vii):
    robot = ssm.load_robot("ets_vii_flexible")
    assert robot.urdf == ets_vii.urdf
    assert (robot.name, robot.end_effector) == ("ets_vii_flexible", "end_effector")
    left, right = robot.appendages
    assert (left.name, right.name) == ("wing_left", "wing_right")
    assert (left.mount, right.mount) == ((0.0, 1.45, 0.0), (0.0, -1.45, 0.0))
    for wing in robot.appendages:
        assert (wing.span, wing.chord, wing.mass, wing.frequency, wing.damping_ratio) == (6.5, 2.4, 50, 0.15, 0.005)
        assert wing.body.centre[1] == pytest.approx(np.sign(wing.mount[1]) * 4.7)  # where the drawn panel stands


def test_a_toml_names_a_urdf_beside_it_or_in_the_catalogue(write, ets_vii):
    path = write(WINGED, "mine.toml")
    robot = ssm.load_robot(path)
    assert robot.name == "mine"
    (wing,) = robot.appendages
    assert (wing.segments, wing.mass) == (2, 50.0)
    assert wing.turn == pytest.approx(np.pi / 6)
    write(ets_vii.urdf, "there.urdf")
    beside = write(WINGED.replace('urdf = "ets_vii"', 'urdf = "there.urdf"\nend_effector = "link_5"'), "other.toml")
    assert ssm.load_robot(str(beside)).end_effector == "link_5"
    assert ssm.load_robot(beside, end_effector="link_6").end_effector == "link_6"
    assert ssm.load_robot(write('urdf = "ets_vii"', "rigid.toml")).appendages == ()
    arm = write('urdf = "ets_vii"\nend_effector = "link_6"', "arm.toml")
    composed = ssm.compose("ets_vii_bus", arm, [0, 0, 3], prefix="b_")
    assert composed.end_effector == "b_link_6"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("urdf = ", "is not TOML"),
        ("", "urdf is missing: name the URDF file"),
        ("urdf = 3", "urdf is 3; it must be a text"),
        (WINGED.replace("urdf =", "udrf ="), "unknown key 'udrf'; did you mean 'urdf'?"),
        ('robot = "ets_vii"', "unknown key 'robot'; known: urdf, end_effector, appendage"),
        (WINGED.replace('"ets_vii"', '"gone.urdf"'), "gone.urdf' is neither a file nor a robot of the catalogue"),
        (WINGED.replace('"ets_vii"', '"ets_vii_flexible"'), "'ets_vii_flexible' is a TOML file too; name the URDF"),
        (WINGED.replace("[[appendage]]", "[appendage]"), "'appendage' must be a list of tables: write [[appendage]]"),
        (WINGED.replace("[[appendage]]", "[[appendages]]"), "unknown key 'appendages'; did you mean 'appendage'?"),
        (
            WINGED.replace("frequency", "freqency"),
            "[[appendage]] wing: unknown key 'freqency'; did you mean 'frequency'?",
        ),
        (WINGED.replace("turn_deg", "turn"), "unknown key 'turn'; did you mean 'turn_deg'?"),
        (WINGED.replace("mass = 50\n", ""), "[[appendage]] wing: mass is missing"),
        (WINGED.replace('name = "wing"\n', ""), "[[appendage]] 1: name is missing"),
        (WINGED.replace("mass = 50", "mass = -50"), "appendage 'wing': mass is -50.0; it must be above zero"),
        (WINGED.replace("mass = 50", 'mass = "50"'), "mass is '50'; it must be a number"),
        (WINGED.replace("turn_deg = 30", 'turn_deg = "30"'), "turn_deg is '30'; it must be a number"),
        (WINGED.replace("segments = 2", "segments = 2.5"), "segments is 2.5"),
        (WINGED.replace("mass = 50", "mass = 5000"), "the appendages wing weigh 5000 kg of the 2550 kg"),
        (WINGED + WINGED.partition("\n")[2], "two appendages are called 'wing'"),
    ],
)
def test_a_toml_that_makes_no_sense_is_refused(write, text, says):
    with pytest.raises(ssm.DecoupleError) as caught:
        ssm.load_robot(write(text, "mine.toml"))
    assert says in str(caught.value)
    assert "mine" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_catalogue_lists_both_kinds(write):
    catalogue = ssm.models()
    assert {path.suffix for path in catalogue.values()} == {".urdf", ".toml"}
    assert list(catalogue) == [
        "ets_vii",
        "ets_vii_bus",
        "ets_vii_flexible",
        "ets_vii_flight",
        "seven_joint",
        "two_arms",
    ]
    assert find_robot("ets_vii_flexible") == catalogue["ets_vii_flexible"]
    assert find_urdf("ets_vii_flexible").samefile(catalogue["ets_vii"])
    assert find_urdf("ets_vii") == catalogue["ets_vii"]
    assert find_urdf(write(WINGED, "mine.toml")) == catalogue["ets_vii"]


def test_the_wheel_takes_the_whole_folder():
    """What installs models/ installs every file in it, whatever its suffix."""
    project = Path(ssm.__file__).parents[2] / "pyproject.toml"
    if not project.is_file():
        pytest.skip("the package is installed, not a source tree")
    included = tomllib.loads(project.read_text(encoding="utf-8"))["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert included["force-include"] == {"models": "ssm_decouple/models"}
    assert "exclude" not in included
    assert {path.parent for path in ssm.models().values()} == {project.parent / "models"}


def test_check_and_models_tell_of_the_wings(write):
    def call(*words: str) -> str:
        done = CliRunner().invoke(app, list(words))
        assert done.exit_code == 0, done.output
        return done.output

    said = call("check", "ets_vii_flexible")
    for words in ("appendages    2", "wing_left ", "1 segment  base held 0.15 Hz", "free-flying   0.1521, 0.1862 Hz"):
        assert words in said
    assert "bus remains   2450 kg, principal moments 3492, 3590.9, 4528.9 kg m2" in said
    flexible = json.loads(call("check", "ets_vii_flexible", "--json"))["flexible"]
    assert [wing["name"] for wing in flexible["appendages"]] == ["wing_left", "wing_right"]
    assert json.loads(call("check", "ets_vii", "--json"))["flexible"] is None
    listed = json.loads(call("models", "--json"))
    assert listed["ets_vii_flexible"]["appendages"] == ["wing_left", "wing_right"]
    assert listed["ets_vii_flexible"]["urdf"].endswith("ets_vii.urdf")
    assert "2 appendages" in call("models")


def test_check_of_wings_that_do_not_fit(write):
    heavy = write(WINGED.replace("mass = 50", "mass = 5000"), "heavy.toml")
    done = CliRunner().invoke(app, ["check", str(heavy)])
    assert done.exit_code == 1
    assert "the appendages wing weigh 5000 kg of the 2550 kg" in done.output
    with pytest.warns(ssm.DecoupleWarning, match="without its appendages"):
        report = ssm.Report.of_file(write(WINGED.replace("mass = 50", "mass = 200"), "odd.toml"))
    assert [finding.where for finding in report.findings] == ["link bus without its appendages"]
