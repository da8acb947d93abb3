"""Range cameras behind GenICam, on harvesters and the GenTL producer (.cti) of their vendor."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from depthba.camera import Camera
from depthba.errors import MissingPackage
from rig.cameras.camera import CameraInfo, Capture
from rig.cameras.scan3d import UNITS, Part, Scan3d, colour_of, depth_of
from rig.errors import CameraError, CameraTimeout

_PRODUCERS = "GENICAM_GENTL64_PATH"
"""Variable in which installers of producers leave their folders."""
_OUTPUTS = ("CalibratedC", "CalibratedABC_Grid", "RectifiedC")
"""Scan3dOutputMode in which C is z over the pixels of a camera."""


@dataclass(frozen=True)
class GenicamOptions:
    """Which camera, and how it measures."""

    producer: Path | None = None
    """The vendor's .cti file. None: all that GENICAM_GENTL64_PATH names."""
    device: str | None = None
    """Id, serial number, name or model of the camera. None: the only one there is."""
    component: str = "Range"
    """ComponentSelector of the range image."""
    features: tuple[tuple[str, str | float | bool], ...] = ()
    """Features to set, in that order, as (("ExposureTime", 12000.0), …)."""
    fx: float | None = None
    """px, as fy, cx and cy. None: Scan3dFocalLength and Scan3dPrincipalPoint of the camera."""
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1 k2 p1 p2 k3, as in OpenCV."""
    depth_scale: float = 1e-4
    """Metres per count of the stored images."""
    depth_min: float | None = None
    """What the camera can measure, m. None: not known."""
    depth_max: float | None = None
    noise: tuple[float, float, float] | None = None
    """sigma_m, at_m and power of the range's standard deviation. None: not known."""


