"""What the link itself costs: delay that it adds, and what it lets through.

python tests/network/link_cost.py
"""

import json
import socket
import statistics
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from link import Link, inside

PORT = 7999
SECONDS = 3.0


def answer() -> None:
    """Send back every datagram; count the bytes of a stream."""
    datagrams = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    datagrams.bind(("0.0.0.0", PORT))
    listener = socket.create_server(("0.0.0.0", PORT))
    print("ready", flush=True)
    while True:
        data, sender = datagrams.recvfrom(2048)
        datagrams.sendto(data, sender)
        if data == b"stream":
            break
    stream, _ = listener.accept()
    while stream.recv(1 << 16):
        pass


def ask(address: str) -> None:
    """Round trips at 200 Hz, then as many bytes as go through."""
    datagrams = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    datagrams.settimeout(1.0)
    trips = []
    for _ in range(400):
        begun = time.perf_counter()
        datagrams.sendto(bytes(600), (address, PORT))
        datagrams.recv(2048)
        trips.append(time.perf_counter() - begun)
        time.sleep(0.005)
    datagrams.sendto(b"stream", (address, PORT))
    datagrams.recv(2048)
    stream = socket.create_connection((address, PORT))
    begun, sent = time.monotonic(), 0
    while time.monotonic() - begun < SECONDS:
        sent += stream.send(bytes(1 << 16))
    trips.sort()
    print(
        json.dumps(
            {
                "round_trip_p50_ms": 1e3 * statistics.median(trips),
                "round_trip_p99_ms": 1e3 * trips[int(0.99 * len(trips))],
                "mbit_per_s": 8e-6 * sent / SECONDS,
            }
        )
    )


def measure(link: Link, loopback: bool = False) -> dict[str, float]:
    """Through the link, or over the loopback of one of its ends for comparison."""
    python = (sys.executable, __file__)
    server = subprocess.Popen(inside(link.second, *python, "answer"), stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    server.stdout.readline()
    here, address = (link.second, "127.0.0.1") if loopback else (link.first, Link.ADDRESS["second"])
    try:
        done = subprocess.run(inside(here, *python, "ask", address), capture_output=True, text=True, check=True)
    finally:
        server.kill()
        server.communicate()
    return dict(json.loads(done.stdout))


def table() -> str:
    """Both, in words."""
    with Link() as link:
        plain, through = measure(link, loopback=True), measure(link)
        link.both(delay=0.05)
        delayed = measure(link)
        link.heal()
        link.both(rate=1e6)
        slow = measure(link)
    lines = []
    for name, one in (("loopback", plain), ("link", through), ("50 ms each way", delayed), ("1 Mbit/s", slow)):
        lines.append(
            f"| {name} | {one['round_trip_p50_ms']:.2f} / {one['round_trip_p99_ms']:.2f} | {one['mbit_per_s']:.1f} |"
        )
    return "\n".join(["| way | round trip p50 / p99 [ms] | Mbit/s |", "|---|---|---|", *lines])


if __name__ == "__main__":
    if sys.argv[1:2] == ["answer"]:
        answer()
    elif sys.argv[1:2] == ["ask"]:
        ask(sys.argv[2])
    else:
        print(table())
