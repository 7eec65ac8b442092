"""Train a small policy inside a world model, and score it in the true simulator.

    python examples/train_in_dream.py reacher reach
    python examples/train_in_dream.py runs/mine place --iterations 20 --seed 1

The policy is a single layer. Its inputs are the states that an estimator reads from the predicted
frames, and their differences from the goal; its output is an action. The cross-entropy method finds
the weights: candidates act in dreams with the same start, the best are kept, and the next ones are
drawn around them. The simulator only provides first frames and goals, and the score at the end.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

import acwm

SPLIT = "ind_test"
"""Split of the episodes that the policy is scored on. It is trained on other episodes."""


@dataclass(frozen=True)
class Policy:
    """``tanh(W · features)``, scaled to the bounds of the action."""

    space: gymnasium.spaces.Box  # space of an action `[A]`
    fields: tuple[str, ...]  # names of the state fields that the policy sees

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of an action."""
        return self.space.low.shape

    def act(
        self, weights: np.ndarray, state: Mapping[str, Any], goal: Mapping[str, Any]
    ) -> np.ndarray:
        """Actions `[N, A]` for weights `[N, A · F]` and state fields `[N, …]`."""
        seen = self.features(state, goal)
        layer = weights.reshape(len(seen), *self.shape, -1)
        middle, half = self.space.high + self.space.low, self.space.high - self.space.low
        made = (middle + half * np.tanh(np.einsum("naf,nf->na", layer, seen))) / 2
        return np.clip(made, self.space.low, self.space.high).astype(np.float32)

    def features(self, state: Mapping[str, Any], goal: Mapping[str, Any]) -> np.ndarray:
        """Inputs of the policy, `[N, F]`: each field, its difference from the goal, and 1."""
        here = [np.asarray(state[name], np.float64) for name in self.fields]
        there = [np.asarray(goal[name]) for name in self.fields]
        away = [wanted - found for wanted, found in zip(there, here, strict=True)]
        rows = [each.reshape(len(each), -1) for each in (*here, *away)]
        rows.append(np.ones((len(rows[0]), 1)))
        return np.nan_to_num(np.concatenate(rows, 1))  # values that cannot be read become 0


def dreamt_returns(
    envs: gymnasium.vector.VectorEnv, policy: Policy, weights: np.ndarray, seed: int
) -> np.ndarray:
    """The return `[N]` of each candidate's weights, in dreams that share one start."""
    alike: Any = [seed] * envs.num_envs  # Gymnasium allows this, though its types do not say so
    _, info = envs.reset(seed=alike)
    goal = stacked(info["goal"])
    running, returns = np.ones(envs.num_envs, bool), np.zeros(envs.num_envs)
    while running.any():
        _, rewards, solved, late, info = envs.step(policy.act(weights, info["state"], goal))
        returns += np.where(running, rewards, 0.0)
        running &= ~(solved | late)  # a restarted episode does not count
    return returns


def stacked(goals: Sequence[Any]) -> dict[str, np.ndarray]:
    """The state fields of goals, `[N, …]` each."""
    return {name: np.stack([goal.state[name] for goal in goals]) for name in goals[0].state}


def train(
    envs: gymnasium.vector.VectorEnv, policy: Policy, *, iterations: int, starts: int, seed: int
) -> np.ndarray:
    """Find weights `[A · F]` that do well in dreams, with the cross-entropy method."""
    rng = np.random.default_rng(seed)
    _, info = envs.reset(seed=seed)
    size = policy.features(info["state"], stacked(info["goal"])).shape[1] * policy.shape[0]
    mean, deviation = np.zeros(size), np.ones(size)
    for iteration in range(iterations):
        weights = mean + deviation * rng.normal(size=(envs.num_envs, size))
        weights[0] = mean
        seeds = rng.integers(2**31, size=starts)
        returns = np.mean([dreamt_returns(envs, policy, weights, int(s)) for s in seeds], 0)
        best = weights[np.argsort(returns)[-max(2, envs.num_envs // 5) :]]
        mean, deviation = best.mean(0), best.std(0) + 0.2 * 0.8**iteration
        print(f"{iteration + 1}: return of the mean {returns[0]:.3g}, best {returns.max():.3g}")
    return mean


def true_scores(
    env: gymnasium.Env, policy: Policy, weights: np.ndarray, repeat: int, episodes: int
) -> tuple[float, float]:
    """Mean return and success rate in the true simulator; actions are held as in the dream."""
    returns, wins = 0.0, 0
    for seed in range(episodes):
        _, info = env.reset(seed=seed, options={"split": SPLIT})
        goal, over = stacked([info["goal"]]), False
        while not over:
            state = {name: info["state"][name][None] for name in policy.fields}
            (action,) = policy.act(weights[None], state, goal)
            for _ in range(repeat):
                _, reward, solved, late, info = env.step(action)
                returns += float(reward)
                if over := solved or late:
                    break
        wins += bool(info["success"])
    return returns / episodes, wins / episodes


def main(words: Sequence[str] | None = None) -> dict[str, tuple[float, float]]:
    """Train, and print the true scores before and after.

    Returns:
        Mean return and success rate, of the untrained and of the trained policy.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=_Plain)
    parser.add_argument("run", help="a run folder, or the name of a trained model")
    parser.add_argument("task", help="a task of its environment")
    parser.add_argument("--iterations", type=int, default=12)
    parser.add_argument("--candidates", type=int, default=32)
    parser.add_argument("--starts", type=int, default=4, help="dreams of each candidate")
    parser.add_argument("--episodes", type=int, default=20, help="in the true simulator")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args(words)
    envs = gymnasium.make_vec(
        "acwm/dream-v0", num_envs=asked.candidates, run=asked.run, task=asked.task
    )
    _, info = envs.reset(seed=asked.seed)
    fields = tuple(sorted(name for name in info["state"] if not name.startswith("_")))
    policy = Policy(envs.single_action_space, fields)  # pyright: ignore[reportArgumentType]
    found = train(envs, policy, iterations=asked.iterations, starts=asked.starts, seed=asked.seed)
    card = acwm.load(asked.run).card
    true = gymnasium.make(f"acwm/{card.name}-v0", task=asked.task, size=card.frame_size)
    repeat: int = envs.unwrapped.repeat  # pyright: ignore
    scores = {
        name: true_scores(true, policy, weights, repeat, asked.episodes)
        for name, weights in (("untrained", 0 * found), ("trained", found))
    }
    for name, (returns, share) in scores.items():
        print(f"{name}: return {returns:.3g}, success {100 * share:.0f} % in the true simulator")
    true.close()
    envs.close()
    return scores


class _Plain(argparse.ArgumentDefaultsHelpFormatter, argparse.RawDescriptionHelpFormatter):
    pass


if __name__ == "__main__":
    main()
