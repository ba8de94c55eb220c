"""A reader of one's own: a file of JSON, one object a line, such as {"t": 0.01, "force": 1.2, "height": 0.003}."""

import json

import numpy as np

from palpd.errors import RecordingError
from palpd.interchange.channels import Channel, ChannelData


class LinesOfJson:
    name = "lines of JSON (.jsonl)"

    def reads(self, path):
        return path.suffix == ".jsonl"

    def channels(self, path):
        return [Channel(name) for name in rows_of(path)[0]]

    def columns(self, path, names):
        rows = rows_of(path)
        try:
            return {name: ChannelData(np.array([float(row[name]) for row in rows])) for name in names}
        except (KeyError, TypeError, ValueError) as error:
            raise RecordingError(f"{path.name}: a row lacks a number ({error}); every line needs all columns") from None


def rows_of(path):
    try:
        return [json.loads(line) for line in path.read_text().splitlines()]
    except ValueError as error:
        raise RecordingError(f"{path.name} is not one JSON object a line ({error})") from None


READER = LinesOfJson()
