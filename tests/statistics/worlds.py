"""Scores to do statistics on."""

import numpy as np

from acwm_core.evaluation.statistics import ClipScores


def scores(values, episodes=None, starts=0, summarise=None):
    """One value per clip, each of an episode of its own unless `episodes` are given."""
    values = np.asarray(values, np.float64)
    episodes = range(len(values)) if episodes is None else episodes
    clips = np.stack([np.array(episodes), np.broadcast_to(starts, len(values))], 1)
    return ClipScores(values, np.ones(len(values)), clips, summarise)


def decibels(error):
    return -10 * np.log10(error)


def pooled(values, weights):
    """PSNR of the mean squared error, which is no mean of the clips' own."""
    return float(decibels(np.average(10 ** (-np.asarray(values) / 10), weights=weights)))
