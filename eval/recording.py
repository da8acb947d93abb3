"""Records a registration for the Rerun viewer: poses, map, clouds and curves, step by step.

Everything is in the world frame, metres. What stands where:

- ``cam/<i>``: pose of frame i over the iterations; its points, in the frame's colour and coloured
  by residual, and view frustum below it;
- ``before/<i>``: the same frame at its start pose;
- ``map/surface``, ``map/picture``: the depth map over the iterations, as a mesh and from above;
- ``spread/before``, ``spread/after``: how far the frames disagree, from above;
- ``centres/start``, ``centres/true``: where the cameras stood at the start, and in truth;
- ``certainty/...``: the map tinted by its standard deviation, the covariance of the centres, the
  directions that the data leave open;
- ``curves/...``, ``residual/<i>``: scalars over the iterations; ``histogram/<i>``: the residuals;
- ``figures``: the metrics for people; the properties of the recording hold them for programs.

Iteration 0 is the start, iteration k + 1 what step k left. Frames count from 0 as in the dataset.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import RrdReader

from depthba import se3
from depthba.clouds import FrameCloud, load_clouds
from depthba.dataset import Dataset
from depthba.depth_map import DepthMap
from depthba.errors import RunError
from depthba.options import Options
from depthba.picture import spread_png, spreads
from depthba.result import Iteration, Result
from depthba.run_folder import history_scalars, summary
from eval.metrics import Metric, pose_errors
from eval.recorded_certainty import log_certainty
from eval.recorded_frames import log_centres, log_cloud, log_frustum, log_pose, shown_clouds
from eval.recorded_map import RecordedMap
from eval.recorded_residuals import RecordedResiduals
from eval.recording_file import RecordingFile
from eval.recording_layout import blueprint, frame_colours, live_blueprint
from eval.report import figures_page
from eval.review import viewer

Floats = NDArray[np.float64]

MILLI = 1e3
"""Curves are in millimetres and milliradians: their axes can be read."""
SCALARS = ("cost", "sigma", "step_t", "step_r", "inliers", "spacing")

CURVES: Mapping[str, tuple[str, tuple[int, int, int]]] = {
    "curves/cost/cost": ("cost", (230, 180, 60)),
    "curves/sigma/sigma": ("sigma (mm)", (90, 190, 250)),
    "curves/step/translation": ("largest translation (mm)", (90, 190, 250)),
    "curves/step/rotation": ("largest rotation (mrad)", (250, 130, 90)),
    "curves/inliers/inliers": ("inliers (%)", (120, 220, 120)),
    "curves/spacing/spacing": ("map spacing (mm)", (200, 200, 200)),
    "curves/error/translation": ("translation, mean absolute (mm)", (90, 190, 250)),
    "curves/error/rotation": ("rotation, mean absolute (mrad)", (250, 130, 90)),
}


class Recorder:
    """Writes a recording while a registration runs; give it to `depthba.register` as the callback.

    The file stands under its name once `finish` was called, and under a hidden one before.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        dataset: Dataset,
        options: Options | None = None,
        clouds: Sequence[FrameCloud] | None = None,
        viewer: str | None = None,
    ) -> None:
        """Begin a recording.

        Args:
            path: the file, such as run.rrd in the run's folder, which exists.
            dataset: what is registered.
            options: how; for the properties and the region of interest.
            clouds: the points of all frames, where the caller has them already.
            viewer: address of a viewer that shows each step as it comes, see `eval.live`.

        """
        self.path = Path(path)
        self._dataset = dataset
        self._options = options or Options()
        self._clouds = load_clouds(dataset, colours=False) if clouds is None else tuple(clouds)
        self._true = dataset.T_world_camera_true
        self._colours = frame_colours(len(dataset))
        self._map = RecordedMap()
        self._residuals: RecordedResiduals | None = None
        self._last = (0, 0.0)
        self._live = viewer is not None
        self._file = RecordingFile(self.path, viewer)
        self._stream = self._file.stream
        self._stream.send_recording_name(self.path.resolve().parent.name)

    def __call__(self, iteration: Iteration) -> None:
        """Record the state after a step."""
        self._begin(self._dataset.T_world_camera_measured, iteration.depth_map)
        self.scalars(history_scalars(iteration))
        self._state(iteration.T_world_camera, iteration.depth_map)

    def scalars(self, step: Mapping[str, Any]) -> None:
        """Record the scalars of a step; alone, where nothing else is left of it.

        Args:
            step: as `depthba.run_folder.history_scalars` gives them.

        """
        self._last = int(step["index"]) + 1, float(step["seconds"])
        self._time(*self._last)
        sizes = {n: np.nan if step[n] is None else float(step[n]) for n in SCALARS}
        self._scalars(
            {
                "curves/cost/cost": _log10(sizes["cost"]),
                "curves/sigma/sigma": MILLI * sizes["sigma"],
                "curves/step/translation": _log10(MILLI * sizes["step_t"]),
                "curves/step/rotation": _log10(MILLI * sizes["step_r"]),
                "curves/inliers/inliers": 100.0 * sizes["inliers"],
                "curves/spacing/spacing": MILLI * sizes["spacing"],
            }
        )

    def finish(
        self,
        result: Result,
        metrics: Sequence[Metric] | None = None,
        run: Mapping[str, Any] | None = None,
    ) -> None:
        """Record the result and put the file into its place.

        Args:
            result: what the registration returned.
            metrics: what `eval.evaluate.evaluate` returned; None: the page of figures does without.
            run: what result.json holds; None: it is made of the result.

        Raises:
            OSError: the file could not be written.

        """
        run = summary(result, self._options, self._dataset) if run is None else run
        self._begin(result.T_world_camera_start, result.depth_map_start)
        count, seconds = self._last
        self._time(count + 1, max(seconds, result.seconds.get("total", 0.0)))
        self._state(result.T_world_camera, result.depth_map, final=True)
        self._time(0, 0.0)
        self._state(result.T_world_camera_start, result.depth_map_start)
        self._before(result)
        rec = self._stream
        scale = log_certainty(rec, result, self._colours)
        rec.send_property("run", rr.AnyValues(**_facts(run)))
        _log_figures(rec, run, metrics or ())
        rec.send_blueprint(
            blueprint(
                result.depth_map,
                result.T_world_camera,
                truth=self._true is not None,
                scale=scale,
            )
        )
        self._file.finish()

    def discard(self) -> None:
        """End without a recording and leave no file."""
        self._file.discard()

    def _begin(self, T_world_camera: Floats, depth_map: DepthMap) -> None:
        """Record, once, what stays as it is: the frames' points and the names of the curves."""
        if self._residuals is not None:
            return
        rec, camera = self._stream, self._dataset.sensor.camera
        T_map_camera = depth_map.T_map_world @ T_world_camera
        shown = shown_clouds(self._dataset, self._clouds, T_map_camera, self._options.roi)
        for i, (cloud, colour) in enumerate(zip(shown, self._colours, strict=True)):
            for root in (f"cam/{i}", f"before/{i}"):
                log_cloud(rec, f"{root}/points", cloud, colour)
                log_frustum(rec, f"{root}/image", camera, cloud.points, colour)
        self._residuals = RecordedResiduals(rec, shown, self._colours)
        names = dict(CURVES)
        for i, (r, g, b) in enumerate(self._colours.tolist()):
            names[f"residual/{i}"] = (f"frame {i}", (r, g, b))
        for path, (name, rgb) in names.items():
            rec.log(path, rr.SeriesLines(names=name, colors=rgb), static=True)
        if self._true is not None:
            centres = se3.align_first(self._true, T_world_camera)[:, :3, 3]
            log_centres(rec, "centres/true", centres, (255, 255, 255), "true centre")
        if self._live:
            truth = self._true is not None
            rec.send_blueprint(live_blueprint(depth_map, T_world_camera, truth=truth))

    def _state(self, T_world_camera: Floats, depth_map: DepthMap, *, final: bool = False) -> None:
        """Record poses, map, residuals and, where truth is known, errors."""
        assert self._residuals is not None
        for i, T in enumerate(T_world_camera):
            log_pose(self._stream, f"cam/{i}", T)
        self._map.log(self._stream, depth_map, final=final)
        sigmas = self._residuals.log(depth_map, T_world_camera, final=final)
        scalars = {f"residual/{i}": MILLI * float(s) for i, s in enumerate(sigmas)}
        if self._true is not None and len(T_world_camera) > 1:
            aligned = se3.align_first(T_world_camera, self._true)
            e = np.abs(pose_errors(aligned, self._true)[1:])
            scalars["curves/error/translation"] = MILLI * float(e[:, :3].mean())
            scalars["curves/error/rotation"] = MILLI * float(e[:, 3:].mean())
        self._scalars(scalars)

    def _before(self, result: Result) -> None:
        """Record the start poses, and how far the frames disagree at them and at the result."""
        rec = self._stream
        for i, T in enumerate(result.T_world_camera_start):
            log_pose(rec, f"before/{i}", T, static=True)
        centres = result.T_world_camera_start[:, :3, 3]
        log_centres(rec, "centres/start", centres, (150, 150, 150), "start centre")
        both = spreads(result, self._dataset, self._clouds, self._options.roi)
        for name, spread in (("before", both.before), ("after", both.after)):
            picture = spread_png(spread, result.depth_map, both.top)
            image = rr.EncodedImage(contents=picture, media_type="image/png")
            rec.log(f"spread/{name}", image, static=True)

    def _time(self, iteration: int, seconds: float) -> None:
        self._stream.set_time("iteration", sequence=iteration)
        self._stream.set_time("elapsed", duration=seconds)

    def _scalars(self, values: Mapping[str, float]) -> None:
        for path, value in values.items():
            if np.isfinite(value):
                self._stream.log(path, rr.Scalars(value))


