"""How many threads the libraries of a new process take."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager

# NumPy's and SciPy's linear algebra, torch and Open3D all heed one of these when they are loaded.
_HEEDED = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_STARTING = threading.Lock()  # the environment is the whole process', which may have several threads


@contextmanager
def threads_of_children(count: int) -> Iterator[None]:
    """Let processes that are started meanwhile read how many threads to take; one at a time."""
    with _STARTING:
        before = {name: os.environ.get(name) for name in _HEEDED}
        os.environ.update(dict.fromkeys(_HEEDED, str(count)))
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value
