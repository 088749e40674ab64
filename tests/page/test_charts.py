from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from utopic_cli.page.charts import BINS, overlap_histogram, residual_histogram


def bars(svg):
    """Read (left edge, height) of each bar back, by scan."""
    root = ElementTree.fromstring(svg)
    found = {}
    for path in root.iter("path"):
        numbers = re.findall(r"M([\d.]+) [\d.]+v-([\d.]+)h", path.get("d"))
        found[path.get("class")] = np.array(numbers, float).reshape(-1, 2)
    return found


def top(svg):
    return max(float(text.strip("%")) for text in re.findall(r">([\d.]+%)<", svg)) / 100


def test_bars_are_as_tall_as_their_shares():
    source = np.repeat([0.025, 0.975], [300, 100])
    svg = overlap_histogram(source, np.full(50, 0.5))
    found = bars(svg)
    full = 134.0 / top(svg)
    np.testing.assert_allclose(found["source"][:, 1], [0.75 * full, 0.25 * full], atol=0.06)
    np.testing.assert_allclose(found["target"][:, 1], [full], atol=0.06)
    assert found["source"][0, 0] < found["target"][0, 0] < found["source"][1, 0]


def test_points_without_a_counterpart_stand_apart_at_the_end():
    residual = np.array([0.1] * 6 + [np.inf] * 4)
    svg = residual_histogram(residual, np.full(3, 1.9), 2.0)
    left = bars(svg)["source"]
    assert left[1, 1] / left[0, 1] == pytest.approx(4 / 6, rel=0.01)
    assert left[1, 0] > bars(svg)["target"][0, 0]
    assert ">none<" in svg


@pytest.mark.parametrize("value", [np.inf, np.nan])
def test_nothing_known_is_no_error(value):
    svg = residual_histogram(np.full(5, value), np.full(5, value), 1.0)
    assert len(bars(svg)["source"]) == 1
    assert "nan" not in overlap_histogram(np.full(BINS, np.nan), np.zeros(0))
