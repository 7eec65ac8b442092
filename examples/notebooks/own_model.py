# %% [markdown]
# # Your own model

# %% [markdown]
# A model predicts latent frames. This one is not a denoiser: a small convolutional network computes
# each latent frame from the previous one and the embedded actions. We train it with our own loop
# on a few episodes of `reacher`, a two-link arm.

# %%
import numpy as np
import torch
from torch import nn
from torch.nn import functional

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.model.build import build_world_model
from acwm_core.model.dynamics import Predictor
from acwm_core.plugins import catalog, hookimpl
from acwm_core.recipe import compose

torch.manual_seed(0)

# %% [markdown]
# ## The model
#
# A model that predicts without noise is a `Predictor` and only has to implement `forward`.
# `conditioning.modulation` holds one vector per latent frame: the actions that lead to it, embedded
# by the conditioner that the recipe names. How it learns is up to an objective: the one it is
# registered with, unless a recipe chooses another.


# %%
class NextFrame(Predictor):
    """Adds a change to each latent frame."""

    layers, heads, causal = 0, 1, True

    def __init__(self, *, latent_channels: int, width: int = 64):
        super().__init__()
        self.width = width
        self.read = nn.Conv2d(latent_channels, width, 3, padding=1)
        self.mix = nn.Conv2d(width, width, 3, padding=1)
        self.out = nn.Conv2d(width, latent_channels, 3, padding=1)

    def next(self, latent, modulation):
        """Compute the next latent frame, `[B, C, h, w]`."""
        hidden = functional.silu(self.read(latent) + modulation[:, :, None, None])
        return latent + self.out(functional.silu(self.mix(hidden)))

    def forward(self, given, conditioning, frames, generators=()):
        """Predict the latent frames of a clip after the given ones, `[B, L − K, C, h, w]`."""
        clip = [given[:, -1]]
        for frame in range(given.shape[1], frames):
            clip.append(self.next(clip[-1], conditioning.modulation[:, frame]))
        return torch.stack(clip[1:], 1)


class Plugin:
    """What the entry point of a package would point to."""

    @staticmethod
    @hookimpl
    def register_models(registry):
        target = f"{__name__}:NextFrame"
        registry.add("next_frame", target, summary="no noise", objective="regression")


catalog().add_plugin(Plugin(), "next_frame")

# %% [markdown]
# ## Data
#
# Twelve training episodes are far too few for a good model, but enough to see that it learns.

# %%
generate("reacher", "arm", episodes={"train": 12, "ind_test": 2}, size=64, workers=0)
train, test = EpisodeDataset("arm", "train"), EpisodeDataset("arm", "ind_test")


def tensors(episode, frames=25):
    """Video `[T, 3, H, W]` in [0, 1] and actions `[T, A]`."""
    video = torch.from_numpy(episode.video[:frames]).permute(0, 3, 1, 2) / 255
    return video, torch.from_numpy(episode.actions[:frames])


# %% [markdown]
# ## Build and train
#
# The recipe names the parts (codec, model, conditioner), and `build_world_model` creates them with
# matching sizes. The codec is frozen, so the latents are computed only once.

# %%
recipe = compose("reacher", ["+small", "model=next_frame", "model.width=96"])
world_model = build_world_model(recipe, train.card.environment)
clips = [tensors(episode) for episode in train]
latents = world_model.encode(torch.stack([video for video, _ in clips]))
actions = torch.stack([actions for _, actions in clips])

parameters = [p for p in world_model.parameters() if p.requires_grad]
optimizer = torch.optim.AdamW(parameters, lr=2e-3)
losses = []
for step in range(150):
    generators = [torch.Generator().manual_seed(step * len(clips) + k) for k in range(len(clips))]
    loss = world_model.loss(latents, actions, generators)
    optimizer.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(parameters, 1.0)
    optimizer.step()
    losses.append(loss.item())
print(f"loss {np.mean(losses[:5]):.3f} → {np.mean(losses[-5:]):.3f}")
assert np.mean(losses[-5:]) < 0.7 * np.mean(losses[:5])

# %% [markdown]
# ## Predict
#
# On an episode that it was not trained on:

# %%
video, moves = tensors(test[0])
with torch.no_grad():
    predicted = world_model.rollout(video[:1], moves[None])[0]
for name, shown in (("prediction", predicted), ("first frame alone", video[:1])):
    error = (shown - video)[1:].square().mean()
    print(f"{name}: {-10 * torch.log10(error):.1f} dB")

# %% [markdown]
# Put the class into a package (the guide "Write a model" shows how), and the command line
# trains it with all the other features of acwm: `acwm fit reacher +small model=next_frame`.
