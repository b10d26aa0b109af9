"""Numbers of other people's code, to compare V-MPO's losses, Gaussians and returns with.

    python tests/python/make_vmpo_fixtures.py --seed 1 --out tests/fixtures/vmpo

Needs requirements-vmpo.txt (see bare_torch.py where torch came without its dependencies). The same seed gives the
same numbers. Inputs are float32. Written are, with N steps, A dimensions, R reward terms, B unrolls of T rows:

`vmpo_*.npz`, from rlax.vmpo_loss in float32, no masked rows:
    log_prob, advantage, kl_mean, kl_std [N]
    temperature, alpha_mean, alpha_std, epsilon_eta, epsilon_mean, epsilon_std, top_fraction
    policy_loss         -sum over the top steps of psi log_prob
    temperature_loss    eta eps_eta + eta log(mean over the top steps of exp(A / eta))
    alpha_loss          sum over both limits of mean(alpha (eps - sg KL) + sg(alpha) KL): rlax's alpha_loss + kl_loss
    grad_log_prob, grad_kl_mean, grad_kl_std [N], grad_temperature, grad_alpha_mean, grad_alpha_std
                        of policy_loss + temperature_loss + alpha_loss
    The top half of an odd number of steps is rounded down, as rlax does.
`gaussian_*.npz`, from torch.distributions in float64 on the float32 inputs; old = other, new = (mean, std):
    mean, std, other_mean, other_std, action, previous [N, A], alpha
    log_prob [N]        of action under (mean, std)
    kl [N]              KL(old || new)
    kl_mean [N]         KL(N(old mean, old std) || N(new mean, old std))
    kl_std [N]          KL(N(old mean, old std) || N(old mean, new std))
    entropy [N]         of (mean, std)
    kl_standard [N]     KL((mean, std) || N(0, I))
    kl_ar1 [N]          KL((mean, std) || N(alpha previous, (1 - alpha^2) I))
`returns_*.npz`, from rlax.n_step_bootstrapped_returns on each episode's piece of an unroll, in float32:
    reward [B, T, R], discount, valid [B, T], values [B, T+1, R], gamma
    returns [B, T, R]   a row that is no transition (valid 0) holds its own value, from which the piece before it
                        bootstraps; the last piece bootstraps from values[:, T]

What rlax says is checked here against the formulas, in NumPy and float64, before it is written.
"""

import argparse
import os
import pathlib
import sys

os.environ.setdefault("JAX_PLATFORMS", "cpu")
sys.setdlopenflags(os.RTLD_LAZY)  # see bare_torch.py

import jax
import jax.numpy as jnp
import numpy as np
import rlax
import torch
from torch import distributions

TOLERANCE = 3e-6  # float32 against float64, relative to the larger of 1 and the number

# name: steps, spread and offset of the advantages, temperature, alphas, epsilons (eta, mean, std)
LOSSES = {
    "small": (64, 0.3, 0.0, 1.0, (1.0, 1.0), (0.1, 0.1, 1e-5)),
    "odd": (255, 1.0, 0.2, 0.7, (2.0, 0.5), (0.1, 0.1, 1e-5)),
    "sharp": (256, 1.0, -0.5, 0.1, (0.3, 40.0), (0.02, 0.2, 1e-4)),
    # Wider still, and the temperature's gradient, a difference of numbers near A / eta, is lost in float32.
    "wide": (256, 8.0, 3.0, 1.0, (1.0, 1.0), (0.5, 0.1, 1e-3)),
    "paper": (4096, 0.5, 0.05, 0.4, (1.5, 12.0), (0.1, 0.1, 1e-5)),
}

# name: steps, dimensions, how far the new distribution is from the old one in standard deviations, the latter's scale
GAUSSIANS = {
    "small": (5, 3, 1.0, 1.0),
    "policy": (24, 56, 0.3, 0.2),
    "near": (24, 56, 1e-3, 0.1),
    "latent": (24, 60, 0.5, 1.0),
}

# name: unrolls, rows, reward terms, gamma, chance that a row is an episode's last observation
RETURNS = {
    "unbroken": (4, 32, 5, 0.95, 0.0),
    "episodes": (16, 32, 5, 0.95, 0.1),
    "short_episodes": (8, 32, 1, 0.99, 0.4),
}


# ---------------------------------------------------------------------------------------------------------- losses


def vmpo_inputs(random, steps, spread, offset, temperature, alphas, epsilons):
    draw = {
        "log_prob": random.normal(20.0, 10.0, steps),
        "advantage": random.normal(offset, spread, steps),
        # Above and below the limits.
        "kl_mean": epsilons[1] * random.exponential(1.0, steps),
        "kl_std": epsilons[2] * random.exponential(1.0, steps),
        "temperature": temperature,
        "alpha_mean": alphas[0],
        "alpha_std": alphas[1],
        "epsilon_eta": epsilons[0],
        "epsilon_mean": epsilons[1],
        "epsilon_std": epsilons[2],
        "top_fraction": 0.5,
    }
    return {name: np.asarray(value, np.float32) for name, value in draw.items()}


