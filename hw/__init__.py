"""Bytes in and out: the drivers of the real devices, and emulators of their far ends."""
