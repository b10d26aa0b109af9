"""Numbers of other people's code, to compare SVG(0)'s targets, losses and gradients with.

    python tests/python/make_svg0_fixtures.py --seed 1 --out tests/fixtures/svg0

Needs requirements-vmpo.txt (see bare_torch.py where torch came without its dependencies). The same seed gives the
same numbers. Inputs are float32; results are computed in float64. Written are, in float32, with B sequences of T rows, of which the first b are
burn-in and n = T - b are learned, J action samples, Z dimensions of an action and R reward terms:

`retrace_*.npz`, from rlax.retrace_continuous on each episode's piece of a sequence:
    reward, discount (gamma d), action_value, coefficient, valid [B, T], value [B, T+1]
    target [B, T]       rows that are no transition (valid 0) hold 0
`step_*.npz`, one gradient step of PyTorch's autograd on the networks written again here (LSTMs are torch's LSTMCell,
densities and divergences torch.distributions', targets rlax's):
    encoder, action_value (hidden sizes), core, policy (units), burn_in, discount, lambda, entropy, kl, mean_scale, min_std
    policy.NAME, value.NAME, target_policy.NAME, target_value.NAME     parameters, named as in a checkpoint
    proprioception, task, first, state, action, mean, std, reward, valid, discount_factor      the minibatch
    noise [2, J, B (n+1), Z]       of the target's values and of the policy's gradient
    target, trace, taken [B n]     Q^ret, c, and Q of the actions taken
    value_loss, policy_loss, entropy_mean, kl_mean
    grad.policy.NAME, grad.value.NAME      of value_loss + policy_loss
`resnet_*.npz`, the residual network of images, whose parameters and pixels are given by formulas (see `resnet`):
    features [N, F]

What rlax says is checked here against the definition of Retrace as a sum before it is written.
"""

import argparse
import os
import pathlib
import sys

os.environ.setdefault("JAX_PLATFORMS", "cpu")
sys.setdlopenflags(os.RTLD_LAZY)  # see bare_torch.py

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
import rlax
import torch
from torch import distributions
from torch.nn import functional

NORMALISED_LIMIT = 10.0  # standard deviations

# name: sequences, rows, chance that a row is an episode's last observation
RETRACE = {
    "unbroken": (3, 12, 0.0),
    "episodes": (6, 16, 0.15),
    "short_episodes": (6, 10, 0.45),
}

# The tasks' sizes are all different, so that a mistaken width does not go unnoticed.
STEPS = {
    "small": dict(
        sequences=5, rows=8, burn_in=3, samples=3, proprioception=4, task=3, action=2, terms=2,
        encoder=[7], core=6, policy=5, action_value=[9],
        discount=0.9, trace=1.0, entropy=0.3, kl=0.2, mean_scale=1.0, min_std=0.3,
    ),
    "deep": dict(
        sequences=4, rows=7, burn_in=2, samples=2, proprioception=5, task=2, action=3, terms=1,
        encoder=[8, 6], core=5, policy=7, action_value=[8, 6],
        discount=0.97, trace=0.8, entropy=0.05, kl=0.4, mean_scale=3.0, min_std=0.1,
    ),
    "without_task_or_burn_in": dict(
        sequences=3, rows=5, burn_in=0, samples=4, proprioception=6, task=0, action=1, terms=3,
        encoder=[5], core=4, policy=3, action_value=[6],
        discount=0.8, trace=0.95, entropy=0.1, kl=0.1, mean_scale=2.0, min_std=0.2,
    ),
}  # fmt: skip


def float32(arrays):
    return {name: np.asarray(value, np.float32) for name, value in arrays.items()}


# --------------------------------------------------------------------------------------------------------- retrace


def rlax_retrace(reward, discount, action_value, value, log_ratio, trace, valid):
    """Q^ret [T] of one sequence: rlax on each run of rows with a transition. A run bootstraps from the value of the
    observation after its last row."""
    target, row = np.zeros(len(reward)), 0
    while row < len(reward):
        if valid[row] == 0:
            row += 1
            continue
        end = row
        while end < len(reward) and valid[end] > 0:
            end += 1
        own, later = slice(row, end), slice(row + 1, end)
        error = rlax.retrace_continuous(
            q_tm1=jnp.asarray(action_value[own]),
            q_t=jnp.asarray(action_value[later]),
            v_t=jnp.asarray(value[row + 1 : end + 1]),
            r_t=jnp.asarray(reward[own]),
            discount_t=jnp.asarray(discount[own]),
            log_rhos=jnp.asarray(log_ratio[later]),
            lambda_=trace,
        )
        target[own] = np.asarray(error) + action_value[own]
        row = end
    return target


