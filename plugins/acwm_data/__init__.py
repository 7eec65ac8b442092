"""Inspects, checks, imports, exports and encodes datasets."""
