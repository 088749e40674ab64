"""Tables stay readable on terminals that are too narrow for them."""

from __future__ import annotations

import io

import pytest
from rich.table import Table

from utopic_cli.commands.result_console import ResultConsole


def shown(width: int) -> str:
    table = Table(title="Success", caption=r"of \[all] pairs")
    table.add_column("pairs")
    table.add_column("method")
    for heading in ("recall\n1 deg", "or symmetric", "CPU, s"):
        table.add_column(heading, justify="right")
    table.add_row("0.5-0.9", "utopic", "98.7654%", "100.0% [34-100]", "1.21")
    table.add_row("", "fpfh", "12.3456%", "", "1.53")
    out = io.StringIO()
    ResultConsole(file=out, width=width).print(table)
    return out.getvalue()


def test_where_there_is_room_it_is_a_table() -> None:
    assert "│ 0.5-0.9 │ utopic │" in shown(80)


@pytest.mark.parametrize("width", [34, 50])
def test_else_each_row_is_a_paragraph_and_no_number_is_cut(width: int) -> None:
    text = shown(width)
    assert "│" not in text and "…" not in text
    assert max(map(len, text.splitlines())) <= width
    assert any("or symmetric 100.0% [34-100]" in line for line in text.splitlines())  # kept together
    plain = " ".join(text.split())
    for wanted in (
        "Success 0.5-0.9, utopic recall 1 deg 98.7654%; or symmetric 100.0% [34-100]; CPU, s 1.21",
        "0.5-0.9, fpfh recall 1 deg 12.3456%; CPU, s 1.53 of [all] pairs",
    ):
        assert wanted in plain