class GenicamCamera:
    """`rig.cameras.camera.DepthCamera` on a GenTL producer.

    Acquisition starts at every capture and ends with its first frame, so that no frame of before
    can be taken for it. The stamp is the host's clock in the middle between the start and the
    arrival of the frame, which the exposure lies between; the camera's own clock has another zero.
    """

    Options = GenicamOptions

    def __init__(self, options: GenicamOptions):
        self._options = options
        self._harvester: Any = None
        self._acquirer: Any = None
        self._scan = Scan3d()

    def open(self) -> CameraInfo:
        """Load the producer, reach the camera, choose its range image."""
        try:
            from genicam.gentl import GenericException as TransportError
            from harvesters.core import Harvester
        except ImportError as error:
            raise MissingPackage(
                "a GenICam camera needs the package harvesters: pip install 'depthba[cameras]'"
            ) from error
        self.close()
        producers = self._producer_files()
        self._harvester = Harvester()
        try:
            for path in producers:
                self._harvester.add_file(str(path), check_existence=True, check_validity=True)
            self._harvester.update()
            found, index = self._chosen()
            self._acquirer = self._harvester.create(index)
            return self._set_up(found)
        except CameraError:
            self.close()
            raise
        except (TransportError, OSError, RuntimeError, ValueError) as error:
            self.close()
            raise CameraError(f"genicam: {_first_line(error)}") from error

    def capture(self, timeout: float) -> Capture:
        """The first frame after a start of the acquisition."""
        from genicam.gentl import GenericException as TransportError
        from genicam.gentl import TimeoutException

        acquirer = self._acquirer
        if acquirer is None:
            raise CameraError("genicam: not open, expected open() first")
        began = time.time()
        try:
            acquirer.start()
            try:
                with acquirer.fetch(timeout=timeout) as buffer:
                    stamp = (began + time.time()) / 2
                    # the producer takes its memory back: copies
                    parts = [
                        Part(c.data_format, int(c.width), int(c.height), np.array(c.data))
                        for c in buffer.payload.components
                    ]
            finally:
                acquirer.stop()
        except TimeoutException as error:
            raise CameraTimeout(f"genicam: no frame within {timeout:g} s") from error
        except (TransportError, RuntimeError) as error:
            raise CameraError(f"genicam: {_first_line(error)}") from error
        depth = depth_of(parts, self._scan)
        return Capture(depth, stamp, colour_of(parts, (depth.shape[0], depth.shape[1])))

    def close(self) -> None:
        """Let go of the camera and its producer."""
        acquirer, self._acquirer = self._acquirer, None
        harvester, self._harvester = self._harvester, None
        for end in (acquirer and acquirer.destroy, harvester and harvester.reset):
            if end:
                with suppress(Exception):  # it is gone already, in whatever way the producer says
                    end()

    def _producer_files(self) -> list[Path]:
        producer = self._options.producer
        if producer is not None:
            if not producer.is_file():
                raise CameraError(f"{producer}: no such file, expected the vendor's .cti")
            return [producer]
        folders = [Path(f) for f in os.environ.get(_PRODUCERS, "").split(os.pathsep) if f]
        found = [path for folder in folders for path in sorted(folder.glob("*.cti"))]
        if not found:
            raise CameraError(
                f"genicam: {_PRODUCERS} names no folder with a .cti;"
                " install the vendor's producer or set the option producer"
            )
        return found

    def _chosen(self) -> tuple[Any, int]:
        """Return what is known of the camera that the options name, and its index."""
        there = list(self._harvester.device_info_list)
        wanted = self._options.device
        listed = ", ".join(_text(info, "id_") for info in there) or "none"
        keys = ("id_", "serial_number", "user_defined_name", "display_name", "model")
        fits = [
            index
            for index, info in enumerate(there)
            if wanted is None or wanted in {_text(info, key) for key in keys}
        ]
        if len(fits) == 1:
            return there[fits[0]], fits[0]
        if wanted is None:
            raise CameraError(
                f"genicam: cameras there: {listed}; expected one, or the option device"
            )
        raise CameraError(
            f"genicam: {len(fits) or 'no'} cameras are called {wanted!r}, expected one of: {listed}"
        )

    def _set_up(self, found: Any) -> CameraInfo:
        component = self._options.component
        if self._node("ComponentSelector") is not None:
            self._set("ComponentSelector", component)
            if self._value("ComponentEnable", True) is not True:
                self._set("ComponentEnable", True)
        for name, value in self._options.features:
            self._set(name, value)
        self._scan = self._scan3d()
        options = self._options
        settings: dict[str, str | float | bool] = {"component": component}
        settings |= dict(options.features)
        return CameraInfo(
            model=f"{_text(found, 'vendor')} {_text(found, 'model')}".strip(),
            serial=_text(found, "serial_number") or _text(found, "id_"),
            camera=self._camera(),
            depth_scale=options.depth_scale,
            depth_min=options.depth_min,
            depth_max=options.depth_max,
            noise=options.noise,
            settings=settings,
        )

    def _scan3d(self) -> Scan3d:
        mode = self._value("Scan3dOutputMode", _OUTPUTS[0])
        if mode not in _OUTPUTS:
            raise CameraError(
                f"genicam: Scan3dOutputMode is {mode}, expected one of {', '.join(_OUTPUTS)}"
            )
        system = self._value("Scan3dCoordinateSystem", "Cartesian")
        if system != "Cartesian":
            raise CameraError(f"genicam: Scan3dCoordinateSystem is {system}, expected Cartesian")
        unit = self._value("Scan3dDistanceUnit", "Millimeter")
        if unit not in UNITS:
            raise CameraError(
                f"genicam: Scan3dDistanceUnit is {unit}, expected one of {', '.join(UNITS)}"
            )
        if self._node("Scan3dCoordinateSelector") is not None:
            self._set("Scan3dCoordinateSelector", "CoordinateC")
        flagged = self._value("Scan3dInvalidDataFlag", False)
        return Scan3d(
            scale=float(self._value("Scan3dCoordinateScale", 1.0)),
            offset=float(self._value("Scan3dCoordinateOffset", 0.0)),
            invalid=float(self._value("Scan3dInvalidDataValue", 0.0)) if flagged else None,
            metres=UNITS[unit],
        )

    def _camera(self) -> Camera:
        options = self._options
        focal = self._value("Scan3dFocalLength", None)
        found = (
            options.fx if options.fx is not None else focal,
            options.fy if options.fy is not None else focal,
            options.cx if options.cx is not None else self._value("Scan3dPrincipalPointU", None),
            options.cy if options.cy is not None else self._value("Scan3dPrincipalPointV", None),
        )
        if None in found:
            raise CameraError(
                "genicam: the camera does not tell its intrinsics,"
                " expected the options fx, fy, cx and cy"
            )
        fx, fy, cx, cy = (float(value) for value in found if value is not None)
        width, height = int(self._value("Width", 0)), int(self._value("Height", 0))
        return Camera(width, height, fx, fy, cx, cy, options.distortion)

    def _node(self, name: str) -> Any:
        nodes = self._acquirer.remote_device.node_map
        return nodes.get_node(name) if nodes.has_node(name) else None

    def _value(self, name: str, absent: Any) -> Any:
        """Return a feature's value; `absent` where the camera has none, or not now."""
        from genicam.genapi import GenericException as FeatureError

        node = self._node(name)
        if node is None:
            return absent
        try:
            return node.value
        except FeatureError:
            return absent

    def _set(self, name: str, value: str | float | bool) -> None:
        from genicam.genapi import GenericException as FeatureError

        node = self._node(name)
        if node is None:
            raise CameraError(f"genicam: the camera has no feature {name}")
        try:
            node.value = value
        except (FeatureError, TypeError) as error:
            choices = getattr(node, "symbolics", None)
            expected = f", expected one of {', '.join(choices)}" if choices else ""
            raise CameraError(
                f"genicam: feature {name} cannot be set to {value!r}{expected}:"
                f" {_first_line(error)}"
            ) from error


def _text(info: Any, name: str) -> str:
    """Return what a producer says of a device, "" where it does not."""
    try:
        value = getattr(info, name)
    except Exception:  # each producer fails in its own way
        return ""
    return "" if value is None else str(value)


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]
