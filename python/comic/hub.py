"""Policies and low levels on a hub: :func:`push` publishes one with a model card, :func:`pull` gets one.

A repository holds ``model.safetensors`` (what ``comic-learner export`` writes), ``README.md`` (the card),
``experiment.toml`` and, if there is one, ``film.gif``. The hub is huggingface.co, or the one that ``HF_ENDPOINT`` names.
The package ``huggingface_hub`` talks to it and keeps the login: ``pip install comic-rl[hub]``, ``hf auth login``.

The same from a shell::

    python -m comic.hub card runs/mine NAME/REPOSITORY
    python -m comic.hub push runs/mine NAME/REPOSITORY
    python -m comic.hub pull NAME/REPOSITORY
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any

from comic import _native, exported, programs
from comic.card import CMU, card

__all__ = ["FILE", "contents", "pull", "push"]

FILE = "model.safetensors"
"""The name in a repository of a policy, or of a part of one."""

LICENCE = "apache-2.0"
"""Licence of weights whose publisher names no other: one of the two of the library's code."""

# Bytes.
_LONGEST_EVALUATION = 16 << 20
_LONGEST_FILM = 64 << 20


def push(source: str | PathLike[str], repo_id: str, *, private: bool | None = None, **options: Any) -> str:
    """Publishes a policy or a low level with a card, in one commit. A repository that does not exist is made.

    Args:
        source: What is published, see :func:`contents`.
        repo_id: The repository: ``NAME/REPOSITORY``.
        private: Whether a new repository is private; by default what the account's settings say.
        **options: ``part``, ``licence``, ``terms``, ``evaluation`` and ``film`` of :func:`contents`.

    Returns:
        The commit's address.

    Raises:
        comic.Error: The source cannot be used, or the hub refuses or cannot be reached.
        ImportError: huggingface_hub is missing: ``pip install comic-rl[hub]``.
    """
    hub = _library()
    files = contents(source, repo_id, **options)
    with _explained(repo_id, "pushed"):
        api = hub.HfApi()
        api.create_repo(repo_id, private=private, exist_ok=True)
        operations = [hub.CommitOperationAdd(name, content) for name, content in files.items()]
        commit = api.create_commit(repo_id, operations, commit_message="Push with comic.hub")
    return str(commit.commit_url)


def pull(repo_id: str, revision: str | None = None) -> Path:
    """Gets the file of a repository and returns its path in the cache of ``huggingface_hub``.

    :func:`comic.exported.describe` has checked it. Without a network, or with ``HF_HUB_OFFLINE=1``, a file that was pulled
    before comes from the cache.

    Args:
        repo_id: The repository: ``NAME/REPOSITORY``.
        revision: A branch, a tag or a commit; by default the newest commit. Only a commit is always the same file.

    Raises:
        comic.Error: The repository, the revision or the file is missing, the hub cannot be reached, or the file is refused.
        ImportError: huggingface_hub is missing: ``pip install comic-rl[hub]``.
    """
    hub = _library()
    with _explained(repo_id, "pulled"):
        found = hub.hf_hub_download(repo_id, FILE, revision=revision, dry_run=True)
        if found.file_size > exported.LONGEST:
            raise _native.Error(
                f"{repo_id}: {FILE} has {found.file_size} bytes, and at most {exported.LONGEST} are read: it is no policy"
            )
        # By the same name of the revision: the cache finds it again by that name when there is no network.
        path = Path(hub.hf_hub_download(repo_id, FILE, revision=revision))
    # If the branch has moved meanwhile, a file that is too long is refused here.
    try:
        exported.describe(path)
    except _native.Error as error:
        raise _native.Error(f"{repo_id}: {error}") from error
    return path


