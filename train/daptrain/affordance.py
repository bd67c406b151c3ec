"""Net 1: where on the container the object goes, as a score per superpoint drawn from p(score | container).

A Point Transformer V2 backbone turns superpoints into features once per scene; Point-DiT blocks (adaLN-Zero on
time, Fourier position before every block, full attention over superpoints) denoise the scores.

Beyond the paper, each with its switch and all off in `preset: paper`:
- `score_radii`: the noisy score also enters smoothed over several radii. Noise hides a region in each single
  superpoint but not in their sum, and attention was slow to find that out by itself in a prototype;
- `prediction: x0`: the clean score is predicted with binary cross-entropy instead of the noise with squared error;
- `object_condition`: the object's fitted extents join the time token. The paper's p(score | container) cannot
  refuse a gap that is too narrow for this object.

`method: cap` is the paper's ablation: the same network, without noise or time, classifies each superpoint at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from dapdata.config import TrainConfig
from daptrain import diffusion
from daptrain.layers import UNIT, DiTBlock, FourierPosition, Neighbours, PointEncoder, TimeToken, exact, gather, halved
from daptrain.prepare import Array, Inputs

CHANNELS = 8  # position 3, normal 3, height 1, log size 1
PRIOR_LOGIT = -3.0  # one superpoint in twenty is positive; starting there saves the first hundred steps


@dataclass(frozen=True)
class SuperpointBatch:
    """B padded scenes, on one device, in network units."""

    points: Tensor  # (B, S, 3)
    features: Tensor  # (B, S, CHANNELS)
    mask: Tensor  # (B, S) bool, False at padding
    near: Neighbours  # of (B, S, K)
    extents: Tensor  # (B, 3)


@dataclass(frozen=True)
class Encoded:
    """What of a scene does not depend on the noisy score: computed once, used in every denoising step."""

    tokens: Tensor  # (B, S, D)
    positions: tuple[Tensor, ...]  # each block's (B, S, D)
    smoothing: Tensor  # (B, R, S, S), rows of unit norm
    condition: Tensor  # (B, D)
    mask: Tensor  # (B, S) bool


class AffordanceNet(nn.Module):
    """Estimates clean scores (x0: as logits; eps: as noise) from noisy ones."""

    name, version = "affordance", 1

    def __init__(self, config: TrainConfig, method: str = "dap") -> None:
        super().__init__()
        self.config, self.method = config, method
        D, width = config.width, config.point_width
        self.encoder = PointEncoder(CHANNELS, width, config.point_layers, config.groups)
        self.embed_point = nn.Linear(width, D)
        self.embed_score = nn.Linear(1 + len(config.score_radii), D, bias=False)
        self.time = TimeToken(D)
        self.embed_extents = nn.Sequential(nn.Linear(3, D), nn.SiLU(), nn.Linear(D, D)) if config.object_condition else None
        self.positions = nn.ModuleList(FourierPosition(D) for _ in range(config.layers))
        self.blocks = nn.ModuleList(DiTBlock(D, config.heads) for _ in range(config.layers))
        self.last_norm, self.head = nn.LayerNorm(D), nn.Linear(D, 1)
        self.register_buffer("alpha_bar", diffusion.cosine_alpha_bar(config.diffusion_steps), persistent=False)
        if self.predicts_logits:
            nn.init.constant_(self.head.bias, PRIOR_LOGIT)

    alpha_bar: Tensor  # (T,) float64

    @property
    def predicts_logits(self) -> bool:
        return self.method == "cap" or self.config.prediction == "x0"

    def encode(self, batch: SuperpointBatch) -> Encoded:
        """Everything of the scenes that all noise levels and samples share."""
        tokens = self.embed_point(self.encoder(batch.features, batch.near))
        condition = torch.zeros_like(tokens[:, 0])
        if self.embed_extents is not None:
            condition = self.embed_extents(batch.extents)
        positions = tuple(position(batch.points) for position in self.positions)
        radii = [radius / UNIT for radius in self.config.score_radii]
        return Encoded(tokens, positions, smoothing(batch.points, batch.mask, radii), condition, batch.mask)

    def forward(self, encoded: Encoded, noisy: Tensor, t: Tensor) -> Tensor:
        """(B, L, S) logits or noise from (B, L, S) noisy scores at (B, L) steps: L noise levels or samples a scene."""
        B, L, S = noisy.shape
        # The background of a score is -1: what is left above it is evidence for a region.
        above = noisy + self.alpha_bar[t].sqrt().float()[..., None]
        above = above.masked_fill(~encoded.mask[:, None], 0.0)
        with exact(noisy.device):
            smooth = torch.einsum("brst,blt->blsr", encoded.smoothing, above)  # (B, L, S, R)
        score = self.embed_score(torch.cat((noisy[..., None], smooth), dim=-1))
        x = (encoded.tokens[:, None] + score).flatten(0, 1)
        condition = self.time(t.flatten()) + encoded.condition.repeat_interleave(L, dim=0)
        mask = encoded.mask.repeat_interleave(L, dim=0)
        for position, block in zip(encoded.positions, self.blocks):
            x = block(x + position.repeat_interleave(L, dim=0), condition, mask)
        return torch.as_tensor(self.head(self.last_norm(x))[..., 0].view(B, L, S))

    def clean(self, encoded: Encoded, noisy: Tensor, t: Tensor) -> Tensor:
        """(B, L, S) estimate of the clean scores in [-1, 1]."""
        out = self(encoded, noisy, t)
        if self.predicts_logits:
            return torch.as_tensor(2 * out.sigmoid() - 1)
        return diffusion.clean_from_noise(noisy, self.alpha_bar[t].float()[..., None], out).clamp(-1, 1)


def smoothing(points: Tensor, mask: Tensor, radii: list[float]) -> Tensor:
    """(B, R, S, S) Gaussian weights, each row of unit norm, so that smoothed white noise keeps its variance."""
    if not radii:
        return points.new_zeros(len(points), 0, points.shape[1], points.shape[1])
    square = torch.cdist(points, points).square()[:, None]
    weight = torch.exp(-square / (2 * torch.tensor(radii, device=points.device)[:, None, None] ** 2))
    return functional.normalize(weight * mask[:, None, None].float(), dim=-1)


def collate(scenes: list[Inputs], turns: Array, mirrored: Array, device: torch.device) -> SuperpointBatch:
    """Scenes as one padded batch.

    Args:
        scenes: B of them.
        turns: (B,) rad, augmentation about the vertical.
        mirrored: (B,) bool, augmentation: left and right exchanged.
    """
    S, K = max(len(s.superpoints) for s in scenes), max(s.neighbours.shape[1] for s in scenes)
    points, features = np.zeros((len(scenes), S, 3), np.float32), np.zeros((len(scenes), S, CHANNELS), np.float32)
    mask, index = np.zeros((len(scenes), S), bool), np.zeros((len(scenes), S, K), np.int64)
    valid = np.zeros((len(scenes), S, K), bool)
    valid[..., 0] = True  # padding rows attend to something, so that their softmax is finite
    for b, (scene, turn, mirror) in enumerate(zip(scenes, turns, mirrored)):
        n, k = scene.neighbours.shape
        R = turned(turn, mirror)
        points[b, :n] = scene.superpoints @ R.T / UNIT
        size = np.log(scene.superpoint_size / max(scene.superpoint_size.mean(), 1e-6) + 1e-3)
        features[b, :n] = np.column_stack(
            (points[b, :n], scene.superpoint_normals @ R.T, scene.superpoints[:, 2] / UNIT, np.clip(size, -3, 3))
        )
        mask[b, :n], index[b, :n, :k], valid[b, :n, :k] = True, scene.neighbours, True
    tensor_points, tensor_index = torch.from_numpy(points).to(device), torch.from_numpy(index).to(device)
    offset = gather(tensor_points, tensor_index) - tensor_points[:, :, None]
    return SuperpointBatch(
        tensor_points,
        torch.from_numpy(features).to(device),
        torch.from_numpy(mask).to(device),
        Neighbours(tensor_index, torch.from_numpy(valid).to(device), offset),
        torch.from_numpy(np.stack([s.extents for s in scenes]) / np.float32(UNIT)).to(device),
    )


def turned(turn: float, mirror: bool) -> Array:
    """(3, 3) float32 turn about the vertical, after exchanging left and right (y) where mirrored."""
    c, s, flip = np.cos(turn), np.sin(turn), -1.0 if mirror else 1.0
    return np.array([[c, -s * flip, 0], [s, c * flip, 0], [0, 0, 1]], np.float32)


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of (B, L, S) values over the superpoints where mask (B, S) is True: scenes and levels weigh equally."""
    weight = mask[:, None].float()
    return ((values * weight).sum(dim=-1) / weight.sum(dim=-1)).mean()


