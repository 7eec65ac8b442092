"""Convert checkpoints of other programs to run folders, with the importers of plugins."""
