import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from trainers.experience.returns import explained_variance, gae, leave_one_out, normalize


def column(*numbers):
    return torch.tensor(numbers, dtype=torch.float64).unsqueeze(1)


def flags(*numbers):
    return torch.tensor(numbers, dtype=torch.bool).unsqueeze(1)


def rollout(seed, steps=12, envs=5, *, end_probability=0.3):
    """A random rollout; next_values are those of the next row but where an episode ended."""
    draw = torch.Generator().manual_seed(seed)

    def numbers():
        return torch.randn(steps, envs, generator=draw, dtype=torch.float64)

    def chances():
        return torch.rand(steps, envs, generator=draw)

    done = chances() < end_probability
    terminated = done & (chances() < 0.5)
    values = numbers()
    following = torch.cat([values[1:], numbers()[:1]])
    next_values = torch.where(done, numbers(), following)
    return numbers(), values, next_values, terminated, done


def advantage_by_definition(rewards, values, next_values, terminated, done, *, gamma, lambd):
    """The weighted mean of all k-step advantages (eq. 16), from sums written out per episode.

    With steps t .. end left in the episode (or the rollout), A = (1 - lambda) (A1 + lambda A2 +
    lambda^2 A3 + ...), where every k past the end repeats the last one.
    """
    steps, envs = rewards.shape
    advantages = torch.zeros_like(rewards)
    for n in range(envs):
        for t in range(steps):
            end = t
            while end < steps - 1 and not done[end, n]:
                end += 1
            k_step = []
            for last in range(t, end + 1):
                earned = sum(gamma ** (i - t) * rewards[i, n] for i in range(t, last + 1))
                ahead = 0.0 if terminated[last, n] else next_values[last, n]
                k_step.append(earned + gamma ** (last - t + 1) * ahead - values[t, n])
            total = sum((1 - lambd) * lambd**k * a for k, a in enumerate(k_step[:-1]))
            advantages[t, n] = total + lambd ** (len(k_step) - 1) * k_step[-1]
    return advantages


def test_gae_by_hand():
    advantages, returns = gae(
        rewards=column(1, 2, 4),
        values=column(10, 20, 40),
        next_values=column(20, 40, 80),
        terminated=flags(0, 0, 0),
        done=flags(0, 0, 0),
        gamma=0.5,
        lambd=0.5,
    )
    # deltas: 1 + 10 - 10 = 1, 2 + 20 - 20 = 2, 4 + 40 - 40 = 4; each step back counts a quarter
    assert advantages.squeeze(1).tolist() == [1 + 3 / 4, 2 + 1, 4]
    assert returns.squeeze(1).tolist() == [11.75, 23, 44]


def test_a_truncated_episode_is_bootstrapped_and_a_terminated_one_is_not():
    advantages, _ = gae(
        rewards=column(1, 1, 1, 1),
        values=column(0, 0, 0, 0),
        next_values=column(100, 6, 100, 8),
        terminated=flags(1, 0, 1, 0),
        done=flags(1, 1, 1, 0),
        gamma=0.5,
        lambd=1.0,
    )
    # terminated: the reward alone; truncated: + 0.5 * 6; end of the rollout: + 0.5 * 8
    assert advantages.squeeze(1).tolist() == [1, 4, 1, 5]


def test_the_value_of_a_terminal_state_is_never_looked_at():
    advantages, returns = gae(
        column(1, 1),
        column(0, 0),
        column(math.nan, 0),
        flags(1, 0),
        flags(1, 0),
        gamma=0.9,
        lambd=0.9,
    )
    assert advantages.isfinite().all()
    assert returns.isfinite().all()


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    end_probability=st.sampled_from([0.0, 0.2, 0.6, 1.0]),
    gamma=st.floats(0, 1),
    lambd=st.floats(0, 1),
)
def test_gae_is_the_sum_it_is_defined_by(seed, end_probability, gamma, lambd):
    given_rollout = rollout(seed, steps=9, envs=2, end_probability=end_probability)
    advantages, returns = gae(*given_rollout, gamma=gamma, lambd=lambd)
    expected = advantage_by_definition(*given_rollout, gamma=gamma, lambd=lambd)
    torch.testing.assert_close(advantages, expected)
    torch.testing.assert_close(returns, expected + given_rollout[1])


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**31), gamma=st.floats(0, 1))
def test_with_lambda_one_the_returns_are_the_discounted_rewards(seed, gamma):
    rewards, values, next_values, terminated, done = rollout(seed)
    advantages, returns = gae(
        rewards, values, next_values, terminated, done, gamma=gamma, lambd=1.0
    )
    following = next_values[-1]
    for t in reversed(range(len(rewards))):
        following = torch.where(done[t], next_values[t], following)
        following = torch.where(terminated[t], 0.0, following)
        following = rewards[t] + gamma * following
        torch.testing.assert_close(returns[t], following)
        torch.testing.assert_close(advantages[t], following - values[t])


