"""The environments, policies and runs of CoMic.

A humanoid with 56 actuators, the CMU humanoid of dm_control, follows motion capture or plays one of five other tasks. The
environments are native code and step without Python's lock.

- ``gymnasium.make("comic/Tracking-v0")`` makes one environment, :func:`make_vec` several that step in threads, and
  :class:`comic.dm.Environment` one for code that is written for ``dm_env``.
- :func:`load` reads a policy, :mod:`comic.runs` a run's metrics, and :func:`train` trains.
- :mod:`comic.clips` reads motion capture, and :mod:`comic.experiment` resolves presets.
"""

import importlib.metadata

# The native module finds libmujoco because this import has loaded it already.
import mujoco

__version__ = importlib.metadata.version("comic-rl")

_MUJOCO = "3.17.0"
if mujoco.__version__ != _MUJOCO:
    raise ImportError(
        f"comic {__version__} needs mujoco {_MUJOCO}, and {mujoco.__version__} is installed: pip install mujoco=={_MUJOCO}"
    )

from comic import clips, experiment, runs  # noqa: E402
from comic._native import Error  # noqa: E402
from comic.environments import TASKS, Environment, observation_names, register  # noqa: E402
from comic.policies import Policy, load  # noqa: E402
from comic.training import train  # noqa: E402
from comic.vector import VectorEnvironment, make_vec  # noqa: E402

__all__ = [
    "TASKS",
    "Environment",
    "Error",
    "Policy",
    "VectorEnvironment",
    "clips",
    "experiment",
    "load",
    "make_vec",
    "observation_names",
    "runs",
    "train",
]

register()