def defined_retrace(reward, discount, action_value, value, log_ratio, trace, valid):
    """The same by its definition: Q_t + the sum over s >= t of (the product of gamma d c) delta_s."""
    coefficient = trace * np.minimum(1, np.exp(log_ratio))
    delta = reward + discount * value[1:] - action_value
    target = np.zeros(len(reward))
    for t in np.flatnonzero(valid):
        weight, target[t] = 1.0, action_value[t]
        for s in range(t, len(reward)):
            if valid[s] == 0:
                break
            weight *= discount[s - 1] * coefficient[s] if s > t else 1.0
            target[t] += weight * delta[s]
    return target


def retrace(*sequences):
    """Of every sequence; the arrays are [B, T], values [B, T+1] and the number lambda."""
    reward, discount, action_value, value, log_ratio, trace, valid = sequences
    rows = [
        (reward[b], discount[b], action_value[b], value[b], log_ratio[b], trace, valid[b]) for b in range(len(reward))
    ]
    found, expected = (np.stack([f(*row) for row in rows]) for f in (rlax_retrace, defined_retrace))
    if not np.allclose(found, expected, rtol=1e-12, atol=1e-12):
        raise SystemExit(f"rlax is {np.abs(found - expected).max():.1e} away from the definition")
    return found


def episodes(random, sequences, rows, chance):
    """valid and d, [B, T], and first, [B, T+1]: the step into an episode's last observation fails (d = 0) or is cut
    off (d = 1), and the next row begins another episode."""
    valid = (random.random((sequences, rows)) >= chance).astype(np.float32)
    failed = random.random((sequences, rows - 1)) < 0.5
    if chance > 0:  # whatever is drawn: a failure, a truncation at the sequence's end, and a sequence that begins with an end
        (valid[0, -3:], failed[0, -2]), (valid[1, -3:], failed[1, -1]) = ([1, 0, 1], True), ([1, 1, 0], False)
        valid[2, 0] = 0
    discount = np.ones((sequences, rows), np.float32)
    discount[:, :-1][(valid[:, 1:] == 0) & failed] = 0.0
    first = np.zeros((sequences, rows + 1), np.float32)
    first[:, 1:][valid == 0] = 1.0
    return valid, discount, first


def retrace_case(random, sequences, rows, chance):
    valid, discount, _ = episodes(random, sequences, rows, chance)
    # What stands in rows that are no transition must not matter.
    inputs = float32(
        {
            "reward": random.normal(0.5, 0.5, (sequences, rows)),
            "discount": 0.95 * discount,
            "action_value": random.normal(3.0, 2.0, (sequences, rows)),
            "value": random.normal(3.0, 2.0, (sequences, rows + 1)),
            "log_ratio": random.normal(0.0, 0.7, (sequences, rows)),
            "valid": valid,
            "trace": 0.9,
        }
    )
    x = {name: value.astype(np.float64) for name, value in inputs.items()}
    names = ("reward", "discount", "action_value", "value", "log_ratio", "trace", "valid")
    target = retrace(*(x[name] for name in names))
    coefficient = x["trace"] * np.minimum(1, np.exp(x["log_ratio"]))
    kept = {name: inputs[name] for name in ("reward", "discount", "action_value", "value", "valid")}
    return kept | {"coefficient": coefficient, "target": target}


# -------------------------------------------------------------------------------------------------------- networks


def torso_parameters(name, width, sizes):
    """Shapes of a torso's parameters, and its width."""
    shapes = {f"{name}norm.weight": (sizes[0],), f"{name}norm.bias": (sizes[0],)}
    for layer, size in enumerate(sizes):
        shapes |= {f"{name}layers.{layer}.weight": (size, width), f"{name}layers.{layer}.bias": (size,)}
        width = size
    return shapes, width


def lstm_parameters(name, width, units):
    return {
        f"{name}lstm.0.input.weight": (4 * units, width),
        f"{name}lstm.0.input.bias": (4 * units,),
        f"{name}lstm.0.recurrent": (4 * units, units),
    }


