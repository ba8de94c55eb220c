"""A sensor plug-in: the driver of the HEX-70 with a scale of its own, in the place of a driver that you write."""

from dataclasses import replace

from hw.hex_sensor import open_hex_70


class ScaledSensor:
    def __init__(self, settings):
        self._hex = open_hex_70(settings)
        self._scale = float(settings.options.get("scale", 1.0))

    def __getattr__(self, name):
        return getattr(self._hex, name)

    def read(self):
        frames = self._hex.read()
        return replace(frames, wrench=frames.wrench * self._scale)


def open_my_sensor(settings):
    return ScaledSensor(settings)
