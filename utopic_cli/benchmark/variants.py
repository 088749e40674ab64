"""The paper's tables of variants: what each row changes in the full network, and its quoted figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

Changes = Mapping[str, Mapping[str, Any]]
"""Keys of a training configuration by section."""

NO_OVERLAP: Changes = {"model": {"overlap": False}, "loss": {"overlap": 0.0}}
NO_COMPLETION: Changes = {"loss": {"completion": 0.0}}
NO_UNCERTAINTY: Changes = {"model": {"uncertainty_scheme": "none"}, "loss": {"uncertainty": 0.0}}
NO_MASKING: Changes = {"schedule": {"masking_from": 1.0}}
NO_GEOMETRY: Changes = {"model": {"positional_scheme": "vanilla"}}

FULL, CONTROL = "full", "full-again"


def together(*changes: Changes) -> dict[str, dict[str, Any]]:
    """Put changes together; of two of one key the later one counts."""
    found: dict[str, dict[str, Any]] = {}
    for one in changes:
        for section, values in one.items():
            found.setdefault(section, {}).update(values)
    return found


VARIANTS: dict[str, Changes] = {
    "no-o-c-u-g": together(NO_OVERLAP, NO_COMPLETION, NO_UNCERTAINTY, NO_GEOMETRY),
    "no-c-u-g": together(NO_COMPLETION, NO_UNCERTAINTY, NO_GEOMETRY),
    "no-u-g": together(NO_UNCERTAINTY, NO_GEOMETRY),
    "no-g": NO_GEOMETRY,
    "absolute": {"model": {"positional_scheme": "absolute"}},
    "learned": {"model": {"positional_scheme": "learned"}},
    "predicted-u": {"model": {"uncertainty_scheme": "predicted"}},
    "no-u": NO_UNCERTAINTY,
    "no-masking": NO_MASKING,
    FULL: {},
}
"""By the name of the folder that holds the run. Without uncertainty there is no random masking either."""


@dataclass(frozen=True)
class Row:
    """One row of a table.

    Attributes:
        label: what the table calls it.
        variant: one of ``VARIANTS``, or ``CONTROL``: the full network trained with another seed.
        quoted: the paper's RMSE(R), MAE(R), RMSE(t), MAE(t), Error(R), Error(t); empty if it has none.
        quoted_accuracy: the paper's overlap accuracy, a share.
    """

    label: str
    variant: str
    quoted: tuple[float, ...] = ()
    quoted_accuracy: float | None = None


_FULL_QUOTED = (0.2238, 0.1322, 0.00212, 0.00131, 0.2464, 0.00264)
_NO_GEOMETRY_QUOTED = (0.2691, 0.1404, 0.00237, 0.00136, 0.2600, 0.00273)
_CONTROL = Row("full, another seed", CONTROL)

TABLES: dict[str, tuple[Row, ...]] = {
    "ablation": (
        Row("none of O, C, U, G", "no-o-c-u-g", (0.3682, 0.1907, 0.00347, 0.00195, 0.3495, 0.00397)),
        Row("O", "no-c-u-g", (0.2837, 0.1481, 0.00241, 0.00149, 0.2761, 0.00300)),
        Row("O, C", "no-u-g", (0.2735, 0.1470, 0.00238, 0.00138, 0.2689, 0.00277)),
        Row("O, C, U", "no-g", _NO_GEOMETRY_QUOTED),
        Row("O, C, U, G (full)", FULL, _FULL_QUOTED),
        _CONTROL,
    ),
    "attention": (
        Row("vanilla", "no-g", _NO_GEOMETRY_QUOTED),
        Row("absolute positions", "absolute", (0.2667, 0.1466, 0.00256, 0.00149, 0.2718, 0.00299)),
        Row("learned positions", "learned", (0.2656, 0.1400, 0.00226, 0.00132, 0.2567, 0.00266)),
        Row("geometric (full)", FULL, _FULL_QUOTED),
        _CONTROL,
    ),
    "uncertainty": (
        Row("PU, RM", "predicted-u", (0.3561, 0.1562, 0.00295, 0.00152, 0.2852, 0.00309), 0.8251),
        Row("no U, no RM", "no-u", (0.3017, 0.1547, 0.00259, 0.00149, 0.2791, 0.00300), 0.9119),
        Row("U, no RM", "no-masking", (0.2612, 0.1466, 0.00230, 0.00142, 0.2713, 0.00286), 0.9531),
        Row("U, RM (full)", FULL, _FULL_QUOTED, 0.9646),
        _CONTROL,
    ),
}
"""The rows in the paper's order. O: overlap-guided weights, C: completion, U: sampled uncertainty,
G: geometric relation embedding, PU: the predicted deviation instead, RM: random masking."""