def draw_parameters(random, case):
    """Parameters of one set of networks, in float32, by name."""
    shapes, width = {}, 0
    for part in ("proprioception", "task"):
        if case[part] > 0:
            own, output = torso_parameters(f"policy.core.{part}.", case[part], case["encoder"])
            shapes, width = shapes | own, width + output
    shapes |= lstm_parameters("policy.core.", width, case["core"])
    shapes |= lstm_parameters("policy.latent_policy.", case["core"], case["policy"])
    shapes |= {
        "policy.latent_policy.head.weight": (2 * case["action"], case["policy"]),
        "policy.latent_policy.head.bias": (2 * case["action"],),
    }
    own, width = torso_parameters("value.", case["core"] + case["action"], case["action_value"])
    shapes |= own | {"value.head.weight": (1, width), "value.head.bias": (1,)}
    drawn = {}
    for name, shape in shapes.items():
        centre = 1.0 if name.endswith("norm.weight") else 0.0
        spread = 1.0 / np.sqrt(shape[-1]) if len(shape) > 1 else 0.3
        drawn[name] = random.normal(centre, spread, shape)
    for part in ("proprioception", "task"):
        size = (case[part],) if part == "proprioception" else (1, case[part])
        drawn[f"policy.normaliser.{part}_mean"] = random.normal(0.0, 0.5, size)
        drawn[f"policy.normaliser.{part}_std"] = random.uniform(0.5, 1.5, size)
    return float32(drawn)


def linear(x, parameters, name):
    return functional.linear(x, parameters[f"{name}.weight"], parameters[f"{name}.bias"])


def torso(x, parameters, name):
    """Linear, layer norm, tanh; then linear, ELU."""
    norm = (parameters[f"{name}norm.weight"], parameters[f"{name}norm.bias"])
    x = linear(x, parameters, f"{name}layers.0")
    x = torch.tanh(functional.layer_norm(x, x.shape[-1:], *norm))
    layer = 1
    while f"{name}layers.{layer}.weight" in parameters:
        x = functional.elu(linear(x, parameters, f"{name}layers.{layer}"))
        layer += 1
    return x


def lstm(x, parameters, name, state, first):
    """[B, T, H] from [B, T, I], and the state after the last row, h and c beside each other. The state is zero where
    `first` is 1."""
    weights = [parameters[f"{name}lstm.0.{part}"] for part in ("input.weight", "recurrent", "input.bias")]
    units = weights[1].shape[1]
    cell = torch.nn.LSTMCell(weights[0].shape[1], units, dtype=torch.float64)
    names = dict(zip(("weight_ih", "weight_hh", "bias_ih"), weights), bias_hh=torch.zeros(4 * units).double())
    state, outputs = state.split(units, 1), []
    for t in range(x.shape[1]):
        kept = (1 - first[:, t])[:, None]
        state = torch.func.functional_call(cell, names, (x[:, t], tuple(part * kept for part in state)))
        outputs.append(state[0])
    return torch.stack(outputs, 1), torch.cat(state, 1)


def observe(parameters, batch, part):
    mean, std = (parameters[f"policy.normaliser.{part}_{moment}"] for moment in ("mean", "std"))
    return torch.clamp((batch[part] - mean) / std, -NORMALISED_LIMIT, NORMALISED_LIMIT)


def rows_of(case, parameters, batch, rows, states):
    """Features and policy of some rows, from two recurrent states, and the states after them."""
    parts = [
        torso(observe(parameters, batch, part)[:, rows], parameters, f"policy.core.{part}.")
        for part in ("proprioception", "task")
        if case[part] > 0
    ]
    first = batch["first"][:, rows]
    features, core = lstm(torch.cat(parts, -1), parameters, "policy.core.", states[0], first)
    hidden, policy = lstm(features.detach(), parameters, "policy.latent_policy.", states[1], first)
    mean, raw = linear(hidden, parameters, "policy.latent_policy.head").chunk(2, -1)
    normal = distributions.Normal(case["mean_scale"] * torch.tanh(mean), case["min_std"] + functional.softplus(raw))
    return features, distributions.Independent(normal, 1), [core, policy]


def forward(case, parameters, batch):
    """Features [B, n+1, H] and policy of the rows that are learned and of the observation after them."""
    states = batch["state"].split([2 * case["core"], 2 * case["policy"]], 1)
    with torch.no_grad():
        if case["burn_in"] > 0:
            states = rows_of(case, parameters, batch, slice(None, case["burn_in"]), states)[2]
    return rows_of(case, parameters, batch, slice(case["burn_in"], None), states)[:2]


