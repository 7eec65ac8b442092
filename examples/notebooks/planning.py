# %% [markdown]
# # Plan with a model

# %% [markdown]
# A planner imagines what many candidates of actions lead to, takes the first actions of the best
# one, looks at what really came of them, and plans again. Here it is the model of `reacher` that
# comes with acwm: an arm is to bring its fingertip to a marker.
#
# The small models that ship do not solve tasks reliably yet; this shows how to measure it.

# %%
from pathlib import Path

import gymnasium
import numpy as np
from PIL import Image

import acwm
from acwm_planning.run import Bench
from acwm_planning.settings import settings_of

# %% [markdown]
# ## A task
#
# A task draws goals and measures distances to them. With a task, an environment has rewards.

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
# The cross-entropy method with few candidates and six actions, so that it takes seconds. The cost
# compares imagined latents with those of the goal's picture.

# %%
words = ["planner=cem", "planner.candidates=24", "planner.iterations=2", "planner.elites=6"]
words += ["planner.horizon=2", "planner.action_block=4", "max_steps=12"]
bench = Bench(acwm.load("reacher"), "reach", settings_of(words))
played, controller = bench.play("model", seed=0)
decision = controller.decisions[0]
print(f"{len(controller.decisions)} decisions, success: {played.success}")
print(f"distance {played.distances[0]:.2f} m at the start, {played.distances[-1]:.2f} m in the end")

# %% [markdown]
# ## Beside others
#
# The same episode, played by random actions and by the script that solves the task.

# %%
for row in ("random", "solution"):
    other, _ = bench.play(row, seed=0)
    print(f"{row}: {other.distances[0]:.2f} → {other.distances[-1]:.2f} m")

# %%
bench.film(Path("films"), "model", 0, played, controller)
bench.close()

# %% [markdown]
# The film in the folder `films` shows what happened, what the model imagined, and the goal. On the
# command line, `acwm plan reacher reach --seeds 0..49 --compare` makes a table with intervals.
# Planners and costs of your own are plugins.
