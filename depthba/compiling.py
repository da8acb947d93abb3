"""How kernels are compiled.

All release the interpreter's lock and are kept on disk. A division by nothing is infinite, as in
NumPy: were it an error, as in Python, no loop that divides could become vector instructions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba as nb

# Sums may be reordered and products fused, but NaN and infinity stay what they are.
FAST = {"contract", "arcp", "reassoc", "nsz"}


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel whose arithmetic stays as it is written."""
    return _compiled(function)


def fast(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel whose sums may be reordered: for vector instructions."""
    return _compiled(function, fastmath=FAST)


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a part of kernels, each of which gets its own copy."""
    return _compiled(function, inline="always")


def _compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    compiled = nb.njit(cache=True, nogil=True, error_model="numpy", **options)(function)
    return compiled  # type: ignore[no-any-return]
