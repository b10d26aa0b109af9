"""Searches for good values of an experiment's fields with Optuna.

Each trial is a run of :func:`comic.train` with values that Optuna chooses, in a directory of its own. It is evaluated while it
trains, and Optuna stops it early if others were better at the same environment steps::

    python -m comic.sweep study.toml

The same command continues after a stop or a kill. ``cargo xtask sweep`` is for grids, in which every combination is
trained with every seed.
"""

from __future__ import annotations

import argparse
import importlib
import json
import signal
import sys
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from comic import _native, experiment, files, programs, training
from comic.environments import whole
from comic.experiment import Clips, Preset

if TYPE_CHECKING:
    import optuna

__all__ = ["Space", "curve", "reports", "search"]

Space = Mapping[str, Mapping[str, Any] | Sequence[Any]]
"""What is tried for a field: ``{"low": 0.1, "high": 3.0, "log": True}``, or a list of values. A range may also have a
``step``. It has whole numbers if both ends are whole."""

_RANGE = {"low", "high", "log", "step"}
# A learner that was told to stop writes its checkpoint first.
_END_LIMIT = 60.0


def search(
    directory: str | PathLike[str],
    space: Space,
    *,
    trials: int,
    preset: Preset = "quickstart",
    report_every: int = 50_000,
    evaluate_every: float = 1.0,
    sampler: optuna.samplers.BaseSampler | None = None,
    pruner: optuna.pruners.BasePruner | None = None,
    actors: int = 2,
    minutes: float | None = None,
    clips: Clips | None = None,
    **fields: Any,
) -> optuna.Study:
    """Trains until so many trials have ended, and returns the study.

    A trial's value is the mean normalised reward of its last policy without noise, over all starts. The directory gets
    ``table.md`` with every trial, ``best.toml`` with the experiment of the best one, and Optuna's ``study.db``.

    Args:
        directory: Where the study is, or will be. Trials that have ended are not trained again. One that was stopped
            half-way is resumed.
        space: What is tried, field by field.
        trials: How many trials end, those that are pruned or fail included.
        preset: A preset's name, an experiment's file or an experiment.
        report_every: Environment steps from one value that the pruner sees to the next. The value is interpolated between
            evaluations, because pruners compare trials at equal steps.
        evaluate_every: Minutes from one evaluation of a trial to the next.
        sampler: Optuna's sampler; by default its own choice.
        pruner: Optuna's pruner; by default its own choice.
        actors: Number of actor processes.
        minutes: Minutes to train each trial, instead of the experiment's budget.
        clips: Clips instead of the experiment's.
        **fields: Fields of every trial.

    Raises:
        comic.Error: Optuna is not installed; a field or one of its values is wrong; the directory has another study, or
            another process uses it.
    """
    _optuna()
    trials = whole("trials", trials, 0, None)
    report_every = whole("report_every", report_every, 1, None)
    actors = whole("actors", actors, 1, 1024)
    evaluate_every = _minutes("evaluate_every", evaluate_every)
    if minutes is not None:
        fields["budget.minutes"] = _minutes("minutes", minutes)
    base = experiment.resolve(preset, clips=clips, **fields)
    distributions = _distributions(base, space)
    for program in ("comic-learner", "comic-actor"):
        programs.find(program)
    directory = Path(directory).absolute()
    directory.mkdir(parents=True, exist_ok=True)
    with files.locked(directory / "lock", "another process runs this study: stop it first"):
        study: optuna.Study = _optuna().create_study(
            storage=f"sqlite:///{directory / 'study.db'}",
            study_name="comic",
            direction="maximize",
            load_if_exists=True,
            sampler=sampler,
            pruner=pruner,
        )
        definition = json.dumps({"experiment": base.toml, "space": space}, sort_keys=True)
        if study.user_attrs.setdefault("definition", definition) != definition:
            problem = "its study has another experiment or other values: choose another directory"
            raise _native.Error(f"{directory}: {problem}")
        study.set_user_attr("definition", definition)
        _take_back(study)
        while _has_waiting(study) or len(_directories(study)) < trials:
            try:
                trial = study.ask(distributions)
            except (TypeError, ValueError) as error:
                raise _native.Error(f"Optuna cannot choose values: {error}: look at the arguments of the sampler") from error
            name = trial.user_attrs.get("directory", f"trial-{len(_directories(study)):04}")
            trial.set_user_attr("directory", name)
            values = {field: _value(tried, trial.params[field]) for field, tried in space.items()}
            run = _Run(trial, directory / name, actors, report_every, evaluate_every)
            run.end(study, base, values)
            _write(study, directory, space)
        _write(study, directory, space)
        return study


