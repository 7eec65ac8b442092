"""Planners that need no gradient: `random_shooting`, `cem`, `icem` and `mppi`."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from acwm_core.errors import RecipeError
from acwm_planning.search import Search, SearchPlanner, at_least

SPREAD = 0.5
"""Standard deviation of the first candidates, for actions scaled to [-1, 1]."""


class RandomShooting(SearchPlanner):
    """Draws all candidates at once, uniformly within the bounds, and takes the best.

    Args:
        candidates: number of candidates.
        **blocks: see `SearchPlanner`.
    """

    def __init__(
        self,
        *,
        candidates: int = 1024,
        **blocks: Any,
    ) -> None:
        super().__init__(**blocks)
        at_least("candidates", candidates, 1)
        self.candidates = candidates

    def search(self, search: Search, start: Tensor, rng: torch.Generator) -> None:
        """Draw and evaluate once."""
        search(2 * torch.rand(self.candidates, *start.shape, generator=rng) - 1)


class CrossEntropy(SearchPlanner):
    """The cross-entropy method (Rubinstein 1999): repeatedly fits a Gaussian to its best samples.

    The last candidates include the mean.

    Args:
        candidates: number of candidates drawn in each iteration.
        iterations: number of times that the Gaussian is fitted.
        elites: number of best candidates to which it is fitted.
        spread: its initial standard deviation, for actions scaled to [-1, 1]; null for that of the
            actions that the model was trained on, or 0.5 if that is not known.
        momentum: share of the old mean and standard deviation that is kept.
        **blocks: see `SearchPlanner`.

    Raises:
        RecipeError: there are more elites than candidates, or a number is out of range.
    """

    def __init__(
        self,
        *,
        candidates: int = 128,
        iterations: int = 6,
        elites: int = 16,
        spread: float | None = SPREAD,
        momentum: float = 0.0,
        **blocks: Any,
    ) -> None:
        super().__init__(**blocks)
        at_least("iterations", iterations, 1)
        at_least("elites", elites, 2)
        at_least("spread", 1 if spread is None else spread, 1e-6)
        if candidates < elites:
            raise RecipeError(
                f"planner.candidates={candidates}: give at least planner.elites={elites}"
            )
        if not 0 <= momentum < 1:
            raise RecipeError(f"planner.momentum={momentum}: give at least 0 and less than 1")
        self.candidates, self.iterations, self.elites = candidates, iterations, elites
        self.spread, self.momentum = spread, momentum

    def search(self, search: Search, start: Tensor, rng: torch.Generator) -> None:
        """Draw candidates and fit the Gaussian, in turn."""
        mean, std = start, self.initial_std(self.spread, SPREAD, start)
        kept = self.previous_elites(start)
        for iteration in range(self.iterations):
            noise = self.noise((self.population(iteration), *start.shape), rng)
            groups = [(mean + std * noise).clamp(-1, 1), kept]
            if iteration == self.iterations - 1:
                groups.append(mean[None])
            candidates = torch.cat(groups)
            costs = search(candidates)
            elites = candidates[costs.argsort(stable=True)[: self.elites]]
            # Candidates without a finite cost are not used for the fit.
            elites = elites[: max(2, int(costs.isfinite().sum()))]
            mean = torch.lerp(elites.mean(0), mean, self.momentum)
            std = torch.lerp(elites.std(0), std, self.momentum)
            kept = self.keep(elites)

    def population(self, iteration: int) -> int:
        """Number of new candidates in an iteration."""
        return self.candidates

    def noise(self, shape: tuple[int, ...], rng: torch.Generator) -> Tensor:
        """Noise with unit variance, `[N, H, A]`."""
        return torch.randn(shape, generator=rng)

    def previous_elites(self, start: Tensor) -> Tensor:
        """Elites of the previous decision, `[K, H, A]`; none here."""
        return start.new_zeros(0, *start.shape)

    def keep(self, elites: Tensor) -> Tensor:
        """Which of the elites `[E, H, A]` stay candidates in the next iteration; none here."""
        return elites[:0]


class ImprovedCrossEntropy(CrossEntropy):
    """iCEM (Pinneri et al. 2020, arXiv 2008.06389): smoother candidates, and elites are kept.

    Noise is coloured in time, with the power spectrum f^-colour. Some elites stay candidates in the
    next iteration and, shifted in time, in the next decision, which starts from the last plan. Each
    iteration draws fewer candidates than the one before.

    Args:
        colour: exponent β of the paper; 0 is white noise.
        kept: share of the elites that stay candidates.
        decay: factor by which the number of drawn candidates falls with each iteration; it never
            falls below twice the elites.
        **cem: see `CrossEntropy`.

    Raises:
        RecipeError: a number is out of range.
    """

    def __init__(
        self,
        *,
        candidates: int = 128,
        iterations: int = 6,
        elites: int = 16,
        spread: float | None = SPREAD,
        momentum: float = 0.1,
        warm_start: bool = True,
        colour: float = 2.0,
        kept: float = 0.3,
        decay: float = 1.25,
        **blocks: Any,
    ) -> None:
        super().__init__(
            candidates=candidates,
            iterations=iterations,
            elites=elites,
            spread=spread,
            momentum=momentum,
            warm_start=warm_start,
            **blocks,
        )
        at_least("colour", colour, 0)
        at_least("decay", decay, 1)
        if not 0 <= kept <= 1:
            raise RecipeError(f"planner.kept={kept}: give a share, 0 to 1")
        self.colour, self.kept, self.decay = colour, kept, decay
        self._elites: Tensor | None = None

    def reset(self) -> None:
        """Forget the last plan and its elites."""
        super().reset()
        self._elites = None

    def population(self, iteration: int) -> int:
        """Number of new candidates; it falls with each iteration."""
        return min(
            self.candidates, max(2 * self.elites, int(self.candidates / self.decay**iteration))
        )

    def noise(self, shape: tuple[int, ...], rng: torch.Generator) -> Tensor:
        """Coloured noise."""
        return coloured_noise(shape, self.colour, rng)

    def previous_elites(self, start: Tensor) -> Tensor:
        """Elites of the previous decision, shifted in time."""
        if not self.warm_start or self._elites is None:
            return super().previous_elites(start)
        return self.shifted(self._elites)

    def keep(self, elites: Tensor) -> Tensor:
        """The best share of the elites."""
        self._elites = elites[: math.ceil(self.kept * len(elites))]
        return self._elites


class PathIntegral(SearchPlanner):
    """MPPI (Williams et al. 2017): a mean of all candidates, in which cheap ones weigh more.

    Weights are exp(-cost / λ), where λ is the temperature times the standard deviation of the
    costs, so that the temperature does not depend on the unit of cost. There is no control cost.

    Args:
        candidates: number of candidates drawn in each iteration.
        iterations: number of updates of the mean.
        temperature: see above.
        spread: standard deviation of candidates around the mean, for actions scaled to [-1, 1].
        **blocks: see `SearchPlanner`.

    Raises:
        RecipeError: a number is too small.
    """

    def __init__(
        self,
        *,
        candidates: int = 128,
        iterations: int = 6,
        temperature: float = 0.2,
        spread: float = 0.3,
        warm_start: bool = True,
        **blocks: Any,
    ) -> None:
        super().__init__(warm_start=warm_start, **blocks)
        at_least("candidates", candidates, 2)
        at_least("iterations", iterations, 1)
        at_least("temperature", temperature, 1e-6)
        at_least("spread", spread, 1e-6)
        self.candidates, self.iterations = candidates, iterations
        self.temperature, self.spread = temperature, spread

    def search(self, search: Search, start: Tensor, rng: torch.Generator) -> None:
        """Draw candidates and update the mean in turn, then evaluate the last mean too."""
        mean = start
        for _ in range(self.iterations):
            noise = torch.randn(self.candidates - 1, *start.shape, generator=rng)
            candidates = torch.cat([mean[None], (mean + self.spread * noise).clamp(-1, 1)])
            costs = search(candidates)
            weights = path_weights(costs, self.temperature)
            mean = (weights[:, None, None] * candidates).sum(0)
        search(mean[None])


def path_weights(costs: Tensor, temperature: float) -> Tensor:
    """Weights `[N]` of candidates, with sum 1; candidates with infinite cost get weight 0."""
    finite = costs.isfinite()
    if not finite.any():
        return torch.full_like(costs, 1 / len(costs))
    scale = temperature * costs[finite].std(correction=0).clamp(min=1e-12)
    return torch.softmax(torch.where(finite, -(costs - costs[finite].min()) / scale, -math.inf), 0)


def coloured_noise(shape: tuple[int, ...], colour: float, rng: torch.Generator) -> Tensor:
    """Gaussian noise `[N, H, A]` with unit variance and the power spectrum f^-`colour` along H.

    Drawn in the frequency domain (Timmer and König 1995). The constant part has the power of the
    lowest frequency.
    """
    number, length, size = shape
    frequencies = torch.fft.rfftfreq(length).clamp(min=1 / length)
    power = frequencies**-colour
    # In a real signal the constant part and, for an even length, the highest frequency are real.
    single = torch.zeros(len(power), dtype=torch.bool)
    single[0], single[-1] = True, length % 2 == 0 or length == 1
    amplitude = (power / (power * torch.where(single, 1.0, 2.0)).sum()).sqrt() * length
    normal = torch.randn(2, number, size, len(power), generator=rng)
    imaginary = torch.where(single, 0.0, normal[1] / math.sqrt(2))
    real = torch.where(single, normal[0], normal[0] / math.sqrt(2))
    spectrum = torch.complex(amplitude * real, amplitude * imaginary)
    return torch.fft.irfft(spectrum, n=length).transpose(1, 2)