def rlax_losses(inputs):
    """The losses and their gradients by rlax; every multiplier is far above rlax's own lower bound of 1e-10."""
    limits = {k: jnp.asarray(inputs[k]) for k in ("epsilon_eta", "epsilon_mean", "epsilon_std")}
    learnt = {
        k: jnp.asarray(inputs[k])
        for k in ("log_prob", "kl_mean", "kl_std", "temperature", "alpha_mean", "alpha_std")
    }

    def total(x):
        loss, parts = rlax.vmpo_loss(
            sample_log_probs=x["log_prob"],
            advantages=jnp.asarray(inputs["advantage"]),
            temperature_constraint=rlax.LagrangePenalty(x["temperature"], limits["epsilon_eta"]),
            kl_constraints=[
                (x["kl_mean"], rlax.LagrangePenalty(x["alpha_mean"], limits["epsilon_mean"])),
                (x["kl_std"], rlax.LagrangePenalty(x["alpha_std"], limits["epsilon_std"])),
            ],
            top_k_fraction=float(inputs["top_fraction"]),
        )
        # One loss a step: the mean over steps is the loss (policy_loss carries a factor of N for that).
        return jnp.mean(loss), {
            "policy_loss": jnp.mean(parts.policy_loss),
            "temperature_loss": parts.temperature_loss,
            "alpha_loss": jnp.mean(parts.alpha_loss + parts.kl_loss),
        }

    gradients, losses = jax.grad(total, has_aux=True)(learnt)
    return {k: np.asarray(v) for k, v in losses.items()} | {f"grad_{k}": np.asarray(v) for k, v in gradients.items()}


def formula_losses(inputs):
    """The same by the formulas, in float64; the gradients are written out."""
    x = {k: np.asarray(v, np.float64) for k, v in inputs.items()}
    eta, steps = x["temperature"], len(x["advantage"])
    top = np.argsort(x["advantage"])[steps - int(x["top_fraction"] * steps) :]
    scaled = x["advantage"][top] / eta
    log_mean = scaled.max() + np.log(np.mean(np.exp(scaled - scaled.max())))
    psi = np.exp(scaled - log_mean) / len(top)
    grad_log_prob = np.zeros(steps)
    grad_log_prob[top] = -psi
    out = {
        "policy_loss": -np.sum(psi * x["log_prob"][top]),
        "temperature_loss": eta * x["epsilon_eta"] + eta * log_mean,
        "alpha_loss": 0.0,
        "grad_log_prob": grad_log_prob,
        "grad_temperature": x["epsilon_eta"] + log_mean - np.sum(psi * scaled),
    }
    for k in ("mean", "std"):
        alpha, epsilon, kl = x[f"alpha_{k}"], x[f"epsilon_{k}"], x[f"kl_{k}"]
        out["alpha_loss"] += np.mean(alpha * (epsilon - kl) + alpha * kl)
        out[f"grad_alpha_{k}"] = epsilon - np.mean(kl)
        out[f"grad_kl_{k}"] = np.full(steps, alpha / steps)
    return out


# ------------------------------------------------------------------------------------------------------- gaussians


def gaussian(random, steps, dimensions, distance, scale):
    shape = (steps, dimensions)
    other_mean = random.normal(0.0, 0.5, shape)
    other_std = scale * np.exp(random.normal(0.0, 0.4, shape))
    mean = other_mean + distance * other_std * random.normal(0.0, 1.0, shape)
    std = other_std * np.exp(0.5 * distance * random.normal(0.0, 1.0, shape))
    inputs = {
        "mean": mean,
        "std": std,
        "other_mean": other_mean,
        "other_std": other_std,
        "action": mean + std * random.normal(0.0, 1.0, shape),
        "previous": random.normal(0.0, 1.0, shape),
        "alpha": 0.95,
    }
    inputs = {name: np.asarray(value, np.float32) for name, value in inputs.items()}
    x = {name: torch.from_numpy(value.astype(np.float64)) for name, value in inputs.items()}

    def diagonal(mean, std):
        return distributions.Independent(distributions.Normal(mean, std), 1)

    new, old = diagonal(x["mean"], x["std"]), diagonal(x["other_mean"], x["other_std"])
    zero, one = torch.zeros_like(x["mean"]), torch.ones_like(x["mean"])
    prior = diagonal(x["alpha"] * x["previous"], torch.sqrt(1 - x["alpha"] ** 2) * one)
    outputs = {
        "log_prob": new.log_prob(x["action"]),
        "kl": distributions.kl_divergence(old, new),
        "kl_mean": distributions.kl_divergence(old, diagonal(x["mean"], x["other_std"])),
        "kl_std": distributions.kl_divergence(old, diagonal(x["other_mean"], x["std"])),
        "entropy": new.entropy(),
        "kl_standard": distributions.kl_divergence(new, diagonal(zero, one)),
        "kl_ar1": distributions.kl_divergence(new, prior),
    }
    return inputs | {name: value.numpy() for name, value in outputs.items()}


