"""Open3D's multiway registration: pairwise ICP, coarse then fine, and its own pose graph.

Choi, Zhou and Koltun, Robust Reconstruction of Indoor Scenes (CVPR 2015).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from eval.methods.features import near_clouds
from eval.methods.graph import connected
from eval.methods.method import Estimate, MethodError, Stopwatch, Task, relative
from eval.methods.overlap import LEAST, overlapping_pairs
from eval.methods.voxel import usual_voxel

if TYPE_CHECKING:
    import open3d as o3d

Floats = NDArray[np.float64]

NORMAL_RADIUS = 2.0
"""In voxels, of the neighbourhood that a normal is fitted to."""
NORMAL_NEIGHBOURS = 30
"""At most so many points in it."""


@dataclass(frozen=True)
class Open3dMultiway:
    """Open3D's multiway registration at the settings that its documentation recommends.

    They are in voxels; the voxel is that of all methods that fit planes to few points. One setting
    differs: pairs by generalised ICP. Point to plane, as in the documentation's example, is a
    little better where surfaces are rough, and where they are smooth and noisy it slides away.
    """

    voxel: float | None = None
    """Edge of the cubes that points are thinned to, m. None: `usual_voxel`."""
    estimation: Literal["plane", "generalised"] = "generalised"
    """What a pair's ICP minimises."""
    coarse: float = 15.0
    """In voxels: first the partners may be so far away."""
    fine: float = 1.5
    """In voxels: then so far, in the information matrices and in the pose graph too."""
    iterations: int = 30
    """At most, of each ICP."""
    prune: float = 0.25
    """A loop closure of less weight is left out of the pose graph."""
    preference: float = 1.0
    """How much the pose graph holds on to loop closures."""
    least_overlap: float = LEAST
    """See `overlapping_pairs`."""

    def run(self, task: Task) -> Estimate:
        """Register the frames from the start poses."""
        import open3d as o3d

        watch = Stopwatch()
        voxel = usual_voxel(task) if self.voxel is None else self.voxel
        with watch("pairs"):
            pairs = overlapping_pairs(task, self.least_overlap)
        if not pairs:
            raise MethodError("no two frames overlap")
        with (
            o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error),
            watch("points"),
        ):
            clouds = [_prepared(points, voxel) for points in near_clouds(task)]
        graph = o3d.pipelines.registration.PoseGraph()
        for T in task.T_world_camera:
            graph.nodes.append(o3d.pipelines.registration.PoseGraphNode(T))
        tied: list[tuple[int, int]] = []
        notes: list[str] = []
        with watch("icp"):
            for k, (i, j) in enumerate(pairs):
                task.say(f"pair {k + 1}/{len(pairs)}")
                edge = self._edge(clouds, i, j, relative(task.T_world_camera, i, j), voxel)
                if edge is None:
                    notes.append(f"frames {i} and {j}: no point has a partner")
                    continue
                graph.edges.append(edge)
                tied.append((i, j))
        if not tied:
            raise MethodError(f"none of {len(pairs)} overlapping pairs could be registered")
        with watch("graph"):
            T = self._optimised(graph, task.T_world_camera, voxel)
        _, loose = connected(len(task), tied)
        if loose:
            T[list(loose)] = task.T_world_camera[list(loose)]
            frames = ", ".join(map(str, loose))
            notes.append(f"not connected to frame 0, kept at their start poses: {frames}")
        return Estimate(T, watch.seconds, tuple(notes))

    def _edge(
        self,
        clouds: Sequence[o3d.geometry.PointCloud],
        i: int,
        j: int,
        T_i_j: Floats,
        voxel: float,
    ) -> Any:
        """Register frame j to frame i and return the edge; None where nothing has a partner."""
        import open3d as o3d

        reg = o3d.pipelines.registration
        criteria = reg.ICPConvergenceCriteria(max_iteration=self.iterations)
        for reach in (self.coarse * voxel, self.fine * voxel):
            if self.estimation == "plane":
                plane = reg.TransformationEstimationPointToPlane()
                found = reg.registration_icp(clouds[j], clouds[i], reach, T_i_j, plane, criteria)
            else:
                found = reg.registration_generalized_icp(
                    clouds[j],
                    clouds[i],
                    reach,
                    T_i_j,
                    reg.TransformationEstimationForGeneralizedICP(),
                    criteria,
                )
            if not len(found.correspondence_set):
                return None
            T_i_j = np.array(found.transformation)
        information = reg.get_information_matrix_from_point_clouds(
            clouds[j], clouds[i], self.fine * voxel, T_i_j
        )
        # Neighbours in time are taken for certain, loop closures are not, as the package has it
        return reg.PoseGraphEdge(j, i, T_i_j, information, uncertain=j != i + 1)

    def _optimised(self, graph: Any, T_start: Floats, voxel: float) -> Floats:
        """Return the poses (N, 4, 4) of the graph's nodes, the first where it started."""
        import open3d as o3d

        reg = o3d.pipelines.registration
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            reg.global_optimization(
                graph,
                reg.GlobalOptimizationLevenbergMarquardt(),
                reg.GlobalOptimizationConvergenceCriteria(),
                reg.GlobalOptimizationOption(
                    max_correspondence_distance=self.fine * voxel,
                    edge_prune_threshold=self.prune,
                    preference_loop_closure=self.preference,
                    reference_node=0,
                ),
            )
        T = np.array([node.pose for node in graph.nodes])
        if not se3.is_rigid(T, 1e-4):
            raise MethodError("the pose graph came to poses that are not rigid")
        return se3.align_first(T, T_start)


def _prepared(points: Floats, voxel: float) -> o3d.geometry.PointCloud:
    """Return a thinned cloud with normals."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(voxel)
    cloud.estimate_normals(
        o3d.geometry.KDTreeSearchParamHybrid(NORMAL_RADIUS * voxel, NORMAL_NEIGHBOURS)
    )
    return cloud
