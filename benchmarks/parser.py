"""Frames a second through the HEX-70 parser, on clean and on dirty bytes, in large pieces and in those of a running loop.

python benchmarks/parser.py
"""

import argparse
import struct
import time

import numpy as np

from hw.hex_frames import DATA, FrameParser

LIMITS = (24792.0, 24666.0, 4584.0, 33777.0, 32460.0, 27948.0)


def stream(frames: int, spoilt: float, seed: int = 0) -> tuple[bytes, int]:
    """Frames of a wandering wrench, a share of them cut short, with a byte changed, or behind noise; and how many are whole."""
    rng = np.random.default_rng(seed)
    counts = np.clip(np.cumsum(rng.integers(-2, 3, (frames, 6)), axis=0), -1400, 1400).tolist()
    fate = np.where(rng.random(frames) < spoilt, rng.integers(1, 4, frames), 0).tolist()
    pieces, whole = [], frames
    for i in range(frames):
        body = DATA + struct.pack(">HH6h", i & 0xFFFF, 0, *counts[i])
        sent = bytearray(body + (sum(body) & 0xFFFF).to_bytes(2, "big"))
        match fate[i]:
            case 1:
                del sent[int(rng.integers(1, 21)) :]
                whole -= 1
            case 2:
                sent[int(rng.integers(0, 22))] ^= 0x5A
                whole -= 1
            case 3:
                sent = bytearray(rng.bytes(int(rng.integers(1, 40)))) + sent
        pieces.append(bytes(sent))
    return b"".join(pieces), whole


def rate(data: bytes, piece: int) -> tuple[float, int, FrameParser]:
    """Frames a second, frames found, and the parser afterwards."""
    parser = FrameParser(1, 150.0, LIMITS)
    began_s = time.perf_counter()
    frames = sum(len(parser.feed(data[at : at + piece]).counter) for at in range(0, len(data), piece))
    frames += len(parser.flush().counter)
    return frames / (time.perf_counter() - began_s), frames, parser


def main() -> None:
    """Print a table."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--frames", type=int, default=300_000)
    frames = options.parse_args().frames
    print(f"{'bytes':<22} {'a call':>10} {'M frames/s':>11} {'whole':>8} {'found':>8} {'rejected':>9}")
    for name, spoilt in (("clean", 0.0), ("1 % of frames spoilt", 0.01), ("10 % of frames spoilt", 0.1)):
        data, whole = stream(frames, spoilt)
        for label, piece in (("all", len(data)), ("4096", 4096), ("2 frames", 44)):
            best, parsed, parser = max((rate(data, piece) for _ in range(3)), key=lambda run: run[0])
            print(f"{name:<22} {label:>10} {best / 1e6:>11.3f} {whole:>8} {parsed:>8} {parser.rejected:>9}")


if __name__ == "__main__":
    main()
