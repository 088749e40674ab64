"""Sums that must round alike belong to one thread; the caller's threads are his again afterwards."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from utopic_cli.model.matching import sinkhorn
from utopic_cli.model.one_thread import one_thread


@pytest.fixture
def three_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("three_threads")
def test_the_number_of_threads_comes_back_even_after_an_error() -> None:
    with torch.inference_mode(), one_thread():
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 3
    with pytest.raises(ZeroDivisionError), torch.inference_mode(), one_thread():
        1 / 0  # noqa: B018
    assert torch.get_num_threads() == 3
    with one_thread():  # in training
        assert torch.get_num_threads() == 3


@pytest.mark.usefixtures("three_threads")
def test_sinkhorn_rounds_the_same_with_any_number_of_threads() -> None:
    affinity = torch.randn(1, 873, 906, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        shared = sinkhorn(affinity, 5)
        assert torch.get_num_threads() == 3
        torch.set_num_threads(1)
        assert torch.equal(shared, sinkhorn(affinity, 5))
