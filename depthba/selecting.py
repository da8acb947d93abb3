"""What of a dataset takes part in a registration, by its options."""

from __future__ import annotations

from depthba.dataset import Dataset
from depthba.options import Options


def selected(dataset: Dataset, options: Options) -> Dataset:
    """Return the frames, pixels and depths that count; the region of interest has its own place.

    Raises:
        DatasetError: the mask does not fit the sensor.
        OptionError: an option makes no sense.

    """
    if options.every != 1:
        dataset = dataset.subsample(options.every)
    if options.depth_range is not None:
        dataset = dataset.crop(depths=options.depth_range)
    return dataset if options.mask is None else dataset.masked(options.mask)
