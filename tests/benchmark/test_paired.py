"""Figures and differences over pairs against hand-made cases."""

from __future__ import annotations

import numpy as np
import pytest

from utopic_cli.benchmark.paired import mean_figure, paired_difference, root_mean_square_figure


def test_a_mean_has_its_standard_error():
    figure = mean_figure([1.0, None, 3.0])
    assert figure is not None
    assert (figure.value, figure.pairs) == (2.0, 2)
    assert figure.error == pytest.approx(1.0)  # sqrt(2) / sqrt(2)
    single = mean_figure([4.0])
    assert single is not None and single.error is None
    assert mean_figure([None]) is None


def test_the_error_of_a_root_mean_square_follows_that_of_the_mean():
    figure = root_mean_square_figure([4.0, 4.0, 16.0, 16.0])
    assert figure is not None and figure.value == pytest.approx(np.sqrt(10.0))
    mean_error = np.std([4.0, 4.0, 16.0, 16.0], ddof=1) / 2.0
    assert figure.error == pytest.approx(mean_error / (2.0 * np.sqrt(10.0)))
    zero = root_mean_square_figure([0.0, 0.0])
    assert zero is not None and (zero.value, zero.error) == (0.0, 0.0)
    assert root_mean_square_figure([]) is None


def test_a_difference_leaves_out_how_hard_the_pairs_are():
    hardness = np.array([0.0, 100.0, 5.0, 60.0, 20.0])
    gaps = np.array([1.0, 1.2, 0.8, 1.1, 0.9])
    difference = paired_difference((hardness + gaps).tolist(), hardness.tolist())
    assert difference is not None and difference.p_value == pytest.approx(0.00015, rel=0.1)
    assert difference.value == pytest.approx(1.0)
    half = 2.7764451 * gaps.std(ddof=1) / np.sqrt(5.0)  # Student's quantile of 4 degrees of freedom
    assert (difference.low, difference.high) == (pytest.approx(1.0 - half), pytest.approx(1.0 + half))


def test_noise_is_called_noise():
    difference = paired_difference([1.0, -1.0, 2.0, -2.0], [0.0] * 4)
    assert difference is not None and difference.p_value == pytest.approx(1.0)
    same = paired_difference([1.0, 2.0], [1.0, 2.0])
    assert same is not None and same.p_value == 1.0 and (same.low, same.high) == (0.0, 0.0)
    single = paired_difference([9.0, None], [1.0, 1.0])
    assert single is not None and single.p_value == 1.0 and single.low is None and single.pairs == 1
    alike = paired_difference([1.0, 1.0, 1.0], [0.0] * 3)
    assert alike is not None and alike.p_value == 0.25  # three coins on one side


def test_what_has_no_partner_is_left_out_or_refused():
    assert paired_difference([None, 1.0], [1.0, None]) is None
    with pytest.raises(ValueError, match="can't be paired"):
        paired_difference([1.0], [1.0, 2.0])
