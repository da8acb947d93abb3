"""Finding and loading the files of a source. `DatasetError` names the file and the fault."""

from __future__ import annotations

import codecs
import os
import re
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import bounds, documents
from depthba.dataset.faults import MalformedError
from depthba.dataset.images import png_chunks
from depthba.errors import DatasetError

Array = NDArray[np.float64]

OUTSIDE = "a file in it, or --outside where you know what it leads to"

DEPTH_SUFFIXES = (".png", ".pgm", ".tif", ".tiff", ".npy")
COLOUR_SUFFIXES = (".png", ".jpg", ".jpeg", ".ppm", ".bmp")


def in_order(files: Iterable[Path]) -> list[Path]:
    """Return files by the numbers in their names, so that 10 comes after 9."""

    def key(path: Path) -> list[tuple[int, int, str]]:
        words = re.split(r"(\d+)", path.name)
        return [(1, int(w), "") if w.isdecimal() else (0, 0, w) for w in words]

    return sorted(files, key=key)


def named(root: Path, name: str, where: Path, outside: bool) -> Path:
    """Return the file that a source names, below its folder.

    Args:
        root: the folder.
        name: as the source has it.
        where: the file of the source that has it.
        outside: whether it may lie outside of the folder.

    Raises:
        DatasetError: it does, and may not.

    """
    told = name if len(name) <= 80 else name[:77] + "…"
    try:
        path = root / name
        inside = path.resolve().is_relative_to(root.resolve())
    except (OSError, RuntimeError, ValueError) as error:  # too long, a loop of links, a NUL in it
        raise DatasetError(f"{where}: {told!r} is no name of a file") from error
    if not inside and not outside:
        raise DatasetError(f"{where}: {told!r} leads out of {root}, expected {OUTSIDE}")
    return path


def refuse_links_out(root: Path) -> None:
    """Refuse a source with a link in it that leads out of it. `DatasetError` names the link."""
    home = root.resolve()
    for folder, folders, names in os.walk(home):
        for name in (*folders, *names):
            path = Path(folder, name)
            if path.is_symlink() and not path.resolve().is_relative_to(home):
                raise DatasetError(f"{path}: a link out of {root}, expected {OUTSIDE}")


def listed(folder: Path, suffixes: Sequence[str], pattern: str = "*") -> list[Path]:
    """Return the files of a folder with one of the suffixes, in order; none where it is absent."""
    if not folder.is_dir():
        return []
    return in_order(p for p in folder.glob(pattern) if p.suffix.lower() in suffixes and p.is_file())


def text(path: Path) -> str:
    """Return a text file."""
    try:
        data = path.read_bytes()
        # Windows' shells write UTF-16 with a mark
        marked = data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
        return data.decode("utf-16" if marked else "utf-8-sig")
    except FileNotFoundError:
        raise DatasetError(f"{path}: no such file") from None
    except OSError as error:
        raise DatasetError(f"{path}: {error.strerror}, expected a readable file") from error
    except UnicodeDecodeError as error:
        raise DatasetError(
            f"{path}: byte {error.start} is not {error.encoding.upper()}, expected text"
        ) from error


def json_object(path: Path) -> dict[str, Any]:
    """Return the JSON object in a file."""
    try:
        value = documents.parse_json(text(path))
    except ValueError as error:
        raise DatasetError(f"{path}: not JSON: {error}") from error
    if not isinstance(value, dict):
        raise DatasetError(f"{path}: holds {type(value).__name__}, expected a JSON object")
    return value