def curve(run: Path) -> tuple[list[int], list[float]]:
    """Environment steps and normalised rewards of a run's evaluations without noise. The steps increase."""
    steps: list[int] = []
    rewards: list[float] = []
    path = run / "evaluations.jsonl"
    # The learner may be writing the last line.
    for text in path.read_text(encoding="utf-8").split("\n")[:-1] if path.exists() else []:
        try:
            line = json.loads(text)
            step, evaluation = int(line["environment_steps"]), line["evaluation"]
            reward = float(evaluation["overall"]["normalised_reward"])
            if not evaluation["deterministic"] or (step == 0 and line["updates"] > 0):
                continue
        except (ValueError, KeyError, TypeError, RecursionError):
            # The learner keeps whatever is reported to it.
            continue
        # A learner that resumes repeats the steps after its last checkpoint. The newer evaluations replace the older ones.
        kept = int(np.searchsorted(steps, step))
        steps[kept:], rewards[kept:] = [step], [reward]
    return steps, rewards


@dataclass(frozen=True)
class _Run:
    """The run of a trial."""

    trial: optuna.Trial
    path: Path
    actors: int
    report_every: int
    evaluate_every: float

    def end(self, study: optuna.Study, base: experiment.Experiment, values: dict[str, Any]) -> None:
        """Trains to the end, and tells the study. If this process is stopped, the trial stays unfinished."""
        optuna = _optuna()
        state = optuna.trial.TrialState
        self._say(", ".join(f"{name}={value}" for name, value in values.items()))
        ended = self.path / "evaluation.json"
        try:
            if not ended.exists():
                self._train(base, values)
                asked = ["evaluate", "--checkpoint", str(self.path), "--deterministic", "--json"]
                files.replace(ended, [json.dumps({"trained": json.loads(programs.run("comic-actor", asked))})])
            value = json.loads(ended.read_text(encoding="utf-8"))["trained"]["overall"]["normalised_reward"]
            study.tell(self.trial, value)
            self._say(f"normalised reward {value:.4f}")
        except optuna.TrialPruned:
            study.tell(self.trial, state=state.PRUNED)
            self._say("pruned")
        except _native.Error as error:
            self.trial.set_user_attr("error", str(error))
            study.tell(self.trial, state=state.FAIL)
            self._say(f"failed: {error}")

    def _train(self, base: experiment.Experiment, values: dict[str, Any]) -> None:
        resume = (self.path / "checkpoints").is_dir()
        if resume:
            # The learner of a search that was killed may still be writing its checkpoint.
            lock = self.path / "checkpoints" / "lock"
            with files.locked(lock, "another learner uses this run: stop it first", _END_LIMIT):
                pass
        reported = 0
        lines = training.train(base, run=self.path, actors=self.actors, evaluator=False, resume=resume, **values)
        with closing(lines), ExitStack() as evaluators:
            for number, line in enumerate(lines):
                if number == 0:
                    evaluators.enter_context(self._evaluator())
                self.trial.set_user_attr("environment_steps", line["environment_steps"])
                self.trial.set_user_attr("minutes", line["seconds"] / 60)
                for step, value in reports(*curve(self.path), self.report_every):
                    if step > reported:
                        self.trial.report(value, step)
                        reported = step
                        if self.trial.should_prune():
                            raise _optuna().TrialPruned

    @contextmanager
    def _evaluator(self) -> Iterator[None]:
        """Evaluates the newest checkpoints meanwhile, without noise. If it fails, nothing is pruned; its log says why.

        It has the priority of the actors, because on a busy machine no trial would be pruned otherwise.
        """
        log = (self.path / "learner.log").read_text(encoding="utf-8", errors="replace")
        # The line in which the newest learner says where it listens.
        said = [json.loads(line) for line in log.splitlines() if line.startswith("{") and '"listening"' in line]
        arguments = ["evaluate", "--learner", f"http://{said[-1]['listening']}", "--watch", "--nice", "0"]
        arguments += ["--every", str(self.evaluate_every)]
        evaluator = programs.child("comic-actor", arguments, self.path / "evaluator.log")
        try:
            yield
        finally:
            evaluator.terminate()
            evaluator.wait()

    def _say(self, what: str) -> None:
        print(f"{self.path.name}: {what}", file=sys.stderr, flush=True)


