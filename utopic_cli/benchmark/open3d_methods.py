"""Open3D's registrations, behind the interface of `Method`.

Global registration as its tutorial has it: voxel grid v, normals within 2 v, FPFH within 5 v, then
RANSAC over feature matches or fast global registration (FGR), then point-to-plane ICP. The voxel
size is the user's business there; here it is a fixed share of the pair's extent (of sparse scans
their spacing), which is more help than Open3D itself gives. ICP alone starts from the identity.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from utopic_cli.benchmark.method import IDENTITY, LOCAL_REACH, NOTHING_NEAR, Trial
from utopic_cli.errors import UsageError

_OPEN3D_SYSTEM_LIBRARIES = "libgl1 libegl1 libx11-6 libgomp1 libusb-1.0-0"


@dataclass(frozen=True)
class Open3DGlobal:
    """Open3D's global registration: FPFH features, RANSAC or FGR, then point-to-plane ICP.

    Attributes:
        name: what the tables call it.
        solver: ``ransac`` or ``fgr``.
        voxels_per_extent: the voxel size is the pair's extent divided by this,
        spacings_per_voxel: but at least so many times the spacing of the sparser scan's points.
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
    spacings_per_voxel: float = 1.0
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
        voxel = trial.voxel(self.voxels_per_extent, self.spacings_per_voxel)
        fine = _fine_clouds(o3d, trial, voxel)
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
        reaches = [distance * voxel for distance in self.icp_voxels]
        for result in _icp_rounds(o3d, fine, reaches, transformation):
            transformation = np.array(result.transformation, dtype=np.float64)
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


@dataclass(frozen=True)
class Open3DIcp:
    """Open3D's point-to-plane ICP alone, from where the scans lie.

    It is local: it can only end well where the start is near the answer. Its reach shrinks by
    rounds, which widens the basin as far as one setting for all pairs can.

    Attributes:
        name: what the tables call it.
        voxels_per_extent: lengths are counted in voxels, the pair's extent divided by this,
        spacings_per_voxel: but at least so many times the spacing of the sparser scan's points.
        icp_voxels: largest correspondence distance in voxels, one entry a round.
        iterations: most iterations of a round.
        start: where it starts from.
        refines: never by our own refinement; it is given its estimate to refine like everybody's.
    """

    name: str = "open3d-icp"
    voxels_per_extent: float = 50.0
    spacings_per_voxel: float = 1.0
    icp_voxels: tuple[float, ...] = LOCAL_REACH
    iterations: int = 100
    start: str = IDENTITY
    refines: bool = False

    def settings(self) -> dict[str, Any]:
        """Return the fields and Open3D's version."""
        return {**asdict(self), "icp_voxels": list(self.icp_voxels), "open3d": load_open3d().__version__}

    def estimate(self, trial: Trial) -> np.ndarray:
        """Register the clouds of a trial.

        Raises:
            RuntimeError: the scans lie too far apart for a single correspondence.
        """
        o3d = load_open3d()
        voxel = trial.voxel(self.voxels_per_extent, self.spacings_per_voxel)
        clouds = _fine_clouds(o3d, trial, voxel)
        reaches = [distance * voxel for distance in self.icp_voxels]
        for result in _icp_rounds(o3d, clouds, reaches, np.eye(4), self.iterations):
            if len(result.correspondence_set) == 0:
                raise RuntimeError(NOTHING_NEAR)
        return np.array(result.transformation, dtype=np.float64)


def _icp_rounds(
    o3d: Any, clouds: list[Any], reaches: list[float], start: np.ndarray, iterations: int = 30
) -> Iterator[Any]:
    """Yield the results of point-to-plane ICP of source and target with one reach after the other."""
    registration = o3d.pipelines.registration
    source, target = clouds
    target.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(30))
    transformation = start
    for reach in reaches:
        result = registration.registration_icp(
            source,
            target,
            reach,
            transformation,
            registration.TransformationEstimationPointToPlane(),
            registration.ICPConvergenceCriteria(max_iteration=iterations),
        )
        yield result
        transformation = result.transformation


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


def _fine_clouds(o3d: Any, trial: Trial, voxel: float) -> list[Any]:
    """Source and target, fine enough for ICP at 0.4 v, and bounded: scans may hold millions of points."""
    return [
        o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points)).voxel_down_sample(voxel / 5.0)
        for cloud in (trial.source, trial.target)
    ]
