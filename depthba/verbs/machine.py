"""What ``doctor`` looks at on a machine: packages, libraries, ports, cores. Nothing is changed."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import platform
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass

SERVES = {
    "ur-rtde": "drives UR arms",
    "pymodbus": "drives gantries",
    "mujoco": "builds simulated scenes",
    "embreex": "casts the rays of simulated sensors",
    "rerun-sdk": "records runs and shows them",
    "open3d": "a baseline, and views of clouds",
    "small-gicp": "a baseline",
    "gtsam": "pose graphs of the baselines",
    "rosbags": "reads bags of ROS 1 and 2",
    "mcap": "reads MCAP",
    "laspy": "reads and writes LAS and LAZ",
    "pye57": "reads and writes E57",
    "tifffile": "writes GeoTIFF",
    "trimesh": "writes meshes",
    "distributed": "generates on many machines",
}
"""What an optional package is good for, for people."""

PORTS = {
    29999: "simulated controller, dashboard",
    30003: "simulated controller, script",
    30004: "simulated controller, RTDE",
    9876: "viewer",
}

# Runs in a process of its own, since a broken driver takes down whoever asks it.
_PROBES = {
    "EGL": """
import ctypes
egl = ctypes.CDLL("libEGL.so.1")
egl.eglGetDisplay.restype = ctypes.c_void_p
egl.eglGetDisplay.argtypes = [ctypes.c_void_p]
display = egl.eglGetDisplay(None)
major, minor = ctypes.c_int(), ctypes.c_int()
egl.eglInitialize.argtypes = [ctypes.c_void_p] + 2 * [ctypes.POINTER(ctypes.c_int)]
if not display or not egl.eglInitialize(display, ctypes.byref(major), ctypes.byref(minor)):
    raise SystemExit("the library is there, but opens no display")
print(f"{major.value}.{minor.value}, renders without a screen")
""",
    "GL": """
import ctypes, os
ctypes.CDLL("libGL.so.1")
print("with screen " + os.environ["DISPLAY"] if os.environ.get("DISPLAY") else "without a screen")
""",
    "OSMesa": """
import ctypes
for name in ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"):
    try:
        ctypes.CDLL(name)
        break
    except OSError as error:
        last = error
else:
    raise last
print(name)
""",
}


@dataclass(frozen=True)
class Check:
    """One thing that was looked at."""

    name: str
    ok: bool
    text: str
    """What was found, or what would bring it."""
    required: bool = False
    """Whether depthba does not run without it."""


def checks() -> Iterator[Check]:
    """Look at this machine, one check after the other."""
    version = platform.python_version()
    new_enough = sys.version_info >= (3, 11)
    hint = "" if new_enough else ", expected 3.11 or newer"
    yield Check("python", new_enough, f"{version} on {platform.platform()}{hint}", required=True)
    yield from _packages()
    for name, code in _PROBES.items():
        yield _probe(name, code)
    for port, use in PORTS.items():
        yield _port(port, use)
    # not every system says which cores this process may use
    mine = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    yield Check("cores", True, f"{mine} of {os.cpu_count()}")
    yield _memory()
    free = shutil.disk_usage(".").free / 2**30
    yield Check("disk", free > 1.0, f"{free:.1f} GiB free here")
    yield _threading()


def _packages() -> Iterator[Check]:
    """Compare what the distribution asks for with what is installed."""
    try:
        wanted = importlib.metadata.requires("depthba") or []
    except importlib.metadata.PackageNotFoundError:
        yield Check("depthba", False, "not installed: pip install -e .", required=True)
        return
    yield Check("depthba", True, importlib.metadata.version("depthba"), required=True)
    from packaging.requirements import Requirement

    for line in wanted:
        requirement = Requirement(line)
        extra = _extra(line)
        if extra == "dev":
            continue
        name, required = requirement.name, extra is None
        serves = f", {SERVES[name]}" if name in SERVES else ""
        here = requirement.marker is None or requirement.marker.evaluate({"extra": extra or ""})
        install = f"pip install 'depthba[{extra}]'" if extra else "pip install depthba"
        try:
            version = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            way = install if here else "there is none for this platform"
            yield Check(name, False, f"{way}{serves}", required)
            continue
        fits = requirement.specifier.contains(version, prereleases=True)
        hint = "" if fits else f", expected {requirement.specifier}: {install}"
        yield Check(name, fits, f"{version}{serves}{hint}", required)


def _extra(line: str) -> str | None:
    found = re.search(r"""extra\s*==\s*['"]([\w-]+)['"]""", line)
    return found.group(1) if found else None


def _probe(name: str, code: str) -> Check:
    if sys.platform != "linux":
        return Check(name, False, "looked for on Linux only")
    command = [sys.executable, "-c", code]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    except subprocess.TimeoutExpired:
        return Check(name, False, "the driver does not answer")
    if done.returncode < 0:
        return Check(name, False, f"the driver crashes (signal {-done.returncode})")
    # the simulation casts its own rays, so none of the three is needed
    said = (done.stdout if done.returncode == 0 else done.stderr).strip().splitlines()
    return Check(name, done.returncode == 0, (said[-1] if said else "") + "; not needed")


def _port(port: int, use: str) -> Check:
    with socket.socket() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind(("127.0.0.1", port))
        except OSError as error:
            return Check(f"port {port}", False, f"{use}: {error.strerror}")
    return Check(f"port {port}", True, f"free ({use})")


def _memory() -> Check:
    try:
        pages = os.sysconf("SC_PHYS_PAGES"), os.sysconf("SC_AVPHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return Check("memory", False, "this system does not say")
    total, free = (count * os.sysconf("SC_PAGE_SIZE") / 2**30 for count in pages)
    return Check("memory", total > 3.0, f"{free:.1f} of {total:.1f} GiB free")


def _threading() -> Check:
    try:
        numba = importlib.import_module("numba")
        parallel = importlib.import_module("numba.np.ufunc.parallel")
        # the layer is chosen when threads are first needed; this asks for them without compiling
        parallel._launch_threads()
        threads, layer = numba.get_num_threads(), numba.threading_layer()
    except (ImportError, AttributeError, ValueError) as error:
        return Check("numba threads", False, str(error), required=True)
    return Check("numba threads", True, f"{threads}, layer {layer}", required=True)
