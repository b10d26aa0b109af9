"""Stable-Baselines3's PPO on one walk: on this package's environments, or on dm_control's.

usage: ppo.py comic|dm_control [--seconds 300] [--seed 1]

Both learn with the same parameters and see the same numbers. Prints one JSON line after each update: `seconds` since the
start of learning, `steps`, and over the last hundred episodes `length` (steps) and `episode_return`.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "disable")

import comic
import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor, VecNormalize

ENVIRONMENTS = 16
CLIP = "builtin:CMU_007_01"


class Vector(VecEnv):
    """This package's environments, as Stable-Baselines3 wants several of them."""

    def __init__(self, seed: int) -> None:
        self.environments = comic.make_vec(
            "tracking", num_envs=ENVIRONMENTS, threads=2, autoreset_mode="SameStep", clips=CLIP
        )
        super().__init__(
            ENVIRONMENTS, self.environments.single_observation_space, self.environments.single_action_space
        )
        self._start_seed: int | None = seed

    def reset(self) -> Any:
        observations, _ = self.environments.reset(seed=self._start_seed)
        self._start_seed = None
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        self.actions = actions

    def step_wait(self) -> Any:
        observations, rewards, terminated, truncated, info = self.environments.step(self.actions)
        infos: list[dict[str, Any]] = [{} for _ in range(ENVIRONMENTS)]
        for index in np.flatnonzero(terminated | truncated):
            infos[index] = {
                "terminal_observation": info["final_obs"][index],
                "TimeLimit.truncated": bool(truncated[index] and not terminated[index]),
            }
        return observations, rewards, terminated | truncated, infos

    def close(self) -> None:
        self.environments.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.environments, attr_name, None)] * ENVIRONMENTS

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError

    def env_method(self, method_name: str, *arguments: Any, indices: Any = None, **keywords: Any) -> list[Any]:
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * ENVIRONMENTS


class DmControl(gymnasium.Env):
    """dm_control's own environment with the same observations."""

    def __init__(self, clips: Path, seed: int) -> None:
        from dm_control import composer
        from dm_control.locomotion import arenas
        from dm_control.locomotion.tasks.reference_pose import tracking, types
        from dm_control.locomotion.walkers import cmu_humanoid

        fields = comic.experiment.resolve(clips=CLIP).fields["tracking"]
        task = tracking.MultiClipMocapTracking(
            cmu_humanoid.CMUHumanoidPositionControlledV2020,
            arenas.Floor(),
            ref_path=str(clips),
            ref_steps=tuple(fields["reference_steps"]),
            dataset=types.ClipCollection(ids=("CMU_007_01",)),
            min_steps=fields["min_steps"],
            reward_type="comic",
            termination_error_threshold=fields["termination_threshold"],
        )
        self.environment = composer.Environment(
            task, time_limit=fields["time_limit"], random_state=seed, strip_singleton_obs_buffer_dim=True
        )
        self.names = [f"walker/{name}" for name in comic.observation_names("tracking", clips=CLIP)]
        size = sum(int(np.prod(self.environment.observation_spec()[name].shape)) for name in self.names)
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (56,), np.float32)

    def _observe(self, step: Any) -> np.ndarray:
        return np.concatenate([np.ravel(step.observation[name]) for name in self.names]).astype(np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return self._observe(self.environment.reset()), {}

    def step(self, action: np.ndarray) -> Any:
        step = self.environment.step(action.astype(np.float64))
        terminated = step.last() and step.discount == 0
        return self._observe(step), float(step.reward), terminated, step.last() and not terminated, {}


class Report(BaseCallback):
    """Prints a line after each rollout, and stops at the time limit."""

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self.seconds, self.begin = seconds, time.monotonic()
        self.lines: list[dict[str, float]] = []

    def _on_step(self) -> bool:
        return time.monotonic() - self.begin < self.seconds

    def _on_rollout_end(self) -> None:
        episodes = self.model.ep_info_buffer or []
        line = {
            "seconds": time.monotonic() - self.begin,
            "steps": float(self.num_timesteps),
            "length": float(np.mean([episode["l"] for episode in episodes])),
            "episode_return": float(np.mean([episode["r"] for episode in episodes])),
        }
        self.lines.append(line)
        print(json.dumps(line), flush=True)


def learn(kind: str, seconds: float, seed: int) -> list[dict[str, float]]:
    """Learns, and returns what was printed."""
    torch.set_num_threads(2)
    with tempfile.TemporaryDirectory() as directory:
        environments: VecEnv
        if kind == "comic":
            environments = Vector(seed)
        else:
            clips = Path(directory) / "walk.h5"
            comic.clips.merge(CLIP, clips)
            makers = [lambda index=index: DmControl(clips, seed + index) for index in range(ENVIRONMENTS)]
            environments = DummyVecEnv(makers)
        environments = VecNormalize(VecMonitor(environments), norm_reward=False)
        model = PPO(
            "MlpPolicy",
            environments,
            n_steps=256,
            batch_size=512,
            n_epochs=5,
            gamma=0.95,
            learning_rate=3e-4,
            policy_kwargs={"net_arch": [256, 256], "log_std_init": -1.6},
            seed=seed,
            device="cpu",
        )
        report = Report(seconds)
        model.learn(10**9, callback=report)
        return report.lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=["comic", "dm_control"])
    parser.add_argument("--seconds", type=float, default=300)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    learn(arguments.kind, arguments.seconds, arguments.seed)


if __name__ == "__main__":
    main()
