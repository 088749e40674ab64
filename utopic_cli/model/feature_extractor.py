"""Feature extraction (Sec. 3.2): four AdaptConv layers and an MLP."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from utopic_cli.config import ModelConfig
from utopic_cli.model.cloud_input import CloudInput, gather, highest
from utopic_cli.model.local_geometry import EDGE_INVARIANTS, LocalGeometryEncoder, edge_invariants


class PointNorm(nn.Module):
    """Normalise (B, N, C) features: per point (``layer``) or over points and batch (``batch``)."""

    def __init__(self, width: int, kind: str) -> None:
        """Build the normalisation of ``width`` channels."""
        super().__init__()
        self.kind = kind
        self.norm: nn.Module = nn.LayerNorm(width) if kind == "layer" else nn.BatchNorm1d(width)

    def forward(self, features: Tensor) -> Tensor:
        """Return normalised (B, N, C) features."""
        if self.kind == "layer":
            return self.norm(features)
        return self.norm(features.transpose(1, 2)).transpose(1, 2)


class AdaptConv(nn.Module):
    """Adaptive graph convolution: each edge's kernel is made from its end points' features.

    The kernel's first linear map of [f_j - f_i, f_i] splits into a part of f_j and a part of
    f_i, computed once per point and then gathered, instead of once per edge.
    """

    def __init__(
        self, width_in: int, width_out: int, edge_width: int, hidden: int, rank: int, normalisation: str
    ) -> None:
        """Build the layer; ``rank`` 0 generates the paper's full kernel."""
        super().__init__()
        self.neighbour_part = nn.Linear(width_in, hidden, bias=False)
        self.point_part = nn.Linear(width_in, hidden)
        self.rank = rank
        if rank:
            self.kernel_factor = nn.Linear(hidden, rank)
            self.edge_factor = nn.Linear(edge_width, rank)
            self.output = nn.Linear(rank, width_out)
        else:
            self.output = nn.Linear((hidden + 1) * edge_width, width_out)
        self.norm = PointNorm(width_out, normalisation)
        self.shortcut = nn.Linear(width_in, width_out)

    def forward(self, features: Tensor, edges: Tensor, neighbours: Tensor) -> Tensor:
        """Convolve over the graph.

        Args:
            features: (B, N, C_in).
            edges: (B, N, k, E) the convolved input of each edge.
            neighbours: (B, N, k) int64.

        Returns:
            (B, N, C_out).
        """
        kernel = gather(self.neighbour_part(features), neighbours) + self.point_part(features)[:, :, None]
        kernel = nn.functional.leaky_relu(kernel, 0.2)  # (B, N, k, H)
        if self.rank:
            convolved = self.output(self.kernel_factor(kernel) * self.edge_factor(edges))
        else:
            kernel = torch.cat([kernel, torch.ones_like(kernel[..., :1])], dim=-1)
            convolved = self.output((kernel[..., :, None] * edges[..., None, :]).flatten(-2))
        strongest = highest(convolved)  # (B, N, C_out)
        return nn.functional.leaky_relu(self.norm(strongest) + self.shortcut(features), 0.2)


class FeatureExtractor(nn.Module):
    """Point-wise features F of one cloud, and the unit descriptors compared directly."""

    def __init__(self, config: ModelConfig) -> None:
        """Build from the architecture's settings."""
        super().__init__()
        self.invariant = config.input_features == "invariant"
        if self.invariant:
            self.local_geometry = LocalGeometryEncoder(config.patch_width)
            width, edge_width = 3 * config.patch_width, EDGE_INVARIANTS
        else:
            width, edge_width = 3, 6
        layers = []
        total = width if self.invariant else 0
        for channels in config.channels:
            layers.append(
                AdaptConv(
                    width,
                    channels,
                    edge_width,
                    config.adaptive_hidden,
                    config.kernel_rank,
                    config.normalisation,
                )
            )
            width = channels
            total += channels
        self.layers = nn.ModuleList(layers)
        self.mlp = nn.Sequential(
            nn.Linear(total, config.feature_width),
            PointNorm(config.feature_width, config.normalisation),
            nn.LeakyReLU(0.2),
            nn.Linear(config.feature_width, config.feature_width),
        )
        self.descriptor = nn.Linear(config.feature_width, config.descriptor_width)

    def forward(self, cloud: CloudInput) -> tuple[Tensor, Tensor]:
        """Return features (B, N, V) and unit descriptors (B, N, D)."""
        neighbour_points = gather(cloud.points, cloud.neighbours)
        offset = neighbour_points - cloud.points[:, :, None]  # (B, N, k, 3)
        if self.invariant:
            features = self.local_geometry(cloud)
            levels = [features]
            edges = edge_invariants(
                offset / (3.0 * cloud.spacing.view(-1, 1, 1, 1)),
                cloud.normals[:, :, None],
                gather(cloud.normals, cloud.neighbours),
            )
        else:
            features = cloud.points
            levels = []
            edges = torch.cat([offset, cloud.points[:, :, None].expand_as(offset)], dim=-1)
        for layer in self.layers:
            features = layer(features, edges, cloud.neighbours)
            levels.append(features)
        features = self.mlp(torch.cat(levels, dim=-1))
        return features, nn.functional.normalize(self.descriptor(features).float(), dim=-1)
