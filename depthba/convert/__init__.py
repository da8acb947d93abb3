"""Other people's data in, other people's tools out: formats, conventions, results.

`importing` reads sources into datasets, `exporting` writes datasets and runs, `registry` knows the
formats, of which each has a module in `formats`.
"""

from depthba.convert.reading import Reading

__all__ = ["Reading"]
