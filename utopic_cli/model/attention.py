"""Geometry transformer (Sec. 3.3.1): geometry self-attention and feature cross-attention, repeated."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from utopic_cli.config import ModelConfig
from utopic_cli.model.geometric_embedding import RELATIONS


class AttentionLayer(nn.Module):
    """Multi-head attention and feed-forward network, each with a residual and a norm after it."""

    def __init__(self, width: int, heads: int, relations: int = 0) -> None:
        """Build the layer; ``relations`` > 0 adds the embedding's bias g W^G to the scores."""
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.merge = nn.Linear(width, width)
        self.relation = nn.Parameter(torch.zeros(heads, relations)) if relations else None
        self.feed_forward = nn.Sequential(nn.Linear(width, 2 * width), nn.ReLU(), nn.Linear(2 * width, width))
        self.attention_norm = nn.LayerNorm(width)
        self.output_norm = nn.LayerNorm(width)

    def forward(
        self,
        queries: Tensor,
        context: Tensor,
        embedding: Tensor | None = None,
        context_valid: Tensor | None = None,
    ) -> Tensor:
        """Attend from queries (B, N, d) to context (B, M, d).

        Args:
            queries: (B, N, d).
            context: (B, M, d).
            embedding: (B, 3, N, M), or None for plain attention.
            context_valid: (B, M) bool, False where there is nothing to attend to; None: everywhere is.
        """
        batch, count, width = queries.shape
        head_width = width // self.heads
        query = self.query(queries).view(batch, count, self.heads, head_width).transpose(1, 2)
        key_value = self.key_value(context).view(batch, -1, 2, self.heads, head_width)
        key, value = key_value.permute(2, 0, 3, 1, 4)  # each (B, heads, M, head_width)
        if self.relation is None or embedding is None:
            mask = None if context_valid is None else context_valid[:, None, None]
            message = nn.functional.scaled_dot_product_attention(query, key, value, attn_mask=mask)
        else:
            # (heads, 3) @ (3, N*M): no d_t-wide tensor per pair of points is ever made.
            bias = (self.relation.to(embedding.dtype) @ embedding.flatten(2)).view(
                batch, self.heads, count, -1
            )
            if context_valid is not None:
                bias = bias.masked_fill(~context_valid[:, None, None], -torch.inf)
            if bias.requires_grad:
                message = _attend(query, key, value, bias)
            else:  # fused: several times faster, but only without a gradient of the bias
                message = nn.functional.scaled_dot_product_attention(
                    query, key, value, attn_mask=bias.to(query.dtype)
                )
        message = message.transpose(1, 2).reshape(batch, count, width)
        features = self.attention_norm(queries + self.merge(message))
        return self.output_norm(features + self.feed_forward(features))


def _attend(query: Tensor, key: Tensor, value: Tensor, bias: Tensor) -> Tensor:
    """Attend from (B, heads, N, w) to (B, heads, M, w) with a bias (B, heads, N, M) on the scores."""
    scores = torch.baddbmm(
        bias.flatten(0, 1),
        query.flatten(0, 1) / math.sqrt(query.shape[-1]),
        key.flatten(0, 1).transpose(1, 2),
    )
    return (torch.softmax(scores, dim=-1) @ value.flatten(0, 1)).view_as(query)


class PositionEncoding(nn.Module):
    """Position added to features: ``absolute`` (fixed sinusoids) or ``learned`` (an MLP) of coordinates."""

    frequencies: Tensor

    def __init__(self, width: int, scheme: str) -> None:
        """Build the encoding for ``width`` channels."""
        super().__init__()
        self.scheme = scheme
        if scheme == "learned":
            self.mlp = nn.Sequential(nn.Linear(3, width), nn.ReLU(), nn.Linear(width, width))
        else:
            frequencies = 2.0 ** torch.arange(math.ceil(width / 6)) * math.pi / 4.0
            self.register_buffer("frequencies", frequencies, persistent=False)
            self.width = width

    def forward(self, points: Tensor) -> Tensor:
        """Return the (B, N, width) encoding of (B, N, 3) points."""
        if self.scheme == "learned":
            return self.mlp(points)
        phase = (points[..., None] * self.frequencies).flatten(-2)  # (B, N, 3 * F)
        return torch.cat([phase.sin(), phase.cos()], dim=-1)[..., : self.width]


class GeometryTransformer(nn.Module):
    """(self, cross) attention repeated; the same weights serve source and target."""

    def __init__(self, config: ModelConfig) -> None:
        """Build from the architecture's settings."""
        super().__init__()
        width = config.transformer_width
        self.scheme = config.positional_scheme
        relations = RELATIONS if self.scheme == "geometric" else 0
        self.project_in = nn.Linear(config.feature_width, width)
        self.project_out = nn.Linear(width, config.feature_width)
        self.self_attention = nn.ModuleList(
            AttentionLayer(width, config.heads, relations) for _ in range(config.layers)
        )
        self.cross_attention = nn.ModuleList(
            AttentionLayer(width, config.heads) for _ in range(config.layers)
        )
        if self.scheme in ("absolute", "learned"):
            self.position = PositionEncoding(width, self.scheme)

    def forward(
        self,
        source: Tensor,
        target: Tensor,
        source_points: Tensor,
        target_points: Tensor,
        source_embedding: Tensor | None,
        target_embedding: Tensor | None,
        source_valid: Tensor | None = None,
        target_valid: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return hybrid features of source (B, N, V) and target (B, M, V), in and out alike."""
        hidden_source, hidden_target = self.project_in(source), self.project_in(target)
        if self.scheme in ("absolute", "learned"):
            hidden_source = hidden_source + self.position(source_points)
            hidden_target = hidden_target + self.position(target_points)
        for within, across in zip(self.self_attention, self.cross_attention, strict=True):
            hidden_source = within(hidden_source, hidden_source, source_embedding, source_valid)
            hidden_target = within(hidden_target, hidden_target, target_embedding, target_valid)
            hidden_source, hidden_target = (
                across(hidden_source, hidden_target, context_valid=target_valid),
                across(hidden_target, hidden_source, context_valid=source_valid),
            )
        # A residual around the whole block: the extractor's features are never lost.
        return source + self.project_out(hidden_source), target + self.project_out(hidden_target)
