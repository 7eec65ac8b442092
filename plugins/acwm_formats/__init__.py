"""Datasets: inspecting, checking and encoding them, and other formats to import and export."""
