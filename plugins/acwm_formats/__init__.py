"""Datasets in other formats: importers, exporters, and `arrays` for recordings in Python."""
