"""Virtual time of a firmware, by a program that sleeps, reads the clock and hears its sockets as the firmware does."""

import re
import socket
import subprocess
from pathlib import Path

import pytest

from transport.model.kernels import compiler
from transport.plant.firmware import firmware_process
from transport.plant.firmware.firmware_process import FirmwareEndedError, Process

STEP_S = 0.25
# A thread for each socket and one for the command line, as the firmware has them. They and the main loop note in a
# file what happens to them, with the time that they see, ns.
PROGRAM = r"""
#include <arpa/inet.h>
#include <errno.h>
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { COMMANDS = 5761, RAW = 9001, MOTORS = 9002, STATE = 9003, STICKS = 9004 };
static FILE *notes;

static long long clock_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * 1000000000LL + now.tv_nsec;
}

static void sleep_us(long us)
{
    struct timespec period = {us / 1000000, us % 1000000 * 1000};
    nanosleep(&period, NULL);
}

static struct sockaddr_in at(int port)
{
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_port = htons(port)};
    return address;
}

static void *hear(void *port)
{
    struct sockaddr_in address = at((int)(intptr_t)port);
    int descriptor = socket(AF_INET, SOCK_DGRAM, 0);
    bind(descriptor, (struct sockaddr *)&address, sizeof address);
    for (;;) {
        double packet[20];
        uint16_t last;
        fd_set set;
        FD_ZERO(&set);
        FD_SET(descriptor, &set);
        int found = select(descriptor + 1, &set, NULL, NULL, NULL);
        size_t room = (intptr_t)port == STATE ? 2 * sizeof *packet : sizeof packet;
        packet[2] = -1.0;
        long size = recvfrom(descriptor, packet, room, 0, NULL, NULL);
        memcpy(&last, (char *)packet + sizeof(double) + 15 * sizeof last, sizeof last);
        if ((intptr_t)port == STATE)
            fprintf(notes, "state %lld %d %ld %g %g\n", clock_ns(), found, size, packet[1], packet[2]);
        else
            fprintf(notes, "sticks %lld %d %ld %d\n", clock_ns(), found, size, last);
        sleep_us(10000000); /* lets no time pass */
    }
    return NULL;
}

static void *command_line(void *none)
{
    struct sockaddr_in address = at(COMMANDS), other = at(5762);
    int second = socket(AF_INET, SOCK_STREAM, 0);
    int descriptor = socket(AF_INET, SOCK_STREAM, 0);
    int refused = bind(second, (struct sockaddr *)&other, sizeof other) ? errno : 0;
    int failed = bind(descriptor, (struct sockaddr *)&address, sizeof address) ? errno : 0;
    fprintf(notes, "commands %d %d\n", refused == EADDRINUSE, failed == EADDRINUSE);
    if (!failed)
        listen(descriptor, 1);
    for (;;) {
        struct timeval long_time = {60, 0};
        char text = '-';
        fd_set set;
        FD_ZERO(&set);
        FD_SET(descriptor, &set);
        int found = select(descriptor + 1, &set, NULL, NULL, &long_time);
        if (found)
            read(accept(descriptor, NULL, NULL), &text, 1);
        fprintf(notes, "commands %lld %d %c\n", clock_ns(), found, text);
    }
    return none;
}

static void *nothing(void *none)
{
    clock_ns(); /* lets no time pass either */
    return none;
}

static void tell(float value, int port, int count)
{
    struct sockaddr_in to = at(port);
    float values[4] = {value, 2 * value, 3 * value, 4 * value};
    long size = sendto(0, values, count * sizeof value, 0, (struct sockaddr *)&to, sizeof to);
    fprintf(notes, "told %ld\n", size);
}

int main(void)
{
    pthread_t thread;
    int signal = 0, more = 0, failed;
    notes = fopen("notes", "w");
    setvbuf(notes, NULL, _IONBF, 0);
    prctl(PR_GET_PDEATHSIG, &signal);
    fprintf(notes, "main %lld signal %d\n", clock_ns(), signal);
    pthread_create(&thread, NULL, hear, (void *)STATE);
    sleep_us(300000); /* nothing is exchanged before both sockets are there */
    pthread_create(&thread, NULL, hear, (void *)STICKS);
    pthread_create(&thread, NULL, command_line, NULL);
    while (!(failed = pthread_create(&thread, NULL, nothing, NULL)))
        more++;
    fprintf(notes, "main %lld threads %d %d\n", clock_ns(), more, failed == EAGAIN);
    sleep_us(199998); /* until 1.5 s, exactly a step */
    tell(0.1, MOTORS, 4);
    tell(0.2, RAW, 4);
    tell(0.3, MOTORS, 3);
    sleep_us(249999); /* until a microsecond before the next one */
    fprintf(notes, "main %lld\n", clock_ns()); /* at that step */
    sleep_us(1050000); /* five more steps */
    fprintf(notes, "main %lld\n", clock_ns());
    return 5;
}
"""
# As a program with a command line notes it; a client speaks before the third of six steps.
NOTES = """\
main 1000001000 signal 9
commands 1 0
main 1300002000 threads 5 1
state 1500000000 1 144 0 -1
commands 1500000000 0 -
told 16
told 16
told 12
main 1750000000
state 1750000000 1 144 1 -1
sticks 1750000000 1 40 1501
commands 1750000000 0 -
state 2000000000 1 144 2 -1
commands 2000000000 1 a
state 2250000000 1 144 3 -1
sticks 2250000000 1 40 1503
commands 2250000000 0 -
state 2500000000 1 144 4 -1
commands 2500000000 0 -
state 2750000000 1 144 5 -1
sticks 2750000000 1 40 1505
commands 2750000000 0 -
main 2800001000
"""
# Without a command line its port is refused too, and its thread does not run again.
WITHOUT_COMMANDS = re.sub("commands .{10} .*\n", "", NOTES).replace("commands 1 0", "commands 1 1")