def loss(net: AffordanceNet, batch: SuperpointBatch, clean: Tensor, t: Tensor, noise: Tensor) -> Tensor:
    """The training loss.

    Args:
        batch: B scenes.
        clean: (B, L, S) target scores in [-1, 1], anything at padding.
        t: (B, L) steps.
        noise: (B, L, S) standard normal.
    """
    if net.method == "cap":
        t, noisy = torch.zeros_like(t), torch.zeros_like(clean)
    else:
        noisy = diffusion.add_noise(clean, net.alpha_bar[t].float()[..., None], noise)
    with halved(clean.device):
        out = net(net.encode(batch), noisy, t).float()
    if net.predicts_logits:
        return masked_mean(functional.binary_cross_entropy_with_logits(out, (clean + 1) / 2, reduction="none"), batch.mask)
    return masked_mean((out - noise).square(), batch.mask)


def sample(net: AffordanceNet, batch: SuperpointBatch, count: int, steps: int, rng: np.random.Generator) -> Array:
    """(B, count, S) sampled scores in [-1, 1]; with `method: cap`, the one classification, repeated."""
    *_, (_, last) = walk(net, batch, count, steps, rng)
    return np.asarray(last.clamp(-1, 1).cpu())


@torch.no_grad()
def walk(
    net: AffordanceNet, batch: SuperpointBatch, count: int, steps: int, rng: np.random.Generator
) -> Iterator[tuple[int, Tensor]]:
    """(B, count, S) scores on their way from noise to a sample, as `diffusion.walk` gives them; `cap` has the last alone.

    The noise comes from numpy, so that a sample is the same on every device.
    """
    encoded = net.encode(batch)
    B, S = batch.mask.shape

    def noise(shape: tuple[int, ...]) -> Tensor:
        return torch.from_numpy(rng.standard_normal(shape, dtype=np.float32)).to(batch.points.device)

    def denoise(noisy: Tensor, step: int) -> Tensor:
        return net.clean(encoded, noisy, torch.full((B, count), step, device=noisy.device))

    if net.method == "cap":
        yield 0, denoise(batch.points.new_zeros(B, count, S), 0)
        return
    yield from diffusion.walk(denoise, (B, count, S), net.alpha_bar, steps, noise)


