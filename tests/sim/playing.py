"""Playing episodes of any world for tests, drawn or not."""

import numpy as np

from acwm_core.env.episode import EpisodeSpec


def undrawn(world):
    """The class of a world, without the cost of drawing."""

    class Undrawn(world):
        def _render(self):
            return np.zeros((*self.frame_size, 3), np.uint8), np.zeros(self.frame_size, np.uint8)

    return Undrawn


def start(env, split="train", index=0, **factors):
    """The first frame and info of an episode."""
    return env.reset(options={"spec": EpisodeSpec(env.card.name, split, index, factors=factors)})


def play(env, split="train", index=0, frames=None, look=None, **factors):
    """Frames, infos and actions of an episode of the policy; `look` is called in each frame."""
    frame, info = start(env, split, index, **factors)
    policy = env.policy(EpisodeSpec(env.card.name, split, index).rng("policy"))
    seen, infos, actions = [frame], [info], []
    for _ in range((frames or env.card.horizon) - 1):
        actions.append(np.asarray(policy(), np.float32))
        frame, _, _, _, info = env.step(actions[-1])
        seen.append(frame)
        infos.append(info)
        if look:
            look(env)
    return np.array(seen), infos, np.array(actions)


def states(infos, name):
    """A state of every frame."""
    return np.array([info["state"][name] for info in infos])
