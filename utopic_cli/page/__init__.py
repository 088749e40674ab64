"""One alignment as a self-contained HTML page: the verdict, a 3D view, the numbers.

``skeleton`` is what the pages of batches, training runs and benchmarks are built on too.
"""

from __future__ import annotations

from utopic_cli.page.align import render

__all__ = ["render"]
