# %% [markdown]
# # Your own recordings

# %% [markdown]
# From videos and tables to an evaluated model. The recordings are made here, without acwm: a
# Gymnasium pendulum is filmed at 15 frames per second, and a table beside each video has the
# torque of its motor and the time. This takes some minutes of a laptop's CPU, and
# `pip install pygame`, which draws the pendulum.

# %%
import csv
import os
import shlex
import subprocess
import sys
from pathlib import Path

import av
import gymnasium
import numpy as np
import torch
from PIL import Image

import acwm

# A quick check of this notebook, with fewer recordings and a model that learns nothing
QUICK = "QUICK" in os.environ
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # pygame opens no window

# %% [markdown]
# ## Record
#
# Your camera and your robot have already done this part. The pendulum starts at rest, and the
# torque of its motor changes in every frame. We hide the arrow with which Gymnasium shows it.


# %%
def swing(seed, frames=60):
    """Film the pendulum; returns its frames and the torque in each."""
    rng = np.random.default_rng(seed)
    env = gymnasium.make("Pendulum-v1", render_mode="rgb_array").unwrapped
    env.dt, env.max_torque, env.screen_dim = 1 / 15, 4.0, 128
    env.reset(seed=seed, options={"y_init": 0})
    film, torques, torque = [], [], 0.0
    for _ in range(frames):
        env.last_u = None
        film.append(env.render())
        torque = float(np.clip(0.8 * torque + rng.normal(0, 2), -4, 4))
        torques.append(torque)
        env.step([torque])
    return film, torques


def save(path, film, torques):
    """Write an mp4 file and a CSV file of the same name."""
    path.parent.mkdir(exist_ok=True)
    with av.open(path.with_suffix(".mp4"), "w") as file:
        stream = file.add_stream("libx264", rate=15)
        stream.width, stream.height = film[0].shape[1], film[0].shape[0]
        for frame in film:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(frame)))
        file.mux(stream.encode())
    with path.with_suffix(".csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time", "torque"])
        writer.writerows((f"{i / 15:.4f}", f"{torque:.3f}") for i, torque in enumerate(torques))


# %% [markdown]
# We use two cameras. The second one delivers each picture one frame late, as cheap ones do.

# %%
takes = 20 if QUICK else 80
for take in range(takes):
    film, torques = swing(take)
    save(Path("takes", f"take {take:03d}"), film, torques)
    if take < takes / 2:
        save(Path("late", f"take {take:03d}"), [film[0], *film[:-1]], torques)
sorted(path.name for path in Path("takes").iterdir())[:4]

# %% [markdown]
# ## Import
#
# `run("data import …")` does what `acwm data import …` does in a terminal.


# %%
def run(words):
    """Run a command of acwm, and print what it says."""
    command = [sys.executable, "-m", "acwm_core.cli", *shlex.split(words)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program:
        for line in program.stdout:
            print(line, end="")
    assert program.returncode == 0


run("data import videos takes --size 64 --out data/pendulum")

# %% [markdown]
# The marked lines are the short form of `acwm data report data/pendulum`. The one about actions
# matters most: the video follows them without delay. Repeated frames occur where the pendulum
# reverses.
#
# ## A camera with a delay
#
# Now the second camera. Its files are valid, but the effect of an action appears one frame late.

# %%
run("data import videos late --size 64 --out data/late")

# %% [markdown]
# The delay is detected, and `--shift 1` moves each action to the frame where it belongs.

# %%
run("data import videos late --size 64 --shift 1 --out data/repaired")

# %% [markdown]
# ## Train
#
# The recipe `small` trains on a laptop's CPU, in 3,000 steps.

# %%
steps = "trainer.max_steps=2" if QUICK else ""
run(f"fit small data.path=data/pendulum {steps} --out runs/pendulum")

# %% [markdown]
# ## Evaluate
#
# Test recordings are predicted from their first frame, with their own actions and with those of
# another recording. A model that uses its actions is worse with the latter.

# %%
few = "evaluation.episodes=2 evaluation.frames=17 evaluation.videos=0" if QUICK else ""
run(f"evaluate runs/pendulum {few}")

# %%
from acwm_report.run import EvaluatedRun

EvaluatedRun.read(Path("runs/pendulum"), "pendulum").verdict

# %% [markdown]
# `acwm report runs/pendulum` writes a page with videos, and `acwm play runs/pendulum` lets you
# drive the model. Here is a test recording, every sixth frame: what happened, what the model
# predicts, and what it predicts if the motor turns the other way.

# %%
recipe, card, world_model = acwm.load("runs/pendulum")
episode = acwm.EpisodeDataset("data/pendulum", "ind_test")[0]
truth = torch.from_numpy(episode.video).permute(0, 3, 1, 2) / 255  # [T, 3, H, W] in [0, 1]
actions = torch.from_numpy(episode.actions)  # a row leads from each frame to the next
with torch.no_grad():
    videos = world_model.rollout(truth[[0, 0]], torch.stack([actions, -actions]))

sheet = torch.cat([torch.cat([*video[:55:6]], 2) for video in (truth, *videos)], 1)
pixels = (sheet * 255).byte().permute(1, 2, 0).numpy()
Image.fromarray(pixels).resize((pixels.shape[1] * 2, pixels.shape[0] * 2))
