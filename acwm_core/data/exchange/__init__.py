"""Datasets of other formats: importers, exporters, and `write_dataset` for a format of your own."""

from acwm_core.data.exchange.importing import import_dataset, write_dataset
from acwm_core.data.exchange.recording import Recording
from acwm_core.data.exchange.source import Source

__all__ = ["Recording", "Source", "import_dataset", "write_dataset"]
