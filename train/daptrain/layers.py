"""The building blocks of both networks: grouped vector attention on nearest neighbours, DiT blocks, encodings.

Shapes: B batch, N points of a padded cloud, M query points, K neighbours, C channels. Positions are in units of
`UNIT` metres, so that a step of the order of the objects' size is of order one; there is no per-cloud rescale,
because whether an object fits is a question of metric size.

LayerNorm takes the place of Point Transformer V2's BatchNorm: batches are small and padded.
Sources: Point Transformer V2 (grouped vector attention with a position-encoding bias), DiT (adaLN-Zero),
learnable Fourier features (Li et al. 2021). Written from the papers.
"""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

UNIT = 0.1  # m: length of one network unit
HALVED = "cuda"  # kind of device on which training computes in bfloat16 what may be; on CPU that is five times slower


def halved(device: torch.device) -> AbstractContextManager[object]:
    """Linear layers and products of features in bfloat16, where that is faster; nothing changes on other devices."""
    faster = device.type == HALVED and (HALVED != "cuda" or torch.cuda.is_bf16_supported(including_emulation=False))
    return torch.autocast(HALVED, torch.bfloat16) if faster else nullcontext()


def exact(device: torch.device) -> AbstractContextManager[object]:
    """float32 within `halved`: for positions, of which bfloat16 keeps 0.4 %, softmax and losses."""
    return torch.autocast(HALVED, enabled=False) if device.type == HALVED else nullcontext()


@dataclass(frozen=True)
class Neighbours:
    """Which keys each query attends to."""

    index: Tensor  # (B, M, K) int64 into the N keys
    valid: Tensor  # (B, M, K) bool; False where the cloud has fewer than K points
    offset: Tensor  # (B, M, K, 3) float, key minus query position


def gather(features: Tensor, index: Tensor) -> Tensor:
    """(B, M, K, C) rows of (B, N, C) features by (B, M, K) index."""
    B, N, C = features.shape
    rows = (index + N * torch.arange(B, device=index.device)[:, None, None]).flatten()
    # index_select: its backward is eight times faster on CPU than that of features[rows].
    return features.reshape(B * N, C).index_select(0, rows).view(*index.shape, C)


def neighbours(query_points: Tensor, key_points: Tensor, key_mask: Tensor, k: int) -> Neighbours:
    """The k nearest keys of each query (fewer where the cloud has fewer points).

    Args:
        query_points: (B, M, 3).
        key_points: (B, N, 3).
        key_mask: (B, N) bool, False at padding; at least one True per cloud.
        k: Neighbours wanted.
    """
    distance = torch.cdist(query_points, key_points, compute_mode="donot_use_mm_for_euclid_dist")
    distance = distance.masked_fill(~key_mask[:, None], math.inf)
    nearest, index = distance.topk(min(k, key_points.shape[1]), dim=-1, largest=False)
    return Neighbours(index, nearest.isfinite(), gather(key_points, index) - query_points[:, :, None])


class GroupedVectorAttention(nn.Module):
    """Each query's mean over its neighbours' values, with one weight per neighbour and group of channels.

    With q, k, v the transformed features and b the encoding of the offset, of query i and neighbour j:
        weight_ij = softmax over j of mlp(k_j - q_i + b_ij), one number a group
        out_i = sum over j of weight_ij (v_j + b_ij)
    k, q and b enter the mlp's first layer linearly, and so does b the sum, so they are projected to the few groups
    before they are gathered and b is summed before its last layer: the same numbers in half the time.
    """

    def __init__(self, width: int, groups: int) -> None:
        super().__init__()
        self.groups, hidden = groups, width // 2
        self.to_query = nn.Sequential(nn.Linear(width, width), nn.LayerNorm(width), nn.ReLU())
        self.to_key = nn.Sequential(nn.Linear(width, width), nn.LayerNorm(width), nn.ReLU())
        self.to_value = nn.Linear(width, width)
        self.offset_hidden = nn.Sequential(nn.Linear(3, hidden), nn.ReLU())
        self.offset_out = nn.Linear(hidden, width)
        self.relation = nn.Linear(width, groups)
        self.weight = nn.Sequential(nn.LayerNorm(groups), nn.ReLU(), nn.Linear(groups, groups))

    def forward(self, query: Tensor, key: Tensor, near: Neighbours) -> Tensor:
        """(B, M, C) from query features (B, M, C) and key features (B, N, C)."""
        to_groups = self.relation.weight  # (G, C)
        bias = self.offset_hidden(near.offset)  # (B, M, K, H)
        relation = (
            gather(self.to_key(key) @ to_groups.T, near.index)
            - (self.to_query(query) @ to_groups.T)[:, :, None]
            + bias @ (to_groups @ self.offset_out.weight).T
            + (to_groups @ self.offset_out.bias + self.relation.bias)
        )
        weight = self.weight(relation).float()
        weight = weight.masked_fill(~near.valid[..., None], -math.inf).softmax(dim=2)  # (B, M, K, G)
        value = gather(self.to_value(key), near.index)  # (B, M, K, C)
        # All groups' weights on all channels, of which each group keeps its own: one matmul is faster than a
        # broadcast product and a sum.
        every = (weight.mT @ value).unflatten(-1, (self.groups, -1))  # (B, M, G, G, C/G)
        from_value = every.diagonal(dim1=2, dim2=3).mT  # (B, M, G, C/G)
        to_out = self.offset_out.weight.view(self.groups, -1, bias.shape[-1])  # (G, C/G, H)
        from_bias = torch.einsum("bmgh,gch->bmgc", weight.mT @ bias, to_out)
        return torch.as_tensor((from_value + from_bias).flatten(-2) + self.offset_out.bias)


