"""A plugin on the path for one test."""

import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.catalog.installing import Install


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Put a distribution with one plugin module on the path, as pip would."""
    monkeypatch.syspath_prepend(str(tmp_path))
    written: list[str] = []

    def write(module: str, text: str, entry_point: str | None = None) -> None:
        written.append(module)
        hook = "from acwm_core.plugins import hookimpl\n"
        (tmp_path / f"{module}.py").write_text(hook + textwrap.dedent(text))
        info = tmp_path / f"{module}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[acwm]\n{entry_point or module} = {module}\n")

    yield write
    for module in written:
        sys.modules.pop(module, None)
