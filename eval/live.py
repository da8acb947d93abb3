"""Shows what goes on while it goes on: a viewer on this machine, and the log of a capture.

A registration streams to the viewer through `eval.recording.Recorder`, a capture session through
`CaptureLog`; each writes the same into its recording.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from depthba.dataset import Frame, Sensor
from depthba.errors import RunError
from eval import review
from eval.recorded_frames import COVER, ShownCloud, log_cloud, log_frustum, log_pose
from eval.recording_file import RecordingFile
from eval.recording_layout import capture_blueprint, frame_colours

Floats = NDArray[np.float64]

START_SECONDS = 60.0
"""In which a viewer must answer."""
FRAME_POINTS = 12_000
"""Shown of each frame of a capture."""
IMAGE_SIDE = 480
"""Longest side of the images of a capture, pixels."""
STEP = 0.002
"""The path of the camera is drawn in steps no shorter than this, m."""
PATH_COLOUR, HERE_COLOUR = (240, 240, 240), (255, 210, 60)


class Viewer:
    """A viewer that waits for what is streamed to it, reachable from this machine alone."""

    def __init__(self, process: subprocess.Popen[bytes], data: int, page: int | None) -> None:
        """Take a process that listens on port ``data`` and, for browsers, ``page``."""
        self._process = process
        self.address = f"rerun+http://{review.LOCAL}:{data}/proxy"
        """Where to stream to."""
        self.page = None if page is None else review.page_url(page, data)
        """What to open in a browser; None: it is a window."""

    @classmethod
    def open(cls, web: bool = False) -> Viewer:
        """Start a viewer: a window, or with ``web`` a page for a browser.

        Raises:
            RunError: there is no screen, or the viewer did not start.
            MissingPackage: rerun-sdk is not installed.

        """
        data = review.free_port()
        page = None
        if web:
            page = review.free_port()
            command = review.web_command(page, data)
        else:
            review.need_screen("--live --web")
            command = [str(review.viewer()), "--bind", review.LOCAL, "--port", str(data)]
        process = subprocess.Popen(
            command,
            env={"RUST_LOG": "error", **os.environ},
            stdout=subprocess.DEVNULL,
            start_new_session=not web,  # a window stays when the command has ended
        )
        try:
            for port in (data,) if page is None else (data, page):
                await_port(process, port)
        except BaseException:
            review.end(process)
            raise
        return cls(process, data, page)

    def stay(self) -> None:
        """Keep a page served until the user interrupts; leave a window to the user."""
        if self.page is None:
            return
        print(f"still shown at {self.page}\nCtrl-C ends it.", file=sys.stderr, flush=True)
        try:
            self._process.wait()
        except KeyboardInterrupt:
            pass
        finally:
            self.close()

    def close(self) -> None:
        """End it."""
        review.end(self._process)


@contextlib.contextmanager
def opened(web: bool = False) -> Iterator[Viewer]:
    """Give a viewer; what fails within ends it, otherwise it is left as `Viewer.stay` leaves it.

    Where nobody calls that, a page is served until `Viewer.close`.
    """
    with review.terminated_cleanly():
        view = Viewer.open(web)
        if view.page is not None:
            print(f"live at {view.page}", file=sys.stderr, flush=True)
        try:
            yield view
        except BaseException:
            view.close()
            raise


class CaptureLog:
    """Shows a capture session as it goes: images, clouds, the way of the camera.

    The layout is that of a registration's recording: ``cam/<i>`` with its points and frustum below
    it, and besides ``path``, ``last/rgb`` and ``last/depth``. Iteration k is the state after k
    frames.
    """

    def __init__(
        self,
        sensor: Sensor,
        name: str,
        path: str | os.PathLike[str] | None = None,
        viewer: str | None = None,
    ) -> None:
        """Begin a session.

        Args:
            sensor: of all frames.
            name: of the session, for people.
            path: the recording to write, whole once `finish` was called; None: none.
            viewer: `Viewer.address` of one that shows it; None: none.

        Raises:
            RunError: there is neither a recording nor a viewer.
            OSError: the recording cannot be written.

        """
        if path is None and viewer is None:
            raise RunError("capture log: neither a recording nor a viewer, expected one or both")
        self._sensor, self._name = sensor, name
        self._file = RecordingFile(None if path is None else Path(path), viewer)
        self._stream = self._file.stream
        self._stream.send_recording_name(name)
        self._stream.send_blueprint(capture_blueprint())
        self._way: list[Floats] = []
        self._count = 0
        self._began: float | None = None

    def moved(self, T_world_camera: Floats, stamp: float) -> None:
        """Show where the camera is between frames: pose (4, 4), stamp in seconds."""
        self._time(stamp)
        self._here(T_world_camera)

    def add(self, frame: Frame) -> None:
        """Show a frame that was taken.

        Raises:
            DatasetError: its images cannot be read.

        """
        i, T = self._count, frame.T_world_camera
        self._count += 1
        self._time(frame.stamp)
        points = np.asarray(frame.points(), dtype=np.float64)
        spacing = point_spacing_of(self._sensor, points)
        shown = np.random.default_rng(i).permutation(points)
        cloud = ShownCloud(shown, COVER * spacing).first(FRAME_POINTS)
        colour = frame_colours(i + 1)[i]
        log_pose(self._stream, f"cam/{i}", T)
        log_cloud(self._stream, f"cam/{i}/points", cloud, colour, static=False)
        camera = self._sensor.camera
        log_frustum(self._stream, f"cam/{i}/image", camera, points, colour, static=False)
        self._images(frame)
        self._here(T)
        page = f"### {self._name}\n\n{self._count} frames; the last has {len(points)} points.\n"
        self._stream.log("figures", rr.TextDocument(page, media_type="text/markdown"))

    def poses(self, T_world_camera: Floats) -> None:
        """Show better poses (n, 4, 4) of the frames so far, such as `depthba.Registration` gives.

        Raises:
            RunError: they are not as many as the frames.

        """
        if len(T_world_camera) != self._count:
            raise RunError(f"capture log: {len(T_world_camera)} poses for {self._count} frames")
        for i, T in enumerate(T_world_camera):
            log_pose(self._stream, f"cam/{i}", T)

    def finish(self) -> None:
        """End the session and put the recording into its place.

        Raises:
            OSError: the recording could not be written.

        """
        self._file.finish()

    def discard(self) -> None:
        """End the session and leave no recording."""
        self._file.discard()

    def _time(self, stamp: float) -> None:
        self._began = stamp if self._began is None else self._began
        self._stream.set_time("iteration", sequence=self._count)
        self._stream.set_time("elapsed", duration=stamp - self._began)

    def _here(self, T_world_camera: Floats) -> None:
        centre = np.asarray(T_world_camera[:3, 3], dtype=np.float64)
        if not self._way or np.linalg.norm(centre - self._way[-1]) >= STEP:
            self._way.append(centre)
            way = rr.LineStrips3D([np.array(self._way)], colors=PATH_COLOUR, radii=-1.5)
            self._stream.log("path/way", way)
        self._stream.log("path/here", rr.Points3D([centre], colors=HERE_COLOUR, radii=-6.0))

    def _images(self, frame: Frame) -> None:
        """Show what the camera saw, made smaller."""
        rgb = frame.rgb()
        if rgb is not None:
            bgr = _smaller(rgb, cv2.INTER_AREA)[..., ::-1]
            data = cv2.imencode(".jpg", np.ascontiguousarray(bgr))[1].tobytes()
            image = rr.EncodedImage(contents=data, media_type="image/jpeg")
            self._stream.log("last/rgb", image)
        if self._sensor.camera is None:
            return
        depth = _smaller(1e3 * np.nan_to_num(frame.depth()), cv2.INTER_NEAREST)
        depth[depth > np.iinfo(np.uint16).max] = 0.0  # too far for the picture, and not wrapped
        data = cv2.imencode(".png", np.rint(depth).astype(np.uint16))[1].tobytes()
        picture = rr.EncodedDepthImage(blob=data, media_type="image/png", meter=1000.0)
        self._stream.log("last/depth", picture)


def point_spacing_of(sensor: Sensor, points: Floats) -> float:
    """Return about how far apart the points (n, 3) of one frame are, m."""
    if not len(points):
        return 0.0
    if sensor.camera is not None:
        return float(np.median(points[:, 2]) / sensor.camera.fx)
    low, high = np.quantile(points[:, :2], [0.05, 0.95], axis=0)
    return float(np.sqrt(np.prod(high - low) / (0.81 * len(points))))


def _smaller(image: NDArray, interpolation: int) -> NDArray:
    scale = IMAGE_SIDE / max(image.shape[:2])
    if scale >= 1:
        return image.copy()
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=interpolation)


def await_port(process: subprocess.Popen[bytes], port: int) -> None:
    """Wait until a viewer listens.

    Raises:
        RunError: it ended, or did not answer in time.

    """
    deadline = time.monotonic() + START_SECONDS
    while True:
        with contextlib.suppress(OSError), socket.create_connection((review.LOCAL, port), 1.0):
            return
        if process.poll() is not None:
            raise RunError(f"the viewer ended at once, with status {process.returncode}")
        if time.monotonic() > deadline:
            raise RunError(f"the viewer did not answer within {START_SECONDS:.0f} s")
        time.sleep(0.1)