def contents(
    source: str | PathLike[str],
    repo_id: str,
    *,
    part: str | None = None,
    licence: str = LICENCE,
    terms: str | None = None,
    evaluation: str | PathLike[str] | None = None,
    film: str | PathLike[str] | None = None,
) -> dict[str, bytes]:
    """The files that :func:`push` publishes, by name. ``README.md`` is the card.

    None of them names a directory of this machine: of the paths of clips and low levels only the file's name is left, also
    in the description inside ``model.safetensors``.

    Args:
        source: A ``.safetensors`` file of ``comic-learner export``; or a run's directory or one of its checkpoints, which
            the program exports first.
        repo_id: The repository: ``NAME/REPOSITORY``.
        part: What is exported of a run: ``policy`` (unless given), ``policy:TASK``, ``low-level`` or ``encoder:TASK``. A file
            has one part.
        licence: Licence of the weights, by a hub's name of it. It is yours to choose.
        terms: Terms of the motion capture, or ``cmu`` for those of the CMU database; by default those in the file, or CMU's
            if all clips are built in.
        evaluation: A file that ``comic-actor evaluate --json`` printed; by default the run's evaluation.
        film: A GIF; by default the run's film of this checkpoint, or the newest one before it.

    Raises:
        comic.Error: A file is missing, of another kind, or names the home directory; or the program is missing or refuses.
    """
    source, evaluated = Path(source), ""
    with tempfile.TemporaryDirectory() as directory:
        file = source
        if source.is_dir():
            file = Path(directory) / FILE
            arguments = ["export", "--checkpoint", str(source), "--part", part or "policy", "--out", str(file)]
            programs.run("comic-learner", arguments)
        description = exported.describe(file)
        if part is not None and part != description["part"]:
            raise _native.Error(
                f"{source}: it holds the part {description['part']}, not {part}: export that part, or name the run's directory"
            )
        try:
            weights = exported.without_directories(file.read_bytes())
        except _native.Error as error:
            raise _native.Error(f"{source}: {error}") from error
    description = exported.parse(weights, len(weights))
    measured = None if evaluation is None else _json(Path(evaluation))
    if source.is_dir():
        run = _run_of(source)
        if measured is None:
            measured, evaluated = _evaluation(run, description["source"])
        film = film or _film(run, description["source"]["updates"])
    files = {FILE: weights, "experiment.toml": description["experiment"].encode()}
    if film is not None:
        files["film.gif"] = _gif(Path(film))
    readme = card(
        description,
        repo_id,
        licence=licence,
        terms=CMU if terms == "cmu" else terms,
        evaluation=measured,
        evaluated=evaluated,
        film="film.gif" if "film.gif" in files else None,
    )
    files["README.md"] = readme.encode()
    home = f"{os.path.expanduser('~')}/".encode()
    for name in (FILE, "README.md", "experiment.toml"):
        # In a container the home directory may be the root, which says nothing of anybody.
        if home not in (b"/", b"//", b"~/") and home in files[name]:
            raise _native.Error(
                f"{source}: {name} would name your home directory, in a card's command or terms: write another card by "
                f"`comic-learner low-level FILE --made-by COMMAND --out FILE`"
            )
    return files


def _run_of(source: Path) -> Path:
    """The directory of a run: of its own path, that of its checkpoints, or of one checkpoint."""
    places = [source, *source.absolute().parents[:2]]
    return next((place for place in places if (place / "checkpoints").is_dir()), source)


def _evaluation(run: Path, exported_from: Mapping[str, Any]) -> tuple[Any, str]:
    """The run's evaluation of a checkpoint, or of the newest one before it; and which one it is of."""
    updates, checkpoint = exported_from["updates"], exported_from["checkpoint"]
    newest = max((run / "checkpoints").glob("checkpoint-*"), default=None)
    last = run / "evaluation.json"
    # `cargo xtask train` has evaluated the run's last checkpoint at every start. A run that went on has a newer checkpoint.
    if newest and newest.name == checkpoint and last.exists() and last.stat().st_mtime >= newest.stat().st_mtime:
        return _json(last).get("trained"), ""
    found: tuple[int, Any] = (-1, None)
    lines = run / "evaluations.jsonl"
    for line in lines.read_text(encoding="utf-8", errors="replace").split("\n") if lines.exists() else []:
        try:
            entry = json.loads(line)
            place, evaluation = int(entry["updates"]), entry["evaluation"]
            # The learner keeps whatever is reported to it.
            if found[0] <= place <= updates and evaluation["deterministic"] and evaluation["overall"]:
                found = place, evaluation
        except (ValueError, KeyError, TypeError):
            continue
    return found[1], "" if found[0] in (-1, updates) else f"after {found[0]:,} of {updates:,} updates"


def _film(run: Path, updates: int) -> Path | None:
    """The film of the checkpoint with so many updates, or the newest one before it."""
    films = {int(path.stem): path for path in (run / "films").glob("*.gif") if path.stem.isdecimal()}
    return films.get(max((number for number in films if number <= updates), default=-1))


