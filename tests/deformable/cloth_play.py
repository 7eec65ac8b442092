"""Episodes of cloth_move for tests, drawn or not."""

import hashlib

import numpy as np

from acwm_core.episode import EpisodeSpec
from acwm_deformable.cloth_move import ClothMove, ClothMove8D

GROUND, SPHERE, CLOTH, HANDS = 0, 1, 2, (3, 4)


class Blind:
    """Without the cost of drawing."""

    def _render(self):
        return np.zeros((*self.frame_size, 3), np.uint8), np.zeros(self.frame_size, np.uint8)


class Unseen(Blind, ClothMove):
    pass


class Unseen8D(Blind, ClothMove8D):
    pass


def play(env, split="train", index=0, frames=None, look=None, **factors):
    """Frames, infos and actions of an episode of the policy; `look` is called in each frame."""
    spec = EpisodeSpec(env.card.name, split, index, factors=factors)
    frame, info = env.reset(options={"spec": spec})
    policy = env.policy(spec.rng("policy"))
    seen, infos, actions = [frame], [info], []
    for _ in range((frames or env.card.horizon) - 1):
        actions.append(np.asarray(policy(), np.float32))
        frame, _, _, _, info = env.step(actions[-1])
        seen.append(frame)
        infos.append(info)
        if look:
            look(env)
    return np.array(seen), infos, np.array(actions)


def begin(env, index=0, **factors):
    spec = EpisodeSpec(env.card.name, "train", index, factors=factors)
    return env.reset(options={"spec": spec})[1]["state"]


def states(infos, name):
    return np.array([info["state"][name] for info in infos])


def digest(env, index, frames=8):
    seen, infos, actions = play(env, index=index, frames=frames)
    state = [value.tobytes() for info in infos for value in info["state"].values()]
    masks = [info["mask"].tobytes() for info in infos]
    return hashlib.md5(b"".join([seen.tobytes(), actions.tobytes(), *state, *masks])).hexdigest()
