"""Domains and ports that runs beside each other do not share."""

from __future__ import annotations

import socket
import subprocess
import sys
from contextlib import ExitStack, suppress
from pathlib import Path

from l2lidar_node.demo.processes import Program, free_udp_ports
from tests.support.processes import ended_with_the_test

ROOT = Path(__file__).parents[3]
TAKER = """
import sys
from l2lidar_node.demo import processes
if sys.argv[1:]:
    processes._LAST_DOMAIN = int(sys.argv[1])
try:
    print(processes.free_ros_domain(), *processes.free_udp_ports(50), flush=True)
except OSError as error:
    print(error, flush=True)
sys.stdin.read()
"""


def taker(*arguments: str) -> subprocess.Popen[str]:
    """Start a process that takes a domain and some ports until its input ends."""
    process = subprocess.Popen(
        [sys.executable, "-c", TAKER, *arguments],
        cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    return ended_with_the_test(process)


def said(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def test_a_program_that_says_much_does_not_stop_at_a_full_pipe() -> None:
    program = Program("dis", [str(ROOT / "l2lidar_node" / "clock" / "lower_envelope.py")])
    assert program._process.wait(timeout=60) == 0
    code, said = program.stop()
    assert code == 0
    assert len(said) > 1 << 16  # what a pipe holds
    assert len(program.lines) <= 2_000
    assert "RETURN_" in program.lines[-1]  # VALUE, or CONST since Python 3.12


def test_processes_beside_each_other_have_domains_and_ports_of_their_own() -> None:
    running = [taker() for _ in range(4)]
    taken = [[int(word) for word in said(process).split()] for process in running]
    domains = [domain for domain, *_ in taken]
    ports = [port for _, *ports in taken for port in ports]
    assert len(set(domains)) == len(domains)
    assert len(set(ports)) == len(ports) == 4 * 50
    assert set(ports).isdisjoint(free_udp_ports(50))
    for process in running:
        process.communicate("", timeout=60)


def test_a_domain_with_a_node_of_another_program_is_left_out() -> None:
    """A node without a claim is known by the port at which DDS listens (DDSI-RTPS 9.6.1.1)."""
    with ExitStack() as stack:
        for domain in (1, 2, 3):
            node = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            with suppress(OSError):  # there is a node already
                node.bind(("127.0.0.1", 7410 + 250 * domain))
        process = taker("3")
        assert "from 1 to 3 are in use" in said(process)
        process.communicate("", timeout=60)
