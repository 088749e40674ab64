"""One thread where several would round otherwise.

Threads that share a sum add it up in another order, it rounds otherwise, and the registration ends
a bit elsewhere. How many threads there really are is not ours to say (OpenMP may take fewer than it
was given), and an answer should not tell how busy a machine was. The few sums that torch and its
libraries cut across threads at the network's usual sizes are too small to gain by it. In training, where
batches are larger, they may be cut.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use one thread of the CPU within a ``with`` block or a decorated function; at inference only.

    Torch's number of threads is the whole process's: Python threads that predict at the same time may
    find it lowered.
    """
    if not torch.is_inference_mode_enabled():
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
