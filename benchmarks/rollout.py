"""Frames per second and latency of video prediction: whole clips, streams, and without a cache.

    python benchmarks/rollout.py --model dit_xs --steps 4,10,20,50
    python benchmarks/rollout.py --size 240 --steps 4

A causal model with random weights predicts one video. A stream makes four frames at a time; its
latency is the time from four actions to their frames. Without a cache, every sampling step
evaluates the past again, at most `--context` latent frames. Nothing else differs: the largest
difference between the two videos is printed. The first figure is always for a clip of 37 frames
from its start; "later on" are the frames after it, which have a full context. "cache ×" is the
speed-up of a stream by the cache, without the codec.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor
from torch.nn import functional

from acwm_core.checks.trial import shaken
from acwm_core.model.objectives.diffusion_forcing import DiffusionForcing
from acwm_core.model.world_model import CLIP_FRAMES, WorldModel
from acwm_core.plugins import catalog

ACTION_SIZE = 2


@dataclass(frozen=True)
class Setting:
    """One model and number of sampling steps, for about `seconds` per measurement."""

    model: str
    steps: int
    size: int
    context: int
    seconds: float
    device: str = "cpu"

    def first_frame(self) -> Tensor:
        """A random frame to start from."""
        return torch.rand(1, 3, self.size, self.size).to(self.device)


def random_world(setting: Setting, *, decoding: bool) -> WorldModel:
    """A causal model behind the codec `compact`; without `decoding`, frames are grey."""
    torch.manual_seed(0)
    codec = catalog().create("codec", "compact")
    network = catalog().create("model", setting.model, latent_channels=codec.channels, causal=True)
    conditioner = catalog().create(
        "conditioner",
        "adaln",
        action_size=ACTION_SIZE,
        temporal_stride=codec.temporal_stride,
        width=network.width,
        layers=network.layers,
        heads=network.heads,
    )
    if not decoding:
        grey = torch.full((1, codec.temporal_stride, 3, setting.size, setting.size), 0.5)
        grey = grey.to(setting.device)
        codec.frame_decoder = lambda: lambda latents: grey
    objective = DiffusionForcing(prediction="clean", shift=20, steps=setting.steps)
    bounds = [-1.0] * ACTION_SIZE, [1.0] * ACTION_SIZE
    world = WorldModel(codec, shaken(network), shaken(conditioner), objective, *bounds)
    return world.requires_grad_(False).eval().to(setting.device)


class Uncached:
    """A stream that caches no keys and values: it evaluates the last latent frames again."""

    def __init__(self, world: WorldModel, first: Tensor, context: int) -> None:
        self.world, self.context = world, context
        self.latents = world.encode(first[:, None])
        self.actions = torch.zeros(1, 0, ACTION_SIZE, device=first.device)
        self.generator = torch.Generator().manual_seed(0)

    @torch.inference_mode()
    def step(self, actions: Tensor) -> Tensor:
        """The next latent frame, `[1, 1, C, h, w]`."""
        world, stride = self.world, self.world.codec.temporal_stride
        past = self.latents[:, 1 - self.context :]
        self.actions = torch.cat([self.actions, actions], 1)[:, -stride * past.shape[1] :]
        rows = functional.pad(self.actions, (0, 0, 0, 1))
        conditioning = world.conditioner(world.normalise(rows))

        def denoise(noisy: Tensor, sigma: Tensor) -> Tensor:
            levels = functional.pad(sigma, (past.shape[1], 0))
            return world.model(torch.cat([past, noisy], 1), levels, conditioning)[:, -1:]

        noise = torch.randn(past.shape[2:], generator=self.generator)[None, None].to(past)
        new = world.objective.sample(denoise, noise, noise[:, :0])
        self.latents = torch.cat([past, new], 1)
        return new


@dataclass(frozen=True)
class Timing:
    """Seconds of each step: for several clips from their start, and for later frames."""

    clips: list[list[float]]
    later: list[float]

    def clip(self) -> float:
        """Seconds per clip, as the median over clips."""
        return float(np.median([sum(clip) for clip in self.clips]))


def timed(
    step: Callable[[Tensor], Tensor], count: int, device: str, budget: float = np.inf
) -> list[float]:
    """Seconds of up to `count` steps, at least one, within the budget."""
    times: list[float] = []
    actions = (torch.rand(1, 4, ACTION_SIZE) * 2 - 1).to(device)
    while len(times) < count and (not times or sum(times) < budget):
        began = time.perf_counter()
        step(actions)
        if device == "cuda":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - began)
    return times


def measure(start: Callable[[], Callable[[Tensor], Tensor]], setting: Setting) -> Timing:
    """Time clips from their start for some seconds, then the frames after the last clip as long."""
    seconds, device = setting.seconds, setting.device
    clip_steps = (CLIP_FRAMES - 1) // 4
    step = start()
    timed(step, 2, device)  # not measured: creates tables and allocates memory
    clips: list[list[float]] = []
    while not clips or sum(map(sum, clips)) < seconds:
        step = start()
        clips.append(timed(step, clip_steps, device))
    return Timing(clips, timed(step, 200, device, seconds))


def whole_clip(world: WorldModel, setting: Setting) -> float:
    """Seconds to predict a whole clip at once, the fastest mode if all actions are known."""
    first = setting.first_frame()
    actions = torch.rand(1, CLIP_FRAMES, ACTION_SIZE).to(setting.device)
    rollout = lambda _: world.rollout(first, actions)  # noqa: E731
    times = timed(rollout, 1000, setting.device, setting.seconds)
    return float(np.median(times))


def difference(world: WorldModel, setting: Setting) -> float:
    """Largest difference between a clip's frames with and without a cache."""
    first, actions = setting.first_frame(), torch.rand(9, 1, 4, ACTION_SIZE).to(setting.device)
    stream = world.stream(first, context=setting.context)
    uncached = Uncached(world, first, setting.context)
    decode = world.codec.frame_decoder()
    decode(uncached.latents)
    pairs = [(stream.step(part), decode(uncached.step(part))) for part in actions]
    return max(float((one - other).abs().max()) for one, other in pairs)


