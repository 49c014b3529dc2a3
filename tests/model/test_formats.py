"""Files in other formats: refused with a line that says how to convert them."""

import pytest

import ssm_decouple as ssm

SDF = '<?xml version="1.0"?>\n<!-- a <robot> -->\n<sdf version="1.9"><model name="m"/></sdf>'


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("robot.sdf", SDF, "rod"),
        ("robot.urdf", SDF, "sdformat_urdf"),
        ("robot.xml", SDF, "SDF"),
        ("robot.world", SDF, "SDF"),
        ("robot.usd", "PXR-USDC", "USD"),
        ("robot.usda", "#usda 1.0", "USD"),
        ("robot.urdf.xacro", "<robot/>", "xacro FILE"),
        ("robot.XACRO", "<robot/>", "xacro FILE"),
        ("robot.mjb", "\x00", "MJCF"),
        ("robot.mat", "MATLAB 5.0", "exportrobot"),
        ("robot.m", "robot = rigidBodyTree;", "exportrobot"),
        ("robot.stl", "solid", "shape"),
    ],
)
def test_another_format_is_refused_with_the_way_to_convert_it(name, text, words, tmp_path, call):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(ssm.ModelError, match=words):
        ssm.load_robot(path)
    with pytest.raises(ssm.ModelError, match=words):
        ssm.compose("ets_vii_bus", path, [0, 0, 1])
    with pytest.raises(ssm.ModelError, match=words):
        ssm.Report.of_file(path)
    done = call("check", path)
    assert done.returncode != 0
    assert words in " ".join(done.stderr.split())


def test_a_text_of_another_format_is_refused_as_well():
    for text, words in ((SDF, "<sdf>"), ("<mujoco/>", "<mujoco>")):
        with pytest.raises(ssm.ModelError, match=words):
            ssm.Robot(text, name="r")
