"""What strangers hand in, or send as tasks: one sentence and exit code 2, in seconds."""

import contextlib
import io
import json
import os
import shutil
import socket
import struct
import zipfile
import zlib

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from acwm_benchmark.predictions import find_predictions
from acwm_benchmark.tasks import Tasks
from acwm_core.cli import main
from acwm_core.errors import DataError
from tests.benchmark.participant import WRITERS
from tests.formats import video_bombs

CLIP = "slide/ood_test-000002"
GREY = np.full((9, 32, 32, 3), 0.5, np.float32)


@pytest.fixture
def folder(tasks, tmp_path):
    """Grey predictions of all tasks, as NPZ, without that of one clip."""
    made = tmp_path / "predictions"
    (made / "slide").mkdir(parents=True)
    for task in Tasks(tasks).all:
        if task.id != CLIP:
            WRITERS["npz"](made / task.id, np.full((task.frames, 32, 32, 3), 0.5, np.float32))
    return made


def sentence(*words):
    """The one with which a command ends."""
    result = CliRunner().invoke(main, [str(word) for word in words])
    assert result.exit_code == 2, result.output
    assert result.stderr.count("\n") == 1
    return result.stderr


def npy(header, content=b"", version=1):
    size = struct.pack("<H" if version == 1 else "<I", len(header))
    return b"\x93NUMPY" + bytes([version, 0]) + size + header + content


def header(shape, dtype="|u1", rest=""):
    return f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}{rest}}}\n".encode()


def zipped(path, members, method=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)


SHAPE = "(9, 32, 32, 3)"
ARRAYS = {
    "10^15 frames": npy(header("(1000000000000000, 32, 32, 3)")),
    "10^15 numbers in a header that is right": npy(header("(9, 32, 32, 3000000000000)")),
    "negative": npy(header("(-1, 32, 32, 3)")),
    "objects": npy(header(SHAPE, "|O"), bytes(27648)),
    "records": npy(b"{'descr': [('a', '|u1')], 'fortran_order': False, 'shape': (9, 32, 32, 3)}\n"),
    "more than it says": lambda: npy(header(SHAPE), bytes(20_000_000)),
    "less than it says": npy(header(SHAPE), bytes(1000)),
    "header of zeros": lambda: npy(bytes(30_000_000), version=2),
    "header of brackets": npy(b"(" * 9000),
    "version 9": npy(header(SHAPE), version=9),
    "no array": b"GIF89a and nothing else",
    "nothing": b"",
}


@pytest.mark.parametrize("name", ARRAYS)
def test_arrays_that_lie(name, folder, tasks):
    content = ARRAYS[name]
    zipped(folder / f"{CLIP}.npz", {"video.npy": content() if callable(content) else content})
    said = sentence("score", folder, "--tasks", tasks)
    assert said.startswith(f"acwm: {CLIP}: ood_test-000002.npz")


def other_member(path):
    zipped(path, {"video": b"no array"})


def many_members(path):
    zipped(path, {f"{n}.npy": b"" for n in range(50_000)}, zipfile.ZIP_STORED)


def encrypted(path):
    zipped(path, {"video.npy": npy(header(SHAPE), bytes(27648))})
    data = bytearray(path.read_bytes())
    for mark, place in ((b"PK\x01\x02", 8), (b"PK\x03\x04", 6)):
        data[data.index(mark) + place] |= 1
    path.write_bytes(data)


@pytest.mark.parametrize("make", [other_member, many_members, encrypted], ids=lambda m: m.__name__)
def test_archives_that_lie(make, folder, tasks):
    make(folder / f"{CLIP}.npz")
    assert sentence("score", folder, "--tasks", tasks).startswith(f"acwm: {CLIP}: ood_test")


def gif(size, frames=1, duration=100):
    buffer = io.BytesIO()
    images = [Image.new("P", size, n % 256) for n in range(frames)]
    images[0].save(
        buffer, "gif", save_all=True, append_images=images[1:], duration=duration, loop=0
    )
    return buffer.getvalue()


def large_gif():
    """A screen of 32×32, then a picture of 60,000×60,000."""
    data = gif((32, 32))
    place = data.index(b"\x2c")
    large = data[place : place + 5] + struct.pack("<HH", 60_000, 60_000) + data[place + 9 :]
    return data[:place] + large


