"""Virtual time of a firmware, by a program that sleeps, reads the clock and hears its sockets as the firmware does."""

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from transport.model.kernels import compiler
from transport.plant.firmware import firmware_process
from transport.plant.firmware.firmware_process import FirmwareEndedError, Process

STEP_S = 1e-3
# The main loop sleeps for a period and tells four outputs. A thread for each socket keeps what comes there, and the
# thread of states when: its motors are the first measurement, the time of the thread from the start, ms, that of the
# main loop beyond it, us, and the last channel.
PROGRAM = r"""
#include <arpa/inet.h>
#include <pthread.h>
#include <stdint.h>
#include <string.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <time.h>

static float motors[4];
static int64_t thread_ns;

static int64_t clock_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

static struct sockaddr_in at(int port)
{
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_port = htons(port)};
    return address;
}

static int bound(int port)
{
    struct sockaddr_in address = at(port);
    int descriptor = socket(AF_INET, SOCK_DGRAM, 0);
    return bind(descriptor, (struct sockaddr *)&address, sizeof address) ? -1 : descriptor;
}

static void *hear(void *port)
{
    int descriptor = bound((int)(intptr_t)port);
    double packet[18];
    for (;;) {
        fd_set set;
        FD_ZERO(&set);
        FD_SET(descriptor, &set);
        if (select(descriptor + 1, &set, NULL, NULL, NULL) != 1)
            continue;
        recvfrom(descriptor, packet, sizeof packet, 0, NULL, NULL);
        if ((intptr_t)port == 9003) {
            thread_ns = clock_ns();
            motors[0] = packet[1];
        } else {
            uint16_t last;
            memcpy(&last, (char *)packet + sizeof(double) + 15 * sizeof last, sizeof last);
            motors[3] = last;
        }
    }
    return NULL;
}

int main(void)
{
    pthread_t threads[2];
    struct sockaddr_in to = at(9002);
    int descriptor = socket(AF_INET, SOCK_DGRAM, 0);
    int64_t start_ns = clock_ns();
    pthread_create(&threads[0], NULL, hear, (void *)9003);
    pthread_create(&threads[1], NULL, hear, (void *)9004);
    for (int turn = 0; turn < 4; turn++) {
        struct timespec period = {0, 1000000};
        nanosleep(&period, NULL);
        motors[1] = (thread_ns - start_ns) / 1e6;
        motors[2] = (clock_ns() - thread_ns) / 1e3;
        sendto(descriptor, motors, sizeof motors, 0, (struct sockaddr *)&to, sizeof to);
    }
    return 5;
}
"""


@pytest.fixture
def process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Process]:
    """The program in virtual time."""
    cc = compiler.find_compiler()
    if cc is None:
        pytest.skip("no C compiler")
    (tmp_path / "program.c").write_text(PROGRAM)
    program = tmp_path / "program"
    build = [cc, "-O1", "-o", str(program), str(tmp_path / "program.c"), "-lpthread"]
    subprocess.run(build, check=True, timeout=60)
    monkeypatch.setattr(firmware_process, "executable", lambda: program)
    made = Process(tmp_path, STEP_S)
    yield made
    made.end()


def test_time_passes_by_steps_and_by_readings_of_the_clock_alone(process: Process) -> None:
    """Threads see the instant of the step; the main loop is a microsecond later for each of its readings.

    Channels are heard with the steps that have them. A program that ends is told.
    """
    assert process.outputs() == (0.0, 0.0, 0.0, 0.0)
    for turn, channel in enumerate((None, 1500, None), start=1):
        channels = None if channel is None else [1000] * 15 + [channel]
        process.give([0.5 * turn, *[0.0] * 9], channels)
        gyro, thread_ms, beyond_us, last = process.outputs()
        assert thread_ms == pytest.approx(turn, abs=2e-3)
        assert beyond_us == pytest.approx(turn + 1, abs=1e-3)
        assert (gyro, last) == (0.5 * turn, 1500.0 if turn >= 2 else 0.0)
    process.give()
    with pytest.raises(FirmwareEndedError, match="exit code 5"):
        process.outputs()
