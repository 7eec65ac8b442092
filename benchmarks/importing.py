"""Speed and memory of an import of videos, beside PyAV that only decodes them, and a kill.

    python benchmarks/importing.py
    python benchmarks/importing.py --recordings 10000 --size 64x64

Writes recordings (H.264 in MP4 and a CSV each), decodes all of them with PyAV alone in as many
processes as the import has, and imports a quarter of them and all of them. CPU seconds are those of
all processes together, and compare better than seconds do if the machine is busy. Memory is the
largest sum over all processes at a moment. Then the import of the quarter is killed by SIGKILL half
way, run again, and its bytes are compared with those of the one that was not killed.
"""

from __future__ import annotations

import concurrent.futures
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import av
import click
import numpy as np

FRAMES = 100
DIFFERENT = 20
"""Number of different videos; the others are copies."""

IMPORT = """
import sys
from acwm_formats.recordings import import_dataset
from acwm_formats.videos import Videos
source, out, workers = sys.argv[1:]
import_dataset(Videos().read(source), out, workers=int(workers), progress=False)
"""
DECODE = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from importing import decode_all
decode_all(sys.argv[1], int(sys.argv[2]))
"""


class Cost(NamedTuple):
    """What a command took.

    Attributes:
        seconds: from its start to its end.
        cpu: seconds of all its processes together.
        memory: most bytes that they held at once, those of shared pages counted in each.
        status: its exit status.
    """

    seconds: float
    cpu: float
    memory: int
    status: int


def write_recordings(folder: Path, count: int, height: int, width: int) -> None:
    """Write videos of a disc that moves before a textured wall, with its way as actions."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[:height, :width]
    for index in range(count):
        path = folder / f"take_{index:05d}.mp4"
        if index >= DIFFERENT:
            for ending in (".mp4", ".csv"):
                shutil.copy(
                    folder / f"take_{index % DIFFERENT:05d}{ending}", path.with_suffix(ending)
                )
            continue
        wall = rng.uniform(60, 200, (height // 8, width // 8, 3)).repeat(8, 0).repeat(8, 1)
        place, lines = np.array([height, width]) / 2, ["x,y"]
        with av.open(str(path), "w") as file:
            stream: Any = file.add_stream("libx264", rate=30)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            for _ in range(FRAMES):
                image = wall + rng.normal(0, 3, wall.shape)
                image[np.hypot(rows - place[0], columns - place[1]) < height / 8] = 240
                frame = av.VideoFrame.from_ndarray(image.clip(0, 255).astype(np.uint8))
                file.mux(stream.encode(frame))
                step = rng.uniform(-2, 2, 2)
                place = (place + step).clip(0, [height, width])
                lines.append(f"{step[1]:.4f},{step[0]:.4f}")
            file.mux(stream.encode(None))
        path.with_suffix(".csv").write_text("\n".join(lines))


def decode_all(folder: str, processes: int) -> None:
    """Decode every frame of every video to RGB with PyAV, one thread a process.

    Frames become arrays as PyAV's documentation has it; a `VideoReformatter` for all frames of a
    video, which the import has, is faster.
    """
    paths = sorted(Path(folder).glob("*.mp4"))
    parts = [paths[place::processes] for place in range(processes)]
    with concurrent.futures.ProcessPoolExecutor(processes) as pool:
        count = sum(pool.map(_decode, parts))
    assert count == FRAMES * len(paths), count


def _decode(paths: Sequence[Path]) -> int:
    count = 0
    for path in paths:
        with av.open(str(path)) as file:
            file.streams.video[0].codec_context.thread_count = 1
            count += sum(
                len(frame.to_ndarray(format="rgb24")) > 0 for frame in file.decode(video=0)
            )
    return count


def measured(words: Sequence[str], stop: Any = None) -> Cost:
    """Run Python with `words`; kill all its processes as soon as `stop()` is true."""
    cpu: dict[int, float] = {}
    most = 0
    started = time.perf_counter()
    process = subprocess.Popen([sys.executable, *words], start_new_session=True)
    while process.poll() is None:
        held = 0
        for number, seconds, memory in _processes(process.pid):
            cpu[number] = seconds
            held += memory
        most = max(most, held)
        if stop is not None and stop():
            process.send_signal(signal.SIGKILL)
        time.sleep(0.05)
    return Cost(time.perf_counter() - started, sum(cpu.values()), most, process.returncode)


def _processes(session: int) -> list[tuple[int, float, int]]:
    """Number, CPU seconds and bytes of memory of the processes of a session."""
    found: list[tuple[int, float, int]] = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            words = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue  # it has just ended
        if int(words[3]) == session:
            ticks = (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
            memory = int(words[21]) * os.sysconf("SC_PAGE_SIZE")
            found.append((int(path.parent.name), ticks, memory))
    return found


def digest(folder: Path) -> str:
    """Of the names and bytes of all files of a dataset."""
    found = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        if not path.relative_to(folder).as_posix().startswith("."):
            found.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return found.hexdigest()


def imported(source: Path, out: Path, workers: int, stop: Any = None) -> Cost:
    """Import `source` into `out`."""
    return measured(["-c", IMPORT, str(source), str(out), str(workers)], stop)


def compare(folder: Path, recordings: int, size: tuple[int, int], workers: int) -> dict[str, Any]:
    """Measure one size of frames; see the top of this file."""
    few, all_of_them = folder / "quarter", folder / "all"
    write_recordings(all_of_them, recordings, *size)
    shutil.copytree(all_of_them, few)
    for path in sorted(few.iterdir())[2 * (recordings // 4) :]:
        path.unlink()
    alone = measured(["-c", DECODE, str(all_of_them), str(max(workers, 1))])
    quarter = imported(few, folder / "out_quarter", workers)
    whole = imported(all_of_them, folder / "out_all", workers)
    assert alone.status == quarter.status == whole.status == 0
    staged = folder / "out_killed" / ".importing"
    killed = imported(
        few,
        folder / "out_killed",
        workers,
        lambda: staged.exists() and len(list(staged.glob("*.zip"))) >= recordings // 8,
    )
    again = imported(few, folder / "out_killed", workers)
    frames = recordings * FRAMES
    return {
        "size": f"{size[0]}×{size[1]}",
        "recordings": recordings,
        "decoded per second": round(frames / alone.seconds),
        "imported per second": round(frames / whole.seconds),
        "ratio": round(alone.seconds / whole.seconds, 3),
        "ratio of CPU seconds": round(alone.cpu / whole.cpu, 3),
        "CPU ms per frame": round(1e3 * whole.cpu / frames, 3),
        "MB": [round(each.memory / 1e6) for each in (quarter, whole)],
        "killed": killed.status == -signal.SIGKILL,
        "seconds after the kill": [round(quarter.seconds, 1), round(again.seconds, 1)],
        "same bytes": digest(folder / "out_quarter") == digest(folder / "out_killed"),
    }


def _size(text: str) -> tuple[int, int]:
    height, width = map(int, text.split("x"))
    return height, width


@click.command(help=(__doc__ or "").partition("\n")[0])
@click.option("--recordings", default=400, show_default=True, help=f"Of {FRAMES} frames each.")
@click.option("--size", "sizes", multiple=True, default=["64x64", "240x320"], show_default=True)
@click.option("--workers", default=len(os.sched_getaffinity(0)), show_default=True)
@click.option(
    "--folder", type=click.Path(path_type=Path), help="For the files; removed at the end."
)
def main(recordings: int, sizes: Sequence[str], workers: int, folder: Path | None) -> None:
    """Print a line of JSON per size."""
    for size in sizes:
        with tempfile.TemporaryDirectory(dir=folder) as made:
            found = compare(Path(made), recordings, _size(size), workers)
            click.echo(json.dumps(found, ensure_ascii=False))


if __name__ == "__main__":
    main()