def add_figures(path: Path, run: Mapping[str, Any], metrics: Sequence[Metric]) -> None:
    """Put the metrics into a recording that is there already.

    Args:
        path: the recording.
        run: what result.json holds.
        metrics: as `eval.evaluate.evaluate` returns them.

    Raises:
        RunError: the recording is broken.

    """
    whole, more = (path.with_name(f".{path.name}.{os.getpid()}.{part}") for part in ("part", "add"))
    try:
        entry = next(iter(RrdReader(path).recordings()))
        rec = rr.RecordingStream(
            entry.application_id, recording_id=entry.recording_id, send_properties=False
        )
        added = RecordingFile(more, stream=rec)
        try:
            _log_figures(rec, run, metrics)
            added.finish()
        except BaseException:
            added.discard()
            raise
        merge = [str(viewer()), "rrd", "merge", str(path), str(more), "-o", str(whole)]
        subprocess.run(merge, check=True, capture_output=True)
        whole.replace(path)
    except (OSError, ValueError, RuntimeError, StopIteration, subprocess.CalledProcessError) as e:
        raise RunError(f"{path}: cannot add the figures to this recording: {e}") from e
    finally:
        whole.unlink(missing_ok=True)
        more.unlink(missing_ok=True)


def _log_figures(
    rec: rr.RecordingStream, run: Mapping[str, Any], metrics: Sequence[Metric]
) -> None:
    """Record the metrics, as a page and as properties."""
    page = rr.TextDocument(figures_page(run, metrics), media_type="text/markdown")
    rec.log("figures", page, static=True)
    values: dict[str, Any] = {m.name: m.value for m in metrics if np.isfinite(m.value)}
    if values:
        rec.send_property("metrics", rr.AnyValues(**values))


def _facts(run: Mapping[str, Any]) -> dict[str, Any]:
    """Return what programs ask many recordings for, from what result.json holds."""
    facts = {
        "dataset": run["name"],
        "preset": run["options"]["preset"],
        "init": run["options"]["init"],
        "seed": run["dataset"]["seed"],
        "status": run["status"],
        "frames": len(run["frames"]),
        "iterations": run["iterations"],
        "seconds": run["seconds"].get("total"),
        "sigma": run["sigma"],
        "map_spacing": run["map"]["spacing"],
        **{f"version_{k}": v for k, v in run["versions"].items()},
        "version_rerun": rr.__version__,
    }
    return {name: value for name, value in facts.items() if value is not None}


def _log10(value: float) -> float:
    return float(np.log10(value)) if value > 0 else float("nan")
