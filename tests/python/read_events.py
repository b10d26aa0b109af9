"""What TensorBoard reads in a run's directory: python read_events.py RUN/tensorboard

Prints one JSON object, {tag: [[step, value], ...]}. Needs requirements-tests.txt.
"""

import json
import sys

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

events = EventAccumulator(sys.argv[1])
events.Reload()
tags = events.Tags()["scalars"]
print(json.dumps({tag: [[scalar.step, scalar.value] for scalar in events.Scalars(tag)] for tag in tags}))