def action_value(parameters, features, action):
    x = torso(torch.cat([features, action], -1), parameters, "value.")
    return linear(x, parameters, "value.head").squeeze(-1)


# ------------------------------------------------------------------------------------------------------------ step


def draw_batch(random, case):
    sequences, rows = case["sequences"], case["rows"]
    valid, discount, first = episodes(random, sequences, rows, 0.2)
    normal = lambda *size, spread=1.0: random.normal(0.0, spread, (sequences, *size))
    return float32(
        {
            "proprioception": normal(rows + 1, case["proprioception"], spread=1.5),
            "task": normal(rows + 1, case["task"], spread=1.5),
            "first": first,
            "state": normal(2 * (case["core"] + case["policy"]), spread=0.7),
            "reward": normal(rows, case["terms"]),
            "valid": valid,
            "discount_factor": discount,
        }
    )


def draw_actions(random, policy, case):
    """The behaviour is near the target policy, so that ratios are on both sides of 1. Rows of the burn-in, and rows
    without a transition, hold any numbers."""
    size = (case["sequences"], case["rows"], case["action"])
    mean, std = random.normal(0.0, 1.0, size), random.uniform(0.5, 1.0, size)
    learned = np.s_[:, case["burn_in"] :]
    near = lambda tensor: tensor[:, :-1].numpy()
    mean[learned] = near(policy.mean) + random.normal(0.0, 0.2, size)[learned]
    std[learned] = near(policy.stddev) * np.exp(random.normal(0.0, 0.2, size)[learned])
    return float32({"mean": mean, "std": std, "action": mean + std * random.normal(0.0, 1.0, size)})


def double(arrays):
    return {name: torch.from_numpy(value.astype(np.float64)) for name, value in arrays.items()}


def step(random, case):
    drawn = [draw_parameters(random, case) for _ in range(2)]
    # The target is an older copy: near the online networks, but not equal.
    drawn[1] = float32({name: 0.8 * value + 0.2 * drawn[1][name] for name, value in drawn[0].items()})
    online, target = (double(parameters) for parameters in drawn)
    learned = {name: value.requires_grad_() for name, value in online.items() if "normaliser" not in name}

    inputs = draw_batch(random, case)
    with torch.no_grad():
        inputs |= draw_actions(random, forward(case, target, double(inputs))[1], case)
    b, n = case["burn_in"], case["rows"] - case["burn_in"]
    noise = random.normal(0.0, 1.0, (2, case["samples"], case["sequences"] * (n + 1), case["action"]))
    inputs["noise"] = noise.astype(np.float32)
    batch = double(inputs)
    noise = batch["noise"].unflatten(2, (case["sequences"], n + 1))  # [2, J, B, n+1, Z]
    action, valid = batch["action"][:, b:], batch["valid"][:, b:]

    features, policy = forward(case, online, batch)
    standard = distributions.Independent(
        distributions.Normal(torch.zeros_like(policy.mean), torch.ones_like(policy.mean)), 1
    )
    divergence = distributions.kl_divergence(policy, standard)
    with torch.no_grad():
        target_features, target_policy = forward(case, target, batch)
        samples = target_policy.mean + target_policy.stddev * noise[0]
        value = action_value(target, target_features.expand(case["samples"], -1, -1, -1), samples).mean(0)
        value = value - case["kl"] * divergence
        target_features = target_features[:, :-1]
        taken = action_value(target, target_features, action)
        near = distributions.Normal(target_policy.mean[:, :-1], target_policy.stddev[:, :-1])
        behaviour = distributions.Normal(batch["mean"][:, b:], batch["std"][:, b:])
        log_ratio = (near.log_prob(action) - behaviour.log_prob(action)).sum(-1)
        reward, discount = batch["reward"][:, b:].sum(-1), case["discount"] * batch["discount_factor"][:, b:]
        arrays = [array.numpy() for array in (reward, discount, taken, value, log_ratio)]
        returns = torch.from_numpy(retrace(*arrays, case["trace"], valid.numpy()))
        trace = case["trace"] * torch.clamp(log_ratio.exp(), max=1.0)

    mean = lambda rows: (rows * valid).sum() / valid.sum()
    values = action_value(online, features[:, :-1], action)
    value_loss = mean(0.5 * (values - returns) ** 2)
    # No gradient reaches the target's parameters: they require none.
    samples = policy.mean[:, :-1] + policy.stddev[:, :-1] * noise[1][:, :, :-1]
    gain = action_value(target, target_features.expand(case["samples"], -1, -1, -1), samples).mean(0)
    entropy, divergence = mean(policy.entropy()[:, :-1]), mean(divergence[:, :-1])
    policy_loss = -mean(gain) - case["entropy"] * entropy + case["kl"] * divergence
    gradients = torch.autograd.grad(value_loss + policy_loss, list(learned.values()))

    flat = lambda rows: rows.detach().flatten().numpy()
    outputs = {
        "target": flat(returns * valid),
        # A row without a transition has none.
        "trace": flat(trace * valid),
        "taken": flat(values * valid),
        "value_loss": value_loss.item(),
        "policy_loss": policy_loss.item(),
        "entropy_mean": entropy.item(),
        "kl_mean": divergence.item(),
    }
    sizes = ("encoder", "action_value", "core", "policy", "burn_in")
    numbers = ("discount", "entropy", "kl", "mean_scale", "min_std")
    fields = {name: case[name] for name in sizes + numbers} | {"lambda": case["trace"]}
    stored = drawn[0] | {f"target_{name}": value for name, value in drawn[1].items()}
    return fields | stored | inputs | outputs | {f"grad.{name}": g.numpy() for name, g in zip(learned, gradients)}


