"""What people align scans with today, behind the interface of `Method`.

Open3D's global registration as its tutorial has it: voxel grid v, normals within 2 v, FPFH
within 5 v, then RANSAC over feature matches or fast global registration (FGR), then
point-to-plane ICP. The voxel size is the user's business there; here it is a fixed share of
the pair's extent, which is more help than Open3D itself gives. KISS-Matcher stands in `kiss`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from utopic_cli.benchmark.kiss import KissMatcher
from utopic_cli.benchmark.method import Method, Trial
from utopic_cli.errors import UsageError
from utopic_cli.point_cloud import PointCloud

_OPEN3D_SYSTEM_LIBRARIES = "libgl1 libegl1 libx11-6 libgomp1 libusb-1.0-0"


@dataclass(frozen=True)
class Open3DGlobal:
    """Open3D: FPFH features, RANSAC or FGR, then point-to-plane ICP.

    Attributes:
        name: what the tables call it.
        solver: ``ransac`` or ``fgr``.
        voxels_per_extent: the voxel size is the pair's extent divided by this.
        iterations: most RANSAC iterations (FGR: most optimiser iterations).
        confidence: RANSAC stops early once this probability of success is reached.
        mutual_filter: keep only matches that are nearest neighbours both ways.
        icp_voxels: ICP's largest correspondence distance in voxels, one entry a round.
        refines: never by our own refinement; it is given its estimate to refine like everybody's.
    """

    name: str
    solver: str
    voxels_per_extent: float
    iterations: int
    confidence: float = 0.999
    mutual_filter: bool = True
    icp_voxels: tuple[float, ...] = (1.0, 0.4)
    refines: bool = False

    def settings(self) -> dict[str, Any]:
        """Return the fields and Open3D's version."""
        return {**asdict(self), "icp_voxels": list(self.icp_voxels), "open3d": load_open3d().__version__}

    def estimate(self, trial: Trial) -> np.ndarray:
        """Register the clouds of a trial.

        Raises:
            RuntimeError: Open3D found no transformation.
        """
        o3d = load_open3d()
        registration = o3d.pipelines.registration
        o3d.utility.random.seed(trial.seed)
        voxel = trial.extent / self.voxels_per_extent
        clouds = (trial.source, trial.target)
        # Fine enough for ICP at 0.4 v, and bounded: full scans may hold many millions of points.
        fine = [_open3d_cloud(o3d, cloud).voxel_down_sample(voxel / 5.0) for cloud in clouds]
        coarse = [cloud.voxel_down_sample(voxel) for cloud in fine]
        features = []
        for cloud in coarse:
            cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=2 * voxel, max_nn=30))
            search = o3d.geometry.KDTreeSearchParamHybrid(radius=5 * voxel, max_nn=100)
            features.append(registration.compute_fpfh_feature(cloud, search))
        if self.solver == "ransac":
            result = self._ransac(registration, coarse, features, voxel)
        else:
            # Distances as given, not as a share of the cloud's size, and an annealed kernel: with
            # Open3D's own defaults for these two it succeeds less often.
            option = registration.FastGlobalRegistrationOption(
                use_absolute_scale=True,
                decrease_mu=True,
                maximum_correspondence_distance=0.5 * voxel,
                iteration_number=self.iterations,
            )
            result = registration.registration_fgr_based_on_feature_matching(*coarse, *features, option)
        transformation = np.array(result.transformation, dtype=np.float64)
        if len(result.correspondence_set) == 0:  # Open3D then returns an identity, without a word
            raise RuntimeError("no transformation with a single inlier")
        fine[1].estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=voxel, max_nn=30))
        for distance in self.icp_voxels:
            transformation = np.array(
                registration.registration_icp(
                    *fine,
                    distance * voxel,
                    transformation,
                    registration.TransformationEstimationPointToPlane(),
                ).transformation
            )
        return transformation

    def _ransac(self, registration: Any, clouds: list[Any], features: list[Any], voxel: float) -> Any:
        distance = 1.5 * voxel
        return registration.registration_ransac_based_on_feature_matching(
            *clouds,
            *features,
            self.mutual_filter,
            distance,
            registration.TransformationEstimationPointToPoint(False),
            3,
            [
                registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                registration.CorrespondenceCheckerBasedOnDistance(distance),
            ],
            registration.RANSACConvergenceCriteria(self.iterations, self.confidence),
        )


BASELINES: dict[str, Method] = {
    method.name: method
    for method in (
        Open3DGlobal("open3d-ransac", "ransac", voxels_per_extent=50, iterations=100_000),
        Open3DGlobal("open3d-ransac-fine", "ransac", voxels_per_extent=120, iterations=2_000_000),
        Open3DGlobal("open3d-fgr", "fgr", voxels_per_extent=50, iterations=64),
        KissMatcher(),
    )
}


def find_baselines(names: Sequence[str]) -> tuple[Method, ...]:
    """Look baselines up by name, and make sure before any work that they can run.

    Raises:
        UsageError: a name is unknown (the known ones are listed), or a library is missing.
    """
    for name in names:
        if name not in BASELINES:
            raise UsageError(f"unknown baseline {name!r}; known: {', '.join(BASELINES)}")
    chosen = tuple(BASELINES[name] for name in dict.fromkeys(names))
    for method in chosen:
        method.settings()  # loads its library
    return chosen


def load_open3d() -> Any:
    """Import Open3D, which takes about a second and needs system libraries.

    Raises:
        UsageError: it can't be loaded; says what is missing and the command that installs it.
    """
    try:
        import open3d
    except ModuleNotFoundError as error:
        raise UsageError(f"the baselines need Open3D ({error}); install it: pip install open3d") from error
    except (ImportError, OSError) as error:
        raise UsageError(
            f"Open3D is installed but can't load ({error}); "
            f"install its system libraries: apt-get install {_OPEN3D_SYSTEM_LIBRARIES}"
        ) from error
    # Its warnings about few correspondences would tear the progress line apart.
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d


def _open3d_cloud(o3d: Any, cloud: PointCloud) -> Any:
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points))
