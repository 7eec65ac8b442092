"""Films of a spot that actions move, at any rate of actions: worlds whose truth is known."""

from dataclasses import dataclass

import numpy as np

from acwm_formats.timeline import Samples, TimedRecording

FPS, SIDE = 12, 32
FINE = 40  # instants per frame at which the motion is computed


@dataclass(frozen=True)
class Moments:
    """Frames that nobody decodes."""

    times: np.ndarray


@dataclass(frozen=True)
class Spot:
    """One episode: a film, and the actions with their times."""

    video: np.ndarray
    times: np.ndarray
    actions: np.ndarray

    @property
    def recording(self):
        cameras = {"top": Moments(np.arange(len(self.video)) / FPS)}
        return TimedRecording("it", cameras, Samples(self.actions, times=self.times))


def action_times(rng, rate, seconds, rhythm):
    """Times of actions until after the end of a film."""
    count = int(1.6 * seconds * rate) + 20
    even = np.arange(count) / rate
    if rhythm == "irregular":
        return np.concatenate([[0], np.cumsum(rng.uniform(0.2, 1.8, count - 1) / rate)])
    if rhythm == "jitter":
        return np.sort(even + rng.uniform(-0.3, 0.3, count) / rate)
    if rhythm == "pairs":
        return (even[::2, None] + [0, 0.2 / rate]).reshape(-1)
    return even - rng.uniform(0, 1 / rate)


def smooth(rng, times, memory):
    """Two actions that forget themselves within so many seconds."""
    kept = np.exp(-np.diff(times, prepend=times[0]) / memory)
    noise = rng.normal(size=(len(times), 2)) * np.sqrt(1 - kept**2)[:, None]
    rows = [rng.normal(size=2)]
    for share, new in zip(kept[1:], noise[1:], strict=True):
        rows.append(share * rows[-1] + new)
    return np.array(rows)


def path(kind, times, actions, frames, late=0.0):
    """Where the spot is at each frame, ``[frames, 2]`` in pixels from where it began."""
    step = 1 / FPS / FINE
    instants = np.arange(frames * FINE) * step
    latest = np.searchsorted(times, instants + 1e-9, side="right") - 1
    now = np.where(latest[:, None] >= 0, actions[latest], 0)
    if kind == "absolute" and late:  # what is left of the way halves and halves again
        place, places = 4 * now[0], []
        for target in now:
            places.append(place)
            place = place + step / late * (4 * target - place)
        found = np.array(places)
    elif kind == "absolute":
        found = 4 * now
    elif kind == "velocity":
        found = 12 * step * np.concatenate([np.zeros((1, 2)), now.cumsum(0)[:-1]])
    elif kind == "delta":  # each is carried out until the next begins
        ends = np.append(times, 2 * times[-1] - times[-2])
        total = np.concatenate([np.zeros((1, 2)), actions.cumsum(0)]) * 12 * np.diff(times).mean()
        found = np.stack([np.interp(instants, ends, column) for column in total.T], 1)
    else:
        speed, place, places = np.zeros(2), np.zeros(2), []
        for force in now:
            places.append(place)
            place = place + step * speed
            speed = speed + step * (80 * force - 4 * speed)
        found = np.array(places)
    return found[::FINE]


def spot(seed, kind, per_frame, rhythm="even", *, memory=0.1, frames=48, late=0.0):
    """An episode of a kind of actions, so many of them per frame.

    Targets are reached with a time constant of `late` seconds.
    """
    rng = np.random.default_rng(seed)
    times = action_times(rng, per_frame * FPS, frames / FPS, rhythm)
    actions = smooth(rng, times, memory)
    places = rng.uniform(12, 20, 2) + path(kind, times, actions, frames, late)
    down, right = np.mgrid[:SIDE, :SIDE]
    half = SIDE / 2
    apart = [
        (np.abs(down - y) - half) ** 2 + (np.abs(right - x) - half) ** 2 for y, x in places % SIDE
    ]
    light = np.exp(-(SIDE - np.sqrt(np.stack(apart)) - 9.5).clip(0) / 3) * 200
    video = np.repeat(light[..., None], 3, -1) + rng.normal(20, 2, (frames, SIDE, SIDE, 3))
    return Spot(video.clip(0, 255).astype(np.uint8), times, actions)
