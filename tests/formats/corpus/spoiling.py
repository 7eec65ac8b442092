"""What may happen to one file of three."""

from tests.formats.corpus.cases import COUNT, three
from tests.formats.corpus.clips import Clip, write_clip


def _second(change):
    def spoil(place, path):
        if place == 1:
            change(path)

    spoil.__name__ = change.__name__
    return spoil


@_second
def empty(path):
    path.write_bytes(b"")


@_second
def cut_off(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@_second
def a_playlist(path):
    path.write_text("#EXTM3U\n#EXTINF:10,\n/etc/hostname\n")


@_second
def flipped_bytes(path):
    data = bytearray(path.read_bytes())
    start = data.find(b"mdat") + 8
    for place in range(start + 400, start + 700):
        data[place % len(data)] ^= 0xFF
    path.write_bytes(bytes(data))


@_second
def no_table(path):
    path.with_suffix(".csv").unlink()


@_second
def other_size(path):
    episode = three()[1]
    write_clip(path, episode.numbers, episode.times, 10, Clip(), (COUNT * 4, COUNT * 6))
