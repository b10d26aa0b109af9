"""What TensorBoard reads in a run's directory: python read_events.py RUN/tensorboard

Prints one JSON object. Needs requirements-tests.txt.

curves    {tag: [[step, value], ...]}
images    {tag: [[step, width, height], ...]}
texts     {tag: the newest text}
columns   {field: "string", "bool" or "float64"}, and
metrics   [tag, ...]: the columns of the table of runs (the dashboard "HParams")
rows      {run: {"fields": {field: value}, "metrics": {tag: value}}}: its rows
"""

import json
import sys
from types import SimpleNamespace

from tensorboard import context
from tensorboard.backend.event_processing.data_provider import MultiplexerDataProvider
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
from tensorboard.plugins.hparams import api_pb2, backend_context, get_experiment, list_session_groups

directory = sys.argv[1]
events = EventAccumulator(directory)
events.Reload()
tags = events.Tags()

# The dashboard's own back end.
runs = EventMultiplexer().AddRunsFromDirectory(directory).Reload()
backend = backend_context.Context(SimpleNamespace(data_provider=MultiplexerDataProvider(runs, directory)))
request = context.RequestContext()
provided = backend.hparams_from_data_provider(request, "", None)
experiment = get_experiment.Handler(request, backend, "", api_pb2.GetExperimentRequest()).run()
wanted = api_pb2.ListSessionGroupsRequest(
    allowed_statuses=[api_pb2.STATUS_UNKNOWN, api_pb2.STATUS_SUCCESS, api_pb2.STATUS_FAILURE, api_pb2.STATUS_RUNNING],
    slice_size=1000,
)
rows = list_session_groups.Handler(request, backend, "", wanted).run()


def value_of(value):
    """A google.protobuf.Value as Python's own."""
    return getattr(value, value.WhichOneof("kind"))


print(
    json.dumps(
        {
            "curves": {tag: [[scalar.step, scalar.value] for scalar in events.Scalars(tag)] for tag in tags["scalars"]},
            "images": {
                tag: [[image.step, image.width, image.height] for image in events.Images(tag)] for tag in tags["images"]
            },
            "texts": {
                tag: events.Tensors(tag)[-1].tensor_proto.string_val[0].decode()
                for tag in tags["tensors"]
                if events.SummaryMetadata(tag).plugin_data.plugin_name == "text"
            },
            "columns": {
                field.name: api_pb2.DataType.Name(field.type).removeprefix("DATA_TYPE_").lower()
                for field in experiment.hparam_infos
            },
            "metrics": [metric.name.tag for metric in experiment.metric_infos],
            "rows": {
                row.name: {
                    "fields": {name: value_of(value) for name, value in row.hparams.items()},
                    "metrics": {metric.name.tag: metric.value for metric in row.metric_values},
                }
                for row in rows.session_groups
            },
        }
    )
)
