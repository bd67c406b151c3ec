"""Net 2: how the object goes into a region, as correspondences between its points and the container's raw points.

Two Point Transformer V2 encoders; blocks of neighbourhood self-attention on the object and cross-attention both
ways; a dot product; dual softmax; focal loss; weighted Kabsch. Superpoints are centimetres apart and gaps have
millimetres of play, so the crop is of raw points.

Cross-attention looks for neighbours in a common frame: the object stands in its box frame, turned by the reference
rotation, in the middle of the region. That is close to where it goes, so the nearest container points are meaningful;
`cross_neighbours` sets how many.

Beyond the paper (`residual`, off in `preset: paper`): each object point also predicts where it ends up, as the mean
of the container points it corresponds to plus a learned offset. Contact pairs alone pull surfaces together and know
nothing of faces without contact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from dapdata import poses
from dapdata.config import TrainConfig
from daptrain.layers import UNIT, PointBlock, PointEncoder, exact, halved, neighbours
from daptrain.prepare import Array, Crop

CROP_CHANNELS = 7  # position 3, normal 3, score 1
OBJECT_CHANNELS = 9  # position 3, normal 3, extents of the box 3
FOCAL_GAMMA = 2.0  # as in the authors' code; the paper leaves it open
RANK_TOLERANCE = 1e-6  # a second singular value below this share of the first: points on a line, no rotation
CERTAIN = 1e-6  # probabilities are kept this far from 0 and 1 in the focal loss


@dataclass(frozen=True)
class CropBatch:
    """B padded crops with their objects, on one device, in network units."""

    points: Tensor  # (B, C, 3) crop frame
    features: Tensor  # (B, C, CROP_CHANNELS)
    mask: Tensor  # (B, C) bool
    object_points: Tensor  # (B, M, 3) box frame
    object_features: Tensor  # (B, M, OBJECT_CHANNELS)
    object_mask: Tensor  # (B, M) bool


@dataclass(frozen=True)
class Matches:
    """What net 2 says of a batch."""

    log_confidence: Tensor  # (B, M, C), logarithm of the dual softmax, -inf at padding
    targets: Tensor  # (B, M, 3) where each object point goes, crop frame, network units


class PoseNet(nn.Module):
    """Correspondence between the object's points and a crop of the container."""

    name, version = "pose", 1

    def __init__(self, config: TrainConfig, method: str = "dap") -> None:
        super().__init__()
        self.config, self.method = config, method
        W = config.pose_width
        self.encode_crop = PointEncoder(CROP_CHANNELS, W, config.point_layers, config.groups)
        self.encode_object = PointEncoder(OBJECT_CHANNELS, W, config.point_layers, config.groups)
        self.object_self = nn.ModuleList(PointBlock(W, config.groups) for _ in range(config.layers))
        self.object_from_crop = nn.ModuleList(PointBlock(W, config.groups, cross=True) for _ in range(config.layers))
        self.crop_from_object = nn.ModuleList(PointBlock(W, config.groups, cross=True) for _ in range(config.layers))
        self.project_object, self.project_crop = nn.Linear(W, W), nn.Linear(W, W)
        self.offset = nn.Sequential(nn.Linear(W + 3, W), nn.ReLU(), nn.Linear(W, 3)) if config.residual else None
        # Where the object stands before it is placed: the most common rotation of the training goals.
        self.register_buffer("reference", torch.eye(3))

    reference: Tensor

    def forward(self, batch: CropBatch) -> Matches:
        config = self.config
        with exact(batch.points.device):
            standing = batch.object_points @ self.reference.T
            near_object = neighbours(standing, standing, batch.object_mask, config.neighbours)
            near_crop = neighbours(batch.points, batch.points, batch.mask, config.neighbours)
            to_crop = neighbours(standing, batch.points, batch.mask, config.cross_neighbours)
            to_object = neighbours(batch.points, standing, batch.object_mask, config.cross_neighbours)
        crop = self.encode_crop(batch.features, near_crop)
        thing = self.encode_object(batch.object_features, near_object)
        for alone, inward, outward in zip(self.object_self, self.object_from_crop, self.crop_from_object):
            thing = alone(thing, thing, near_object)
            thing = inward(thing, crop, to_crop)
            crop = outward(crop, thing, to_object)
        with exact(batch.points.device):
            thing, crop = thing.float(), crop.float()
            logits = self.project_object(thing) @ self.project_crop(crop).mT * config.pose_width**-0.5
            targets = logits.masked_fill(~batch.mask[:, None], -torch.inf).softmax(dim=-1) @ batch.points
            if self.offset is not None:
                targets = targets + self.offset(torch.cat((thing, targets - standing), dim=-1))
            return Matches(dual_softmax(logits, batch.object_mask, batch.mask), targets)


def dual_softmax(logits: Tensor, row_mask: Tensor, column_mask: Tensor) -> Tensor:
    """(B, M, C) logarithm of softmax over columns times softmax over rows; -inf at padding.

    Args:
        logits: (B, M, C).
        row_mask: (B, M) bool, False at padding.
        column_mask: (B, C) bool.
    """
    both = row_mask[:, :, None] & column_mask[:, None]
    # A large negative number instead of -inf: a row of padding would have a softmax of NaN, and so its gradient.
    filled = logits.masked_fill(~both, -1e9)
    return (filled.log_softmax(dim=2) + filled.log_softmax(dim=1)).masked_fill(~both, -torch.inf)


