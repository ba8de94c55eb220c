"""A service that holds one conversation of `palpd resolve`, as docs/jobs.md describes it: it diagnoses, proposes, and hears the answer."""

import json
import socketserver
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

from palpd.config import parse_plan
from palpd.daemon.kept_plans import KeptPlans
from palpd.daemon.what_now import Standing, what_now
from palpd.errors import PalpdError

ID = "20261122-101502-resolve"
PLAN = {"sites": [{"name": "A", "x_m": 0.0, "y_m": 0.0}], "depths_m": [0.003], "mode": "static", "hold_s": 0.5, "press_speed_m_per_s": 0.01}
GAP = "A gap in fz_N during holds: tissue.viscoelastic (0.62) or sensor.drift (0.31) <b>explains</b> it."
PROPOSAL = {
    "number": 1, "gap": GAP, "decides": "Hold at 3 mm for 10 s: it separates tissue.viscoelastic and sensor.drift by 4.2 nats.",
    "duration_s": 41.5, "expected_peak_N": 7.9, "limit_N": 12.0, "plan": PLAN,
}  # fmt: skip
ROUNDS = [
    {"number": 1, "recording": "round-1.csv", "duration_s": 40.0, "verdict": "ambiguous", "sentence": GAP, "pair": None,
     "expected_gain": None, "open": {"tissue.viscoelastic": 0.62, "sensor.drift": 0.31}, "gained": None,
     "reversal": False, "settled": False},
]  # fmt: skip


class FakeResolve:
    """Listens at `path`. `requests` are what it was asked; `refusal`, if set, answers what needs the controls."""

    def __init__(self, path: Path) -> None:
        self.requests: list[dict[str, Any]] = []
        self.refusal = ""
        self.job: dict[str, Any] | None = None
        self.plans = KeptPlans(path.parent / "plans")
        fake = self

        class Handler(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                request = json.loads(self.rfile.readline() or b"{}")
                with suppress(OSError):  # the page has left
                    if request.get("do") == "watch":
                        self.wfile.write(json.dumps({"ok": True, "event": "status", **fake.status()}).encode() + b"\n")
                        fake.over.wait()
                    elif request:
                        self.wfile.write(json.dumps(fake.answer(request)).encode() + b"\n")

        class Server(socketserver.ThreadingUnixStreamServer):
            daemon_threads = True

        self.over = threading.Event()
        self._server = Server(str(path), Handler)
        threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True).start()

    def close(self) -> None:
        """Answer nobody any more."""
        self.over.set()
        self._server.shutdown()
        self._server.server_close()

    def status(self) -> dict[str, Any]:
        """The status that the service would give."""
        state = "armed" if self.job is None or self.job["ended"] else self.job["state"]
        standing = Standing(armed=state == "armed", job=None if state == "armed" else ID, proposal=state == "waiting", reference=True)
        now = what_now(standing).published
        return {"state": state, "now": now, "latched": None, "controls": None, "active": self.job, "cell": None, "ring": "absent", "pid": 1}

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Answer one request."""
        self.requests.append(request)
        do = request["do"]
        if self.refusal and do in ("begin", "decide"):
            return {"ok": False, "error": self.refusal}
        if do == "begin":
            self.job = {
                "id": ID, "program": "resolve", "by": "anna", "begun": "2026-11-22T10:15:02+00:00", "state": "waiting", "activity": "",
                "runs": 1, "most_runs": 4, "proposal": PROPOSAL, "ended": None, "verdict": None, "reason": "", "exit_code": None,
            }  # fmt: skip
            return {"ok": True, "id": ID, "most_runs": 4, "state": "waiting"}
        if do in ("decide", "cancel") and self.job is not None:
            reason = "Resolved: tissue.viscoelastic." if request.get("agree") else "the operator declined the proposed motion"
            verdict = "cancelled" if do == "cancel" else "done" if request.get("agree") else "declined"
            self.job |= {"state": verdict, "verdict": verdict, "reason": reason, "ended": "now", "proposal": None, "exit_code": 0}
            return {"ok": True, "state": "armed"}
        if do == "jobs":
            other = {"id": "20261122-090000-calibrate", "program": "calibrate", "ended": "before"}
            return {"ok": True, "jobs": [*([self.job] if self.job else []), other]}
        if do == "job":
            if self.job is None or request.get("id") != ID:
                return {"ok": False, "error": f"there is no job {request.get('id')!r}; palpd jobs lists them"}
            log = [
                "",
                f"Recording round-1.csv (40 s): {GAP}",
                "  still open: tissue.viscoelastic 0.62, sensor.drift 0.31",
                "Next: hold longer.",
            ]
            return {"ok": True, **self.job, "log": log, "result": {"rounds": ROUNDS, "diagnosis": None} if self.job["ended"] else {}}
        if do in ("plans", "keep-plan", "forget-plan"):
            return self._kept(request)
        standard = {"lease": "a-lease", "lease_s": 10.0} if do in ("take", "renew") else {}
        return {"ok": True, **self.status(), **standard}

    def _kept(self, request: Any) -> dict[str, Any]:
        try:
            if request["do"] == "keep-plan":
                return {"ok": True, **self.plans.keep(request, parse_plan(request["plan"], "the plan"), "anna")}
            return {"ok": True, **(self.plans.answer if request["do"] == "plans" else self.plans.forget)(request)}
        except PalpdError as error:
            return {"ok": False, "error": str(error)}
