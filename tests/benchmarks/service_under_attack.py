"""A real server under attack: what its health and another client's small question take meanwhile.

``/livez`` and ``/readyz`` are asked all the time by another process; the promise is 100 ms at the 99th
percentile and 1 s at most. 50 clients of one address saturate robust questions and uploads, while another
address asks a small question: its 99th percentile may be 5 times that of the idle server, or 100 ms. Memory
is the server's resident set: before, at most, and a minute after the last attack.

``--bodies`` makes the large bodies smaller (megabytes), ``--seconds`` each attack shorter.
"""

from __future__ import annotations

import argparse
import json
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import httpx
import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "support"))

from attack import RealServer, Seen, real_server, witness

HEALTH = ("/livez", "/readyz")
JSON = {"Content-Type": "application/json"}
ROW = b'{"position":[0.0,0.01,0.09],"quaternion_xyzw":[1,0,0,0],"outcome":true}'
SMALL = "/objects/small/best-grasp"
MIB = 2**20


def columns(count: int, share: float) -> dict[str, Any]:
    """Made-up trials about one grasp."""
    rng = np.random.default_rng(0)
    turns = rng.normal((1, 0, 0, 0), 0.2, (count, 4))
    return {
        "position": rng.normal(0, 0.02, (count, 3)).tolist(),
        "quaternion_xyzw": (turns / np.linalg.norm(turns, axis=1)[:, None]).tolist(),
        "outcome": (rng.random(count) < share).tolist(),
    }


def rows(server: RealServer, size: int) -> None:
    """One body of many trials."""
    body = b'{"trials":[' + b",".join([ROW] * min(size // len(ROW), 1_000_000)) + b"]}"
    httpx.post(f"{server.url}/objects/mug/trials", content=body, headers=JSON, timeout=900).raise_for_status()


def lists(server: RealServer, size: int) -> None:
    """Bodies of empty lists, where they are read and where they are refused."""
    body = b'{"id":"x","metadata":{"a":[' + b"[]," * (size // 3) + b"[]]}}"
    for path in ("/objects", "/objects/mug/trials", "/objects/mug/likelihood"):
        with suppress(httpx.TransportError):
            httpx.post(f"{server.url}{path}", content=body, headers=JSON, timeout=900)


def bodies(server: RealServer, size: int) -> None:
    """30 bodies that are held back before their last byte."""
    url = httpx.URL(server.url)
    head = f"POST /objects/mug/trials HTTP/1.1\r\nHost: x\r\nContent-Length: {size}\r\n\r\n".encode()
    with ExitStack() as stack:
        for _ in range(30):
            connection = stack.enter_context(socket.create_connection((url.host, url.port), timeout=2))
            with suppress(OSError):
                connection.sendall(head)
                for _ in range(size // MIB - 1):
                    connection.sendall(b" " * MIB)


def crowd(server: RealServer, seconds: float) -> None:
    """50 clients of one address: robust questions and uploads."""
    end = time.monotonic() + seconds
    noise = {"objective": "robust", "pose_noise_m": 0.01, "pose_noise_deg": 10, "count": 10}
    batch = {"columns": columns(5_000, 0.5)}

    def one(number: int) -> None:
        with httpx.Client(base_url=server.url, timeout=300) as http:
            while time.monotonic() < end:
                with suppress(httpx.TransportError):
                    if number % 5:
                        http.post("/objects/large/best-grasp", json=noise)
                    else:
                        http.post("/objects/mug/trials", json=batch)

    threads = [threading.Thread(target=one, args=(number,)) for number in range(50)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def told(name: str, found: Seen) -> str:
    """A path's times in milliseconds."""
    p50, p99 = 1e3 * found.share(0.5), 1e3 * found.share(0.99)
    return f"{name:<22}{p50:>8.1f}{p99:>9.1f}{1e3 * found.seconds[-1]:>9.1f}{len(found.other):>8}"


def main() -> None:
    """Attack, and print what the others saw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bodies", type=int, default=250, help="megabytes of a large body")
    parser.add_argument("--seconds", type=float, default=40.0, help="how long clients crowd the server")
    given = parser.parse_args()
    size = given.bodies * MIB
    with tempfile.TemporaryDirectory() as folder, real_server(Path(folder)) as server:
        with httpx.Client(base_url=server.url, timeout=300) as http:
            for name, count in (("mug", 100), ("small", 400), ("large", 100_000)):
                http.post("/objects", json={"id": name})
                http.post(f"/objects/{name}/trials", json={"columns": columns(count, 0.6)}).raise_for_status()
                http.get(f"/objects/{name}/best-grasp").raise_for_status()
        time.sleep(5.0)
        before = server.megabytes()
        with witness(server.url, SMALL, source="127.0.0.2") as alone:
            time.sleep(10.0)
        print(f"{'ms':<22}{'p50':>8}{'p99':>9}{'max':>9}{'not 200':>8}")
        print(told("small question, alone", alone[SMALL]), flush=True)
        attacks: list[tuple[str, Callable[[RealServer, Any], None], Any]] = [
            ("lists", lists, size),
            ("rows", rows, size),
            ("30 bodies held back", bodies, size),
            ("50 clients", crowd, given.seconds),
        ]
        for name, attack, amount in attacks:
            with (
                witness(server.url, *HEALTH) as seen,
                witness(server.url, SMALL, source="127.0.0.2") as other,
            ):
                attack(server, amount)
            print(f"-- {name}, memory at most so far {server.megabytes('VmHWM'):,.0f} MiB")
            for path in HEALTH:
                print(told(path, seen[path]))
            print(told("another's question", other[SMALL]), flush=True)
        ratio = other[SMALL].share(0.99) / alone[SMALL].share(0.99)
        print(
            f"another client's p99 among 50: {ratio:.1f} times its p99 alone (or 100 ms, whichever is larger)"
        )
        time.sleep(60.0)
        print(json.dumps({"MiB before": round(before), "a minute later": round(server.megabytes())}))


if __name__ == "__main__":
    main()
