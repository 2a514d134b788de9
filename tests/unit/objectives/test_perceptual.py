"""The part of the uncertainty that seeing the whole state would remove."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from cura_torchrl.modules import DistributionalCollisionEstimator
from cura_torchrl.objectives import PerceptualObjective

PRIVILEGED_KEYS = ("privileged_atoms", "privileged_risk", "privileged_uncertainty")
PERCEPTUAL_KEYS = ("perceptual_atoms", "perceptual_risk", "uncertainty")


def make_objective(num_atoms: int = 20) -> PerceptualObjective:
    """Estimators of a state of one number beside an observation of one."""
    torch.manual_seed(0)
    options = {"num_atoms": num_atoms, "hidden_sizes": (16,)}
    return PerceptualObjective(
        DistributionalCollisionEstimator(
            2, in_keys=("observation", "obstacle_code"), out_keys=PRIVILEGED_KEYS, **options
        ),
        DistributionalCollisionEstimator(1, in_keys=("observation",), out_keys=PERCEPTUAL_KEYS, **options),
    )


def hidden_coins() -> TensorDict:
    """400 episodes of one step: an unseen coin decides whether 20 % or 80 % of them end in a collision."""
    code = (torch.arange(400) % 2).float().reshape(400, 1, 1)
    is_hit = torch.cat([torch.tensor([[float(i < 40)], [float(i < 160)]]) for i in range(200)]).reshape(400, 1, 1)
    end = torch.ones(400, 1, 1, dtype=torch.bool)
    seen = {"observation": torch.zeros(400, 1, 1), "obstacle_code": code}
    return TensorDict({**seen, "next": {**seen, "cost": is_hit, "done": end, "terminated": end}}, [400, 1])


def test_it_learns_the_variance_that_an_unseen_coin_makes() -> None:
    """Catches the total variance, or that within a state: 0.25 = 0.16 within + 0.09 between the coin's sides.

    The expected possibility is 0.2 or 0.8 with even odds: variance 0.3^2.
    """
    objective, data = make_objective(), hidden_coins()
    optimizer = torch.optim.Adam(objective.parameters(), lr=1e-2)
    for _ in range(300):
        losses = objective.losses(objective.targets(data.clone()).reshape(-1))
        optimizer.zero_grad()
        sum(losses.values()).backward()
        optimizer.step()
    with torch.no_grad():
        state = objective.privileged_network(data.select("observation", "obstacle_code"))
        seen = objective.perceptual_network(data.select("observation"))
    assert state["privileged_risk"][:2].flatten().tolist() == pytest.approx([0.2, 0.8], abs=0.05)
    assert state["privileged_uncertainty"].mean().item() == pytest.approx(0.16, abs=0.03)
    assert seen["perceptual_risk"].mean().item() == pytest.approx(0.5, abs=0.05)
    assert seen["uncertainty"].mean().item() == pytest.approx(0.09, abs=0.015)


def test_targets_follow_the_estimator_that_sees_the_state() -> None:
    """Catches bootstrapping from the observation's estimator, another discount, and an expectation outside of [0, 1].

    Both atoms are the code +- 0.1. With lambda = 0 the target is 0.5 * atoms at the next state, and the cost alone at
    the collision.
    """
    privileged = TensorDictModule(
        lambda code: (torch.cat([code - 0.1, code + 0.1], -1), code, code), ["obstacle_code"], list(PRIVILEGED_KEYS)
    )
    objective = PerceptualObjective(privileged, make_objective().perceptual_network, gamma=0.5, lmbda=0.0)
    end = torch.tensor([[[False], [True]]])
    codes = torch.tensor([[[0.3], [0.4], [1.2]]])
    after = {"obstacle_code": codes[:, 1:], "cost": end.float(), "done": end, "terminated": end}
    data = TensorDict({"obstacle_code": codes[:, [0, 2]], "next": after}, [1, 2])
    objective.targets(data)
    torch.testing.assert_close(data["privileged_target"][0], torch.tensor([[0.15, 0.25], [1.0, 1.0]]))
    torch.testing.assert_close(data["perceptual_target"][0], torch.tensor([[0.3], [1.0]]))


def test_padding_after_an_open_trajectory_does_not_reach_its_targets() -> None:
    """Catches targets that run on from a trajectory's last step, which is not done, into its padding."""
    torch.manual_seed(0)
    seen = {"observation": torch.rand(2, 8, 1), "obstacle_code": torch.rand(2, 8, 1)}
    no = torch.zeros(2, 8, 1, dtype=torch.bool)
    data = TensorDict({**seen, "next": {**seen, "cost": no.float(), "done": no, "terminated": no}}, [2, 8])
    objective = make_objective()
    objective.lmbda = 1.0
    expected = objective.targets(data[:, :5].clone())["privileged_target"]
    data["next", "cost"][:, 5:] = 1.0
    data["collector", "mask"] = (torch.arange(8) < 5).expand(2, 8)
    torch.testing.assert_close(objective.targets(data)["privileged_target"][:, :5], expected)


def test_a_rollout_without_the_cost_is_refused() -> None:
    """Catches an error that does not name what is missing."""
    data = hidden_coins()
    del data["next", "cost"]
    with pytest.raises(KeyError, match=r"\('next', 'cost'\) is missing"):
        make_objective().targets(data)


@pytest.mark.parametrize("name", ["privileged", "perceptual"])
def test_each_loss_trains_its_own_estimator(name: str) -> None:
    """Catches an expectation that is made easy to predict in place of being right."""
    objective = make_objective()
    losses = objective.losses(objective.targets(hidden_coins()).reshape(-1))
    losses[f"loss_{name}"].backward()
    reached = {key.split("_")[0] for key, value in objective.named_parameters() if value.grad is not None}
    assert reached == {name}


def test_the_random_choices_go_on_after_a_restore() -> None:
    """Catches a resumed run whose targets are not those of an unbroken one."""
    objective, other = make_objective(), make_objective()
    seen = {"observation": torch.zeros(2, 8, 1), "obstacle_code": torch.rand(2, 8, 1)}
    no = torch.zeros(2, 8, 1, dtype=torch.bool)
    data = TensorDict({**seen, "next": {**seen, "cost": no.float(), "done": no, "terminated": no}}, [2, 8])
    before = objective.targets(data.clone())["privileged_target"]
    other.load_state_dict(objective.state_dict())
    after = objective.targets(data.clone())["privileged_target"]
    assert not torch.equal(after, before)
    assert torch.equal(other.targets(data.clone())["privileged_target"], after)