PICTURES = {
    "wide.gif": lambda: gif((3_000, 3_000)),
    "claims.gif": lambda: gif((32, 32))[:6] + struct.pack("<HH", 65535, 65535) + gif((32, 32))[10:],
    "large.gif": large_gif,
    "long.gif": lambda: gif((32, 32), duration=655_350),
    "many.gif": lambda: gif((32, 32), frames=3000),
    "samples.mp4": video_bombs.BOMBS["samples.mp4"],
    "fragment.mp4": video_bombs.BOMBS["fragment.mp4"],
    "edits.mp4": video_bombs.BOMBS["edits.mp4"],
    "ffv1.mkv": video_bombs.BOMBS["ffv1.mkv"],
    "raw.avi": video_bombs.BOMBS["raw.avi"],
    "playlist.mp4": lambda: b"#EXTM3U\nfile:///etc/passwd\n",
    "program.gif": lambda: b"%!PS\n{ } loop\n",
    "program.png": lambda: b"%!PS\n{ } loop\n",
}


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_that_lie(name, folder, tasks):
    suffix = name.rpartition(".")[2]
    path = folder / (f"{CLIP}/0.png" if suffix == "png" else f"{CLIP}.{suffix}")
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(PICTURES[name]())
    assert sentence("score", folder, "--tasks", tasks).startswith(f"acwm: {CLIP}: ")


def test_a_picture_that_claims_to_be_huge_is_not_unpacked(folder, tasks):
    (folder / CLIP).mkdir()
    for number in range(9):
        size = struct.pack(">II", 60_000, 60_000) + bytes([8, 2, 0, 0, 0])
        chunk = b"IHDR" + size
        sound = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk
        sound += struct.pack(">I", zlib.crc32(chunk))
        (folder / CLIP / f"{number}.png").write_bytes(sound)
    assert "60000×60000, not 32×32" in sentence("score", folder, "--tasks", tasks)


def a_link(path, other):
    path.symlink_to(other)


def a_pipe(path, _):
    os.mkfifo(path)


def a_device(path, _):
    path.symlink_to("/dev/zero")


def a_broken_link(path, _):
    path.symlink_to("nowhere.npz")


def a_circle(path, _):
    path.symlink_to(path.name)


def a_folder(path, other):
    path.parent.joinpath(path.stem).symlink_to(other.parent)


KINDS = [a_link, a_pipe, a_device, a_broken_link, a_circle, a_folder]


@pytest.mark.parametrize("make", KINDS, ids=lambda make: make.__name__)
def test_only_files_of_its_own_are_an_entrys(make, folder, tasks, tmp_path):
    theirs = tmp_path / "theirs" / "sound.npz"
    theirs.parent.mkdir()
    np.savez(theirs, video=GREY)
    make(folder / f"{CLIP}.npz", theirs)
    said = sentence("score", folder, "--tasks", tasks)
    assert "ood_test-000002" in said
    assert "is missing" not in said


@pytest.mark.parametrize("make", [a_link, a_pipe, a_device], ids=lambda make: make.__name__)
def test_nor_are_other_pictures(make, folder, tasks, tmp_path):
    WRITERS["png"](folder / CLIP, GREY)
    picture = folder / CLIP / "4.png"
    theirs = picture.rename(tmp_path / "theirs.png")
    make(picture, theirs)
    assert "4.png" in sentence("score", folder, "--tasks", tasks)


def test_the_folder_itself_may_be_a_link(folder, tasks, tmp_path):
    np.savez(folder / f"{CLIP}.npz", video=GREY)
    (tmp_path / "linked").symlink_to(folder)
    (world,) = Tasks(tasks).worlds()
    find_predictions(tmp_path / "linked", world, Tasks(tasks).of("slide")).check()


def a_socket(path, _):
    with contextlib.chdir(path.parent), socket.socket(socket.AF_UNIX) as made:
        made.bind(path.name)  # as a whole path may have 107 characters


def a_chain(path, other):
    """Links within the entry, of which the last leads out."""
    path.with_name(".one").symlink_to(other)
    path.with_name(".two").symlink_to(".one")
    path.symlink_to(".two")


def an_open_file(path, _):
    path.symlink_to("/proc/self/fd/0")


def a_round_trip(path, other):
    """A path that leaves the entry and comes back to another's file beside it."""
    path.symlink_to(f"../../{other.parent.name}/{other.name}")


def a_playlist(path, other):
    path.with_suffix(".mp4").write_text(f"#EXTM3U\n#EXTINF:1,\n{other}\n#EXT-X-ENDLIST\n")


def a_concatenation(path, other):
    path.with_suffix(".mkv").write_text(f"ffconcat version 1.0\nfile {other}\n")


OTHERS = [a_socket, a_chain, an_open_file, a_round_trip, a_playlist, a_concatenation]


