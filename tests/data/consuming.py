"""Consumers of clips that keep a log and a checkpoint, and are killed until they have finished.

python consuming.py DATA OUT KILLS: run after run, each in a folder of its own below OUT, until
KILLS processes were killed by SIGKILL at random moments. A process takes a few milliseconds to
start, because it is forked from this one, which has imported torch.
"""

import contextlib
import json
import os
import random
import signal
import sys
import time
import zlib
from pathlib import Path

import torch

from acwm_core.data.atomic import written_whole
from acwm_core.data.episodes import ClipDataset, EpisodeDataset
from acwm_core.data.loader import ResumableLoader

STEPS, BATCH, SAVE_EVERY = 40, 5, 3
FRAMES, STRIDE = 9, 4


def checksum(video, actions):
    """CRC-32 of a clip."""
    return zlib.crc32(actions.numpy().tobytes(), zlib.crc32(video.numpy().tobytes()))


def workers_of(run):
    """Every fourth run loads with workers."""
    return 2 if run % 4 == 0 else 0


def consume(data, folder, run):
    """Take the batches of a run from its last checkpoint on; log them, checkpoint now and then."""
    clips = ClipDataset(EpisodeDataset(data, "train"), frames=FRAMES, stride=STRIDE)
    workers = workers_of(run)
    loader = ResumableLoader(clips, batch_size=BATCH, seed=run, workers=workers)
    if workers:
        loader._loader.multiprocessing_context = "fork"  # spawned ones import torch for seconds
    step, saved = 0, folder / "state.json"
    if saved.exists():
        state = json.loads(saved.read_text())
        step = state["step"]
        loader.load_state_dict(state["loader"])
    log = os.open(folder / "log", os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    while step < STEPS:
        for batch in loader:
            clips = [*map(checksum, batch["video"], batch["actions"])]
            os.write(log, f"{json.dumps([step, clips])}\n".encode())
            step += 1
            if step % SAVE_EVERY == 0:
                with written_whole(saved) as partial:
                    partial.write_text(json.dumps({"step": step, "loader": loader.state_dict()}))
            if step == STEPS:
                break


def live(data, folder, run, rng):
    """One process of a run; whether it was killed before it had finished."""
    pid = os.fork()
    if not pid:
        os.setsid()
        try:
            consume(data, folder, run)
            os._exit(0)
        except BaseException as error:
            (folder / "error").write_text(repr(error))
            os._exit(1)
    log = folder / "log"
    before = log.stat().st_size if log.exists() else 0
    target = before + rng.randrange(600)  # some batches later; one takes about 60 bytes
    until = time.monotonic() + 10
    while (log.stat().st_size if log.exists() else 0) < target and time.monotonic() < until:
        if os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            break
        time.sleep(0.0005)
    time.sleep(rng.random() * 0.004)
    os.kill(pid, signal.SIGKILL)
    killed = os.WIFSIGNALED(os.waitpid(pid, 0)[1])
    with contextlib.suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)  # its workers would notice within seconds
    return killed


def main(data, out, kills):
    """Runs until enough processes were killed; the last run is finished, too."""
    torch.set_num_threads(1)
    rng, killed, run = random.Random(0), 0, 0
    while killed < kills:
        folder = out / f"run-{run}"
        folder.mkdir()
        while live(data, folder, run, rng):
            killed += 1
        run += 1
    (out / "killed").write_text(str(killed))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))
