"""A small chart in SVG: axes from 0, lines, dots and blocks placed by their values."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

WIDTH, HEIGHT = 420, 340
LEFT, RIGHT, TOP, BOTTOM = 52, 20, 14, 44  # margins; the left one is wider where its numbers are long
STEPS = 5
LETTER = 6.2  # widest of a number's, at the page's size of letters


@dataclass
class Chart:
    """Marks are drawn in the order they are added; their looks are CSS classes of the page.

    Attributes:
        title: for those who can't see it.
        across: what the horizontal axis counts.
        up: what the vertical axis counts.
        most: largest value on either axis.
        forms: how the numbers along either axis are written; an empty one leaves them out.
    """

    title: str
    across: str
    up: str
    most: tuple[float, float] = (1.0, 1.0)
    forms: tuple[str, str] = ("{:.1f}", "{:.1f}")
    _marks: list[str] = field(default_factory=list)

    def line(self, points: Sequence[tuple[float, float]], look: str) -> None:
        """Draw through points (across, up); what is beyond the axes is put on their ends.

        A single point, through which no line can be seen, is drawn as a small disc.
        """
        if len(points) == 1:
            x, y = points[0]
            place = f'cx="{self._x(x):.1f}" cy="{self._y(y):.1f}"'
            self._marks.append(f'<circle class="{look}" {place} r="2.5"/>')
            return
        places = " ".join(f"{self._x(x):.1f},{self._y(y):.1f}" for x, y in points)
        self._marks.append(f'<polyline class="{look}" points="{places}"/>')

    def dot(self, x: float, y: float, radius: float, look: str, tip: str) -> None:
        """Draw a dot of a radius in pixels, with words that show under the pointer."""
        place = f'cx="{self._x(x):.1f}" cy="{self._y(y):.1f}" r="{radius:.1f}"'
        self._marks.append(f'<circle class="{look}" {place}><title>{html.escape(tip)}</title></circle>')

    def block(self, low: tuple[float, float], high: tuple[float, float], look: str, tip: str = "") -> None:
        """Fill a rectangle between two corners (across, up)."""
        x, y = self._x(low[0]), self._y(high[1])
        size = f'width="{self._x(high[0]) - x:.1f}" height="{self._y(low[1]) - y:.1f}"'
        title = f"<title>{html.escape(tip)}</title>" if tip else ""
        self._marks.append(f'<rect class="{look}" x="{x:.1f}" y="{y:.1f}" {size}>{title}</rect>')

    def word(self, x: float, y: float, text: str) -> None:
        """Write a word centred on a place."""
        self._marks.append(_text(self._x(x), self._y(y), "middle", text))

    def svg(self) -> str:
        """Return the chart as an SVG element."""
        grid = []
        for step in range(STEPS + 1):
            across, up = (most * step / STEPS for most in self.most)
            x, y = self._x(across), self._y(up)
            grid.append(_rule((x, self._y(0.0)), (x, self._y(self.most[1]))))
            grid.append(_text(x, HEIGHT - BOTTOM + 16, "middle", self.forms[0].format(across)))
            if self.forms[1]:
                grid.append(_rule((self._x(0.0), y), (self._x(self.most[0]), y)))
                grid.append(_text(self._left - 7, y + 4, "end", self.forms[1].format(up)))
        middle = (TOP + HEIGHT - BOTTOM) / 2
        grid.append(_text((self._left + WIDTH - RIGHT) / 2, HEIGHT - 8, "middle", self.across))
        grid.append(f'<g transform="rotate(-90 13 {middle})">{_text(13, middle, "middle", self.up)}</g>')
        head = f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{html.escape(self.title)}">'
        return "".join([head, *grid, *self._marks, "</svg>"])

    @property
    def _left(self) -> float:
        numbers = [self.forms[1].format(self.most[1] * step / STEPS) for step in range(STEPS + 1)]
        return max(LEFT, 26 + LETTER * max(map(len, numbers)))

    def _x(self, value: float) -> float:
        return self._left + min(value / self.most[0], 1.0) * (WIDTH - self._left - RIGHT)

    def _y(self, value: float) -> float:
        return HEIGHT - BOTTOM - min(value / self.most[1], 1.0) * (HEIGHT - TOP - BOTTOM)


def round_up(value: float) -> float:
    """Return the least end of an axis from 0, at or above ``value``, whose steps are round numbers."""
    if value <= 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value / STEPS))
    steps = (1.0, 2.0, 2.5, 4.0, 5.0, 8.0, 10.0)
    step = next(step for step in steps if step * power * STEPS >= value * (1.0 - 1e-9))
    return float(step * power * STEPS)


def _text(x: float, y: float, anchor: str, text: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{html.escape(text)}</text>'


def _rule(start: tuple[float, float], end: tuple[float, float]) -> str:
    (x1, y1), (x2, y2) = start, end
    return f'<line class="rule" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'
