"""How a result shows itself, and what the library says and promises to programs."""

from __future__ import annotations

import logging
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from tests.commands.conftest import FakePipeline
from tests.io.samples import bumpy_points
from utopic_cli.config import AlignOptions
from utopic_cli.result import RegistrationResult
from utopic_cli.result_display import headline

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def result() -> RegistrationResult:
    return FakePipeline().register(range(60), range(80), AlignOptions())


class Tags(HTMLParser):
    """Counts that every tag is closed, and keeps the text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.names: set[str] = set()
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self.open.append(tag)
        self.names.add(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def test_repr_is_a_line_about_the_answer_not_its_arrays(result: RegistrationResult) -> None:
    assert repr(result) == (
        "<RegistrationResult: aligned and trusted, confidence=0.970, 60 -> 80 points,"
        " turned by 90.000 degrees, rivals: 0>"
    )
    unknown = repr(replace(result, confidence=None, trusted=False))
    assert "confidence=None" in unknown and "aligned, not trusted" in unknown


def test_a_notebook_shows_verdict_reasons_and_matrix(result: RegistrationResult) -> None:
    page = Tags(result._repr_html_())
    assert not page.open and page.names <= {"div", "b", "ul", "li", "pre", "code"}
    assert "aligned and trusted; confidence 97%" in page.text and "the surfaces agree" in page.text
    matrix = page.text.partition("T_target_source")[2].split()
    rows = np.reshape([float(value) for value in matrix], (4, 4))
    np.testing.assert_array_equal(rows, result.T_target_source)
    doubted = replace(result, trusted=False, confidence=0.2, ambiguous_with=(np.eye(4),), warnings=("odd",))
    text = Tags(doubted._repr_html_()).text
    assert "do not trust it" in text and "rivals 1, see ambiguous_with" in text and "odd" in text


def test_a_notebook_shows_six_digits_and_no_rounding(result: RegistrationResult) -> None:
    turned = result.T_target_source.copy()
    turned[0, 0], turned[1, 1], turned[0, 3] = -1e-17, 0.123456789, 1234.56789
    fit = replace(result.fit, inlier_rmse=1.2e-17)
    text = Tags(replace(result, T_target_source=turned, fit=fit)._repr_html_()).text
    matrix = text.partition("T_target_source")[2].split()
    assert matrix[5] == "0.123457" and matrix[3] == "1234.57" and float(matrix[0]) == 0.0
    assert "residual 0 file units" in text


def test_words_from_outside_are_escaped(result: RegistrationResult) -> None:
    hostile = "<script>alert('a & b')</script>"
    page = Tags(replace(result, reasons=(hostile,), warnings=(hostile,))._repr_html_())
    assert "script" not in page.names and page.text.count(hostile) == 2


@pytest.mark.parametrize(
    ("confidence", "trusted", "said"),
    [
        (0.999, True, "aligned and trusted; confidence over 99%"),
        (0.5, False, "aligned, but do not trust it; confidence 50%"),
        (None, False, "aligned, but nothing says how well: do not trust it unseen"),
    ],
)
def test_the_headline(result: RegistrationResult, confidence: float | None, trusted: bool, said: str) -> None:
    assert headline(replace(result, confidence=confidence, trusted=trusted)) == said


def test_the_library_is_silent_until_logging_is_asked_for(tmp_path: Path, caplog) -> None:
    from utopic_cli.io.scan import read_scan

    points = np.concatenate([bumpy_points(), [[np.nan] * 3]])
    path = tmp_path / "a.xyz"
    np.savetxt(path, points)
    script = f"import utopic_cli\nfrom utopic_cli.io.scan import read_scan\nread_scan({str(path)!r})"
    alone = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert (alone.returncode, alone.stdout, alone.stderr) == (0, "", "")
    with caplog.at_level(logging.INFO, logger="utopic_cli"):
        read_scan(path)
    levels = [(record.name, record.levelname) for record in caplog.records]
    assert levels == [("utopic_cli.io.scan", "INFO"), ("utopic_cli.io.scan", "WARNING")]
    assert "80 points" in caplog.text and "NaN" in caplog.text


PROGRAM = """
import numpy as np
from utopic_cli import RegistrationResult, __version__, align

result: RegistrationResult = align("a.ply", np.zeros((100, 3)), seed=1)
matrix: np.ndarray = result.T_target_source
sure: float | None = result.confidence
trusted: bool = result.trusted
reasons: tuple[str, ...] = result.reasons
count: int = len(result.correspondences)
rmse: float = result.fit.inlier_rmse
shown: str = repr(result) + result._repr_html_() + __version__
reveal_type(align("a", "b"))
"""


@pytest.mark.slow
def test_a_program_that_uses_the_library_passes_mypy_strict(tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    settings = tmp_path / "mypy.ini"
    # What the library is built on is not followed: that is slow, and not the program's business.
    settings.write_text(
        "[mypy]\nstrict = true\nfollow_imports = silent\n"
        "[mypy-torch.*,scipy.*,safetensors.*,trimesh.*]\n"
        "follow_imports = skip\nignore_missing_imports = true\n"
    )
    checked = subprocess.run(
        [sys.executable, "-m", "mypy", f"--config-file={settings}", f"--cache-dir={tmp_path}", str(program)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert checked.returncode == 0, checked.stdout
    assert '"utopic_cli.result.RegistrationResult"' in checked.stdout