# --------------------------------------------------------------------------------------------------------- returns


@jax.jit
def piece_returns(reward, discount, values):
    """Returns [n, R] of one piece of an episode: rewards [n, R], discounts gamma d [n], values of the n next states."""
    steps = len(discount)
    one = lambda r, v: rlax.n_step_bootstrapped_returns(r, discount, v, n=steps)
    return jax.vmap(one, in_axes=1, out_axes=1)(reward, values)


def returns(random, unrolls, rows, terms, gamma, chance):
    valid = (random.random((unrolls, rows)) >= chance).astype(np.float32)
    if chance > 0:  # the ends of an unroll, and an episode whose only row here is its last
        valid[0, 0], valid[1, rows - 1], valid[2, 10:12] = 0.0, 0.0, 0.0
    # The step into an episode's last observation fails (discount 0) or is cut off (discount 1).
    discount = np.ones((unrolls, rows), np.float32)
    failed = (valid[:, 1:] == 0) & (random.random((unrolls, rows - 1)) < 0.5)
    discount[:, :-1][failed] = 0.0
    # What stands in rows that are no transition must not matter.
    reward = random.normal(0.5, 0.5, (unrolls, rows, terms)).astype(np.float32)
    values = random.normal(5.0, 2.0, (unrolls, rows + 1, terms)).astype(np.float32)
    gamma = np.float32(gamma)

    out = np.empty_like(reward)
    for b in range(unrolls):
        start = 0
        for end in [*np.flatnonzero(valid[b] == 0), rows]:
            if end > start:
                piece, following = slice(start, end), slice(start + 1, end + 1)
                out[b, piece] = piece_returns(reward[b, piece], gamma * discount[b, piece], values[b, following])
            if end < rows:
                out[b, end] = values[b, end]
            start = end + 1
    inputs = {"reward": reward, "discount": discount, "valid": valid, "values": values, "gamma": gamma}
    return inputs | {"returns": out}


def formula_returns(x):
    """G_t = r_t + gamma d_t G_{t+1}, or V(s_t) where the row is no transition; G_T = V(s_T)."""
    x = {k: np.asarray(v, np.float64) for k, v in x.items()}
    out, following = np.empty_like(x["reward"]), x["values"][:, -1]
    for t in reversed(range(out.shape[1])):
        valid, discount = x["valid"][:, t, None], x["gamma"] * x["discount"][:, t, None]
        following = np.where(valid > 0, x["reward"][:, t] + discount * following, x["values"][:, t])
        out[:, t] = following
    return {"returns": out}


# ------------------------------------------------------------------------------------------------------------ main


def check(name, found, expected):
    """Largest deviation, relative to the larger of 1 and the number; an error if float32 does not explain it."""
    error = {k: np.max(np.abs(found[k] - v) / np.maximum(1.0, np.abs(v))) for k, v in expected.items()}
    worst = max(error, key=error.get)
    if not error[worst] < TOLERANCE:
        raise SystemExit(f"{name}: {worst} is {error[worst]:.1e} away from its formula")
    return f"{name}: within {error[worst]:.1e} of the formulas ({worst})"


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=pathlib.Path, required=True, help="folder to write into")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)

    cases = [
        *((f"vmpo_{name}", "loss", case) for name, case in LOSSES.items()),
        *((f"gaussian_{name}", "gaussian", case) for name, case in GAUSSIANS.items()),
        *((f"returns_{name}", "returns", case) for name, case in RETURNS.items()),
    ]
    streams = np.random.SeedSequence(arguments.seed).spawn(len(cases))
    for (name, kind, case), stream in zip(cases, streams):
        random = np.random.default_rng(stream)
        if kind == "loss":
            arrays = vmpo_inputs(random, *case)
            outputs = rlax_losses(arrays)
            print(check(name, outputs, formula_losses(arrays)))
            arrays |= outputs
        elif kind == "gaussian":
            arrays = gaussian(random, *case)
            print(f"{name}: KL of {arrays['kl_mean'].mean():.1e} (mean) and {arrays['kl_std'].mean():.1e} (std)")
        else:
            arrays = returns(random, *case)
            print(check(name, arrays, formula_returns(arrays)))
        np.savez_compressed(arguments.out / f"{name}.npz", **arrays)


if __name__ == "__main__":
    main()
