"""``python -m utopic_cli``: the same as the ``utopic`` command."""

from __future__ import annotations

from utopic_cli.cli import main

if __name__ == "__main__":
    main()
