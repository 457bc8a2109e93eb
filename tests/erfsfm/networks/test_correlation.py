"""Correlation of feature maps against its definition."""

import torch

from erfsfm.networks.correlation import expected_place, local_correlation, offsets


def test_local_correlation_is_the_product_with_each_shifted_map():
    generator = torch.Generator().manual_seed(0)
    target = torch.randn(2, 5, 6, 9, generator=generator)
    source = torch.randn(2, 5, 6 + 2, 9 + 4, generator=generator)
    shifted = [(target * source[..., y : y + 6, x : x + 9]).sum(1) for y in range(3) for x in range(5)]
    torch.testing.assert_close(local_correlation(target, source, (1, 2)), torch.stack(shifted, dim=1))
    steps = offsets((1, 2), (10.0, 1.0), torch.device("cpu"))
    assert steps[0].tolist() == [-2.0, -10.0] and steps[7].tolist() == [0.0, 0.0] and steps[14].tolist() == [2.0, 10.0]


def test_a_permuted_map_is_found_again():
    generator = torch.Generator().manual_seed(0)
    source = torch.nn.functional.normalize(torch.randn(1, 32, 4, 7, generator=generator), dim=1)
    order = torch.randperm(28, generator=generator)
    target = source.flatten(2)[..., order].reshape(1, 32, 4, 7)
    places = torch.rand(28, 2, generator=generator)
    seen, sureness = expected_place(target, source, places, torch.tensor(200.0))
    torch.testing.assert_close(seen[0], places[order], atol=1e-3, rtol=0)
    assert (sureness > 0.99).all()
