"""Reports: evaluated runs as a page, as tables and figures, compared, and gathered.

Free of torch, so that a report needs no more than the results. Import what you need from its
modules.
"""
