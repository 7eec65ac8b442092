"""Read untrusted files: bounded in memory and time, confined to their folder, never executed."""

from acwm_core.untrusted.files import check_folder, printable, read_bytes
from acwm_core.untrusted.json_values import parse_json, read_json, typed
from acwm_core.untrusted.parquet_values import most_values
from acwm_core.untrusted.yaml_values import MAX_YAML, PlainLoader

__all__ = [
    "MAX_YAML",
    "PlainLoader",
    "check_folder",
    "most_values",
    "parse_json",
    "printable",
    "read_bytes",
    "read_json",
    "typed",
]
