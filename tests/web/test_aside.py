"""The process beside the server."""

import subprocess
import sys
from pathlib import Path

import pytest

from palpd.testing.processes import until

SERVER = """
import asyncio, os
from palpd.web.aside import Aside

async def serve():
    print(await Aside().compute(os.getpid), flush=True)
    await asyncio.sleep(600)

if __name__ == "__main__":
    asyncio.run(serve())
"""


@pytest.mark.timeout(120)
def test_it_ends_with_a_server_that_is_killed(tmp_path: Path) -> None:
    program = tmp_path / "server.py"
    program.write_text(SERVER)
    with subprocess.Popen([sys.executable, str(program)], stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        beside = Path("/proc", server.stdout.readline().strip())
        assert beside.exists()
        server.kill()
        server.wait()
        until(lambda: not beside.exists() or " Z " in (beside / "stat").read_text(), "the process beside the server ends", 60.0)