def test_an_episode_does_not_see_the_next_one():
    rewards, values, next_values, terminated, done = rollout(0, end_probability=0.0)
    done[5] = True
    before, _ = gae(rewards, values, next_values, terminated, done, gamma=0.99, lambd=0.95)
    rewards[6:] += 100
    after, _ = gae(rewards, values, next_values, terminated, done, gamma=0.99, lambd=0.95)
    assert torch.equal(before[:6], after[:6])
    assert (after[6:] > before[6:] + 99).all()


def test_gae_leaves_its_inputs_alone_and_has_no_gradient():
    inputs = rollout(1)
    inputs[1].requires_grad_()
    copies = [tensor.clone() for tensor in inputs]
    advantages, returns = gae(*inputs, gamma=0.99, lambd=0.95)
    assert all(torch.equal(a, b) for a, b in zip(inputs, copies, strict=True))
    assert not advantages.requires_grad
    assert not returns.requires_grad


def test_gae_keeps_single_precision():
    rewards, values, next_values, terminated, done = rollout(1)
    discounts = {"gamma": 0.9, "lambd": 0.9}
    single = gae(
        rewards.float(), values.float(), next_values.float(), terminated, done, **discounts
    )
    double = gae(rewards, values, next_values, terminated, done, **discounts)
    for mine, exact in zip(single, double, strict=True):
        assert mine.dtype == torch.float32
        torch.testing.assert_close(mine.double(), exact, atol=1e-5, rtol=1e-5)


def test_normalize_by_hand():
    # mean 3, mean square deviation 4
    normalized = normalize(torch.tensor([[1.0, 5.0], [1.0, 5.0]]))
    torch.testing.assert_close(normalized, torch.tensor([[-1.0, 1.0], [-1.0, 1.0]]))


@pytest.mark.parametrize("count", [1, 2, 999])
@pytest.mark.parametrize("level", [0.0, 0.1, -1e6])
def test_normalize_makes_equal_values_zero(count, level):
    assert normalize(torch.full((count,), level)).tolist() == [0.0] * count


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.integers(-1000, 1000), min_size=2, max_size=30).filter(lambda x: len(set(x)) > 1),
    st.floats(-1e3, 1e3),
)
def test_normalize_gives_mean_zero_and_deviation_one_wherever_the_values_lie(numbers, shift):
    advantages = torch.tensor(numbers, dtype=torch.float64)
    normalized = normalize(advantages)
    assert normalized.mean().item() == pytest.approx(0, abs=1e-9)
    assert normalized.square().mean().item() == pytest.approx(1, abs=1e-6)
    torch.testing.assert_close(normalize(advantages + shift), normalized, atol=1e-6, rtol=1e-6)


def test_explained_variance_by_hand():
    returns = torch.tensor([[0.0, 4.0], [0.0, 4.0]])
    assert explained_variance(returns, returns) == 1
    assert explained_variance(returns, returns + 7) == 1  # a constant error is no variance
    assert explained_variance(returns, torch.zeros(2, 2)) == 0
    assert explained_variance(returns, returns / 2) == pytest.approx(0.75)
    assert explained_variance(returns, -returns) == -3


@pytest.mark.parametrize("returns", [torch.full((999,), 0.1), torch.tensor([3.0])])
def test_explained_variance_of_equal_returns_is_zero(returns):
    values = torch.linspace(-1, 1, len(returns))
    assert explained_variance(returns, values) == 0
    assert explained_variance(returns, returns) == 0


def test_a_return_is_compared_with_the_mean_of_the_others_of_its_group():
    returns = torch.tensor([1.0, 5.0, 2.0, 6.0, 3.0])
    groups = torch.tensor([2, 0, 2, 1, 2])
    # Of group 2: 1 - (2 + 3) / 2, 2 - (1 + 3) / 2 and 3 - (1 + 2) / 2; 0 and 1 have one each.
    assert leave_one_out(returns, groups).tolist() == [-1.5, 0.0, 0.0, 0.0, 1.5]


@given(seed=st.integers(0, 10**6), count=st.integers(1, 40), kinds=st.integers(1, 6))
def test_an_own_return_has_no_part_in_its_baseline(seed, count, kinds):
    draw = torch.Generator().manual_seed(seed)
    returns = torch.randn(count, generator=draw, dtype=torch.float64)
    groups = torch.randint(kinds, (count,), generator=draw)
    baseline = returns - leave_one_out(returns, groups)
    others = [
        [float(returns[j]) for j in range(count) if j != i and groups[j] == groups[i]]
        for i in range(count)
    ]
    expected = [sum(o) / len(o) if o else float(returns[i]) for i, o in enumerate(others)]
    assert baseline.tolist() == pytest.approx(expected, abs=1e-12)
