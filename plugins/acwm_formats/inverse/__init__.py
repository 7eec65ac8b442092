"""Actions read from videos: inverse dynamics, learnt from episodes whose actions were recorded."""
