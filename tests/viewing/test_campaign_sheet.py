"""The figure of a campaign: its bars, curves and intervals are the store's numbers."""

from __future__ import annotations

import numpy as np
import pytest

import ssm_decouple as ssm
from ssm_decouple.studies.campaign import Campaign
from ssm_decouple.studies.store import Store
from ssm_decouple.viewing.campaign import campaign_sheet, combinations
from ssm_decouple.viewing.targets import FLOOR_MM

TEXT = """
title = "A sheet"
seed = 2
samples = 12
chunk = 6
cases = ["case1", "case2"]
protections = ["none", "case", "all"]
[target]
position = { ball = 0.9 }
"""


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    folder = tmp_path_factory.mktemp("campaign")
    (folder / "campaign.toml").write_text(TEXT)
    Campaign.load(folder / "campaign.toml").run(folder / "s.zarr")
    return Store.open(folder / "s.zarr")


def test_bars_curves_and_angles_are_those_of_the_store(store):
    figure = campaign_sheet(store)
    tallies = store.tallies()
    assert "A sheet\n72 of 72 samples" in figure._suptitle.get_text()
    for row, case in enumerate(("case1", "case2")):
        ends, left, base = figure.axes[3 * row : 3 * row + 3]
        mine = [tally for tally in tallies if tally.case == case]
        assert [label.get_text() for label in ends.get_yticklabels()] == ["none", "the case's own", "all rotation"]
        for place, tally in enumerate(mine):
            bars = [bar for bar in ends.patches if round(bar.get_y() + bar.get_height() / 2) == -place]
            assert sum(bar.get_width() for bar in bars) == pytest.approx(1.0)
            widths = [tally.arrived, tally.running / 12, tally.stalled / 12, tally.failed / 12]
            assert [bar.get_width() for bar in bars] == pytest.approx([width for width in widths if width])
            np.testing.assert_allclose(ends.lines[place].get_xdata(), [tally.arrived_low, tally.arrived_high])
            errors = store.dataset().final_error.values[36 * row + 12 * place :][:12]
            np.testing.assert_allclose(left.lines[place].get_xdata(), np.maximum(1e3 * np.sort(errors), FLOOR_MM))
        assert base.lines
    assert len({tally.arrived for tally in tallies}) > 2


def test_what_is_not_there_yet_is_left_out_and_nothing_at_all_is_told(store, tmp_path, call):
    campaign = store.campaign
    with Store.writing(tmp_path / "part.zarr", campaign) as part:
        with pytest.raises(ssm.InputError, match=r"no sample is in .*part\.zarr yet"):
            campaign_sheet(part)
        for chunk in (0, 1, 3):
            part.write(chunk, campaign.rows(range(*campaign.span(chunk))))
    found = combinations(Store.open(tmp_path / "part.zarr"))
    assert {case: {name: rows.sizes["sample"] for name, rows in rest.items()} for case, rest in found.items()} == {
        "case1": {"none": 12, "the case's own": 6}
    }
    np.testing.assert_array_equal(
        found["case1"]["the case's own"].final_error.values, store.dataset().final_error.values[18:24]
    )
    done = call("campaign", "plot", tmp_path / "part.zarr", "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["part.pdf", "part.png"]
