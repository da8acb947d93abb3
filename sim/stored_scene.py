"""The scene that a dataset carries, which comes from wherever the dataset does.

An MJCF model may name files of the whole disk, and plugins. Here it has what lies beside it in the
dataset, and nothing else.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from depthba.errors import DatasetError

SCENE = Path("scene") / "scene.xml"
"""MJCF, relative to a dataset."""
_FOLDERS = ("meshdir", "texturedir", "assetdir")
_REFUSED = ("include", "model", "plugin", "extension", "attach")
"""Elements that bring in other models, or code."""
_LARGEST = 500_000_000
"""Bytes of a scene with all its files."""


def read(dataset: str | Path) -> tuple[str, dict[str, bytes]]:
    """Return the MJCF text of a dataset's scene, and the files that it names.

    The text is written anew from what was checked, so that no other reader sees another. Raises
    `DatasetError` where the scene names anything but files beside it.
    """
    path = Path(dataset) / SCENE
    home = path.parent.resolve()
    if home != Path(dataset).resolve() / SCENE.parent:
        raise DatasetError(f"{path.parent}: a link, expected a folder of the dataset")
    room = _LARGEST
    text = _bytes(path, home, room)
    room -= len(text)
    try:
        # A document type may bring in entities, of which a few lines make gigabytes.
        if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
            raise DatasetError(f"{path}: has a document type, expected an MJCF model without one")
        root = ElementTree.fromstring(text.decode("utf-8"))
    except (ElementTree.ParseError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: {error}, expected an MJCF model") from error
    files: dict[str, bytes] = {}
    for element in root.iter():
        if element.tag in _REFUSED:
            raise DatasetError(f"{path}: has <{element.tag}>, expected a model that stands alone")
        for key, value in element.attrib.items():
            if key in _FOLDERS and value:
                raise DatasetError(f"{path}: {key} is {value!r}, expected none")
            if not key.startswith("file") or not value or value in files:
                continue
            if Path(value).name != value or "\\" in value or value in (".", ".."):
                raise DatasetError(
                    f"{path}: names {value!r}, expected the name of a file beside it"
                )
            files[value] = _bytes(home / value, home, room)
            room -= len(files[value])
    return ElementTree.tostring(root, encoding="unicode"), files


def _bytes(path: Path, home: Path, room: int) -> bytes:
    """Read a file of the scene; DatasetError: it is none, a link, or too much."""
    try:
        if path.resolve().parent != home or not path.is_file():
            raise DatasetError(f"{path}: not a file of the scene, expected one beside it")
        if path.stat().st_size > room:
            raise DatasetError(f"{path}: too large, expected {_LARGEST / 1e6:.0f} MB in all")
        return path.read_bytes()
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: {error}") from error