def _json(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(_read(path, _LONGEST_EVALUATION))
    except (ValueError, RecursionError) as error:
        if isinstance(error, _native.Error):
            raise
        value = None
    if not isinstance(value, dict):
        raise _native.Error(f"{path}: it is no evaluation: `comic-actor evaluate --deterministic --json` prints one")
    return value


def _gif(path: Path) -> bytes:
    film = _read(path, _LONGEST_FILM)
    if not film.startswith((b"GIF87a", b"GIF89a")):
        raise _native.Error(f"{path}: it is no GIF: `comic-actor render --policy FILE --out film.gif` makes one")
    return film


def _read(path: Path, most: int) -> bytes:
    try:
        with path.open("rb") as file:
            content = file.read(most + 1)
    except OSError as error:
        raise _native.Error(f"{path}: it cannot be read: {error.strerror}") from error
    if len(content) > most:
        raise _native.Error(f"{path}: it has more than {most} bytes")
    return content


def _library() -> Any:
    try:
        import huggingface_hub
    except ImportError as error:
        raise ImportError("comic.hub needs huggingface_hub: pip install comic-rl[hub]") from error
    return huggingface_hub


@contextmanager
def _explained(repo_id: str, action: str) -> Iterator[None]:
    """Says what an error of the library means, and what to do."""
    from huggingface_hub import errors

    remedies: dict[type[BaseException], str] = {
        errors.HFValidationError: "it is no name of a repository: give NAME/REPOSITORY",
        errors.LocalTokenNotFoundError: "nobody is logged in: hf auth login",
        errors.RevisionNotFoundError: "there is no such revision: leave it out for the newest",
        errors.RepositoryNotFoundError: "there is no such repository, or this login may not use it: check the name, or log "
        "in by `hf auth login`",
        errors.LocalEntryNotFoundError: "the hub cannot be reached, and the cache does not have it: pull it once with a "
        "network, without HF_HUB_OFFLINE",
        errors.EntryNotFoundError: f"the repository has no such file: `python -m comic.hub push` writes {FILE}",
        errors.HfHubHTTPError: "the hub refuses: check that this login may write there, or log in by `hf auth login`",
    }
    try:
        yield
    except _native.Error:
        raise
    # Errors of the network are those of the library's HTTP client, which is another package from release to release.
    except Exception as error:
        package = type(error).__module__.partition(".")[0]
        is_network = isinstance(error, OSError) or package not in ("builtins", "huggingface_hub")
        unreachable = "the hub cannot be reached: check the network, HF_ENDPOINT and HF_HUB_OFFLINE"
        otherwise = unreachable if is_network else "huggingface_hub cannot do it: try another release of it"
        remedy = next((text for kind, text in remedies.items() if isinstance(error, kind)), otherwise)
        # The hub's own words may be among it: a terminal must not obey them.
        first = (str(error).strip().splitlines() or [type(error).__name__])[0]
        reason = "".join(letter for letter in first if letter.isprintable())
        raise _native.Error(f"{repo_id}: {FILE} is not {action}: {remedy} ({reason})") from error


def main(arguments: list[str] | None = None) -> None:
    """The program ``python -m comic.hub``."""
    parser = argparse.ArgumentParser(prog="python -m comic.hub", description="Policies and low levels on a hub.")
    commands = parser.add_subparsers(dest="command", required=True)
    pushes = [
        commands.add_parser("push", help="publish a policy or a low level, and print the commit's address"),
        commands.add_parser("card", help="print the card that push would publish; needs no network"),
    ]
    for command in pushes:
        command.add_argument("source", help="a run's directory, a checkpoint, or a .safetensors file of an export")
        command.add_argument("repository", help="NAME/REPOSITORY")
        command.add_argument("--part", help="policy, policy:TASK, low-level or encoder:TASK of a run [default: policy]")
        command.add_argument("--licence", default=LICENCE, help="of the weights [default: %(default)s]")
        command.add_argument("--terms", help="of the motion capture; `cmu` for those of the CMU database")
        command.add_argument("--evaluation", help="what `comic-actor evaluate --json` printed [default: the run's]")
        command.add_argument("--film", help="a GIF [default: the run's]")
    pushes[0].add_argument("--private", action="store_true", default=None, help="make a new repository private")
    command = commands.add_parser("pull", help="get the file of a repository, and print its path")
    command.add_argument("repository", help="NAME/REPOSITORY")
    command.add_argument("--revision", help="a branch, a tag or a commit [default: the newest]")
    given = vars(parser.parse_args(arguments))
    name, repository = given.pop("command"), given.pop("repository")
    try:
        match name:
            case "pull":
                print(pull(repository, **given))
            case "push":
                print(push(given.pop("source"), repository, **given))
            case _:
                print(contents(given.pop("source"), repository, **given)["README.md"].decode(), end="")
    except (_native.Error, ImportError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
