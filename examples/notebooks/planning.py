# %% [markdown]
# # Plan with a model

# %% [markdown]
# A planner predicts the outcome of many candidate action sequences, executes the first actions of
# the best one, observes the result, and plans again. Here it uses the `reacher` model that ships
# with acwm: an arm has to bring its fingertip to a marker.
#
# The small models that ship do not solve tasks reliably yet; this shows how to measure it.

# %%
from pathlib import Path

import gymnasium
import numpy as np
from PIL import Image

import acwm
from acwm_planning.run import EpisodePlayer
from acwm_planning.settings import settings_of

# %% [markdown]
# ## A task
#
# A task samples goals and measures the distance to them. With a task, an environment has rewards.

# %%
env = gymnasium.make("acwm/reacher-v0", task="reach", size=64)
frame, info = env.reset(seed=0)
goal = info["goal"]
picture = Image.fromarray(np.concatenate([frame, goal.frame], 1)).resize((384, 192))
picture.save("goal.png")
picture  # the start, and the goal

# %% [markdown]
# ## Plan
#
# We use the cross-entropy method with few candidates and a short episode, so that it takes seconds.
# The cost compares predicted latents with the latent of the goal image.

# %%
words = ["planner=cem", "planner.candidates=24", "planner.iterations=2", "planner.elites=6"]
words += ["planner.horizon=2", "planner.action_block=4", "max_steps=12"]
bench = EpisodePlayer(acwm.load("reacher"), "reach", settings_of(words))
played, controller = bench.play("model", seed=0)
decision = controller.decisions[0]
print(f"{len(controller.decisions)} decisions, success: {played.success}")
print(f"distance {played.distances[0]:.2f} m at the start, {played.distances[-1]:.2f} m in the end")

# %% [markdown]
# ## Compare with baselines
#
# The same episode with random actions, and with the script that solves the task:

# %%
for row in ("random", "solution"):
    other, _ = bench.play(row, seed=0)
    print(f"{row}: {other.distances[0]:.2f} → {other.distances[-1]:.2f} m")

# %%
bench.write_video(Path("videos"), "model", 0, played, controller)
bench.close()

# %% [markdown]
# The video in the folder `videos` shows what happened, what the model predicted, and the goal. On
# the command line, `acwm plan reacher reach --seeds 0..49 --compare` prints a table with confidence
# intervals. You can add your own planners and costs as plugins.