def rows(setting: Setting) -> tuple[list[list[str]], float]:
    """The lines of the table for one number of steps, and the difference of the videos."""
    first, context = setting.first_frame(), setting.context
    world = random_world(setting, decoding=True)
    bare = random_world(setting, decoding=False)
    frames, steps = CLIP_FRAMES - 1, str(setting.steps)
    stream = measure(lambda: world.stream(first, context=context).step, setting)
    cached = measure(lambda: bare.stream(first, context=context).step, setting)
    plain = measure(lambda: Uncached(bare, first, context).step, setting)
    lines = [[steps, "whole clip", f"{frames / whole_clip(world, setting):.1f}"]]
    for way, timing in (("stream", stream), ("· no codec", cached), ("· nor cache", plain)):
        half, most = np.percentile(timing.later, [50, 95]) * 1e3
        line = [f"{frames / timing.clip():.1f}", f"{4e3 / half:.1f}", f"{half:.1f}", f"{most:.1f}"]
        if timing is cached:
            line.append(f"{plain.clip() / timing.clip():.1f}")
            line.append(f"{np.median(plain.later) * 1e3 / half:.1f}")
        lines.append([steps, way, *line])
    return lines, difference(world, setting)


def main() -> None:
    """Measure and print one table per model."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--model", action="append", help="dit_xs if not given")
    parser.add_argument("--steps", default="4,10,20,50", help="sampling steps, with commas")
    parser.add_argument("--size", type=int, default=64, help="side of the frames")
    parser.add_argument("--context", type=int, default=10, help="latent frames")
    parser.add_argument("--seconds", type=float, default=5.0, help="per measurement")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    for model in arguments.model or ["dit_xs"]:
        size, threads = arguments.size, arguments.threads
        where = arguments.device if arguments.device != "cpu" else f"{threads} threads"
        title = f"{model}, {size}×{size}, compact, float32, {where}"
        heads = ("steps", "way", "frames/s", "later on", "p50 ms", "p95 ms", "cache ×", "later on")
        table = Table(*heads, title=title)
        worst = 0.0
        for steps in map(int, arguments.steps.split(",")):
            wanted = (model, steps, size, arguments.context, arguments.seconds, arguments.device)
            setting = Setting(*wanted)
            lines, apart = rows(setting)
            worst = max(worst, apart)
            for line in lines:
                table.add_row(*line)
            table.add_section()
        Console(width=110).print(table)
        print(f"videos with and without a cache differ by at most {worst:.1e}")


if __name__ == "__main__":
    main()
