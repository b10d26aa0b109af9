"""``python -m comic.track``."""

from __future__ import annotations

import argparse
import signal
import sys
import threading

import comic
from comic import track


def main() -> None:
    """Follows a run. Ends with 1 and a message when it cannot."""
    parser = argparse.ArgumentParser(
        prog="python -m comic.track", description="Copies a run to a tracker while it trains: curves, films, checkpoints."
    )
    parser.add_argument("run", metavar="RUN", help="the run's directory; it may not exist yet")
    parser.add_argument("--to", required=True, choices=list(track.TRACKERS), help="the tracker")
    parser.add_argument(
        "--project", default="comic", help="project, in MLflow the experiment [default: %(default)s]"
    )
    parser.add_argument("--name", help="the run's name [default: the directory's]")
    parser.add_argument(
        "--checkpoints", default="none", choices=track.CHECKPOINTS, help="which are copied, too [default: %(default)s]"
    )
    parser.add_argument("--once", action="store_true", help="copy what is there, and end")
    parser.add_argument(
        "--every", type=float, default=5.0, metavar="SECONDS", help="time between two looks [default: %(default)s]"
    )
    parser.add_argument(
        "--timeout", type=float, default=3600.0, metavar="SECONDS",
        help="give up when there was nothing new for so long [default: %(default)s]",
    )  # fmt: skip
    arguments = vars(parser.parse_args())
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        points = track.follow(arguments.pop("run"), arguments.pop("to"), stop=stop, **arguments)
    # For instance a file of the run that may not be read.
    except (comic.Error, OSError) as error:
        sys.exit(f"error: {error}")
    print(f"the tracker has {points} points")


main()
