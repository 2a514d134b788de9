"""Running normalisation of the observation."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cura_torchrl.modules import ObservationNorm

FEATURES = 3


def _data(rows: int = 1000) -> torch.Tensor:
    return torch.randn(rows, FEATURES) * torch.tensor([0.1, 1.0, 50.0]) + torch.tensor([1000.0, 0.0, -3.0])


def test_before_the_first_update_values_pass_through() -> None:
    """Catches a division by a standard deviation of zero, or a shift by statistics nobody gave."""
    x = torch.tensor([[0.5, -2.0, 9.0]])
    assert torch.equal(ObservationNorm(FEATURES)(x), x)


def test_statistics_are_those_of_all_data_whatever_the_batches() -> None:
    """Catches an average of batch means, and cancellation at a large offset, against NumPy in float64."""
    data = _data()
    norm = ObservationNorm(FEATURES)
    for batch in (data[:1], data[1:4], data[4:700].reshape(4, 174, FEATURES), data[700:]):
        norm.update(batch)
    exact = data.numpy().astype(np.float64)
    # 1000 rows of a feature at 1000 +- 0.1: double precision keeps 1e-10 of the deviation.
    assert np.allclose(norm.mean.numpy(), exact.mean(0), rtol=1e-12)
    assert np.allclose((norm.squared_deviation / norm.count).sqrt().numpy(), exact.std(0), rtol=1e-9)


def test_normalised_data_has_mean_zero_and_deviation_one() -> None:
    """Catches a forward that uses the variance for the deviation."""
    data = _data(5000)
    norm = ObservationNorm(FEATURES)
    norm.update(data)
    out = norm(data)
    assert torch.allclose(out.mean(0), torch.zeros(FEATURES), atol=1e-3)  # float32 at an offset of 10,000 deviations
    assert torch.allclose(out.std(0), torch.ones(FEATURES), atol=1e-2)


def test_forward_changes_no_statistics() -> None:
    """Catches a norm that moves between collection and loss, which makes PPO's ratios wrong."""
    norm = ObservationNorm(FEATURES).train()
    norm.update(_data())
    before = {name: value.clone() for name, value in norm.state_dict().items()}
    norm(_data())
    assert all(torch.equal(before[name], value) for name, value in norm.state_dict().items())


def test_output_is_clipped() -> None:
    """Catches an outlier that saturates the first layer."""
    norm = ObservationNorm(1, clip=10.0)
    norm.update(torch.tensor([[-1.0], [1.0]]))
    assert norm(torch.tensor([[1e6], [-1e6], [3.0]])).tolist() == [[10.0], [-10.0], [3.0]]


def test_a_constant_feature_is_divided_by_the_floor() -> None:
    """Catches noise of 1e-6 on a feature that never moved coming out as +-10."""
    norm = ObservationNorm(1, min_std=0.01)
    norm.update(torch.full((100, 1), 5.0))
    assert norm(torch.tensor([[5.001]])).item() == pytest.approx(0.1, rel=1e-3)


def test_a_value_that_is_not_finite_is_refused_and_leaves_the_statistics() -> None:
    """Catches one NaN that poisons the statistics for the rest of the run."""
    norm = ObservationNorm(2)
    norm.update(torch.zeros(4, 2))
    with pytest.raises(ValueError, match="1 values that are not finite"):
        norm.update(torch.tensor([[0.0, float("nan")]]))
    assert norm.count.item() == 4
    assert norm.mean.isfinite().all()


def test_a_batch_of_another_width_is_refused() -> None:
    """Catches statistics of a wrong key that happen to broadcast."""
    with pytest.raises(ValueError, match=r"batch has shape \(4, 1\); accepted: \[..., 3\]"):
        ObservationNorm(FEATURES).update(torch.zeros(4, 1))


def test_an_empty_batch_changes_nothing() -> None:
    """Catches a mean of nothing, which is NaN."""
    norm = ObservationNorm(FEATURES)
    norm.update(torch.zeros(0, FEATURES))
    assert norm.count.item() == 0
    assert torch.equal(norm.mean, torch.zeros(FEATURES, dtype=torch.float64))


def test_the_state_dict_restores_the_output_exactly() -> None:
    """Catches statistics that are not saved: a resumed or evaluated policy would see other observations."""
    norm, copy = ObservationNorm(FEATURES), ObservationNorm(FEATURES)
    norm.update(_data())
    copy.load_state_dict(norm.state_dict())
    x = _data()
    assert torch.equal(copy(x), norm(x))


def test_it_has_no_parameters() -> None:
    """Catches statistics that an optimiser would move."""
    assert list(ObservationNorm(FEATURES).parameters()) == []


@pytest.mark.parametrize("kwargs", [{"num_features": 0}, {"clip": 0.0}, {"min_std": -1.0}])
def test_arguments_that_are_not_positive_are_refused(kwargs: dict[str, float]) -> None:
    """Catches a clip of zero, which would blind the policy without a word."""
    with pytest.raises(ValueError, match="accepted: a positive number"):
        ObservationNorm(**{"num_features": 3, **kwargs})