@pytest.mark.parametrize("make", OTHERS, ids=lambda make: make.__name__)
@pytest.mark.parametrize("place", ["a prediction", "a picture", "the card"])
def test_nothing_else_is_read_in_the_place_of_a_file(place, make, folder, tasks, tmp_path):
    theirs = tmp_path / "theirs" / "sound.npz"
    theirs.parent.mkdir()
    np.savez(theirs, video=GREY)
    path = folder / f"{CLIP}.npz"
    if place == "a picture":
        WRITERS["png"](folder / CLIP, GREY)
        path = folder / CLIP / "9.png"
    elif place == "the card":
        np.savez(path, video=GREY)
        path = folder / "entry.yaml"
    make(path, theirs)
    if place == "the card" and path.suffix == ".yaml" and not os.path.lexists(path):
        return  # a video beside it is no card
    said = sentence("score", folder, "--tasks", tasks)
    assert ("entry.yaml" if place == "the card" else "ood_test-000002") in said


@pytest.mark.parametrize("make", [a_link, a_pipe, a_device, a_socket], ids=lambda m: m.__name__)
def test_the_folder_of_a_world_is_its_own(make, folder, tasks, tmp_path):
    np.savez(folder / f"{CLIP}.npz", video=GREY)
    theirs = (folder / "slide").rename(tmp_path / "theirs")
    make(folder / "slide", theirs)
    assert "slide" in sentence("score", folder, "--tasks", tasks)


def test_links_within_an_entry_are_its_own(folder, tasks, tmp_path):
    """A file, a picture, a folder of pictures, and the folder of a world."""
    (world,) = Tasks(tasks).worlds()
    given = Tasks(tasks).of("slide")
    np.savez(folder / f"{CLIP}.npz", video=GREY)
    (folder / "kept").mkdir()
    (folder / f"{CLIP}.npz").rename(folder / "kept" / "clip.npz")
    (folder / f"{CLIP}.npz").symlink_to("../kept/clip.npz")
    find_predictions(folder, world, given).check()
    (folder / f"{CLIP}.npz").unlink()
    WRITERS["png"](folder / "kept" / "pictures", GREY)
    (folder / CLIP).symlink_to("../kept/pictures")
    found = find_predictions(folder, world, given)
    found.check()
    assert len(found.checksum) == 64
    (folder / "slide").rename(folder / "elsewhere")
    (folder / "slide").symlink_to("elsewhere")
    find_predictions(folder, world, given).check()


def test_predictions_on_other_disks_are_asked_for(folder, tasks, tmp_path):
    (world,) = Tasks(tasks).worlds()
    given, away = Tasks(tasks).of("slide"), tmp_path / "disk"
    away.mkdir()
    np.savez(away / "clip.npz", video=GREY)
    (folder / f"{CLIP}.npz").symlink_to(away / "clip.npz")
    found = find_predictions(folder, world, given, follow_links=True)
    np.testing.assert_array_equal(found.video(CLIP), GREY)
    (folder / "slide").rename(away / "slide")
    (folder / "slide").symlink_to(away / "slide")
    find_predictions(folder, world, given, follow_links=True).check()
    for make in (a_pipe, a_device, a_socket, a_circle, a_broken_link):
        path = away / f"{CLIP}.npz"
        path.unlink()
        make(path, None)
        with pytest.raises(DataError, match="ood_test-000002"):
            find_predictions(folder, world, given, follow_links=True)


def laughs(levels=12):
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, levels)]
    return "\n".join(lines)


def merges(levels=30):
    lines = ["- &m0 {x: 1}"]
    lines += [f"- &m{n} {{<<: [*m{n - 1}, *m{n - 1}, *m{n - 1}]}}" for n in range(1, levels)]
    return "\n".join(lines)


CARDS = {
    "billion laughs": laughs(),
    "billion merges": merges(),
    "a circle": "name: &a [*a]",
    "deep": "name: " + "[" * 5000,
    "deep in blocks": "\n".join(" " * n + "a:" for n in range(2000)),
    "large": "data: " + "x" * 200_000,
    "a list": "- name: ours",
    "a text": "ours",
    "parameters: -5": "parameters: -5",
    "parameters of 400 digits": "parameters: " + "9" * 400,
    "parameters of 9999 digits": "parameters: " + "9" * 9999,
    "infinite": "parameters: .inf",
    "text for a number": "parameters: many",
    "no name": "name: ''",
    "a name of a page": "name: " + "x" * 5000,
    "characters of a terminal": 'name: "\\e[31mred"',
    "a script": "url: javascript:alert(1)",
    "code": "name: !!python/object/apply:os.system [ls]",
    "unknown": "size: 5",
    "no YAML": "name: [",
    "bytes": b"\xff\xfe\x00",
}


