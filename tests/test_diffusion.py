"""The diffusion's formulas agree with their closed forms, and its sampler with an all-knowing denoiser."""

import math

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from daptrain import diffusion  # noqa: E402

ALPHA_BAR = diffusion.cosine_alpha_bar(100)


def normal(seed: int):
    rng = np.random.default_rng(seed)
    return lambda shape: torch.from_numpy(rng.standard_normal(shape))


def test_the_schedule_falls_from_almost_one_to_almost_zero():
    assert len(ALPHA_BAR) == 100
    assert (ALPHA_BAR[1:] < ALPHA_BAR[:-1]).all()
    assert ALPHA_BAR[0] == pytest.approx(1 - 6.3e-4, abs=1e-5)  # diffusers' squaredcos_cap_v2 begins so
    assert ALPHA_BAR[99] == pytest.approx(2.4e-7, rel=0.05)


def test_noise_added_step_by_step_has_the_closed_form_moments():
    s0, kept = 0.7, np.r_[ALPHA_BAR[0], ALPHA_BAR[1:] / ALPHA_BAR[:-1]]
    mean, variance = s0, 0.0
    for alpha in kept[:40]:
        mean, variance = math.sqrt(alpha) * mean, alpha * variance + 1 - alpha
    clean = torch.full((200_000,), s0, dtype=torch.float64)
    drawn = diffusion.add_noise(clean, ALPHA_BAR[39], normal(0)((200_000,)))
    assert mean == pytest.approx(s0 * math.sqrt(ALPHA_BAR[39]), rel=1e-12)
    assert float(drawn.mean()) == pytest.approx(mean, abs=0.01)
    assert float(drawn.var()) == pytest.approx(variance, abs=0.01)


def test_the_clean_score_comes_back_from_the_noise():
    clean, noise = torch.randn(3, 5, dtype=torch.float64), torch.randn(3, 5, dtype=torch.float64)
    noisy = diffusion.add_noise(clean, ALPHA_BAR[60], noise)
    torch.testing.assert_close(diffusion.clean_from_noise(noisy, ALPHA_BAR[60], noise), clean)


@pytest.mark.parametrize("t", [1, 50, 99])
def test_the_posterior_is_ddpms(t):
    alpha, bar, before = float(ALPHA_BAR[t] / ALPHA_BAR[t - 1]), float(ALPHA_BAR[t]), float(ALPHA_BAR[t - 1])
    noisy, clean = torch.tensor([0.4]), torch.tensor([-0.9])
    mean, variance = diffusion.posterior(noisy, clean, bar, before)
    beta = 1 - alpha
    by_hand = math.sqrt(before) * beta / (1 - bar) * clean + math.sqrt(alpha) * (1 - before) / (1 - bar) * noisy
    torch.testing.assert_close(mean, by_hand)
    assert variance == pytest.approx((1 - before) / (1 - bar) * beta, rel=1e-12)


def test_the_posterior_of_a_long_stride_keeps_the_marginal():
    """Noising to step 80 and stepping back to step 30 gives the distribution of step 30."""
    clean = torch.full((400_000,), 0.6, dtype=torch.float64)
    draw = normal(1)
    noisy = diffusion.add_noise(clean, ALPHA_BAR[80], draw(clean.shape))
    mean, variance = diffusion.posterior(noisy, clean, float(ALPHA_BAR[80]), float(ALPHA_BAR[30]))
    back = mean + math.sqrt(variance) * draw(clean.shape)
    assert float(back.mean()) == pytest.approx(0.6 * math.sqrt(ALPHA_BAR[30]), abs=0.01)
    assert float(back.var()) == pytest.approx(1 - float(ALPHA_BAR[30]), abs=0.01)


@pytest.mark.parametrize("steps", [1, 5, 20, 100, 1000])
def test_an_all_knowing_denoiser_gives_back_the_truth(steps):
    truth = torch.sign(torch.randn(2, 30, dtype=torch.float64))
    drawn = diffusion.sample(lambda noisy, t: truth, (2, 30), ALPHA_BAR, steps, normal(2))
    torch.testing.assert_close(drawn, truth)


def test_a_denoiser_that_knows_two_modes_gives_both_and_no_mixture():
    """The exact posterior mean of a two-point distribution must sample each point about half of the time."""
    modes = torch.tensor([[1.0, 1, -1, -1], [-1, -1, 1, 1]], dtype=torch.float64)

    def denoise(noisy, t):
        square = ((noisy[:, None] - math.sqrt(ALPHA_BAR[t]) * modes) ** 2).sum(dim=-1)
        return (-square / (2 * (1 - ALPHA_BAR[t]))).softmax(dim=1) @ modes

    drawn = diffusion.sample(denoise, (1000, 4), ALPHA_BAR, 20, normal(3))
    torch.testing.assert_close(drawn.abs(), torch.ones_like(drawn), atol=1e-3, rtol=0)
    assert (drawn[:, 0] == drawn[:, 1]).all() or float((drawn[:, 0] - drawn[:, 1]).abs().max()) < 1e-3
    assert 0.44 < float((drawn[:, 0] > 0).double().mean()) < 0.56


def test_the_way_of_a_sample_begins_with_noise_ends_with_it_and_says_how_much_noise_is_left():
    modes = torch.tensor([[1.0, 1, -1, -1], [-1, -1, 1, 1]], dtype=torch.float64)
    way = list(diffusion.walk(lambda noisy, t: modes[:1].expand_as(noisy), (500, 4), ALPHA_BAR, 5, normal(4)))
    left = [t for t, _ in way]
    assert left == [100, 75, 51, 26, 1, 0]
    torch.testing.assert_close(way[0][1], normal(4)((500, 4)))
    for t, s in way[1:-1]:  # what the forward process makes of the clean score in so many steps
        kept = float(ALPHA_BAR[t - 1])
        assert float((s - math.sqrt(kept) * modes[0]).std()) == pytest.approx(math.sqrt(1 - kept), rel=0.1)
    torch.testing.assert_close(way[-1][1], modes[:1].expand(500, 4))
    sample = diffusion.sample(lambda noisy, t: modes[:1].expand_as(noisy), (500, 4), ALPHA_BAR, 5, normal(4))
    assert torch.equal(sample, way[-1][1])


def test_sampling_visits_the_first_and_the_last_step():
    visited = []
    diffusion.sample(lambda noisy, t: visited.append(t) or noisy, (1,), ALPHA_BAR, 5, normal(0))
    assert visited == [99, 74, 50, 25, 0]