@pytest.fixture(autouse=True)
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The program in place of the firmware."""
    cc = compiler.find_compiler()
    if cc is None:
        pytest.skip("no C compiler")
    source, made = tmp_path / "program.c", tmp_path / "program"
    source.write_text(PROGRAM)
    build = [cc, "-O1", "-w", "-o", str(made), str(source), "-lpthread"]
    subprocess.run(build, check=True, timeout=60)
    monkeypatch.setattr(firmware_process, "executable", lambda: made)


@pytest.mark.parametrize("has_commands", [True, False])
def test_it_is_the_same_whatever_the_host(tmp_path: Path, has_commands: bool) -> None:
    """Time passes by sleeping and by readings of the clock, 1 us each; at each step there is one exchange of packets.

    Threads run there, and see its instant. Motor outputs are those told last; channels are heard with the steps that
    have them. A program that ends is told.
    """
    with socket.socket(socket.AF_UNIX) as listener, socket.socket(socket.AF_UNIX) as client:
        listener.bind(str(tmp_path / "commands"))
        listener.listen()
        process = Process(tmp_path, STEP_S, listener if has_commands else None)
        told = []
        for step in range(6):
            told.append(process.outputs())
            if step == 2:
                client.connect(str(tmp_path / "commands"))
                client.send(b"a")
            process.give([step, *[0.0] * 9], [1500 + step] * 16 if step % 2 else None)
        with pytest.raises(FirmwareEndedError, match="exit code 5"):
            process.outputs()
        process.end()
    assert told == [(0.0,) * 4, *[pytest.approx((0.1, 0.2, 0.3, 0.4))] * 5]
    expected = NOTES if has_commands else WITHOUT_COMMANDS
    assert (tmp_path / "notes").read_text() == expected


@pytest.mark.parametrize("direction", [socket.SHUT_RD, socket.SHUT_WR])
def test_it_ends_in_order_with_its_simulation(tmp_path: Path, direction: int) -> None:
    """One that takes no more outputs or gives no more states: the program does not go on without it."""
    process = Process(tmp_path, STEP_S)
    process.outputs()
    process.give()
    process.outputs()
    process._socket.shutdown(direction)
    if direction == socket.SHUT_RD:
        process.give()
    assert process._process.wait(timeout=10.0) == 0
    process.end()
    states = (tmp_path / "notes").read_text().count("state")
    assert states == (2 if direction == socket.SHUT_RD else 1)