def reports(steps: list[int], rewards: list[float], every: int) -> Iterator[tuple[int, float]]:
    """The curve's values at multiples of ``every``, as far as they lie between evaluations: pruners compare equal steps."""
    if steps:
        for step in range(-(-max(steps[0], 1) // every) * every, steps[-1] + 1, every):
            yield step, float(np.interp(step, steps, rewards))


def _distributions(base: experiment.Experiment, space: Space) -> dict[str, Any]:
    """The space for Optuna. Refuses what it or an experiment would refuse, before the first trial begins."""
    if not isinstance(space, Mapping) or not space:
        raise _native.Error("the space has no field, so there is nothing to search for")
    distributions = {}
    for name, values in space.items():
        try:
            json.dumps(values)
        except (TypeError, ValueError, RecursionError) as error:
            remedy = "give Python's own numbers, texts and lists"
            raise _native.Error(f"{name}: {values!r} cannot be stored with the study ({error}): {remedy}") from error
        if isinstance(values, Mapping):
            if not {"low", "high"} <= set(values) <= _RANGE:
                given = ", ".join(values)
                raise _native.Error(f"{name}: a range has low and high, and perhaps log or step, not {given}")
            tried = [values["low"], values["high"]]
        elif not isinstance(values, Sequence) or isinstance(values, str) or not values:
            raise _native.Error(f"{name}: {values!r}; give a range or a list of values")
        else:
            tried = list(values)
        for value in tried:
            experiment.resolve(base, **{name: value})
        try:
            distributions[name] = _distribution(values)
        except (TypeError, ValueError) as error:
            raise _native.Error(f"{name}: {error}") from error
    return distributions


def _distribution(values: Mapping[str, Any] | Sequence[Any]) -> Any:
    kinds = _optuna().distributions
    if isinstance(values, Mapping):
        integers = all(isinstance(values[end], int) for end in ("low", "high"))
        return (kinds.IntDistribution if integers else kinds.FloatDistribution)(**values)
    return kinds.CategoricalDistribution([_stored(value) for value in values])


def _value(values: Mapping[str, Any] | Sequence[Any], chosen: Any) -> Any:
    """The value that Optuna chose."""
    return chosen if isinstance(values, Mapping) else values[[_stored(value) for value in values].index(chosen)]


def _stored(value: Any) -> Any:
    """A value of a list as Optuna stores it. It stores no lists."""
    return value if isinstance(value, (bool, int, float, str)) else json.dumps(value)


def _minutes(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value < np.inf:
        raise _native.Error(f"{name}: {value!r}; give a number of minutes")
    return float(value)


def _take_back(study: Any) -> None:
    """Puts trials that were stopped half-way at the front: their directories have their checkpoints."""
    state = _optuna().trial.TrialState
    waiting = {trial.user_attrs.get("directory") for trial in study.get_trials(states=(state.WAITING,))}
    for trial in study.get_trials(states=(state.RUNNING,)):
        name = trial.user_attrs.get("directory")
        # Without a name the process was killed before the trial began.
        if name is not None and name not in waiting:
            study.enqueue_trial(trial.params, user_attrs={"directory": name})
            print(f"{name}: it was stopped half-way and is resumed", file=sys.stderr)
        study.tell(trial.number, state=state.FAIL)


def _has_waiting(study: Any) -> bool:
    return bool(study.get_trials(deepcopy=False, states=(_optuna().trial.TrialState.WAITING,)))


def _directories(study: Any) -> set[str]:
    trials = study.get_trials(deepcopy=False)
    return {trial.user_attrs["directory"] for trial in trials if "directory" in trial.user_attrs}


def _write(study: Any, directory: Path, space: Space) -> None:
    """Writes the table and the best experiment."""
    # A trial that was resumed replaces the one that was stopped.
    newest = {trial.user_attrs.get("directory"): trial for trial in study.get_trials(deepcopy=False)}
    newest.pop(None, None)

    rows = [["trial", "ended", "normalised reward", "environment steps", "minutes", *space]]
    rows.append(["---"] * len(rows[0]))
    for name, trial in sorted(newest.items(), key=lambda item: (-_reward(item[1]), item[0])):
        steps, minutes = trial.user_attrs.get("environment_steps", 0), trial.user_attrs.get("minutes", 0.0)
        chosen = [_text(trial.params.get(field)) for field in space]
        rows.append([name, trial.state.name.lower(), _text(trial.value), f"{steps:,}", f"{minutes:.1f}", *chosen])
    files.replace(directory / "table.md", (f"| {' | '.join(row)} |\n" for row in rows))
    best = max(newest.values(), key=_reward, default=None)
    if best is not None and _reward(best) > -np.inf:
        document = directory / best.user_attrs["directory"] / "experiment.toml"
        files.replace(directory / "best.toml", [document.read_text(encoding="utf-8")])


def _reward(trial: Any) -> float:
    """The value of a trial that was trained to its end, and less than any value otherwise."""
    return float(trial.value) if trial.state.name == "COMPLETE" else -np.inf


def _text(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _optuna() -> Any:
    try:
        return importlib.import_module("optuna")
    except ImportError as error:
        raise _native.Error(f"Optuna is not installed ({error}): pip install comic-rl[optuna]") from error


# The keys of a file that are arguments of `search` as they are.
_ARGUMENTS = {"preset", "trials", "report_every", "evaluate_every", "actors", "minutes", "clips"}
_TABLES = {"set", "search", "sampler", "pruner"}
# The names of arguments of `search`, which are no fields.
_RESERVED = {*_ARGUMENTS, "directory", "space", "sampler", "pruner"}
_LARGEST_SEED = 2**31


def _read(path: Path, trained: int) -> dict[str, Any]:
    """The arguments of `search` that a file describes, for a directory with so many trials."""
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise _native.Error(f"{path}: {error}") from error
    unknown = set(document) - _ARGUMENTS - _TABLES
    if unknown or not {"trials", "search"} <= set(document):
        known = f"trials and search, and perhaps {', '.join(sorted((_ARGUMENTS | _TABLES) - {'trials', 'search'}))}"
        raise _native.Error(f"{path}: it has {', '.join(sorted(document)) or 'nothing'}; a study has {known}")
    for name in sorted(_TABLES & set(document)):
        if not isinstance(document[name], Mapping):
            raise _native.Error(f"{path}: {name}: {document[name]!r}; it is a table, such as [{name}]")
    arguments = {key: value for key, value in document.items() if key in _ARGUMENTS}
    fields = document.get("set", {})
    if reserved := sorted(fields.keys() & _RESERVED):
        raise _native.Error(f"{path}: set: {', '.join(reserved)}: it is no field; write it outside of [set], or not at all")
    for kind in ("sampler", "pruner"):
        if kind in document:
            arguments[kind] = _choice(kind, document[kind], trained)
    return {**arguments, "space": document["search"], **fields}


def _choice(kind: str, table: Mapping[str, Any], trained: int) -> Any:
    """The sampler or pruner of a table: its ``class``, and the arguments."""
    optuna = _optuna()
    module = {"sampler": optuna.samplers, "pruner": optuna.pruners}[kind]
    arguments = dict(table)
    name = arguments.pop("class", None)
    if not isinstance(name, str) or name not in module.__all__:
        raise _native.Error(f"{kind}.class: {name!r}; choose one of {', '.join(module.__all__)}")
    if "seed" in arguments:
        # Otherwise a study that continues would draw its first values again.
        arguments["seed"] = trained + whole(f"{kind}.seed", arguments["seed"], 0, _LARGEST_SEED)
    try:
        return getattr(module, name)(**arguments)
    except (TypeError, ValueError) as error:
        raise _native.Error(f"{kind}: {error}") from error


def main() -> None:
    """Runs the study of a file. Ends with 1 and a message when it cannot."""
    parser = argparse.ArgumentParser(
        prog="python -m comic.sweep", description="Searches for good values of an experiment's fields with Optuna."
    )
    parser.add_argument("study", metavar="STUDY.toml", type=Path, help="what is tried; docs/trackers.md explains the file")
    parser.add_argument("--out", metavar="DIR", type=Path, help="the study's directory [default: runs/study-STUDY]")
    asked = parser.parse_args()
    out = asked.out or Path("runs") / f"study-{asked.study.stem}"
    # The learner and its actors are stopped on the way out.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    try:
        search(out, **_read(asked.study, len(list(out.glob("trial-*")))))
    except KeyboardInterrupt:
        sys.exit("interrupted; the same command resumes the study")
    # For instance a directory that cannot be made.
    except (_native.Error, OSError) as error:
        sys.exit(f"error: {error}")
    print((out / "table.md").read_text(encoding="utf-8"), end="")


if __name__ == "__main__":
    main()
