"""Datasets on disk, format version 1: open, write, resume and verify them."""

from depthba.dataset.faults import Fault
from depthba.dataset.model import Frame, Marker, StoredFile
from depthba.dataset.reading import Dataset, is_dataset
from depthba.dataset.sensor import HandEyeNoise, PoseNoise, Sensor
from depthba.dataset.verifying import verify
from depthba.dataset.writing import DatasetWriter

__all__ = [
    "Dataset",
    "DatasetWriter",
    "Fault",
    "Frame",
    "HandEyeNoise",
    "Marker",
    "PoseNoise",
    "Sensor",
    "StoredFile",
    "is_dataset",
    "verify",
]
