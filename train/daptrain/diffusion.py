"""Denoising diffusion of per-point scores: schedule, forward process, reverse steps, sampler.

Steps are counted t = 0 .. T-1 and `alpha_bar[t]` is the share of signal variance left after step t + 1, so that
"before step 0" is the clean score. One reverse formula serves all samplers: the Gaussian q(s_before | s_t, s_0) for
any earlier step. With neighbouring steps it is the ancestral sampler of DDPM; with a subset of the steps it is its
strided form (DDIM with eta = 1). 20 such steps were as good as all 100 in a prototype.
The variance is the posterior's; the paper's sigma_t^2 = beta_t is the other DDPM choice, which a cosine schedule
(beta of the last step 0.999) makes needlessly noisy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor

MAX_BETA = 0.999  # cap of the cosine schedule, as in improved DDPM: keeps alpha_bar above zero

Denoiser = Callable[[Tensor, int], Tensor]  # (noisy scores, step) -> estimate of the clean scores
Noise = Callable[[tuple[int, ...]], Tensor]  # shape -> standard normal numbers


def cosine_alpha_bar(steps: int) -> Tensor:
    """(T,) float64 signal variance left after each step of the cosine schedule (Nichol and Dhariwal 2021)."""

    def level(u: np.ndarray) -> np.ndarray:
        return np.asarray(np.cos((u + 0.008) / 1.008 * math.pi / 2) ** 2)

    u = np.arange(steps + 1) / steps
    beta = np.minimum(1 - level(u[1:]) / level(u[:-1]), MAX_BETA)
    return torch.from_numpy(np.cumprod(1 - beta))


def add_noise(clean: Tensor, alpha_bar: Tensor, noise: Tensor) -> Tensor:
    """Scores after diffusion: sqrt(alpha_bar) clean + sqrt(1 - alpha_bar) noise, (..., S)."""
    return alpha_bar.sqrt() * clean + (1 - alpha_bar).sqrt() * noise


def clean_from_noise(noisy: Tensor, alpha_bar: Tensor, noise: Tensor) -> Tensor:
    """The clean scores that an estimate of the noise implies; the inverse of `add_noise`."""
    return (noisy - (1 - alpha_bar).sqrt() * noise) / alpha_bar.sqrt()


def posterior(noisy: Tensor, clean: Tensor, alpha_bar_now: float, alpha_bar_before: float) -> tuple[Tensor, float]:
    """Mean and variance of q(s_before | s_now, s_0) for any earlier step; exactly `clean` and 0 before step 0."""
    kept = alpha_bar_now / alpha_bar_before  # signal variance that survives from the earlier step to now
    to_clean = math.sqrt(alpha_bar_before) * (1 - kept) / (1 - alpha_bar_now)
    to_noisy = math.sqrt(kept) * (1 - alpha_bar_before) / (1 - alpha_bar_now)
    return to_clean * clean + to_noisy * noisy, (1 - alpha_bar_before) / (1 - alpha_bar_now) * (1 - kept)


def sample(denoise: Denoiser, shape: tuple[int, ...], alpha_bar: Tensor, steps: int, noise: Noise) -> Tensor:
    """Scores drawn by walking back from pure noise; arguments as in `walk`."""
    *_, (_, last) = walk(denoise, shape, alpha_bar, steps, noise)
    return last


def walk(
    denoise: Denoiser, shape: tuple[int, ...], alpha_bar: Tensor, steps: int, noise: Noise
) -> Iterator[tuple[int, Tensor]]:
    """The scores on their way, each with the number of noising steps that are left in them.

    Pure noise comes first, with T; the sample comes last, with 0.

    Args:
        denoise: Estimates the clean scores in [-1, 1] at a step.
        shape: Shape of the scores.
        alpha_bar: (T,) schedule.
        steps: How many of the T steps are visited, evenly spread, first and last among them.
        noise: Maker of standard normal numbers.
    """
    T = len(alpha_bar)
    visited = np.unique(np.linspace(0, T - 1, min(steps, T)).round().astype(int))[::-1] if steps > 1 else np.array([T - 1])
    s = noise(shape)
    yield T, s
    for i, t in enumerate(visited):
        before = float(alpha_bar[visited[i + 1]]) if i + 1 < len(visited) else 1.0
        s, variance = posterior(s, denoise(s, int(t)), float(alpha_bar[t]), before)
        if variance > 0:
            s = s + math.sqrt(variance) * noise(shape)
        yield (int(visited[i + 1]) + 1 if i + 1 < len(visited) else 0), s
