"""Steps of equal size in every direction for kernels; Adam for the rest."""

import pytest
import torch
from torch import nn

from erfsfm.training.muon import Muon, is_matrix, orthogonalised


@pytest.mark.parametrize("shape", [(4, 4), (3, 50), (50, 3), (16, 144)])
def test_singular_values_become_about_one_and_vectors_stay(shape: tuple[int, int]) -> None:
    torch.manual_seed(0)
    U, _, Vt = torch.linalg.svd(torch.randn(shape), full_matrices=False)
    values = torch.logspace(0, -1, len(Vt))
    result = orthogonalised(U @ torch.diag(values) @ Vt)
    inside = U.T @ result @ Vt.T
    assert torch.allclose(inside - torch.diag(inside.diag()), torch.zeros_like(inside), atol=1e-4)
    assert float(inside.diag().min()) > 0.6 and float(inside.diag().max()) < 1.3


def test_no_gradient_no_step() -> None:
    assert torch.equal(orthogonalised(torch.zeros(3, 5)), torch.zeros(3, 5))


def test_other_parameters_follow_adam() -> None:
    torch.manual_seed(1)
    ours, theirs = nn.Parameter(torch.ones(5)), nn.Parameter(torch.ones(5))
    muon, adam = Muon([{"params": [ours]}], lr=0.01), torch.optim.Adam([theirs], lr=0.01)
    for _ in range(20):
        ours.grad = theirs.grad = torch.randn(5)
        muon.step()
        adam.step()
    assert torch.allclose(ours, theirs, atol=1e-6)


def test_the_step_size_of_a_kernel_does_not_depend_on_the_gradients() -> None:
    torch.manual_seed(2)
    for scale in (1e-6, 1.0, 1e6):
        kernel = nn.Parameter(torch.zeros(8, 4, 3, 3))
        kernel.grad = scale * torch.randn_like(kernel)
        Muon([{"params": [kernel], "orthogonal": True}], lr=0.1).step()
        assert 0.5 * 0.02 < float(kernel.detach().square().mean().sqrt()) < 1.3 * 0.02


def test_a_restored_state_continues_bit_for_bit() -> None:
    def steps(parameters: list[nn.Parameter], optimiser: Muon, first: int, last: int) -> None:
        for seed in range(first, last):
            torch.manual_seed(seed)
            for parameter in parameters:
                parameter.grad = torch.randn_like(parameter)
            optimiser.step()

    def fresh() -> tuple[list[nn.Parameter], Muon]:
        parameters = [nn.Parameter(torch.ones(4, 3, 3, 3)), nn.Parameter(torch.ones(4))]
        groups = [{"params": parameters[:1], "orthogonal": True}, {"params": parameters[1:]}]
        return parameters, Muon(groups, lr=0.05)

    whole, optimiser = fresh()
    steps(whole, optimiser, 0, 10)
    first, optimiser = fresh()
    steps(first, optimiser, 0, 4)
    second, resumed = fresh()
    resumed.load_state_dict(optimiser.state_dict())
    for source, target in zip(first, second):
        target.data.copy_(source.data)
    steps(second, resumed, 4, 10)
    assert all(torch.equal(a, b) for a, b in zip(whole, second))


def test_heads_of_one_channel_and_biases_are_no_matrices() -> None:
    head, layer = nn.Conv2d(8, 1, 3), nn.Conv2d(8, 4, 3)
    assert is_matrix(layer.weight)
    assert not is_matrix(head.weight) and not is_matrix(layer.bias)  # type: ignore[arg-type]
