"""One V-MPO update written plainly in Python PyTorch, to measure the learner's update against.

    python tests/python/torch_vmpo_update.py --threads 2 --repeats 10 --seconds 60

Needs requirements-torch.txt (or bare_torch.py, which says how to do without CUDA's libraries). Paper-size networks on a
batch of 128 unrolls of 32 transitions, all of it random and in memory; an update is forward, backward and Adam, eager,
float32, on the CPU. Prints one JSON line: the median of the updates' milliseconds, the threads, and how many updates
were timed (after two that were not), fewer than asked for when the seconds ran out.

Shapes: B unrolls, T transitions, S proprioception, X task observation, Z latent, A action, R reward terms. The
networks and rules are the CoMic supplement's (Hasenclever et al., 2020) and V-MPO's (Song et al., 2020).
"""

from torch_update import gaussian, mean_and_std, measure, mlp, standard_normal

import torch
from torch import nn
from torch.distributions import kl_divergence

B, T = 128, 32
X, S, Z, A, R = 1086, 205, 60, 56, 5
CLIPS, EMBEDDING = 836, 30
GAMMA, BETA, TOP_FRACTION = 0.95, 5e-4, 0.5
EPSILON_ETA, EPSILON_MEAN, EPSILON_STD = 0.1, 0.1, 1e-5
LEARNING_RATE, MIN_MULTIPLIER = 1e-4, 1e-8


class Networks(nn.Module):
    def __init__(self):
        super().__init__()
        self.encoder = mlp(X + S + Z, [1024] * 2, 2 * Z)
        self.linear_path = nn.Linear(X + S + Z, 2 * Z, bias=False)
        self.low_level = mlp(Z + S, [1024] * 2, 2 * A)
        self.embedding = nn.Embedding(CLIPS, EMBEDDING)
        self.value_function = mlp(X + S + EMBEDDING, [1024] * 3, R)
        self.temperature = nn.Parameter(torch.tensor(1.0))
        self.alpha_mean = nn.Parameter(torch.tensor(1.0))
        self.alpha_std = nn.Parameter(torch.tensor(1.0))

    def policy(self, x, s, previous_latent, noise):
        """The latent's distribution, and the action's given the latent that the stored noise makes."""
        inputs = torch.cat([x, s, previous_latent], dim=-1)
        latent_mean, latent_std = mean_and_std(self.encoder(inputs) + self.linear_path(inputs))
        latent = latent_mean + latent_std * noise
        return (latent_mean, latent_std), mean_and_std(self.low_level(torch.cat([latent, s], dim=-1)))

    def value(self, x, s, clip):
        return self.value_function(torch.cat([x, s, self.embedding(clip)], dim=-1))


def returns(reward, discount, valid, values):
    """n-step to the end of the unroll [B, T, R]; a row that is no transition has its own value."""
    following, rows = values[:, T], []
    for t in reversed(range(T)):
        transition = reward[:, t] + GAMMA * discount[:, t, None] * following
        following = torch.where(valid[:, t, None] > 0, transition, values[:, t])
        rows.append(following)
    return torch.stack(rows[::-1], dim=1)


def limit(alpha, epsilon, kl):
    """The multiplier learns from the KL, the policy from the multiplier."""
    return (alpha * (epsilon - kl.detach()) + alpha.detach() * kl).mean()


def losses(networks, batch):
    """L_pi, L_eta, L_alpha, the value loss and the latent's KL of one batch."""
    x, s = batch["task"], batch["proprioception"]
    latent, action = networks.policy(x[:, :T], s[:, :T], batch["previous_latent"], batch["latent_noise"])
    values = networks.value(x, s, batch["clip"])
    valid = batch["valid"] > 0

    targets = returns(batch["reward"], batch["discount"], batch["valid"], values.detach())
    advantage = (targets - values[:, :T].detach()).sum(dim=-1)[valid]

    # E-step: weights of the top half of the valid steps.
    top, index = advantage.topk(int(TOP_FRACTION * len(advantage)))
    scaled = top / networks.temperature
    log_prob = gaussian(*action).log_prob(batch["action"])[valid][index]
    policy = -(scaled.detach().softmax(dim=0) * log_prob).sum()
    log_mean = scaled.logsumexp(dim=0) - torch.log(torch.tensor(float(len(top))))
    temperature = networks.temperature * (EPSILON_ETA + log_mean)

    # M-step: limits on mean and standard deviation apart, over all valid steps.
    (mean, std), (old_mean, old_std) = action, (batch["mean"], batch["std"])
    old = gaussian(old_mean, old_std)
    kl_mean = kl_divergence(old, gaussian(mean, old_std))[valid]
    kl_std = kl_divergence(old, gaussian(old_mean, std))[valid]
    alpha = limit(networks.alpha_mean, EPSILON_MEAN, kl_mean) + limit(networks.alpha_std, EPSILON_STD, kl_std)

    value = 0.5 * (values[:, :T] - targets)[valid].square().mean()
    latent_kl = kl_divergence(gaussian(*latent), standard_normal(latent[0]))[valid].mean()
    return policy, temperature, alpha, value, BETA * latent_kl


def random_batch(networks):
    """A batch whose behaviour policy is the untrained one, with an episode's end in one row of 24."""
    batch = {
        "proprioception": torch.randn(B, T + 1, S),
        "task": torch.randn(B, T + 1, X),
        "clip": torch.randint(CLIPS, (B, T + 1)),
        "previous_latent": torch.randn(B, T, Z),
        "latent_noise": torch.randn(B, T, Z),
        "reward": torch.rand(B, T, R) / R,
        "discount": (torch.rand(B, T) > 1 / 24).float(),
        "valid": (torch.rand(B, T) > 1 / 24).float(),
    }
    with torch.no_grad():
        x, s = batch["task"][:, :T], batch["proprioception"][:, :T]
        _, (mean, std) = networks.policy(x, s, batch["previous_latent"], batch["latent_noise"])
    return batch | {"mean": mean, "std": std, "action": mean + std * torch.randn_like(mean)}


def update(networks, optimiser, batch):
    optimiser.zero_grad()
    parts = losses(networks, batch)
    sum(parts).backward()
    optimiser.step()
    with torch.no_grad():
        for multiplier in (networks.temperature, networks.alpha_mean, networks.alpha_std):
            multiplier.clamp_(min=MIN_MULTIPLIER)
    return [part.item() for part in parts]


def prepare():
    networks = Networks()
    optimiser = torch.optim.Adam(networks.parameters(), lr=LEARNING_RATE)
    batch = random_batch(networks)
    return lambda: update(networks, optimiser, batch)


if __name__ == "__main__":
    measure(__doc__, prepare)
