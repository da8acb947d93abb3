"""Which formats there are, and which one a source is of."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

from depthba.convert import files
from depthba.convert.recording import Format
from depthba.errors import DatasetError, OptionError

_MODULES = (
    "tum_rgbd",
    "seven_scenes",
    "redwood",
    "nerfstudio",
    "bop",
    "scannet",
    "sens",
    "kitti",
    "colmap",
    "bags",
    "zed",
    "depth_folder",
    "cloud_folder",
)


def formats() -> tuple[Format, ...]:
    """Return all formats."""
    return tuple(_formats())


def named(name: str) -> Format:
    """Return the format of a name. `OptionError` lists the names there are."""
    for found in _formats():
        if found.name == name:
            return found
    choices = ", ".join(f.name for f in _formats())
    raise OptionError(f"no format {name!r}; choose from: {choices}")


def recognise(path: Path) -> Format:
    """Return the one format that a source is of, by what lies in it.

    Raises:
        DatasetError: there is no such source, or it is of none, or of several.

    """
    if not path.exists():
        raise DatasetError(f"{path}: no such file or folder")
    if (path / "result.json").is_file():
        raise DatasetError(f"{path}: a run of depthba, expected a dataset or another source")
    found = [(f, told) for f in _formats() if f.read is not None and (told := f.recognise(path))]
    specific = [row for row in found if not row[0].generic] or found
    if len(specific) == 1:
        return specific[0][0]
    if specific:
        could = " or ".join(f"{f.name} ({told})" for f, told in specific)
        raise DatasetError(f"{path}: could be {could}: say which with --kind")
    choices = ", ".join(f.name for f in _formats() if f.read is not None)
    raise DatasetError(
        f"{path}: {_unknown(path)}, expected a dataset or one of: {choices} (`depthba convert "
        "--list` says what lies in each)"
    )


def _unknown(path: Path) -> str:
    """Say what is there in place of a known source, and what it may have been meant as."""
    if path.is_file():
        if path.suffix.lower() in (*files.DEPTH_SUFFIXES, *files.COLOUR_SUFFIXES):
            return "one image, while a source is the folder of images and poses"
        return f"a file of no known kind ({path.suffix or 'without a suffix'})"
    try:
        there = sorted(path.iterdir())
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    if not there:
        return "an empty folder"
    folders = [p for p in there if p.is_dir()]
    for folder in (*folders, *(p for f in folders for p in sorted(f.iterdir()) if p.is_dir())):
        if images := files.listed(folder, files.DEPTH_SUFFIXES):
            return (
                f"nothing in it is known, but {images[0].relative_to(path)} is an image: depth "
                "images lie in the folder itself or in depth/, all in one"
            )
    for folder in (path / "depth", path):
        if images := files.listed(folder, files.COLOUR_SUFFIXES):
            return f"nothing in it is known: {images[0].name} is of a kind that holds no depth"
    names = ", ".join(p.name for p in there[:3]) + (", …" if len(there) > 3 else "")
    return f"nothing in it is known ({names})"


def _formats() -> Iterator[Format]:
    for name in _MODULES:
        module = import_module(f"depthba.convert.formats.{name}")
        yield from getattr(module, "FORMATS", None) or (module.FORMAT,)
