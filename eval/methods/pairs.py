"""Pairs of frames registered by features: found once, shared by the methods that build on them."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from eval.methods import features
from eval.methods.features import Keypoints
from eval.methods.method import MethodError, Stopwatch, Task
from eval.methods.pair_cache import Cache, digest
from eval.methods.teaser import TeaserOptions, register

Floats = NDArray[np.float64]

FORMAT = 1
"""Of what is kept; one more with every change of what is computed."""
LEAST_INLIERS = 3
"""That fix a rigid motion."""


@dataclass(frozen=True)
class PairOptions:
    """How pairs of frames are registered by features."""

    voxel: float | None = None
    """Edge of the cubes that points are thinned to, m; None: by `features.usual_voxel`."""
    reach: float = features.REACH
    """How far points are described, in a frame's median ranges; see `features.near`."""
    noise_bound: float = 0.75
    """Largest error of a matched point that counts as noise, in voxels."""
    most_matches: int = 2000
    """Matches that TEASER is given, the best by the ratio test."""
    clique_seconds: float = 30.0
    """After which TEASER's largest clique so far must do."""


@dataclass(frozen=True, eq=False)
class FeaturePair:
    """How frame ``source`` lies on frame ``target``, by TEASER on FPFH matches."""

    target: int
    source: int
    T_target_source: Floats
    """(4, 4)."""
    matches: NDArray[np.int64]
    """(m, 2), keypoints of target and source that were matched: rows of `Keypoints.points`."""
    inliers: NDArray[np.int64]
    """(k,), rows of ``matches`` that agree: the maximum clique, cut to those within the bound."""
    seconds: Mapping[str, float]
    """That each stage took when the pair was made."""
    note: str = ""
    """What a reader of the report must know: that the clique was not proven to be the largest."""


def feature_pairs(
    task: Task,
    pairs: Sequence[tuple[int, int]],
    options: PairOptions,
    watch: Stopwatch,
) -> tuple[list[Keypoints], list[FeaturePair], list[tuple[int, int, str]]]:
    """Register pairs of frames by features, each once per dataset where the task has a cache.

    Args:
        task: the frames; their start poses are not used.
        pairs: frames (target, source), by index into ``task.clouds``.
        options: see there.
        watch: is charged with the stages "features", "matches" and "teaser"; with what they took
            when they were made, where the cache had them.

    Returns:
        The keypoints of all frames, the pairs that were registered, in the order asked, and those
        that were not, as (target, source, why).

    """
    voxel = pair_voxel(task, options, watch)
    described = keypoints(task, voxel, watch, options.reach)
    kept = Cache(task.cache)
    digests = _digests(task)
    found, failed = [], []
    for k, (target, source) in enumerate(pairs):
        task.say(f"features, pair {k + 1}/{len(pairs)}")
        key = {
            **_base(voxel),
            **asdict(options),
            "voxel": voxel,
            "target": digests[target],
            "source": digests[source],
        }
        pair = _kept_pair(kept, key, target, source, described)
        if pair is None:
            pair = _made_pair(described, target, source, voxel, options, task.threads)
            _say_if(task, kept.put("pair", key, _arrays(pair)))
        for stage, seconds in pair.seconds.items():
            watch.charge(stage, seconds)
        if len(pair.inliers) < LEAST_INLIERS:
            failed.append((target, source, pair.note))
        else:
            found.append(pair)
    return described, found, failed


def pair_voxel(task: Task, options: PairOptions, watch: Stopwatch) -> float:
    """Return the voxel that pairs are registered with, m."""
    if options.voxel is not None:
        return options.voxel
    with watch("features"):
        return features.usual_voxel(features.near_clouds(task, options.reach), task.spacing)


def keypoints(
    task: Task, voxel: float, watch: Stopwatch, reach: float = features.REACH
) -> list[Keypoints]:
    """Return the keypoints of all frames; ``watch`` is charged with the stage "features".

    Args:
        task: the frames.
        voxel: edge of the cubes that points are thinned to, m.
        watch: is charged with what frames out of the cache took when they were made.
        reach: how far points are described, in a frame's median ranges.

    """
    kept = Cache(task.cache)
    reach = reach if task.dataset.sensor.origin else float("inf")
    expected = {"points": ("f", 2), "descriptors": ("f", 2), "seconds": ("f", 0)}
    described = []
    for k, (cloud, known) in enumerate(zip(task.clouds, _digests(task), strict=True)):
        task.say(f"features, frame {k + 1}/{len(task)}")
        key = {**_base(voxel), "reach": reach, "frame": known}
        arrays = kept.get("keypoints", key, expected)
        if arrays is None:
            _warm()
            began = time.perf_counter()
            one = features.describe(features.near(cloud, reach), voxel)
            seconds = time.perf_counter() - began
            arrays = {
                "points": one.points,
                "descriptors": one.descriptors,
                "seconds": np.array(seconds),
            }
            _say_if(task, kept.put("keypoints", key, arrays))
        watch.charge("features", float(arrays["seconds"]))
        described.append(Keypoints(arrays["points"], arrays["descriptors"]))
    return described


