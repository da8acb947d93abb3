"""TEASER+BA: what TEASER took for inliers, as landmarks that are adjusted with all poses."""

from __future__ import annotations

from dataclasses import dataclass, field

from eval.methods.graph import Edge, isotropic, spanning_tree
from eval.methods.landmarks import LandmarkOptions, adjust
from eval.methods.method import Estimate, MethodError, Stopwatch, Task
from eval.methods.overlap import overlapping_pairs
from eval.methods.pairs import PairOptions, feature_pairs, pair_voxel
from eval.methods.tracks import Link, build_tracks, only_frames, tied_frames


@dataclass(frozen=True)
class TeaserBa:
    """Bundle adjustment of tracks through the feature pairs of all overlapping frames."""

    pairs: PairOptions = field(default_factory=PairOptions)
    least_overlap: float = 0.25
    """Two frames are paired when they share this part of the smaller one's ground."""
    fewest: int = 8
    """A pair with fewer inliers is left out, unless nothing else ties its frames to frame 0: among
    2000 matches so few agree by chance."""
    huber: float | None = None
    """Residual beyond which a landmark's pull no longer grows, m; None: half the feature voxel."""
    iterations: int = 100
    """Of the adjustment, at most."""

    def run(self, task: Task) -> Estimate:
        """Register the frames; of the start poses only which frames overlap is used.

        A frame that no features tie to frame 0 keeps its start pose.
        """
        watch = Stopwatch()
        with watch("overlap"):
            wanted = overlapping_pairs(task, self.least_overlap)
        keypoints, found, failed = feature_pairs(task, wanted, self.pairs, watch)
        if not found:
            raise MethodError(f"none of {len(wanted)} pairs of frames could be matched")
        huber = self.huber
        if huber is None:
            huber = 0.5 * pair_voxel(task, self.pairs, watch)
        task.say("bundle adjustment")
        support = [len(p.inliers) for p in found]
        with watch("tracks"):
            edges = [Edge(p.target, p.source, p.T_target_source, isotropic(1, 1)) for p in found]
            T, tree = spanning_tree(task.T_world_camera, edges, support)
            chance = {k for k, s in enumerate(support) if s < self.fewest} - set(tree)
            links = [
                Link(p.target, p.source, p.matches[p.inliers])
                for k, p in enumerate(found)
                if k not in chance
            ]
            tracks = build_tracks([k.points for k in keypoints], links)
            tied = tied_frames(tracks)
            tracks = only_frames(tracks, tied)
        if not tied[1:].any():
            raise MethodError("no frame shares three landmarks with the first one")
        with watch("adjust"):
            T[~tied] = task.T_world_camera[~tied]
            solution = adjust(tracks, T, LandmarkOptions(huber, self.iterations))
        notes = []
        if failed:
            notes.append(f"{len(failed)} of {len(wanted)} pairs could not be matched")
        if chance:
            notes.append(f"{len(chance)} pairs left out in which as few matches agree as by chance")
        if not tied.all():
            loose = ", ".join(str(f.id) for f, t in zip(task.dataset, tied, strict=True) if not t)
            notes.append(f"frames that no landmarks tie to the first one: {loose}")
        if not solution.converged:
            notes.append(f"bundle adjustment not converged after {solution.iterations} iterations")
        return Estimate(solution.T_world_camera, watch.seconds, tuple(notes), solution.iterations)