def focal_loss(log_confidence: Tensor, positive: Tensor) -> Tensor:
    """Mean over positive pairs of -(1 - p)^gamma log p; zero (with a gradient of zero) when there is none.

    The paper's sum over all pairs has log 0 wherever the label is 0; the authors' code takes the positives, and lets
    the softmax push the others down.

    Args:
        log_confidence: (B, M, C), logarithm of p.
        positive: (B, M, C) bool.
    """
    log_p = log_confidence[positive].clamp(np.log(CERTAIN), np.log1p(-CERTAIN))
    if log_p.numel() == 0:
        return log_confidence.nan_to_num(neginf=0.0).sum() * 0
    return -((1 - log_p.exp()) ** FOCAL_GAMMA * log_p).mean()


def collate(crops: list[Crop], extents: Array, device: torch.device) -> CropBatch:
    """Crops as one padded batch; extents (B, 3) m."""
    C, M = max(len(c.points) for c in crops), max(len(c.object_points) for c in crops)
    features, object_features = np.zeros((len(crops), C, CROP_CHANNELS)), np.zeros((len(crops), M, OBJECT_CHANNELS))
    mask, object_mask = np.zeros((len(crops), C), bool), np.zeros((len(crops), M), bool)
    for b, c in enumerate(crops):
        n, m = len(c.points), len(c.object_points)
        features[b, :n] = np.column_stack((c.points / UNIT, c.normals, c.score))
        object_features[b, :m, :6] = np.column_stack((c.object_points / UNIT, c.object_normals))
        object_features[b, :m, 6:] = extents[b] / UNIT
        mask[b, :n], object_mask[b, :m] = True, True
    crop_tensor = torch.from_numpy(features).float().to(device)
    object_tensor = torch.from_numpy(object_features).float().to(device)
    return CropBatch(
        crop_tensor[..., :3].contiguous(),
        crop_tensor,
        torch.from_numpy(mask).to(device),
        object_tensor[..., :3].contiguous(),
        object_tensor,
        torch.from_numpy(object_mask).to(device),
    )


def loss(net: PoseNet, batch: CropBatch, T_crop_box: Tensor, ramp: float) -> tuple[Tensor, Tensor]:
    """The training loss, and the mean distance (m) of the object points' targets from where they belong.

    Args:
        batch: B crops.
        T_crop_box: (B, 4, 4) float32, m: the goal, the right one of its symmetric copies.
        ramp: Weight in [0, 1] of the residual term, which competes with the correspondences when it starts at once.
    """
    with halved(batch.points.device):
        matches = net(batch)
    goal = batch.object_points @ T_crop_box[:, :3, :3].mT + T_crop_box[:, None, :3, 3] / UNIT
    positive = torch.cdist(goal, batch.points) <= net.config.eps_corr / UNIT
    positive &= batch.object_mask[:, :, None] & batch.mask[:, None]
    distance = (matches.targets - goal).abs().sum(dim=-1)
    off = (distance * batch.object_mask).sum() / batch.object_mask.sum()
    total = focal_loss(matches.log_confidence, positive)
    if net.offset is not None:
        total = total + net.config.residual_weight * ramp * off
    return total, off.detach() * UNIT


@dataclass(frozen=True)
class Solution:
    """The pose of one crop."""

    T_crop_box: Array  # (4, 4) f8, m; NaN where there is none
    residual: float  # m, weighted RMS distance of the moved object points from their targets; NaN where there is none
    status: str  # "ok", or why there is no pose


@torch.no_grad()
def solve(net: PoseNet, batch: CropBatch) -> list[Solution]:
    """The pose of each crop.

    With the residual head every object point has its own target; without, the pairs of highest confidence are
    used, as many as the larger cloud has points, as in the authors' code.
    """
    matches = net(batch)
    source, target, crop_points = (
        x.double().cpu().numpy() * UNIT for x in (batch.object_points, matches.targets, batch.points)
    )
    confidence, object_mask = matches.log_confidence.exp().double().cpu().numpy(), batch.object_mask.cpu().numpy()
    out = []
    for b in range(len(source)):
        if net.offset is not None:
            pairs = source[b], target[b], object_mask[b].astype(float)
        else:
            most = np.argsort(confidence[b], axis=None)[::-1][: max(object_mask[b].sum(), int(batch.mask[b].sum()))]
            i, j = np.unravel_index(most, confidence[b].shape)
            pairs = source[b][i], crop_points[b][j], confidence[b][i, j]
        T, status = kabsch(*pairs)
        square = ((poses.transform(T, pairs[0]) - pairs[1]) ** 2).sum(axis=1)
        residual = float(np.sqrt(np.average(square, weights=pairs[2]))) if status == "ok" else np.nan
        out.append(Solution(T, residual, status))
    return out


def kabsch(source: Array, target: Array, weights: Array) -> tuple[Array, str]:
    """The rigid pose that brings source points onto target points, weighted least squares (Arun 1987).

    Weights are normalised by their exact sum: an epsilon there pulls the translation to zero when confidences are
    low. What determines no pose is said so; nothing stands in for it.

    Args:
        source: (P, 3).
        target: (P, 3).
        weights: (P,) >= 0, of any scale.

    Returns:
        (4, 4) T_target_source, NaN when it failed; and "ok", "not_finite", "no_weight" or "degenerate".
    """
    nothing = np.full((4, 4), np.nan)
    if not (np.isfinite(source).all() and np.isfinite(target).all() and np.isfinite(weights).all()):
        return nothing, "not_finite"
    if not (len(weights) and weights.max() > 0 and weights.min() >= 0):
        return nothing, "no_weight"
    share = weights / weights.max()  # first the scale, so that tiny weights do not underflow
    share = share / share.sum()
    source_mean, target_mean = share @ source, share @ target
    U, spread, Vt = np.linalg.svd((target - target_mean).T @ (share[:, None] * (source - source_mean)))
    if not spread[1] > RANK_TOLERANCE * max(spread[0], 1e-12):
        return nothing, "degenerate"
    R = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return poses.pose(R, target_mean - R @ source_mean), "ok"