def _made_pair(
    described: Sequence[Keypoints],
    target: int,
    source: int,
    voxel: float,
    options: PairOptions,
    threads: int,
) -> FeaturePair:
    """Register one pair; one that fails has no inliers, and a note that says why."""
    _warm()
    a, b = described[target], described[source]
    began = time.perf_counter()
    matches = features.match(a, b, options.most_matches, threads)
    matched = time.perf_counter()
    T, inliers, note = np.eye(4), np.empty(0, np.int64), ""
    try:
        result = register(
            b.points[matches[:, 1]],
            a.points[matches[:, 0]],
            TeaserOptions(
                noise_bound=options.noise_bound * voxel, clique_seconds=options.clique_seconds
            ),
        )
        T, inliers = result.T_target_source, result.inliers
        if len(inliers) < LEAST_INLIERS:
            note = f"{len(inliers)} of {len(matches)} matches agree, {LEAST_INLIERS} are needed"
        elif not result.clique_proven:
            note = (
                f"frames {target} and {source}: the clique of {len(result.clique)} may not be the "
                f"largest, {options.clique_seconds:g} s were not enough to tell"
            )
    except MethodError as error:
        note = str(error)
    seconds = {"matches": matched - began, "teaser": time.perf_counter() - matched}
    return FeaturePair(target, source, T, matches, inliers, seconds, note)


def _arrays(pair: FeaturePair) -> dict[str, NDArray]:
    return {
        "T_target_source": pair.T_target_source,
        "matches": pair.matches,
        "inliers": pair.inliers,
        "stages": np.array(list(pair.seconds)),
        "seconds": np.array(list(pair.seconds.values())),
        "note": np.array(pair.note),
    }


def _kept_pair(
    kept: Cache, key: object, target: int, source: int, described: Sequence[Keypoints]
) -> FeaturePair | None:
    """Return a pair out of the cache, or None where it is not there or fits not these frames."""
    expected = {
        "T_target_source": ("f", 2),
        "matches": ("i", 2),
        "inliers": ("i", 1),
        "stages": ("U", 1),
        "seconds": ("f", 1),
        "note": ("U", 0),
    }
    arrays = kept.get("pair", key, expected)
    if arrays is None:
        return None
    T, matches, inliers = (arrays[name] for name in ("T_target_source", "matches", "inliers"))
    counts = [len(described[target].points), len(described[source].points)]
    fits = (
        se3.is_rigid(T)
        and matches.shape[1] == 2
        and bool(((matches >= 0) & (matches < counts)).all())
        and bool(((inliers >= 0) & (inliers < len(matches))).all())
        and len(arrays["stages"]) == len(arrays["seconds"])
    )
    if not fits:
        return None
    seconds = dict(zip(arrays["stages"].tolist(), arrays["seconds"].tolist(), strict=True))
    return FeaturePair(target, source, T, matches, inliers, seconds, str(arrays["note"]))


def _base(voxel: float) -> dict[str, object]:
    """Return what keypoints depend on, besides the frame."""
    return {"format": FORMAT, "open3d": version("open3d"), "voxel": voxel}


def _digests(task: Task) -> list[str]:
    """Return what identifies each frame: its points, so that a dataset may be moved or renamed."""
    return [digest(cloud) if task.cache else "" for cloud in task.clouds]


@cache
def _warm() -> None:
    """Load and compile what is timed later."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (400, 3)) * [1, 1, 0.1] + [0, 0, 1]
    one = features.describe(points, 0.05)
    rows = features.match(one, one, 50)[:, 0]
    register(one.points[rows], one.points[rows] + [0, 0, 0.1])


def _say_if(task: Task, trouble: str) -> None:
    if trouble:
        task.say(f"not kept: {trouble}")
