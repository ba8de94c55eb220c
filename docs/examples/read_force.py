"""Reads the force of palpd stream --force: `python read_force.py SOCKET [RECORDS]`. It takes the newest record and skips older ones."""

import socket
import struct
import sys
import time

RECORD = struct.Struct("<4sBBHQ3d6d")

with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as force:
    force.connect(sys.argv[1])
    before = None
    for _ in range(int(sys.argv[2]) if len(sys.argv) > 2 else 1_000_000):
        data = force.recv(RECORD.size)  # waits for a record; b"" where the stream has ended
        try:
            while newer := force.recv(RECORD.size, socket.MSG_DONTWAIT):
                data = newer
        except BlockingIOError:
            pass  # nothing newer
        magic, phase, action, version, sequence, sensor_s, tick_s, sent_s, *wrench = RECORD.unpack(data)
        assert (magic, version) == (b"PFRC", 1), "another version of palpd"
        lost = sequence - before - 1 if before is not None else 0
        before, age_ms = sequence, (time.monotonic() - sensor_s) * 1e3
        print(f"{sequence}: fz {wrench[2]:+.2f} N, {age_ms:.1f} ms after the sensor, {lost} lost")
