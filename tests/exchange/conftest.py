"""Fixtures of the tests of exchange."""

import hashlib

import pytest

from tests.exchange import release


@pytest.fixture(scope="session")
def published(tmp_path_factory):
    """One environment in the published layout and what its videos and actions were made of."""
    folder = tmp_path_factory.mktemp("release") / "rigid_dynamics" / "push_block"
    return folder, release.environment(folder)


def checksums(folder):
    """SHA-256 of every file of a data folder but its lock."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != ".lock"
    }
