"""Coverage-guided fuzz of the parsers of bytes: HEX-70 frames, requests on the control socket, unfinished recordings.

`python -m benchmarks.fuzz_bytes [--seconds S] [--target NAME] [--keep FOLDER]`. Needs atheris (`pip install atheris`), which the project
does not depend on; without it the fuzz says so and ends with 2. Every target begins with valid data and runs for S seconds in a process of
its own. Prints executions and covered edges; ends with 1 if a parser raised anything but an error of ours, or gave a wrong answer. The
bytes that did it stand in the folder as crash-*.
"""

import argparse
import importlib.util
import json
import re
import socket
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

Target = tuple[Callable[[bytes], None], list[bytes]]
"""What takes the bytes, and valid data to begin with."""


def frames(_: Path) -> Target:
    """HEX-70 frames: the result must not depend on how the bytes are split."""
    from hw.hex_frames import DATA, FrameParser

    def feed(data: bytes) -> None:
        size = data[0] % 40 + 1 if data else 1
        whole, split = FrameParser(1, 150.0), FrameParser(1, 150.0)
        at_once = [*whole.feed(data).counter, *whole.flush().counter]
        pieces = [counter for at in range(0, len(data), size) for counter in split.feed(data[at : at + size]).counter]
        if at_once != [*pieces, *split.flush().counter] or whole.rejected != split.rejected:
            raise AssertionError("the frames depend on how the bytes are split")

    bodies = [DATA + struct.pack(">HH6h", k, 0, 10, -10, -400 + k, 1, 2, 3) for k in range(20)]
    stream = b"".join(body + (sum(body) & 0xFFFF).to_bytes(2, "big") for body in bodies)
    return feed, [stream, stream[5:100] + stream[110:]]


def requests(folder: Path) -> Target:
    """Requests on the control socket: each is answered with one line of JSON, or dropped where it has no line."""
    from palpd.config import parse_plan
    from palpd.daemon.control_socket import ControlSocket
    from palpd.daemon.socket_client import ControlAnswer, ControlRequest
    from palpd.errors import PalpdError

    def answer(request: ControlRequest) -> ControlAnswer:
        try:
            parse_plan(request.get("plan"), "the plan")
        except PalpdError as error:
            return {"ok": False, "error": str(error)}
        return {"ok": True}

    path = folder / "palpd.sock"
    server = ControlSocket(path, answer)

    def ask(data: bytes) -> None:
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(path))
            client.sendall(data[:60_000])
            client.shutdown(socket.SHUT_WR)
            client.settimeout(5.0)
            for _ in range(3):  # accept, receive, notice the end
                server.poll()
            received = client.recv(65536)
        if b"\n" in data[:60_000] and not isinstance(json.loads(received)["ok"], bool):
            raise AssertionError("the answer does not say whether it is ok")

    plan = {"sites": [{"name": "A", "x_m": 0.0}], "depths_m": [0.004], "search": {"speed_m_per_s": 0.01}}
    return ask, [json.dumps({"do": "start", "plan": plan}).encode() + b"\n", b'{"do": "status"}\n']


def recordings(folder: Path) -> Target:
    """Unfinished recordings: recovered or refused, and what is recovered can be read."""
    import numpy as np

    from palpd.errors import PalpdError
    from palpd.recording.mcap_file import RecordingWriter
    from palpd.recording.reader import Recording
    from palpd.recording.recovery import recover
    from palpd.tick import ROW

    part, whole = folder / "some.part", folder / "some.mcap"
    writer = RecordingWriter(whole, {"epoch_offset_s": 0.0, "sites": []})
    for _ in range(3):
        writer.write(np.zeros(5, ROW))
        writer.flush()
    writer.close({"verdict": "done", "reason": ""})
    seed = whole.read_bytes()

    def restore(data: bytes) -> None:
        whole.unlink(missing_ok=True)
        part.write_bytes(data)
        try:
            recover(part)
        except PalpdError:
            return
        Recording.load(whole)

    return restore, [seed, seed[: len(seed) // 2]]


TARGETS = {"frames": frames, "requests": requests, "recordings": recordings}


def _fuzz(name: str, seconds: float, keep: Path) -> None:
    """Fuzz one target in this process; atheris ends it."""
    import atheris

    with atheris.instrument_imports(include=["palpd", "hw"]):
        target, seeds = TARGETS[name](Path(tempfile.mkdtemp(prefix="palpd-fuzz-")))
    corpus = Path(tempfile.mkdtemp(prefix="palpd-corpus-"))
    for number, seed in enumerate(seeds):
        (corpus / str(number)).write_bytes(seed)
    arguments = [str(corpus), f"-max_total_time={seconds:.0f}", "-print_final_stats=1", "-max_len=8192", "-timeout=10"]
    atheris.Setup([sys.argv[0], *arguments, f"-artifact_prefix={keep}/"], target)
    atheris.Fuzz()


def main() -> int:
    """Print a table; 1 if a parser failed, 2 without atheris."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="for each target")
    parser.add_argument("--target", choices=[*TARGETS], help="this one only")
    parser.add_argument("--keep", type=Path, default=Path(tempfile.gettempdir()), help="folder for the bytes that broke a parser")
    parser.add_argument("--here", action="store_true", help="fuzz --target in this process")
    options = parser.parse_args()
    if importlib.util.find_spec("atheris") is None:
        print("atheris is not installed; pip install atheris, and try again", file=sys.stderr)
        return 2
    if options.here:
        _fuzz(options.target, options.seconds, options.keep)
    failed = False
    print(f"{'target':<12}{'executions':>12}{'edges':>8}  result")
    for name in [options.target] if options.target else TARGETS:
        command = [sys.executable, "-m", "benchmarks.fuzz_bytes", "--here", "--target", name]
        command += ["--seconds", str(options.seconds), "--keep", str(options.keep)]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
        runs = re.findall(r"number_of_executed_units:\s*(\d+)", done.stderr)
        edges = re.findall(r"cov: (\d+)", done.stderr)
        failed = failed or done.returncode != 0 or not runs
        result = "held" if done.returncode == 0 and runs else f"broken:\n{done.stderr[-3000:]}"
        print(f"{name:<12}{runs[-1] if runs else '-':>12}{edges[-1] if edges else '-':>8}  {result}", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
