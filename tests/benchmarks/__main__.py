"""``python tests/benchmarks [NAME ...]``: run every benchmark, or those whose file name contains a NAME.

Each benchmark is a file with a ``main()`` that prints its own table of medians and ratios, measured against
its peers in the same run. Machines differ and are noisy: compare ratios, and across machines use the
calibration score printed first.
"""

from __future__ import annotations

import os
import platform
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).parent


def calibration(rounds: int = 7) -> tuple[float, float]:
    """Median GFLOP/s of a float32 polynomial over 16 MB, and GB/s of copying them: one core."""
    x = np.linspace(-1.0, 1.0, 4_000_000, dtype=np.float32)
    y = np.empty_like(x)
    flops, bandwidth = [], []
    for _ in range(rounds):
        started = time.perf_counter()
        np.multiply(x, np.float32(0.3), out=y)
        for coefficient in (0.1, 0.2, 0.3, 0.4, 0.5):
            np.add(y, np.float32(coefficient), out=y)
            np.multiply(y, x, out=y)
        flops.append(11 * x.size / (time.perf_counter() - started) / 1e9)
        started = time.perf_counter()
        np.copyto(y, x)
        bandwidth.append(2 * x.nbytes / (time.perf_counter() - started) / 1e9)
    return statistics.median(flops), statistics.median(bandwidth)


def processor() -> str:
    """The processor's name, where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")


def main() -> None:
    """Run the benchmarks asked for."""
    wanted = sys.argv[1:]
    flops, bandwidth = calibration()
    print(f"{processor()}, Python {platform.python_version()}, NumPy {np.__version__}")
    print(f"calibration, one core: {flops:.2f} GFLOP/s float32, copy {bandwidth:.1f} GB/s", flush=True)
    # What benchmarks share with tests lies beside them.
    support = [str(FOLDER.parent / "support"), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, support))}
    failed = False
    for path in sorted(FOLDER.glob("*.py")):
        if path.name.startswith("_") or (wanted and not any(name in path.stem for name in wanted)):
            continue
        print(f"\n== {path.stem.replace('_', ' ')}", flush=True)
        # A process of its own: nothing is warm or in memory because another one ran before.
        failed |= subprocess.run([sys.executable, path], env=environment, check=False).returncode != 0
    sys.exit(failed)


if __name__ == "__main__":
    main()
