# %% [markdown]
# # Load a model and look at it

# %% [markdown]
# acwm ships a trained model of `push_cube`. It has 1.7 M parameters and predicts video of 64×64
# pixels. `acwm.load` takes the name of a model, a run folder or `hf://ORG/NAME`.

# %%
import gymnasium
import numpy as np
import torch
from PIL import Image

import acwm

recipe, card, world_model = acwm.load("push_cube")
print(card.summary)
print("actions:", card.action.names, "in", card.action.units)

# %% [markdown]
# ## One episode of the simulator
#
# Environments are Gymnasium environments. The behaviour policy is the policy that collects data.

# %%
env = gymnasium.make("acwm/push_cube-v0", size=64).unwrapped
frame, info = env.reset(seed=7)
policy = env.policy(np.random.default_rng(7))
frames, actions = [frame], []
for _ in range(36):
    actions.append(np.asarray(policy(), np.float32))
    frames.append(env.step(actions[-1])[0])
truth = torch.from_numpy(np.stack(frames)).permute(0, 3, 1, 2) / 255  # [T, 3, H, W] in [0, 1]

# %% [markdown]
# ## What the model predicts
#
# The model takes the first frame and the actions, one row per frame. No frame follows the last row.

# %%
rows = torch.from_numpy(np.stack([*actions, np.zeros_like(actions[0])]))
with torch.no_grad():
    prediction = world_model.rollout(truth[:1], rows[None])[0]


def psnr(video):
    """PSNR of each frame, in dB."""
    return -10 * torch.log10((video - truth).square().mean((1, 2, 3)) + 1e-8)


still = truth[:1].expand_as(truth)
print(f"prediction        {psnr(prediction)[1:].mean():.1f} dB")
print(f"first frame alone {psnr(still)[1:].mean():.1f} dB")

# %% [markdown]
# Every sixth frame, the truth above the prediction:

# %%
sheet = torch.cat([torch.cat([*video[::6]], 2) for video in (truth, prediction)], 1)
pixels = (sheet * 255).byte().permute(1, 2, 0).numpy()
picture = Image.fromarray(pixels).resize((pixels.shape[1] * 2, pixels.shape[0] * 2))
picture.save("demo.png")
picture

# %% [markdown]
# ## A small evaluation
#
# An evaluation predicts whole test episodes, in distribution and out of distribution, and writes
# scores and videos. `acwm report scores` turns them into a page. Here we use two episodes of each
# split, and leave out the slower tests that simulate other futures.

# %%
from acwm_core.data.generate import generate
from acwm_interventions.evaluate import evaluate_run

generate("push_cube", "few", episodes={"ind_test": 2, "ood_test": 2}, size=64, workers=0)
settings = {
    **{"counterfactual_episodes": 0, "perturbed_episodes": 0, "noise_floor_episodes": 1},
    "metrics": "[psnr,ssim,position_error,permanence]",
}
words = [f"evaluation.{name}={value}" for name, value in settings.items()]
summary = evaluate_run("push_cube", data="few", out="scores", overrides=words, progress=False)

# %%
for split, result in summary.splits.items():
    for row in ("model", "shuffled", "copy", "codec"):
        print(f"{split} {row:8} {result.scores.rows[row]['psnr'].value:.1f} dB")
