"""What tests ask of folders and of processes."""

import hashlib
import time
from pathlib import Path

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.shards import open_shard


def checksums(folder):
    """SHA-256 of every file of a data folder but its lock."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(Path(folder).rglob("*"))
        if path.is_file() and path.name != ".lock"
    }


def wait_until(condition, process=None, seconds=600):
    """Poll until something is so; `process`, if it is given, must not end before."""
    deadline = time.monotonic() + seconds
    while True:
        ended = process is not None and process.poll() is not None  # perhaps well, so ask first
        if condition():
            return
        assert not ended, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.005)


def damage_episode(data, split, index, member="video.mkv"):
    """Change a byte of one member of an episode; its shard's other episodes stay sound."""
    episodes = EpisodeDataset(data, split)
    number = episodes.shard_of(index)
    path, place = episodes.shard_path(number), index - episodes.shards[number][0]
    content = bytearray(path.read_bytes())
    content[open_shard(path).episodes[place][member].offset + 20] ^= 255
    path.write_bytes(content)
