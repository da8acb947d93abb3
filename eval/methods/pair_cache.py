"""Arrays kept in files, so that several methods, and processes, make them once."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import durable

Arrays = Mapping[str, NDArray[Any]]


def digest(array: NDArray[Any]) -> str:
    """Return what tells an array from any other, in hex."""
    kind = f"{array.dtype.str} {array.shape} ".encode()
    return hashlib.sha256(kind + np.ascontiguousarray(array).tobytes()).hexdigest()


class Cache:
    """Arrays by key in a folder; a missing folder is made, and None keeps nothing.

    A key is whatever JSON can say: all that the arrays depend on.
    """

    def __init__(self, folder: Path | None) -> None:
        """Use ``folder``."""
        self.folder = folder

    def get(self, kind: str, key: object, expected: Mapping[str, tuple[str, int]]) -> Arrays | None:
        """Return what was kept, or None where there is nothing, or nothing that is whole.

        Args:
            kind: the first part of the file's name.
            key: of the arrays.
            expected: by name the kind of numbers, as in ``dtype.kind``, and the dimensions.

        """
        if self.folder is None:
            return None
        text = _text(key)
        try:
            with np.load(self._path(kind, text), allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None
        # Another program's file, or one key's file under another one's name
        if set(arrays) != {"key", *expected} or str(arrays.pop("key")) != text:
            return None
        for name, (number, dimensions) in expected.items():
            if arrays[name].dtype.kind != number or arrays[name].ndim != dimensions:
                return None
        return arrays

    def put(self, kind: str, key: object, arrays: Arrays) -> str:
        """Keep arrays; return "", or why they could not be kept, which harms nobody."""
        if self.folder is None:
            return ""
        text = _text(key)
        data = io.BytesIO()
        np.savez(data, allow_pickle=False, key=np.array(text), **arrays)
        try:
            durable.make_folder(self.folder)
            durable.write_bytes(self._path(kind, text), data.getvalue())
        except OSError as error:
            return str(error)
        return ""

    def _path(self, kind: str, text: str) -> Path:
        assert self.folder is not None
        return self.folder / f"{kind}-{hashlib.sha256(text.encode()).hexdigest()[:32]}.npz"


def _text(key: object) -> str:
    return json.dumps(key, sort_keys=True)
