"""Reports: evaluated runs as a page, as tables and figures, compared, and gathered; no torch."""
