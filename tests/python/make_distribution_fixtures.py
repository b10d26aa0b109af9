"""PyTorch's numbers for the distributions of the other low levels: mixtures and products of Gaussians.

    python tests/python/make_distribution_fixtures.py --seed 1 --out tests/fixtures/vmpo

Needs requirements-vmpo.txt (see bare_torch.py where torch came without its dependencies). The same seed gives the
same numbers. Inputs are float32, everything else float64 on them. With N rows, K components, A dimensions:

`mixture_*.npz`; old = behaviour, new = current:
    logits, old_logits [N, K], mean, std, old_mean, old_std [N, K, A], action [N, A]
    log_prob [N]            of action under the new mixture (torch.distributions.MixtureSameFamily)
    expectation [N, A]      of the new mixture
    kl_weights [N]          KL(Categorical(old) || Categorical(new))
    kl_mean, kl_std [N]     of each component as for one Gaussian (torch.distributions.kl_divergence between the old
                            component and one with the new mean, or the new standard deviation), averaged with the old
                            weights
    grad_logits, grad_mean, grad_std
                            of the sum of all four of log_prob, kl_weights, kl_mean and kl_std
`product_*.npz`; old = behaviour:
    logits, old_logits [N, K], mean, std, old_mean, old_std [N, K, A], action [N, A]; the exponents are sigmoid(logits)
    product_mean, product_std [N, A], log_prob [N] of action
    kl_mean, kl_std [N]     KL of the old product to one with the new mean, or the new standard deviation
    grad_logits, grad_mean, grad_std   of the sum of all three of log_prob, kl_mean and kl_std

The product is normalised on a grid here: the density of its Gaussian is compared with the product of the densities,
each to its exponent, before anything is written.
"""

import argparse
import os
import pathlib
import sys

sys.setdlopenflags(os.RTLD_LAZY)  # see bare_torch.py

import numpy as np
import torch
from torch import distributions

# name: rows, components, dimensions, how far the new distribution is from the old one, scale of the deviations
MIXTURES = {
    "small": (6, 2, 3, 1.0, 1.0),
    "policy": (16, 5, 56, 0.2, 0.2),
    "near": (16, 5, 56, 1e-3, 0.1),
    "lonely": (8, 5, 4, 0.5, 0.3),
}
# name: rows, components, dimensions, scale of the deviations
PRODUCTS = {"small": (6, 2, 3, 1.0), "policy": (16, 5, 56, 0.2)}


def learnt(array):
    return torch.from_numpy(array.astype(np.float64)).requires_grad_()


def diagonal(mean, std):
    return distributions.Independent(distributions.Normal(mean, std), 1)


def components(random, shape, scale):
    return random.normal(0.0, 0.5, shape), scale * np.exp(random.normal(0.0, 0.4, shape))


def mixture(random, name, rows, count, actions, distance, scale):
    shape = (rows, count, actions)
    old_mean, old_std = components(random, shape, scale)
    # Weights that float32 hardly holds, too.
    old_logits = random.normal(0.0, 12.0 if name == "lonely" else 1.0, (rows, count))
    inputs = {
        "old_logits": old_logits,
        "old_mean": old_mean,
        "old_std": old_std,
        "logits": old_logits + distance * random.normal(0.0, 1.0, (rows, count)),
        "mean": old_mean + distance * old_std * random.normal(0.0, 1.0, shape),
        "std": old_std * np.exp(0.5 * distance * random.normal(0.0, 1.0, shape)),
    }
    chosen = random.integers(0, count, rows)
    drawn = random.normal(0.0, 1.0, (rows, actions))
    inputs["action"] = inputs["mean"][np.arange(rows), chosen] + inputs["std"][np.arange(rows), chosen] * drawn
    inputs = {key: np.asarray(value, np.float32) for key, value in inputs.items()}
    x = {key: learnt(value) for key, value in inputs.items()}
    old, new = (distributions.Categorical(logits=x[key]) for key in ("old_logits", "logits"))
    density = distributions.MixtureSameFamily(new, diagonal(x["mean"], x["std"]))
    before = diagonal(x["old_mean"], x["old_std"])

    def averaged(other):
        return (old.probs * distributions.kl_divergence(before, other)).sum(-1)

    outputs = {
        "log_prob": density.log_prob(x["action"]),
        "kl_weights": distributions.kl_divergence(old, new),
        "kl_mean": averaged(diagonal(x["mean"], x["old_std"])),
        "kl_std": averaged(diagonal(x["old_mean"], x["std"])),
    }
    gradients = torch.autograd.grad(sum(value.sum() for value in outputs.values()), [x[k] for k in LEARNT])
    outputs["expectation"] = density.mean
    return inputs, outputs, gradients