class PointBlock(nn.Module):
    """A residual block around grouped vector attention: of a cloud to itself, or (`cross`) to another cloud."""

    def __init__(self, width: int, groups: int, *, cross: bool = False) -> None:
        super().__init__()
        self.before = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.ReLU())
        self.before_key = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.ReLU()) if cross else None
        self.attention = GroupedVectorAttention(width, groups)
        self.after = nn.Sequential(nn.LayerNorm(width), nn.ReLU(), nn.Linear(width, width))

    def forward(self, query: Tensor, key: Tensor, near: Neighbours) -> Tensor:
        """(B, M, C) refined query features."""
        hidden_query = self.before(query)
        hidden_key = hidden_query if self.before_key is None else self.before_key(key)
        return torch.as_tensor(query + self.after(self.attention(hidden_query, hidden_key, near)))


class PointEncoder(nn.Module):
    """Per-point features of a cloud: an embedding and self-attention blocks."""

    def __init__(self, channels: int, width: int, layers: int, groups: int) -> None:
        super().__init__()
        self.embed = nn.Sequential(nn.Linear(channels, width), nn.LayerNorm(width), nn.ReLU(), nn.Linear(width, width))
        self.blocks = nn.ModuleList(PointBlock(width, groups) for _ in range(layers))
        self.norm = nn.LayerNorm(width)

    def forward(self, features: Tensor, near: Neighbours) -> Tensor:
        """(B, N, C) from input features (B, N, channels)."""
        x = self.embed(features)
        for block in self.blocks:
            x = block(x, x, near)
        return torch.as_tensor(self.norm(x))


class FourierPosition(nn.Module):
    """Learnable Fourier features of positions, projected to the width of the tokens."""

    def __init__(self, width: int, frequencies: int = 32, scale: float = 0.3) -> None:
        """scale: standard deviation of the first frequencies, cycles per network unit; larger: finer detail."""
        super().__init__()
        self.frequency = nn.Parameter(torch.randn(3, frequencies) * scale)
        self.project = nn.Linear(2 * frequencies, width)

    def forward(self, points: Tensor) -> Tensor:
        """(..., width) from (..., 3) positions."""
        with exact(points.device):
            phase = 2 * math.pi * points @ self.frequency
        return torch.as_tensor(self.project(torch.cat((phase.cos(), phase.sin()), dim=-1)))


class TimeToken(nn.Module):
    """A token of the diffusion step: sinusoids and a small network, as in DiT."""

    def __init__(self, width: int, frequencies: int = 32) -> None:
        super().__init__()
        self.frequencies = frequencies
        self.mlp = nn.Sequential(nn.Linear(2 * frequencies, width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, t: Tensor) -> Tensor:
        """(B, width) from (B,) steps."""
        rate = torch.exp(-math.log(1000.0) * torch.arange(self.frequencies, device=t.device) / self.frequencies)
        phase = t[:, None].float() * rate
        return torch.as_tensor(self.mlp(torch.cat((phase.cos(), phase.sin()), dim=-1)))


class DiTBlock(nn.Module):
    """Full attention and an MLP, both shifted, scaled and gated by the condition (adaLN-Zero).

    The modulation starts at zero, so that the block starts as the identity.
    """

    def __init__(self, width: int, heads: int, mlp_ratio: int = 4) -> None:
        super().__init__()
        self.heads = heads
        self.norm_attention = nn.LayerNorm(width, elementwise_affine=False, eps=1e-6)
        self.norm_mlp = nn.LayerNorm(width, elementwise_affine=False, eps=1e-6)
        self.to_qkv = nn.Linear(width, 3 * width)
        self.project = nn.Linear(width, width)
        self.mlp = nn.Sequential(
            nn.Linear(width, mlp_ratio * width), nn.GELU(approximate="tanh"), nn.Linear(mlp_ratio * width, width)
        )
        self.modulation = nn.Linear(width, 6 * width)
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)

    def attend(self, x: Tensor, mask: Tensor) -> Tensor:
        """Multi-head attention of (B, S, width) over the tokens where mask (B, S) is True."""
        q, k, v = self.to_qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)  # 3 x (B, H, S, d)
        out = functional.scaled_dot_product_attention(q, k, v, attn_mask=mask[:, None, None])
        return torch.as_tensor(self.project(out.transpose(1, 2).flatten(-2)))

    def forward(self, x: Tensor, condition: Tensor, mask: Tensor) -> Tensor:
        """(B, S, width) tokens, refined under a condition (B, width); mask (B, S) is False at padding."""
        shift_a, scale_a, gate_a, shift_m, scale_m, gate_m = self.modulation(functional.silu(condition))[:, None].chunk(
            6, dim=-1
        )
        x = x + gate_a * self.attend(self.norm_attention(x) * (1 + scale_a) + shift_a, mask)
        return torch.as_tensor(x + gate_m * self.mlp(self.norm_mlp(x) * (1 + scale_m) + shift_m))
