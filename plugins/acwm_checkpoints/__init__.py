"""Makes run folders of checkpoints that other programs wrote, with the importers of plugins."""