def peaks(score: Array, superpoints: Array, count: int, reach: float) -> list[Array]:
    """At most `count` scores, each left with one peak of a classification: best first, neighbours suppressed.

    The fair way to draw several candidates from CAP's one map: a crop of everything positive spans many modes.

    Args:
        score: (S,) in [-1, 1].
        superpoints: (S, 3) m.
        reach: Superpoints within this distance of a peak belong to it, m.
    """
    p, left, found = np.clip((score + 1) / 2, 0, 1), np.ones(len(score), bool), list[Array]()
    while left.any() and len(found) < count:
        peak = np.flatnonzero(left)[np.argmax(p[left])]
        near = np.linalg.norm(superpoints - superpoints[peak], axis=1) <= reach
        # A probability is shared by all modes; within one peak it is what it is relative to its best superpoint.
        found.append(np.where(near, 2 * np.minimum(p / max(p[peak], 1e-6), 1) - 1, -1.0))
        left &= ~near
    return found


def positives(score: Array) -> Array:
    """(S,) score in [-1, 1] that is above 0 on all that a classification calls positive, over however many modes.

    As published, that is where its probability is above 0.5. Where several places are as likely it may be above 0.5
    nowhere, since they share it; then half of its maximum takes the place of 0.5. That is the kinder reading: by the
    other one nothing would be left to crop.

    Args:
        score: (S,) in [-1, 1].
    """
    p = np.clip((score + 1) / 2, 0, 1)
    threshold = 0.5 if p.max() > 0.5 else max(float(p.max()) / 2, 1e-6)
    return np.asarray(np.minimum(p / threshold - 1, 1))
