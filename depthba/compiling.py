"""How kernels are compiled.

All release the interpreter's lock; whole ones are kept on disk. A division by nothing is infinite,
as in NumPy: were it an error, as in Python, no loop that divides could become vector instructions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba as nb

# Sums may be reordered and products fused, but NaN and infinity stay what they are.
FAST = {"contract", "arcp", "reassoc", "nsz"}


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel whose arithmetic stays as it is written."""
    return _compiled(function, cache=True)


def fast(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel whose sums may be reordered: for vector instructions."""
    return _compiled(function, cache=True, fastmath=FAST)


def part(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a part of kernels, which becomes one with each of them.

    Were it left to the compiler whether it does, the copy that one kernel has of it could come to
    run in another, and a run from the disk's kernels differ in the last digits from the one that
    had compiled them.
    """
    return _compiled(function, forceinline=True)


def fast_part(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a part of kernels whose sums may be reordered."""
    return _compiled(function, forceinline=True, fastmath=FAST)


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a part of kernels that is copied into them as it is written."""
    return _compiled(function, inline="always")


def _compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    compiled = nb.njit(nogil=True, error_model="numpy", **options)(function)
    return compiled  # type: ignore[no-any-return]