# ---------------------------------------------------------------------------------------------------------- images


def resnet(images=2, features=8, channels=(16, 32, 32), size=64):
    """IMPALA's residual network. Entry i of parameter number k, in the order of the names, is sin(i + k) / sqrt(fan-in); byte i
    of the images is (31 i^2 + 7 i) mod 251."""
    shapes = {"output.weight": (features, channels[-1] * (size // 8) ** 2), "output.bias": (features,)}
    before = 3
    for section, width in enumerate(channels):
        convolutions = {"convolution": before} | {f"blocks.{b}.{l}": width for b in (0, 1) for l in (0, 1)}
        for name, inputs in convolutions.items():
            shapes[f"sections.{section}.{name}.weight"] = (width, inputs, 3, 3)
            shapes[f"sections.{section}.{name}.bias"] = (width,)
        before = width
    parameters = {}
    for number, name in enumerate(sorted(shapes)):
        shape = shapes[name]
        fan_in = np.prod(shape[1:]) if len(shape) > 1 else 1.0
        entries = np.sin(np.arange(np.prod(shape)) + number) / np.sqrt(fan_in)
        parameters[name] = torch.from_numpy(entries.astype(np.float32).astype(np.float64).reshape(shape))

    index = np.arange(images * size * size * 3, dtype=np.int64)
    pixels = torch.from_numpy(((31 * index * index + 7 * index) % 251).astype(np.float64))
    x = pixels.reshape(images, size, size, 3).permute(0, 3, 1, 2) / 255.0 - 0.5

    def convolve(x, name):
        return functional.conv2d(x, parameters[f"{name}.weight"], parameters[f"{name}.bias"], padding="same")

    for section in range(len(channels)):
        x = functional.max_pool2d(convolve(x, f"sections.{section}.convolution"), 3, stride=2, padding=1)
        for block in (0, 1):
            inner = convolve(functional.relu(x), f"sections.{section}.blocks.{block}.0")
            x = x + convolve(functional.relu(inner), f"sections.{section}.blocks.{block}.1")
    x = functional.relu(x).flatten(1)
    return {"features": functional.relu(functional.linear(x, parameters["output.weight"], parameters["output.bias"])).numpy()}


# ------------------------------------------------------------------------------------------------------------ main


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=pathlib.Path, required=True, help="folder to write into")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)

    cases = [
        *((f"retrace_{name}", lambda random, case=case: retrace_case(random, *case)) for name, case in RETRACE.items()),
        *((f"step_{name}", lambda random, case=case: step(random, case)) for name, case in STEPS.items()),
        ("resnet_small", lambda random: resnet()),
    ]
    streams = np.random.SeedSequence(arguments.seed).spawn(len(cases))
    for (name, make), stream in zip(cases, streams):
        arrays = float32(make(np.random.default_rng(stream)))
        np.savez_compressed(arguments.out / f"{name}.npz", **arrays)
        told = {k: float(arrays[k]) for k in ("value_loss", "policy_loss", "entropy_mean", "kl_mean") if k in arrays}
        print(name, {k: round(v, 4) for k, v in told.items()})


if __name__ == "__main__":
    main()