LEARNT = ("logits", "mean", "std")


def product(random, _, rows, count, actions, scale):
    mean, std = components(random, (rows, count, actions), scale)
    inputs = {
        "logits": random.normal(0.0, 1.5, (rows, count)),
        "mean": mean,
        "std": std,
        "action": random.normal(0.0, 0.5, (rows, actions)),
    }
    inputs |= {
        "old_logits": inputs["logits"] + 0.3 * random.normal(0.0, 1.0, (rows, count)),
        "old_mean": mean + 0.3 * std * random.normal(0.0, 1.0, mean.shape),
        "old_std": std * np.exp(0.2 * random.normal(0.0, 1.0, std.shape)),
    }
    inputs = {key: np.asarray(value, np.float32) for key, value in inputs.items()}
    x = {key: learnt(value) for key, value in inputs.items()}
    exponents, composed_mean, composed_std = composed(x["logits"], x["mean"], x["std"])
    check_on_a_grid(x, exponents, composed_mean, composed_std)
    _, *old = composed(x["old_logits"], x["old_mean"], x["old_std"])
    old_mean, old_std = (value.detach() for value in old)
    before = diagonal(old_mean, old_std)
    outputs = {
        "log_prob": diagonal(composed_mean, composed_std).log_prob(x["action"]),
        "kl_mean": distributions.kl_divergence(before, diagonal(composed_mean, old_std)),
        "kl_std": distributions.kl_divergence(before, diagonal(old_mean, composed_std)),
    }
    gradients = torch.autograd.grad(sum(value.sum() for value in outputs.values()), [x[k] for k in LEARNT])
    return inputs, outputs | {"product_mean": composed_mean, "product_std": composed_std}, gradients


def composed(logits, mean, std):
    """Exponents, mean and standard deviation of the Gaussians' product."""
    exponents = torch.sigmoid(logits).unsqueeze(-1)
    precision = (exponents / std**2).sum(1)
    return exponents, (exponents * mean / std**2).sum(1) / precision, precision**-0.5


def check_on_a_grid(x, exponents, mean, std):
    """Of the first row's first dimension: the product of the densities to their exponents, normalised by a sum."""
    with torch.no_grad():
        grid = torch.linspace(-8, 8, 20001, dtype=torch.float64) * std[0, 0] + mean[0, 0]
        parts = distributions.Normal(x["mean"][0, :, :1], x["std"][0, :, :1]).log_prob(grid)
        unnormalised = (exponents[0] * parts).sum(0).exp()
        density = unnormalised / torch.trapezoid(unnormalised, grid)
        found = distributions.Normal(mean[0, 0], std[0, 0]).log_prob(grid).exp()
        error = ((density - found).abs().max() / found.max()).item()
    if not error < 1e-6:
        raise SystemExit(f"the product is {error:.1e} away from the densities' product")


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=pathlib.Path, required=True, help="folder to write into")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)

    cases = [
        *((f"mixture_{name}", mixture, (name, *case)) for name, case in MIXTURES.items()),
        *((f"product_{name}", product, (name, *case)) for name, case in PRODUCTS.items()),
    ]
    streams = np.random.SeedSequence(arguments.seed).spawn(len(cases))
    for (name, make, case), stream in zip(cases, streams):
        inputs, outputs, gradients = make(np.random.default_rng(stream), *case)
        arrays = inputs | {key: value.detach().numpy() for key, value in outputs.items()}
        arrays |= {f"grad_{key}": value.numpy() for key, value in zip(LEARNT, gradients)}
        np.savez_compressed(arguments.out / f"{name}.npz", **arrays)
        print(f"{name}: log-probability {arrays['log_prob'].mean():.2f}")


if __name__ == "__main__":
    main()
