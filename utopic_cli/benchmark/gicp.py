"""small_gicp (the package ``small-gicp``, MIT licence) behind the interface of `Method`."""

from __future__ import annotations

import importlib.metadata
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from utopic_cli.benchmark.method import IDENTITY, LOCAL_REACH, NOTHING_NEAR, Trial
from utopic_cli.errors import optional_part
from utopic_cli.geometry.rigid import rigid


@dataclass(frozen=True)
class SmallGicp:
    """small_gicp: generalised ICP from where the scans lie, on one thread.

    Like ``open3d-icp`` it is local, counts lengths in the same voxels and has the same rounds. Each
    pair is centred on the target and scaled so that the voxel is small_gicp's own default for
    thinning, 0.25: then its bounds of convergence mean what its authors meant.

    Attributes:
        name: what the tables call it.
        voxels_per_extent: lengths are counted in voxels, the pair's extent divided by this,
        spacings_per_voxel: but at least so many times the spacing of the sparser scan's points.
        voxel_size: the voxel in the unit the pair is scaled to.
        thinning_voxels: size of the grid that both clouds are thinned on, in voxels.
        icp_voxels: largest correspondence distance in voxels, one entry a round.
        iterations: most iterations of a round.
        neighbours: points that the covariance of each is estimated from (its authors' default).
        start: where it starts from.
        refines: never by our own refinement; it is given its estimate to refine like everybody's.
    """

    name: str = "small-gicp"
    voxels_per_extent: float = 50.0
    spacings_per_voxel: float = 1.0
    voxel_size: float = 0.25
    thinning_voxels: float = 0.2
    icp_voxels: tuple[float, ...] = LOCAL_REACH
    iterations: int = 100
    neighbours: int = 20
    start: str = IDENTITY
    refines: bool = False

    def settings(self) -> dict[str, Any]:
        """Return the fields and the package's version (see `Method.settings`).

        Raises:
            UsageError: the package is missing.
        """
        load_small_gicp()
        version = importlib.metadata.version("small-gicp")
        return {**asdict(self), "icp_voxels": list(self.icp_voxels), "small_gicp": version}

    def estimate(self, trial: Trial) -> np.ndarray:
        """Register the clouds of a trial.

        Raises:
            RuntimeError: the scans lie too far apart for a single correspondence.
        """
        library = load_small_gicp()
        per_unit = self.voxel_size / trial.voxel(self.voxels_per_extent, self.spacings_per_voxel)
        centre = trial.target.points.mean(axis=0)
        (source, _), (target, tree) = (
            library.preprocess_points(
                (cloud.points - centre) * per_unit,
                downsampling_resolution=self.thinning_voxels * self.voxel_size,
                num_neighbors=self.neighbours,
                num_threads=1,
            )
            for cloud in (trial.source, trial.target)
        )
        T = np.eye(4)
        for reach in self.icp_voxels:
            result = library.align(
                target,
                source,
                tree,
                T,
                registration_type="GICP",
                max_correspondence_distance=reach * self.voxel_size,
                num_threads=1,
                max_iterations=self.iterations,
            )
            if result.num_inliers == 0:
                raise RuntimeError(NOTHING_NEAR)
            T = np.asarray(result.T_target_source)
        rotation = T[:3, :3]
        return rigid(rotation, T[:3, 3] / per_unit + centre - rotation @ centre)


def load_small_gicp() -> Any:
    """Import small_gicp.

    Raises:
        UsageError: it can't be loaded; says why and the command that installs it.
    """
    with optional_part("the baseline small-gicp needs small_gicp", "small-gicp"):
        import small_gicp
    return small_gicp
