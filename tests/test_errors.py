from __future__ import annotations

import pytest

from utopic_cli.errors import UsageError, optional_part


@pytest.mark.parametrize(
    "error", [ModuleNotFoundError("No module named 'x'"), OSError("libGL.so.1: missing")]
)
def test_an_optional_part_that_cannot_be_loaded_is_said_in_one_line(error: Exception) -> None:
    with pytest.raises(UsageError) as raised, optional_part("pictures need x", "x-library"):
        raise error
    assert str(raised.value) == f"pictures need x ({error}); install it: pip install x-library"


def test_other_errors_pass_an_optional_part() -> None:
    with pytest.raises(ZeroDivisionError), optional_part("pictures need x", "x"):
        raise ZeroDivisionError
