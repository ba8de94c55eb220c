"""Known vulnerabilities in the versions that uv.lock names, by pip-audit, which is fetched for that alone.

`python benchmarks/audit.py` ends with 1 where one is known, and with 0 and a sentence where pip-audit or its database cannot be reached.
"""

import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
PATIENCE_S = 60


def main() -> None:
    """Export the lock, ask the database."""
    uv = shutil.which("uv") or str(Path(sys.executable).with_name("uv"))
    with tempfile.TemporaryDirectory() as folder:
        requirements = Path(folder) / "requirements.txt"
        export = [uv, "export", "--frozen", "--no-emit-project", "--all-extras", "--format", "requirements-txt", "--quiet", "--output-file"]
        subprocess.run([*export, str(requirements)], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        audit = [
            uv,
            "tool",
            "run",
            "pip-audit",
            "--disable-pip",
            "--require-hashes",
            "--progress-spinner",
            "off",
            "--format",
            "json",
            "-r",
            str(requirements),
        ]
        try:
            done = subprocess.run(audit, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
        except subprocess.TimeoutExpired:
            print(f"audit skipped: no answer within {PATIENCE_S} s")
            return
    try:
        packages = json.loads(done.stdout)["dependencies"]
    except (ValueError, KeyError):
        last = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        print(f"audit skipped: pip-audit or its database cannot be reached ({last[:200]})")
        return
    judged = [package for package in packages if "skip_reason" not in package]
    if not judged:
        print(f"audit skipped: the database that can be reached from here knows none of the {len(packages)} packages of uv.lock")
        return
    known = [(package, vulnerability) for package in judged for vulnerability in package["vulns"]]
    for package, vulnerability in known:
        fixed = ", ".join(vulnerability["fix_versions"]) or "no version yet"
        print(f"{package['name']} {package['version']}: {vulnerability['id']}, fixed in {fixed}")
    print(f"{len(known)} known vulnerabilities in {len(judged)} of {len(packages)} packages of uv.lock")
    sys.exit(1 if known else 0)


if __name__ == "__main__":
    main()
