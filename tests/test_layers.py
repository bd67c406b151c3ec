"""Attention on neighbours, DiT blocks and encodings do what their docstrings say."""

import math

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from daptrain.layers import (  # noqa: E402
    DiTBlock,
    FourierPosition,
    GroupedVectorAttention,
    Neighbours,
    PointBlock,
    PointEncoder,
    TimeToken,
    gather,
    neighbours,
)


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def cloud(B: int, N: int, C: int):
    return torch.randn(B, N, 3), torch.randn(B, N, C), torch.ones(B, N, dtype=torch.bool)


def brute_force(layer: GroupedVectorAttention, query, key, query_points, key_points, k: int):
    """Grouped vector attention as its formula reads, one query at a time."""
    q, kk, v = layer.to_query(query), layer.to_key(key), layer.to_value(key)
    out = torch.zeros_like(query)
    size = query.shape[-1] // layer.groups
    for b in range(query.shape[0]):
        for i in range(query.shape[1]):
            near = (key_points[b] - query_points[b, i]).norm(dim=-1).argsort()[:k]
            bias = layer.offset_out(layer.offset_hidden(key_points[b, near] - query_points[b, i]))
            weight = layer.weight(layer.relation(kk[b, near] - q[b, i] + bias)).softmax(dim=0)
            for j, n in enumerate(near):
                for g in range(layer.groups):
                    part = slice(g * size, (g + 1) * size)
                    out[b, i, part] += weight[j, g] * (v[b, n] + bias[j])[part]
    return out


def test_grouped_vector_attention_equals_its_formula():
    query_points, query, _ = cloud(2, 7, 12)
    key_points, key, mask = cloud(2, 11, 12)
    layer = GroupedVectorAttention(12, groups=3)
    fast = layer(query, key, neighbours(query_points, key_points, mask, 5))
    torch.testing.assert_close(fast, brute_force(layer, query, key, query_points, key_points, 5), atol=2e-6, rtol=1e-5)


def test_permuting_the_points_permutes_the_features():
    points, features, mask = cloud(1, 20, 8)
    encoder = PointEncoder(8, 12, layers=2, groups=3)
    order = torch.randperm(20)
    straight = encoder(features, neighbours(points, points, mask, 6))
    shuffled = encoder(features[:, order], neighbours(points[:, order], points[:, order], mask, 6))
    torch.testing.assert_close(shuffled, straight[:, order], atol=1e-5, rtol=1e-4)


def test_moving_a_cloud_leaves_its_attention():
    points, features, mask = cloud(1, 20, 12)
    block = PointBlock(12, groups=3)
    here = block(features, features, neighbours(points, points, mask, 6))
    there = block(features, features, neighbours(points + 1, points + 1, mask, 6))
    torch.testing.assert_close(here, there, atol=1e-5, rtol=1e-4)


def test_gather_picks_rows_and_sums_their_gradients():
    features = torch.randn(2, 5, 3, requires_grad=True)
    index = torch.tensor([[[0, 1], [1, 1]], [[4, 0], [2, 3]]])
    picked = gather(features, index)
    torch.testing.assert_close(picked, torch.stack([features[b][index[b]] for b in range(2)]))
    picked.sum().backward()
    assert features.grad is not None
    np.testing.assert_array_equal(features.grad[0, :, 0], [1, 3, 0, 0, 0])


def test_neighbours_are_the_nearest_and_never_padding():
    points, _, mask = cloud(2, 9, 1)
    mask[1, 4:] = False
    near = neighbours(points, points, mask, 6)
    assert near.valid[0].all()
    np.testing.assert_array_equal(near.valid[1].sum(dim=-1), np.full(9, 4))
    assert near.index[1][near.valid[1]].max() < 4
    np.testing.assert_array_equal(near.index[0, :, 0], np.arange(9))
    torch.testing.assert_close(near.offset[0, 2, 1], points[0, near.index[0, 2, 1]] - points[0, 2])


def test_a_dit_block_starts_as_the_identity():
    block, x = DiTBlock(16, heads=2), torch.randn(2, 5, 16)
    mask = torch.ones(2, 5, dtype=torch.bool)
    torch.testing.assert_close(block(x, torch.randn(2, 16), mask), x, atol=0, rtol=0)


def test_a_dit_block_attends_as_softmax_of_products_says():
    block, x = DiTBlock(8, heads=2), torch.randn(1, 5, 8)
    mask = torch.tensor([[True, True, True, True, False]])
    q, k, v = block.to_qkv(x)[0].view(5, 3, 2, 4).unbind(dim=1)
    heads = []
    for h in range(2):
        weight = (q[:, h] @ k[:4, h].T / math.sqrt(4)).softmax(dim=-1)
        heads.append(weight @ v[:4, h])
    torch.testing.assert_close(block.attend(x, mask)[0], block.project(torch.cat(heads, dim=-1)), atol=1e-6, rtol=1e-5)


def test_fourier_position_tells_places_apart_and_is_smooth():
    encode = FourierPosition(32)
    points = torch.randn(50, 3)
    code = encode(points)
    assert code.shape == (50, 32)
    assert torch.cdist(code, code).fill_diagonal_(math.inf).min() > 1e-3
    assert (encode(points + 1e-4) - code).norm(dim=-1).max() < 1e-2


def test_fourier_features_are_cosines_and_sines_of_learned_frequencies():
    encode = FourierPosition(4, frequencies=3)
    point = torch.tensor([0.3, -0.2, 0.5])
    phase = [2 * math.pi * sum(point[i] * encode.frequency[i, f].item() for i in range(3)) for f in range(3)]
    by_hand = torch.tensor([math.cos(p) for p in phase] + [math.sin(p) for p in phase])
    torch.testing.assert_close(encode(point), encode.project(by_hand), atol=1e-6, rtol=1e-5)


def test_time_tokens_differ_from_step_to_step():
    tokens = TimeToken(16)(torch.arange(100))
    assert torch.cdist(tokens, tokens).fill_diagonal_(math.inf).min() > 1e-4


def test_fewer_points_than_neighbours_is_fine():
    points, features, mask = cloud(1, 3, 12)
    near = neighbours(points, points, mask, 16)
    assert isinstance(near, Neighbours)
    assert PointBlock(12, groups=2)(features, features, near).isfinite().all()