def numbers(path: Path, *columns: int, row_limit: int | None = None) -> Array:
    """Return the rows (n, c) of a text file of numbers, c one of ``columns``; # is a comment."""
    rows: list[list[float]] = []
    for at, line in enumerate(text(path).splitlines(), 1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            rows.append([float(word) for word in words])
        except ValueError:
            raise DatasetError(f"{path}: line {at}: {line[:60]!r}, expected numbers") from None
        if len(words) not in columns or len(words) != len(rows[0]):
            expected = " or ".join(map(str, columns))
            raise DatasetError(
                f"{path}: line {at}: {len(words)} numbers, expected {expected} on every line"
            )
        if len(rows) == row_limit:
            break
    return np.array(rows, dtype=np.float64).reshape(len(rows), -1 if rows else columns[0])


def matrix(path: Path, rows: int = 4) -> Array:
    """Return the one matrix (4, 4) or (3, 4) that a text file holds, as (4, 4)."""
    M = numbers(path, 4, row_limit=rows)
    if len(M) == 3:
        M = np.vstack([M, [0, 0, 0, 1]])
    if M.shape != (4, 4):
        raise DatasetError(f"{path}: {len(M)} rows of 4 numbers, expected 4")
    return M


def depth_image(
    path: Path, scale: float, invalid: tuple[int, ...] = (), *, floats: bool = False
) -> Callable[[], Array]:
    """Return what loads a depth image as (height, width), m, NaN where nothing was measured.

    Args:
        path: an image of one channel, or .npy.
        scale: metres per unit.
        invalid: values beside 0 that are no measurement.
        floats: whether pixels may be floating-point numbers.

    """
    return partial(_load_depth, path, scale, invalid, floats)


def colour_image(path: Path) -> Callable[[], NDArray[np.uint8]]:
    """Return what loads a colour image as (height, width, 3), RGB."""
    return partial(_load_colour, path)


def colour_of(data: bytes, name: str) -> NDArray[np.uint8]:
    """Return the colour (height, width, 3), RGB, of a packed image. ``name`` is for the error."""
    import cv2

    image = decoded(data, cv2.IMREAD_COLOR, name, "a colour image")
    return np.ascontiguousarray(image[..., ::-1]).astype(np.uint8, copy=False)


def image_size(path: Path) -> tuple[int, int]:
    """Return the width and height of an image, pixels."""
    pixels = _pixels(path)
    return int(pixels.shape[1]), int(pixels.shape[0])


def _load_depth(path: Path, scale: float, invalid: tuple[int, ...], floats: bool) -> Array:
    pixels = _pixels(path)
    if pixels.ndim != 2:
        raise DatasetError(
            f"{path}: a picture of {pixels.shape[2]} channels of {pixels.dtype}, expected depth: "
            "one channel of 16 bits. Colour belongs into rgb/"
        )
    if pixels.dtype not in (np.uint16, np.uint32) and not (floats and pixels.dtype.kind == "f"):
        kinds = "16-bit" + (" or floating-point" if floats else "")
        lost = ": 8 bits hold a picture of it, export the depth itself"
        raise DatasetError(
            f"{path}: pixels of type {pixels.dtype}, expected {kinds} depth"
            f"{lost if pixels.dtype == np.uint8 else ''}"
        )
    gone = pixels <= 0
    if pixels.dtype.kind == "f":
        gone |= ~np.isfinite(pixels)
    z = pixels.astype(np.float64)
    z *= scale
    for value in invalid:
        gone |= pixels == value
    z[gone] = np.nan
    return np.asarray(z)


def _load_colour(path: Path) -> NDArray[np.uint8]:
    return colour_of(_bytes(path), str(path))


def _pixels(path: Path) -> NDArray[Any]:
    import cv2

    if path.suffix.lower() == ".npy":
        try:
            array = bounds.read_array(_bytes(path))
            array = array.squeeze(-1) if array.ndim == 3 and array.shape[2] == 1 else array
            if array.ndim != 2:
                raise ValueError(f"shape {array.shape}")
            bounds.check_pixels(*array.shape)
        except ValueError as error:
            raise DatasetError(f"{path}: {error}, expected an array of depth") from error
        return array
    return decoded(_bytes(path), cv2.IMREAD_UNCHANGED, str(path), "a depth image")


def decoded(data: bytes, how: int, name: str, what: str) -> NDArray[Any]:
    """Return the pixels of a packed image whose head was looked at before.

    Args:
        data: the file's bytes.
        how: a flag of `cv2.imdecode`.
        name: of the file, for the `DatasetError`.
        what: what is expected, for the `DatasetError`.

    """
    import cv2

    try:
        bounds.check_image(data)
        image = cv2.imdecode(np.frombuffer(data, np.uint8), how)
    except (ValueError, cv2.error) as error:
        raise DatasetError(f"{name}: {error}, expected {what}") from error
    if image is None:
        raise DatasetError(f"{name}: cannot be decoded, expected {what}")
    return np.asarray(image)


def _bytes(path: Path) -> bytes:
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise DatasetError(f"{path}: no such file, expected an image") from None
    except ValueError as error:  # a NUL in its name
        raise DatasetError(f"{str(path)!r}: {error}, expected an image") from error
    except OSError as error:
        raise DatasetError(f"{path}: {error.strerror}, expected a readable image") from error
    if not data:
        raise DatasetError(f"{path}: empty, expected an image")
    if path.suffix.lower() == ".png":  # the decoder would talk about it on stderr
        try:
            png_chunks(data)
        except MalformedError as error:
            raise DatasetError(f"{path}: {error}") from error
    return data