@pytest.mark.parametrize("name", CARDS)
def test_cards_that_are_refused(name, folder, tasks):
    np.savez(folder / f"{CLIP}.npz", video=GREY)
    card = CARDS[name]
    (folder / "entry.yaml").write_bytes(card if isinstance(card, bytes) else card.encode())
    assert "entry.yaml is not the card of an entry" in sentence("score", folder, "--tasks", tasks)


@pytest.mark.parametrize("make", [*KINDS[:-1], lambda path, _: path.mkdir()])
def test_a_card_is_a_file_of_its_own(make, folder, tasks, tmp_path):
    np.savez(folder / f"{CLIP}.npz", video=GREY)
    (tmp_path / "mine.yaml").write_text("name: Ours")
    make(folder / "entry.yaml", tmp_path / "mine.yaml")
    assert "entry.yaml" in sentence("score", folder, "--tasks", tasks)


@pytest.fixture
def ours(tasks, tmp_path):
    """A copy of the tasks, to be changed."""
    return shutil.copytree(tasks, tmp_path / "tasks")


def change(path, **values):
    content = json.loads(path.read_text())
    content["worlds"]["slide"] |= values
    path.write_text(json.dumps(content))


@pytest.mark.parametrize("name", ["../../evil", "/tmp/evil", "..", "a/b", "", "a\\b", "a\0b", "~"])
def test_a_worlds_name_decides_no_folder(name, folder, ours, tmp_path):
    change(ours / "benchmark.json", name=name)
    assert "cannot be the name of a world" in sentence("score", folder, "--tasks", ours)
    content = json.loads((ours / "benchmark.json").read_text())
    content["worlds"] = {name: content["worlds"]["slide"]}
    (ours / "benchmark.json").write_text(json.dumps(content))
    before = {*tmp_path.rglob("*")}
    sentence("score", folder, "--tasks", ours, "--out", tmp_path / "scores")
    assert {*tmp_path.rglob("*")} == before


TASKS = {
    "deep JSON": ("benchmark.json", "[" * 100_000),
    "deep objects": ("benchmark.json", '{"a":' * 100_000),
    "a deep line": ("index.jsonl", "[" * 100_000),
    "a number of 9999 digits": ("index.jsonl", "9" * 9999),
    "no UTF-8": ("index.jsonl", b"\xff\xfe"),
    "a list": ("benchmark.json", "[]"),
}


@pytest.mark.parametrize("name", TASKS)
def test_tasks_that_are_damaged(name, folder, ours):
    file, content = TASKS[name]
    (ours / file).write_bytes(content if isinstance(content, bytes) else content.encode())
    assert file in sentence("score", folder, "--tasks", ours)


@pytest.mark.parametrize("file", ["benchmark.json", "index.jsonl", f"{CLIP}.npz"])
@pytest.mark.parametrize("make", [a_link, a_pipe, a_device], ids=lambda make: make.__name__)
def test_tasks_are_files_of_their_own(make, file, folder, ours, tmp_path, truth):
    np.savez(folder / f"{CLIP}.npz", video=GREY)
    away = (ours / file).rename(tmp_path / "away")
    make(ours / file, away)
    sentence("score", folder, "--tasks", ours, "--data", truth, "--out", tmp_path / "scores")


def test_actions_that_lie(folder, ours, tmp_path, truth):
    np.savez(folder / f"{CLIP}.npz", video=GREY)
    for content in (npy(header("(1000000000000000, 1)", "<f4")), npy(header("(9, 1)", "<f4"))):
        zipped(ours / f"{CLIP}.npz", {"actions.npy": content})
        words = "score", folder, "--tasks", ours, "--data", truth, "--out", tmp_path / "scores"
        assert "ood_test-000002.npz" in sentence(*words)


def test_names_of_tasks_stay_in_their_folder(ours):
    lines = [json.loads(line) for line in (ours / "index.jsonl").read_text().splitlines()]
    for values in ({"id": "slide/../../x"}, {"id": "other/x"}, {"world": "other"}):
        changed = [lines[0] | values, *lines[1:]]
        (ours / "index.jsonl").write_text("\n".join(map(json.dumps, changed)))
        with pytest.raises(DataError, match=r"index\.jsonl is damaged"):
            Tasks(ours)
