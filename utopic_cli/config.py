"""Settings as plain frozen data, with their defaults; saved whole beside every result."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, TypedDict, TypeVar

from utopic_cli.errors import InputError

INPUT_FEATURES = ("invariant", "coordinates")
POSITIONAL_SCHEMES = ("vanilla", "absolute", "learned", "geometric")
UNCERTAINTY_SCHEMES = ("matched", "sampled", "predicted", "none")
NORMALISATIONS = ("layer", "batch")
SOLVERS = ("auto", "svd", "consensus")
DEVICES = ("auto", "cpu", "cuda", "mps")

ColourMapName = Literal["blue-red", "purple-yellow"]
DEFAULT_COLOUR_MAP: ColourMapName = "blue-red"

ConfigType = TypeVar("ConfigType")


@dataclass(frozen=True)
class ModelConfig:
    """The network's architecture. The defaults are what the bundled weights were trained with.

    The paper's own setting is ``input_features="coordinates"``, ``layers=3``, ``heads=4``,
    ``transformer_width=256``, ``feature_width=512``, ``channels=(64, 64, 128, 256)``,
    ``adaptive_hidden=64``, ``kernel_rank=0``, ``neighbours=20``, ``normalisation="batch"``,
    ``sinkhorn_iterations=20``, ``descriptor_skip=False``, ``hypothesis=False``,
    ``uncertainty_scheme="sampled"``.

    Attributes:
        input_features: ``invariant`` (local geometry of the dense scan, the same in any
            pose) or ``coordinates`` (the paper's).
        patch_width: output channels of each of the three local-geometry encoders.
        channels: output channels of the four AdaptConv layers.
        adaptive_hidden: hidden channels of the adaptive kernels.
        kernel_rank: rank of the adaptive kernel; 0 generates the full kernel (the paper's).
        neighbours: k of the AdaptConv graph.
        feature_width: V, the width of the point-wise features.
        descriptor_width: width of the unit descriptors compared before the transformers.
        transformer_width: d_t, the hidden width of attention.
        heads: attention heads.
        layers: how often (self, cross) attention repeats in each geometry transformer.
        positional_scheme: vanilla, absolute, learned or geometric self-attention.
        uncertainty_scheme: ``matched`` (variance told from the first correspondences), ``sampled`` (the
            paper's, from features), ``predicted`` or ``none``.
        overlap: whether overlap heads weight the correspondences (ablation O).
        uncertainty_samples: K of the overlap distribution.
        sinkhorn_iterations: rounds of row and column normalisation.
        descriptor_skip: add the extractor's similarity to both affinities.
        hypothesis: accept a transformation under test as further evidence (not in the paper).
        normalisation: ``layer`` (independent of batch mates) or ``batch`` (the paper's).
    """

    input_features: str = "invariant"
    patch_width: int = 48
    channels: tuple[int, ...] = (32, 32, 64, 128)
    adaptive_hidden: int = 32
    kernel_rank: int = 32
    neighbours: int = 16
    feature_width: int = 128
    descriptor_width: int = 64
    transformer_width: int = 128
    heads: int = 4
    layers: int = 2
    positional_scheme: str = "geometric"
    uncertainty_scheme: str = "matched"
    overlap: bool = True
    uncertainty_samples: int = 50
    sinkhorn_iterations: int = 5
    descriptor_skip: bool = True
    hypothesis: bool = True
    normalisation: str = "layer"

    def __post_init__(self) -> None:
        """Refuse what no network can be built from.

        Raises:
            InputError: an unknown scheme (the known ones are listed) or a size that doesn't fit.
        """
        for name, known in (
            ("input_features", INPUT_FEATURES),
            ("positional_scheme", POSITIONAL_SCHEMES),
            ("uncertainty_scheme", UNCERTAINTY_SCHEMES),
            ("normalisation", NORMALISATIONS),
        ):
            if getattr(self, name) not in known:
                raise InputError(f"{name} is {getattr(self, name)!r}; choose {', '.join(known)}")
        sizes = ("patch_width", "adaptive_hidden", "feature_width", "descriptor_width", "heads", "layers")
        for name in (*sizes, "uncertainty_samples", "sinkhorn_iterations"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}; it must be at least 1")
        if not 2 <= self.neighbours <= 20:
            raise InputError(f"neighbours is {self.neighbours}; choose 2 to 20")
        if self.transformer_width % self.heads:
            raise InputError(
                f"transformer_width {self.transformer_width} is no multiple of heads {self.heads}"
            )


@dataclass(frozen=True)
class AlignOptions:
    """Options of one registration.

    Attributes:
        weights: a bundled name or the path of a ``.safetensors`` file with its JSON card.
        points: most points per cloud the network sees.
        refine: refine at full resolution after the network's estimate.
        solver: ``svd`` (the paper's), ``consensus``, or ``auto`` (chooses by verification).
        max_rotation: degrees that the source is turned by at most, from where it lies or an initial
            transformation puts it; 180 admits any pose.
        device: auto, cpu, cuda or mps.
        threads: CPU threads; 0 leaves the library's choice.
        seed: seed of every random draw.
    """

    weights: str = "utopic"
    points: int = 1024
    refine: bool = True
    solver: str = "auto"
    max_rotation: float = 180.0
    device: str = "auto"
    threads: int = 0
    seed: int = 0


class OptionValues(TypedDict, total=False):
    """``AlignOptions`` as keywords."""

    weights: str
    points: int
    refine: bool
    solver: str
    max_rotation: float
    device: str
    threads: int
    seed: int


def to_dict(config: Any) -> dict[str, Any]:
    """Return a configuration dataclass as plain JSON-ready data."""
    return {key: _listed(value) for key, value in asdict(config).items()}


def from_dict(kind: type[ConfigType], values: dict[str, Any], where: str) -> ConfigType:
    """Build a configuration dataclass from plain data.

    Args:
        kind: the dataclass to build.
        values: keys and values, as read from TOML or JSON.
        where: what to call the place the values come from in an error.

    Raises:
        InputError: a key is unknown (the known ones are listed), a value has another type, or the
            dataclass refuses it.
    """
    known = {f.name: f for f in fields(kind)}  # type: ignore[arg-type]
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise InputError(f"{where}: unknown key {', '.join(unknown)}; known keys: {', '.join(sorted(known))}")
    defaults = kind()
    built = {}
    for key, value in values.items():
        default = getattr(defaults, key)
        if isinstance(default, tuple):
            value = _tupled(value)
        if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if type(value) is not type(default):
            raise InputError(
                f"{where}: {key} is {value!r}; expected {type(default).__name__}, like {default!r}"
            )
        built[key] = value
    try:
        return kind(**built)
    except InputError as error:  # values that don't go together
        raise InputError(f"{where}: {error}") from error


def _listed(value: Any) -> Any:
    """Turn tuples, nested ones too, into lists, as JSON and TOML have them."""
    return [_listed(item) for item in value] if isinstance(value, tuple) else value


def _tupled(value: Any) -> Any:
    """Turn lists, nested ones too, into tuples."""
    return tuple(_tupled(item) for item in value) if isinstance(value, list) else value
