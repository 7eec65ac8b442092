"""Predictions of single clips, made without the code of the evaluation."""

import torch

from acwm_core.evaluation.clips import derangement, noise_seed


def true_clip(episode, start=0, frames=9):
    """Frames `[T, 3, H, W]` and actions `[T, A]` of a part of an episode."""
    end = start + frames
    video = torch.tensor(episode.video[start:end].transpose(0, 3, 1, 2) / 255).float()
    actions = torch.tensor(episode.actions[start:end]).clone()
    actions[-1] = 0
    return video, actions


def predictions(world_model, episodes, index, *, given=1, **settings):
    """The true first frames of episode `index` of a list, and each row's prediction of them."""
    video, actions = true_clip(episodes[index])
    donor = true_clip(episodes[derangement(len(episodes), 0)[index]])[1]
    donor[: given - 1] = actions[: given - 1]
    made = {
        "model": rollout(world_model, episodes[index], given=given, **settings),
        "shuffled": rollout(world_model, episodes[index], given=given, actions=donor, **settings),
        "copy": video[given - 1 : given].expand_as(video),
        "codec": world_model.codec(video[None])[0],
    }
    return video, made


def rollout(world_model, episode, *, start=0, frames=9, given=1, actions=None, **settings):
    """What a model with windows of nine frames predicts of a part of an episode."""
    video, own = true_clip(episode, start, frames)
    actions = own if actions is None else actions
    seeds = [noise_seed(0, episode.spec.split, episode.spec.index, start)]
    return world_model.rollout(
        video[None, :given], actions[None], window=9, seeds=seeds, **settings
    )[0]


def squared_error(made, true, first=0):
    """The mean from frame `first` on."""
    return (made.double() - true.double())[first:].square().mean().item()
