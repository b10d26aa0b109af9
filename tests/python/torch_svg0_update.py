"""One gradient step of SVG(0) written plainly in Python PyTorch, to measure the learner's against.

    python tests/python/torch_svg0_update.py --threads 2 --repeats 10 --seconds 60

Needs requirements-torch.txt (or bare_torch.py, which says how to do without CUDA's libraries). Transfer to go-to-target, all
of it random and in memory; a step is forward, backward and Adam, eager, float32, on the CPU. Prints one JSON line: the
median of the steps' milliseconds, the threads, and how many steps were timed (after two that were not), fewer than asked
for when the seconds ran out.

Shapes: B sequences, T transitions, S proprioception, X task observation, Z the action, which is a latent, J actions that are
sampled for each observation. The first rows only build up the recurrent states. A state is reset where an episode begins, so
the LSTMs run step by step. The networks are the CoMic supplement's (Hasenclever et al., 2020), the rules SVG(0)'s (Heess et
al., 2015) with Retrace (Munos et al., 2016).
"""

import copy

from torch_update import gaussian, mean_and_std, measure, mlp, standard_normal, torso

import torch
from torch import nn
from torch.distributions import kl_divergence

B, T, BURN_IN, J = 64, 32, 8, 10
S, X, Z = 205, 3, 60
ENCODER, CORE, POLICY, ACTION_VALUE = 256, 128, 128, 256
GAMMA, LAMBDA, ENTROPY, KL, MEAN_SCALE = 0.99, 1.0, 1e-3, 1e-3, 3.0
LEARNING_RATE, TARGET_PERIOD = 1e-4, 100


def unrolled(cell, inputs, first, state):
    """Hidden values [B, rows, H] of an LSTM, and the state after the last row."""
    outputs = []
    for row, begins in zip(inputs.unbind(1), first.unbind(1)):
        kept = 1 - begins[:, None]
        state = cell(row, (state[0] * kept, state[1] * kept))
        outputs.append(state[0])
    return torch.stack(outputs, dim=1), state


class Networks(nn.Module):
    def __init__(self):
        super().__init__()
        self.encoders = nn.ModuleList([torso(S, [ENCODER]), torso(X, [ENCODER])])
        self.core = nn.LSTMCell(2 * ENCODER, CORE)
        self.policy = nn.LSTMCell(CORE, POLICY)
        self.head = nn.Linear(POLICY, 2 * Z)
        self.action_value = mlp(CORE + Z, [ACTION_VALUE], 1)

    def rows(self, batch, rows, states):
        """The core's features, the policy's hidden values, and both states after the last row."""
        observations = batch["proprioception"][:, rows], batch["task"][:, rows]
        encoded = torch.cat([encoder(part) for encoder, part in zip(self.encoders, observations)], dim=-1)
        features, core = unrolled(self.core, encoded, batch["first"][:, rows], states[0])
        # The critic alone trains the core.
        hidden, policy = unrolled(self.policy, features.detach(), batch["first"][:, rows], states[1])
        return features, hidden, (core, policy)

    def forward(self, batch):
        """Features and the policy's mean and deviation in the rows after the burn-in, [B, n + 1, .]."""
        with torch.no_grad():
            _, _, states = self.rows(batch, slice(0, BURN_IN), batch["state"])
        features, hidden, _ = self.rows(batch, slice(BURN_IN, T + 1), states)
        mean, std = mean_and_std(self.head(hidden))
        return features, (mean.tanh() * MEAN_SCALE, std)

    def value(self, features, action):
        return self.action_value(torch.cat([features, action], dim=-1)).squeeze(-1)

    def expected_value(self, features, policy):
        """The mean action value over J sampled actions, which are differentiable."""
        actions = gaussian(*policy).rsample((J,))
        return self.value(features.expand(J, *features.shape), actions).mean(dim=0)


def retrace(reward, discount, value, action_value, trace):
    """Targets of the action value, [B, n], backwards from the last row, which is bootstrapped with the value alone."""
    targets = [reward[:, -1] + discount[:, -1] * value[:, -1]]
    for t in reversed(range(reward.shape[1] - 1)):
        correction = trace[:, t + 1] * (targets[-1] - action_value[:, t + 1])
        targets.append(reward[:, t] + discount[:, t] * (value[:, t + 1] + correction))
    return torch.stack(targets[::-1], dim=1)


def without_last(policy):
    mean, std = policy
    return mean[:, :-1], std[:, :-1]


def losses(online, target, batch):
    """L_Q and L_pi of one minibatch."""
    reward, action, mean, std = (batch[name][:, BURN_IN:] for name in ("reward", "action", "mean", "std"))
    valid, discount = batch["valid"][:, BURN_IN:], GAMMA * batch["discount"][:, BURN_IN:]
    features, policy = online(batch)
    divergence = kl_divergence(gaussian(*policy), standard_normal(policy[0]))
    with torch.no_grad():
        target_features, target_policy = target(batch)
        value = target.expected_value(target_features, target_policy) - KL * divergence
        ratio = gaussian(*without_last(target_policy)).log_prob(action) - gaussian(mean, std).log_prob(action)
        trace = LAMBDA * ratio.clamp(max=0).exp() * valid
        target_features = target_features[:, :-1]
        targets = retrace(reward, discount, value, target.value(target_features, action), trace)

    policy, total = without_last(policy), valid.sum()
    error = online.value(features[:, :-1], action) - targets
    gain = target.expected_value(target_features, policy) + ENTROPY * gaussian(*policy).entropy()
    value_loss = (0.5 * error.square() * valid).sum() / total
    policy_loss = ((KL * divergence[:, :-1] - gain) * valid).sum() / total
    return value_loss, policy_loss


def random_minibatch(networks):
    """A minibatch whose behaviour policy is the untrained one, with an episode's end in one row of 24."""
    minibatch = {
        "proprioception": torch.randn(B, T + 1, S),
        "task": torch.randn(B, T + 1, X),
        "first": (torch.rand(B, T + 1) < 1 / 24).float(),
        "state": [(torch.zeros(B, units), torch.zeros(B, units)) for units in (CORE, POLICY)],
        "reward": torch.rand(B, T),
        "discount": (torch.rand(B, T) > 1 / 24).float(),
        "valid": (torch.rand(B, T) > 1 / 24).float(),
    }
    with torch.no_grad():
        _, hidden, _ = networks.rows(minibatch, slice(0, T), minibatch["state"])
        mean, std = mean_and_std(networks.head(hidden))
        mean = mean.tanh() * MEAN_SCALE
    return minibatch | {"mean": mean, "std": std, "action": mean + std * torch.randn_like(mean)}


def prepare():
    online = Networks()
    target = copy.deepcopy(online).requires_grad_(False)
    optimiser = torch.optim.Adam(online.parameters(), lr=LEARNING_RATE)
    minibatch, steps = random_minibatch(online), 0

    def update():
        nonlocal steps
        optimiser.zero_grad()
        parts = losses(online, target, minibatch)
        sum(parts).backward()
        optimiser.step()
        steps += 1
        if steps % TARGET_PERIOD == 0:
            target.load_state_dict(online.state_dict())
        return [part.item() for part in parts]

    return update


if __name__ == "__main__":
    measure(__doc__, prepare)
